"""The journal of one run: every evaluated batch, appended and synced before the search continues.

A journal is a file of frames: magic, length and CRC-32 of a payload, then the payload in MessagePack. The first frame names the
study and the run; the last frame of a finished run holds its result. A torn tail, left by a killed process or a full disk, is cut
off; damage before intact frames is an error.
"""

from __future__ import annotations

import errno
import os
import re
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, NamedTuple

import msgspec
import numpy as np
import portalocker

from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.results.files import make_synced_directory, sync_directory
from safevar_sumo.study import refuse_other_than_file

FORMAT = 2
READABLE_FORMATS = (1, FORMAT)
MAGIC = b"SVJ\n"
FRAME_HEAD = struct.Struct("<4sII")
OUTCOME_CODES = {
    Outcome.STOPPED: 0, Outcome.PASSED: 1, Outcome.COLLISION: 2, Outcome.TIMEOUT: 3, Outcome.NEVER_MOVED: 4, Outcome.SIMULATOR_ERROR: 5,
    Outcome.INVALID_TEST: 6, Outcome.INFEASIBLE: 7}
"""Codes of outcomes in journals; a code never changes its meaning."""
_OUTCOME_BY_CODE = {code: outcome.value for outcome, code in OUTCOME_CODES.items()}
NON_METRIC_COLUMNS = ("collision_speed", "f_diff", "f_num_diff")
SPARE_POSITION = -1
"""Position of an evaluation that the search has not requested yet, or not again after `Retry`."""


class Owner(msgspec.Struct, frozen=True, tag="owner"):
    """The owner of a journal: the digest of the study's identity, and the run's name."""

    format: int
    study: str
    run: str


class Batch(msgspec.Struct, frozen=True, tag="batch", omit_defaults=True):
    """Evaluations: their `positions` in the run (int32), `numbers` as columns of float64, and the `reasons` of failed rows by row."""

    positions: bytes
    outcome: bytes
    settings: bytes
    numbers: dict[str, bytes]
    reasons: dict[int, str] = {}


class Result(msgspec.Struct, frozen=True, tag="result", omit_defaults=True):
    """Solutions of a run by `positions` of their evaluations; the run requested `asked` of `budget` evaluations (format 1: budget 0)."""

    positions: list[int]
    asked: int
    budget: int = 0


class Retry(msgspec.Struct, frozen=True, tag="retry"):
    """Discards all earlier failed evaluations; evaluations after the first failure become `SPARE_POSITION`."""


JournalFrame = Owner | Batch | Result | Retry


class JournalContent(NamedTuple):
    """The contents of a journal: evaluations, or None; their positions, results by budget, and the size of a torn tail [bytes]."""

    positions: list[int]
    evaluations: Evaluations | None
    results: Mapping[int, Result]
    tail_size: int = 0

    def result(self, budget: int) -> Result | None:
        """The result of the run with a budget of evaluations; None if it is unfinished."""
        return self.results.get(budget, self.results.get(0))

    def take_positions(self, positions: list[int]) -> Evaluations:
        """The evaluations at `positions`, in this order."""
        assert self.evaluations is not None
        row_of = {position: row for row, position in enumerate(self.positions)}
        return self.evaluations.take([row_of[position] for position in positions])

    def requested_within(self, budget: int) -> Evaluations | None:
        """The evaluations that a run with this budget requested; None if there is none."""
        if self.evaluations is None:
            return None
        return self.evaluations.take(np.array([0 <= position < budget for position in self.positions], dtype=bool))


def encode_frame(frame: JournalFrame) -> bytes:
    """Magic, length, CRC-32 and payload of a frame."""
    payload = msgspec.msgpack.encode(frame)
    return FRAME_HEAD.pack(MAGIC, len(payload), zlib.crc32(payload)) + payload


def make_batch(positions: list[int], evaluations: Evaluations) -> Batch:
    """Make the frame that holds a batch of evaluations."""
    numbers = {**{name: getattr(evaluations, name) for name in NON_METRIC_COLUMNS}, **evaluations.metrics}
    reasons = {row: evaluations.reasons[setting.tobytes()] for row, setting in enumerate(evaluations.settings)
               if setting.tobytes() in evaluations.reasons}
    return Batch(
        positions=np.array(positions, dtype="<i4").tobytes(),
        outcome=bytes(OUTCOME_CODES[outcome] for outcome in evaluations.outcome.tolist()),
        settings=evaluations.settings.astype("<f8").tobytes(),
        numbers={name: values.astype("<f8").tobytes() for name, values in numbers.items()}, reasons=reasons)


