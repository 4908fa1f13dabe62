"""The journal of one run: every evaluated batch, appended and synced before the search goes on.

A journal is a file of frames: magic, length and CRC-32 of a payload, then the payload in MessagePack. The first
frame tells whose journal it is, the last one of a finished run which evaluations are its result. A torn tail, as a
kill or a full disk leaves it, is cut off; damage before intact frames is an error.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import msgspec
import numpy as np
import portalocker

from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.records import Evaluations, FloatArray, Outcome

FORMAT = 1
MAGIC = b"SVJ\n"
HEAD = struct.Struct("<4sII")
OUTCOMES = list(Outcome)
_CODE = {outcome.value: code for code, outcome in enumerate(OUTCOMES)}


class _Owner(msgspec.Struct, frozen=True, tag="owner"):
    """Whose journal this is."""

    format: int
    study: str
    run: str


class _Batch(msgspec.Struct, frozen=True, tag="batch"):
    """Evaluations; `positions` (int32) are their places in the run's order, numbers are float64 by column."""

    positions: bytes
    outcome: bytes
    settings: bytes
    numbers: dict[str, bytes]


class _Result(msgspec.Struct, frozen=True, tag="result"):
    """The result of a finished run by the positions of its evaluations, and how many the run asked for."""

    positions: list[int]
    asked: int


_Frame = _Owner | _Batch | _Result


class JournalBusy(SafevarError):
    """Another live process works on this run."""


class Journal:
    """An open, locked journal; a dead process's lock is gone with it.

    Parameters
    ----------
    path
        The file; it is made if it does not exist.
    study, run
        Whose journal it is.

    Attributes
    ----------
    positions, evaluations
        What it held when it was opened; None if there was nothing.
    result
        Positions of the result, None while the run is unfinished.
    asked
        How many evaluations the finished run asked for.
    cut
        How many bytes of a torn tail were cut off.

    Raises
    ------
    JournalBusy
        If another live process works on the run.
    InputError
        If it belongs to another study or is damaged before its tail; names file and offset.
    """

    def __init__(self, path: Path, study: str, run: str) -> None:
        self.path, self.cut = path, 0
        self._file = _opened(path)
        try:
            self.positions, self.evaluations, self.result, self.asked = self._take_in(study, run)
        except BaseException:
            self.close()
            raise

    def append(self, positions: list[int], evaluations: Evaluations) -> None:
        """Add a batch and sync it to the disk."""
        numbers = {"collision_speed": evaluations.collision_speed, "f_diff": evaluations.f_diff, "f_num_diff": evaluations.f_num_diff,
                   **evaluations.metrics}
        self._write(_Batch(
            positions=np.array(positions, dtype="<i4").tobytes(), outcome=bytes(_CODE[str(one)] for one in evaluations.outcome),
            settings=evaluations.settings.astype("<f8").tobytes(),
            numbers={name: values.astype("<f8").tobytes() for name, values in numbers.items()}))

    def finish(self, positions: list[int], asked: int) -> None:
        """Add the result."""
        self._write(_Result(positions=positions, asked=asked))

    def close(self) -> None:
        """Give the lock back."""
        self._file.close()

    def _take_in(self, study: str, run: str) -> tuple[list[int], Evaluations | None, list[int] | None, int]:
        size = os.fstat(self._file.fileno()).st_size
        frames, end = read_frames(self._file.read(), self.path)
        if end < size:
            self.cut = size - end
            self._file.truncate(end)
            self._file.seek(end)
        if not frames:
            self._write(_Owner(format=FORMAT, study=study, run=run))
        elif frames[0] != _Owner(format=FORMAT, study=study, run=run):
            raise InputError(self.path, f"belongs to another study, run or version: {frames[0]}", "another --out")
        positions, evaluations = merged(frames)
        result = next((frame for frame in frames if isinstance(frame, _Result)), None)
        return positions, evaluations, result.positions if result else None, result.asked if result else 0

    def _write(self, frame: _Frame) -> None:
        payload = msgspec.msgpack.encode(frame)
        start = self._file.tell()
        try:
            rest = memoryview(HEAD.pack(MAGIC, len(payload), zlib.crc32(payload)) + payload)
            while rest:
                rest = rest[self._file.write(rest):]
            os.fsync(self._file.fileno())
            if not self.path.exists():
                raise OSError(2, "the file is gone")
        except OSError as error:
            self._undo(start)
            raise SafevarError(f"{self.path}: cannot be written: {error.strerror}; what was written before stays valid") from None

    def _undo(self, start: int) -> None:
        """Cut a half-written frame off again; where that fails too, the next reader does it."""
        try:
            self._file.truncate(start)
            self._file.seek(start)
        except OSError:
            return


