"""What a journal is made of: frames of magic, length and CRC-32 of a payload, then the payload in MessagePack."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.records import Evaluations, FloatArray, Outcome

FORMAT = 2
READABLE = (1, FORMAT)
MAGIC = b"SVJ\n"
HEAD = struct.Struct("<4sII")
OUTCOMES = {
    Outcome.STOPPED: 0, Outcome.PASSED: 1, Outcome.COLLISION: 2, Outcome.TIMEOUT: 3, Outcome.NEVER_MOVED: 4, Outcome.SIMULATOR_ERROR: 5,
    Outcome.INVALID_TEST: 6}
"""How journals write an outcome down; numbers are never given anew."""
_OUTCOME_OF = {code: outcome.value for outcome, code in OUTCOMES.items()}
SPARE = -1
"""Position of an evaluation that is known and that the search has not asked for (again)."""


class Owner(msgspec.Struct, frozen=True, tag="owner"):
    """Whose journal this is: the digest of a study's identity, and the run's name."""

    format: int
    study: str
    run: str


class Batch(msgspec.Struct, frozen=True, tag="batch", omit_defaults=True):
    """Evaluations; `positions` (int32) are their places in the run's order, numbers are float64 by column.

    `reasons` tells by row why a setting could not be simulated.
    """

    positions: bytes
    outcome: bytes
    settings: bytes
    numbers: dict[str, bytes]
    reasons: dict[int, str] = {}


class Result(msgspec.Struct, frozen=True, tag="result", omit_defaults=True):
    """The result of a finished run by the positions of its evaluations, and how many the run asked for.

    `budget` is how many evaluations the run had; format 1 does not tell.
    """

    positions: list[int]
    asked: int
    budget: int = 0


class Retry(msgspec.Struct, frozen=True, tag="retry"):
    """From here on failed evaluations count no more; what came after the first of them is spare."""


Frame = Owner | Batch | Result | Retry


class Content(NamedTuple):
    """What a journal holds: evaluations (None if there is none), their positions, and results by their budget."""

    positions: list[int]
    evaluations: Evaluations | None
    results: Mapping[int, Result]

    def result(self, budget: int) -> Result | None:
        """The result of the run with a budget of evaluations; None while it is unfinished."""
        return self.results.get(budget, self.results.get(0))

    def by_position(self, positions: list[int]) -> Evaluations:
        """The evaluations at some positions."""
        assert self.evaluations is not None
        row_of = {position: row for row, position in enumerate(self.positions)}
        return self.evaluations.take([row_of[position] for position in positions])

    def within(self, budget: int) -> Evaluations | None:
        """The evaluations that a run with a budget asked for; None if there is none."""
        if self.evaluations is None:
            return None
        return self.evaluations.take(np.array([0 <= position < budget for position in self.positions], dtype=bool))


NOTHING = Content([], None, {})


def encoded(frame: Frame) -> bytes:
    """A frame's bytes."""
    payload = msgspec.msgpack.encode(frame)
    return HEAD.pack(MAGIC, len(payload), zlib.crc32(payload)) + payload


def batch_of(positions: list[int], evaluations: Evaluations) -> Batch:
    """The frame of a batch."""
    numbers = {"collision_speed": evaluations.collision_speed, "f_diff": evaluations.f_diff, "f_num_diff": evaluations.f_num_diff,
               **evaluations.metrics}
    reasons = {row: evaluations.reasons[setting.tobytes()] for row, setting in enumerate(evaluations.settings)
               if setting.tobytes() in evaluations.reasons}
    return Batch(
        positions=np.array(positions, dtype="<i4").tobytes(), outcome=bytes(OUTCOMES[one] for one in evaluations.outcome.tolist()),
        settings=evaluations.settings.astype("<f8").tobytes(),
        numbers={name: values.astype("<f8").tobytes() for name, values in numbers.items()}, reasons=reasons)


def read_frames(data: bytes, path: Path) -> tuple[list[Frame], int]:
    """All intact frames, and where the last of them ends.

    Raises
    ------
    InputError
        If a frame is damaged and intact ones follow it.
    """
    frames: list[Frame] = []
    offset = 0
    while offset < len(data):
        frame, end = _frame_at(data, offset, path)
        if frame is None:
            if any(_frame_at(data, later, path)[0] is not None for later in _occurrences(data, offset + 1)):
                raise InputError(path, f"is damaged at byte {offset}, and intact frames follow",
                                 "restore the file, or remove it to simulate the run again")
            break
        frames.append(frame)
        offset = end
    return frames, offset


def content_of(frames: list[Frame]) -> Content:
    """What frames tell when they are read one after the other."""
    positions: list[int] = []
    batches: list[Evaluations] = []
    results: dict[int, Result] = {}
    for frame in frames:
        if isinstance(frame, Batch):
            positions += np.frombuffer(frame.positions, dtype="<i4").tolist()
            batches.append(_unpacked(frame))
        elif isinstance(frame, Result):
            results[frame.budget] = frame
        elif isinstance(frame, Retry) and batches:
            positions, kept = _without_failures(positions, Evaluations.concatenate(batches))
            batches, results = [kept], {}
    return Content(positions, Evaluations.concatenate(batches) if positions else None, results)


def _without_failures(positions: list[int], evaluations: Evaluations) -> tuple[list[int], Evaluations]:
    """What is left to a run that tries its failed settings again."""
    simulated = ~evaluations.failed
    first = min((position for position, fine in zip(positions, simulated, strict=True) if not fine), default=max(positions) + 1)
    kept = [position if position < first else SPARE for position, fine in zip(positions, simulated, strict=True) if fine]
    return kept, evaluations.take(simulated)


def _frame_at(data: bytes, offset: int, path: Path) -> tuple[Frame | None, int]:
    if offset + HEAD.size > len(data):
        return None, offset
    magic, length, checksum = HEAD.unpack_from(data, offset)
    payload = data[offset + HEAD.size:offset + HEAD.size + length]
    if magic != MAGIC or len(payload) != length or zlib.crc32(payload) != checksum:
        return None, offset
    try:
        return msgspec.msgpack.decode(payload, type=Frame), offset + HEAD.size + length
    except msgspec.DecodeError as error:
        raise InputError(path, f"holds at byte {offset} what this version does not know: {error}", "the version that wrote it") from None


def _occurrences(data: bytes, start: int) -> Iterator[int]:
    """Where the magic stands after `start`."""
    found = data.find(MAGIC, start)
    while found >= 0:
        yield found
        found = data.find(MAGIC, found + 1)


def _unpacked(batch: Batch) -> Evaluations:
    numbers = {name: _floats(values) for name, values in batch.numbers.items()}
    speed, f_diff, f_num_diff = (numbers.pop(name) for name in ("collision_speed", "f_diff", "f_num_diff"))
    outcome = np.array([_OUTCOME_OF[code] for code in batch.outcome], dtype="U16")
    settings = _floats(batch.settings).reshape(len(outcome), -1)
    reasons = {settings[row].tobytes(): reason for row, reason in batch.reasons.items()}
    return Evaluations(settings=settings, outcome=outcome, collision_speed=speed, metrics=numbers, f_diff=f_diff,
                       f_num_diff=f_num_diff, reasons=reasons)


def _floats(values: bytes) -> FloatArray:
    return np.frombuffer(values, dtype="<f8").astype(float)