def decode_frames(data: bytes, path: Path) -> tuple[list[JournalFrame], int]:
    """All intact frames, and the offset at which the last frame ends.

    Raises
    ------
    InputError
        If a frame is damaged and intact frames follow it.
    """
    frames: list[JournalFrame] = []
    offset = 0
    while offset < len(data):
        frame, end = _decode_frame_at(data, offset, path)
        if frame is None:
            if any(_decode_frame_at(data, match.start(), path)[0] is not None for match in re.compile(MAGIC).finditer(data, offset + 1)):
                raise InputError(path, f"is damaged at byte {offset}, and intact frames follow",
                                 "restore the file, or remove it to simulate the run again")
            break
        frames.append(frame)
        offset = end
    return frames, offset


def content_of(frames: list[JournalFrame]) -> JournalContent:
    """The contents of a journal from its frames in order."""
    positions: list[int] = []
    batches: list[Evaluations] = []
    results: dict[int, Result] = {}
    for frame in frames:
        if isinstance(frame, Batch):
            positions += np.frombuffer(frame.positions, dtype="<i4").tolist()
            batches.append(_evaluations_of(frame))
        elif isinstance(frame, Result):
            results[frame.budget] = frame
        elif isinstance(frame, Retry) and batches:
            positions, remaining_evaluations = _drop_failures(positions, Evaluations.concatenate(batches))
            batches, results = [remaining_evaluations], {}
    return JournalContent(positions, Evaluations.concatenate(batches) if positions else None, results)


def _drop_failures(positions: list[int], evaluations: Evaluations) -> tuple[list[int], Evaluations]:
    """Positions and evaluations that a run keeps when its failed settings are simulated again."""
    has_succeeded = ~evaluations.failed
    pairs = list(zip(positions, has_succeeded, strict=True))
    first_failure = min((position for position, success in pairs if not success), default=max(positions) + 1)
    new_positions = [position if position < first_failure else SPARE_POSITION for position, success in pairs if success]
    return new_positions, evaluations.take(has_succeeded)


def _decode_frame_at(data: bytes, offset: int, path: Path) -> tuple[JournalFrame | None, int]:
    if offset + FRAME_HEAD.size > len(data):
        return None, offset
    magic, length, checksum = FRAME_HEAD.unpack_from(data, offset)
    payload = data[offset + FRAME_HEAD.size:offset + FRAME_HEAD.size + length]
    if magic != MAGIC or len(payload) != length or zlib.crc32(payload) != checksum:
        return None, offset
    try:
        return msgspec.msgpack.decode(payload, type=JournalFrame), offset + FRAME_HEAD.size + length
    except msgspec.DecodeError as error:
        raise InputError(path, f"holds at byte {offset} a frame of another version: {error}", "the version that wrote it") from None


def _evaluations_of(batch: Batch) -> Evaluations:
    numbers = {name: _decode_floats(values) for name, values in batch.numbers.items()}
    speed, f_diff, f_num_diff = (numbers.pop(name) for name in NON_METRIC_COLUMNS)
    outcome = np.array([_OUTCOME_BY_CODE[code] for code in batch.outcome], dtype="U16")
    settings = _decode_floats(batch.settings).reshape(len(outcome), -1)
    reasons = {settings[row].tobytes(): reason for row, reason in batch.reasons.items()}
    return Evaluations(settings=settings, outcome=outcome, metrics=numbers, reasons=reasons, collision_speed=speed, f_diff=f_diff,
                       f_num_diff=f_num_diff)


def _decode_floats(values: bytes) -> FloatArray:
    return np.frombuffer(values, dtype="<f8").astype(float)


class JournalBusyError(SafevarError):
    """Another live process works on this run."""