def read_journal(path: Path) -> tuple[list[int], Evaluations | None, list[int] | None]:
    """Positions, evaluations and the result's positions of a journal that somebody may still write to."""
    try:
        frames, _ = read_frames(path.read_bytes(), path)
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror}") from None
    positions, evaluations = merged(frames)
    return positions, evaluations, next((frame.positions for frame in frames if isinstance(frame, _Result)), None)


def read_frames(data: bytes, path: Path) -> tuple[list[_Frame], int]:
    """All intact frames, and where the last of them ends.

    Raises
    ------
    InputError
        If a frame is damaged and intact ones follow it.
    """
    frames: list[_Frame] = []
    offset = 0
    while offset < len(data):
        frame, end = _frame_at(data, offset)
        if frame is None:
            if any(_frame_at(data, later)[0] is not None for later in _occurrences(data, offset + 1)):
                raise InputError(path, f"is damaged at byte {offset}, and intact frames follow",
                                 "restore the file, or remove it to simulate the run again")
            break
        frames.append(frame)
        offset = end
    return frames, offset


def merged(frames: list[_Frame]) -> tuple[list[int], Evaluations | None]:
    """The evaluations of all batches, and their positions."""
    batches = [frame for frame in frames if isinstance(frame, _Batch)]
    positions = [position for batch in batches for position in np.frombuffer(batch.positions, dtype="<i4").tolist()]
    return positions, Evaluations.concatenate([_unpacked(batch) for batch in batches]) if batches else None


def _opened(path: Path) -> IO[bytes]:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = open(path, "a+b", buffering=0)  # noqa: SIM115
    except OSError as error:
        raise SafevarError(f"{path}: cannot be opened: {error.strerror}") from None
    try:
        portalocker.lock(file, portalocker.LOCK_EX | portalocker.LOCK_NB)
    except portalocker.LockException:
        file.close()
        raise JournalBusy(f"{path}: another process works on this run") from None
    file.seek(0)
    return file


def _frame_at(data: bytes, offset: int) -> tuple[_Frame | None, int]:
    if offset + HEAD.size > len(data):
        return None, offset
    magic, length, checksum = HEAD.unpack_from(data, offset)
    payload = data[offset + HEAD.size:offset + HEAD.size + length]
    if magic != MAGIC or len(payload) != length or zlib.crc32(payload) != checksum:
        return None, offset
    return msgspec.msgpack.decode(payload, type=_Frame), offset + HEAD.size + length


def _occurrences(data: bytes, start: int) -> Iterator[int]:
    """Where the magic stands after `start`."""
    found = data.find(MAGIC, start)
    while found >= 0:
        yield found
        found = data.find(MAGIC, found + 1)


def _unpacked(batch: _Batch) -> Evaluations:
    numbers = {name: _floats(values) for name, values in batch.numbers.items()}
    named = {name: numbers.pop(name) for name in ("collision_speed", "f_diff", "f_num_diff")}
    outcome = np.array([OUTCOMES[code].value for code in batch.outcome], dtype="U16")
    return Evaluations(settings=_floats(batch.settings).reshape(len(outcome), -1), outcome=outcome, metrics=numbers, **named)


def _floats(values: bytes) -> FloatArray:
    return np.frombuffer(values, dtype="<f8").astype(float)