class Journal:
    """An open, locked journal; the lock ends with the process.

    Parameters
    ----------
    path
        The file, made if it does not exist. A journal without evaluations passes to this owner.
    study, run
        Owner of the journal.

    Attributes
    ----------
    content
        The journal's contents when it was opened.
    cut_bytes
        Number of bytes of a torn tail that were cut off.

    Raises
    ------
    JournalBusyError
        If another live process works on the run.
    InputError
        If the journal belongs to another study or is damaged before its tail; the error names file and offset.
    """

    def __init__(self, path: Path, study: str, run: str) -> None:
        self.path, self.cut_bytes = path, 0
        self._file = _open_and_lock(path)
        try:
            self.content = self._read_and_claim(Owner(format=FORMAT, study=study, run=run))
        except OSError as error:
            self.close()
            raise SafevarError(f"{path}: cannot be read: {error.strerror}; earlier data stays valid") from None
        except BaseException:
            self.close()
            raise

    def append(self, positions: list[int], evaluations: Evaluations) -> None:
        """Add a batch and sync it to the disk."""
        self._write(make_batch(positions, evaluations))

    def finish(self, positions: list[int], asked: int, budget: int) -> None:
        """Add the result: the positions of the solutions, the number of evaluations that the run asked for, and its budget."""
        self._write(Result(positions=positions, asked=asked, budget=budget))

    def retry(self) -> None:
        """Drop failed evaluations, and results based on them."""
        self._write(Retry())
        self._file.seek(0)
        self.content = content_of(decode_frames(self._file.read(), self.path)[0])

    def close(self) -> None:
        """Release the lock."""
        self._file.close()

    def _read_and_claim(self, owner: Owner) -> JournalContent:
        """Read the contents, cut off a torn tail, and write the owner into a journal without evaluations."""
        data = self._file.read()
        size = len(data)
        frames, end = decode_frames(data, self.path)
        if not frames and data.strip(b"\0") and not data.startswith(MAGIC[:len(data)]):
            raise InputError(self.path, "is no journal", "another `out`")
        if frames and frames[0] != owner:
            if any(isinstance(frame, Batch) for frame in frames):
                raise _owner_error(self.path, frames[0], owner, "another `out`")
            frames, end, size = [], 0, 0
            self._truncate(0)
        if end < size:
            self.cut_bytes = size - end
            self._truncate(end)
        if not frames:
            self._write(owner)
            sync_directory(self.path.parent)
        return content_of(frames)

    def _write(self, frame: JournalFrame) -> None:
        start = self._file.tell()
        try:
            remainder = memoryview(encode_frame(frame))
            while remainder:
                remainder = remainder[self._file.write(remainder):]
            os.fsync(self._file.fileno())
            if not self.path.exists():
                raise OSError(errno.ENOENT, "the file is gone")
        except OSError as error:
            self._undo(start)
            raise SafevarError(f"{self.path}: cannot be written: {error.strerror}; earlier data stays valid") from None

    def _undo(self, start: int) -> None:
        """Cut off a half-written frame; if that fails too, the next reader cuts it off."""
        try:
            self._truncate(start)
        except OSError:
            return

    def _truncate(self, end: int) -> None:
        self._file.truncate(end)
        self._file.seek(end)


def read_journal(path: Path, study: str, run: str) -> JournalContent:
    """The contents of a journal that another process may be writing.

    Raises
    ------
    InputError
        If the journal cannot be read, is damaged, or belongs to another study or run.
    """
    frames, tail_size = _read_frames(path)
    if frames and not (isinstance(frames[0], Owner) and frames[0].format in READABLE_FORMATS):
        raise InputError(path, "is of a format that this version does not read", "the version that wrote it")
    owner = Owner(format=FORMAT, study=study, run=run)
    if frames and frames[0] not in [msgspec.structs.replace(owner, format=number) for number in READABLE_FORMATS]:
        raise _owner_error(path, frames[0], owner, "only journals of this study")
    return content_of(frames)._replace(tail_size=tail_size)


def _owner_error(path: Path, frame: JournalFrame, owner: Owner, expected: str) -> InputError:
    """The error for a journal that begins with another frame than its owner."""
    if isinstance(frame, Owner) and frame.study == owner.study and frame.run != owner.run:
        problem = f"is the journal of run {frame.run}, not of {owner.run}: was it renamed or swapped?"
        return InputError(path, problem, f"the journal of {owner.run}")
    return InputError(path, "belongs to another study or version", expected)


def owner_of(path: Path) -> str | None:
    """The digest of a journal's study; None until the process that opened the journal has written its owner."""
    frames, _ = _read_frames(path)
    return frames[0].study if frames and isinstance(frames[0], Owner) else None


def _read_frames(path: Path) -> tuple[list[JournalFrame], int]:
    """The frames of a journal, and the number of bytes of a torn tail after them."""
    try:
        refuse_other_than_file(path)
        data = path.read_bytes()
        frames, end = decode_frames(data, path)
        return frames, len(data) - end
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror}") from None


def _open_and_lock(path: Path) -> IO[bytes]:
    try:
        refuse_other_than_file(path)
        make_synced_directory(path.parent)
        file = open(path, "a+b", buffering=0)  # noqa: SIM115
    except OSError as error:
        raise SafevarError(f"{path}: cannot be opened: {error.strerror}") from None
    try:
        portalocker.lock(file, portalocker.LOCK_EX | portalocker.LOCK_NB)
    except portalocker.AlreadyLocked:
        file.close()
        raise JournalBusyError(f"{path}: another process works on this run") from None
    except portalocker.LockException as error:
        file.close()
        raise SafevarError(f"{path}: cannot be locked: {error.strerror or error}; results need a disk whose files can be locked") from None
    file.seek(0)
    return file
