"""The journal of one run: a file of JSON lines, one for each evaluated batch, written before the
search continues.

The first line names the study, the run and the characteristics. A batch is a table: a list for each
column of `solutions.csv`, the number of each evaluation in its run, the collision's speed and the
reason of a failure; an undefined value is null. The last line of a finished run lists its
solutions. Each line after the first ends with a checksum of the journal up to there. What follows
the first line that cannot be read, or that the checksum contradicts, was lost with a process, a
disk or a power supply, or was altered, and is simulated again.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, NamedTuple

import msgspec
import numpy as np
import portalocker

from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, JsonObject
from safevar_sumo.results.manifest import disk_errors

FORMAT = 7
"""Version number of the format of journals."""
PATIENCE = 2.0
"""Time within which the workers of a killed process end, which hold locks until then [s]."""
SECONDS_BETWEEN_ATTEMPTS = 0.05
"""Time between two attempts to lock a journal [s]."""
POSITION, OUTCOME, REASON, POINT = "evaluation", "outcome", "reason", "point"
SOLUTIONS, CHECKSUM = "solutions", "crc32"
CHECKSUM_MARK = f',"{CHECKSUM}":'.encode()
OBJECTIVE_COLUMNS = ("collision_speed", "f_diff", "f_num_diff")


def journal_head(study: str, run: str, characteristics: Iterable[str]) -> JsonObject:
    """The first line of a journal: what it belongs to, the digest of a study's identity and the
    name of a run; and the characteristics.
    """
    return {
        "format": FORMAT,
        "study": study,
        "run": run,
        "characteristics": list(characteristics),
    }


class JournalContent(NamedTuple):
    """The contents of a journal.

    Attributes
    ----------
    positions
        The number of each evaluation in its run, from 0.
    evaluations
        The evaluations, in the order in which they were written.
    results
        By budget, the positions of the run's solutions.
    size
        Size of the lines that were read [bytes].
    checksum
        The CRC-32 of these lines without their checksums and ends.
    """

    positions: list[int]
    evaluations: Evaluations
    results: Mapping[int, list[int]]
    size: int
    checksum: int

    def take_positions(self, positions: Sequence[int]) -> Evaluations:
        """The evaluations at `positions`, in this order."""
        row_of = {position: row for row, position in enumerate(self.positions)}
        return self.evaluations.take([row_of[position] for position in positions])

    def requested_within(self, budget: int) -> tuple[list[int], Evaluations]:
        """Positions and evaluations that a run with this budget requested, in the order of its
        requests.

        A journal may hold more: those of a search with a larger budget.
        """
        positions = sorted(position for position in self.positions if position < budget)
        return positions, self.take_positions(positions)


class Journal:
    """An open, locked journal; the lock ends with the process.

    Parameters
    ----------
    path
        The file, made if it does not exist.
    head
        The owner of the journal, as `journal_head` names it. A journal without evaluations passes
        to the owner.
    retry_failed
        Whether to drop the first failed evaluation and all that came after it.

    Attributes
    ----------
    content
        The journal's contents when it was opened.

    Raises
    ------
    InputError
        If the journal belongs to another study.
    SafevarError
        If another live process works on the run, or the file cannot be locked or written.
    """

    def __init__(
        self, path: Path, head: JsonObject, *, retry_failed: bool = False
    ) -> None:
        self.path = path
        self._characteristics = head["characteristics"]
        self._file = open_and_lock(path)
        try:
            with disk_errors(path, "read"):
                self._file.seek(0)
                self.content = _read(
                    self._file.read(), path, head, until_failure=retry_failed
                )
                self._file.truncate(self.content.size)
            self._checksum = self.content.checksum
            if not self.content.size:
                text = msgspec.json.encode(head)
                self._checksum = zlib.crc32(text)
                self._write(text)
        except BaseException:
            self._file.close()
            raise

    def append(self, positions: Sequence[int], evaluations: Evaluations) -> None:
        """Add a batch of evaluations, as a table."""
        line = {
            POSITION: list(positions),
            OUTCOME: evaluations.outcome.tolist(),
            **dict(
                zip(self._characteristics, evaluations.settings.T.tolist(), strict=True)
            ),
        }
        for name in OBJECTIVE_COLUMNS:
            line[name] = getattr(evaluations, name).tolist()
        for name, values in evaluations.metrics.items():
            line[name] = values.tolist()
        if evaluations.worst_points is not None:
            line[POINT] = evaluations.worst_points.tolist()
        if evaluations.reasons:
            reasons = [
                evaluations.reasons.get(setting.tobytes())
                for setting in evaluations.settings
            ]
            if any(reasons):
                line[REASON] = reasons
        self._add(line)

    def finish(self, positions: Sequence[int], budget: int) -> None:
        """Add the result, the positions of the solutions and the allowed number of evaluations;
        sync all.
        """
        self._add({SOLUTIONS: list(positions), "budget": budget})
        with disk_errors(self.path, "written"):
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Release the lock."""
        self._file.close()

    def _add(self, line: JsonObject) -> None:
        text = msgspec.json.encode(line)
        self._checksum = zlib.crc32(text, self._checksum)
        self._write(text[:-1] + CHECKSUM_MARK + b"%d}" % self._checksum)

    def _write(self, text: bytes) -> None:
        remainder = memoryview(text + b"\n")
        with disk_errors(self.path, "written"):
            while remainder:
                remainder = remainder[self._file.write(remainder) :]


def read_journal(
    path: Path, head: JsonObject, *, head_only: bool = False
) -> JournalContent:
    """The contents of a journal that another process may be writing; arguments as of `Journal`.
    With `head_only`, only its owner is checked.

    Raises
    ------
    InputError
        If the journal cannot be read, or belongs to another study or run.
    """
    try:
        with path.open("rb") as file:
            # One byte after the head says that it is not alone, so that its owner counts.
            data = file.readline() + file.read(1)
            if not head_only:
                data += file.read()
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror}") from None
    return _read(data, path, head)


class _Progress(msgspec.Struct):
    """What a line of a journal says about the progress of its run."""

    evaluation: list[int] = []
    budget: int = 0


class JournalReader:
    """Follows how many evaluations a run has asked for, in the journal that another process
    writes.
    """

    def __init__(self, path: Path, budget: int) -> None:
        self._path = path
        self._budget = budget
        self._end = self._asked = 0
        self.is_finished = False

    def asked(self) -> int:
        """Number of evaluations that the run has asked for."""
        with suppress(FileNotFoundError), open(self._path, "rb") as file:
            file.seek(self._end)
            for text in file:
                # Another process may be writing this line, or have truncated the file.
                if not text.endswith(b"\n"):
                    break
                try:
                    progress = msgspec.json.decode(text, type=_Progress)
                except msgspec.DecodeError:
                    break
                self._end += len(text)
                if progress.evaluation:
                    self._asked = min(progress.evaluation[-1] + 1, self._budget)
                elif progress.budget == self._budget:
                    self.is_finished = True
        return self._asked

    @property
    def left(self) -> int:
        """Number of evaluations that the run may still ask for."""
        if self.is_finished:
            return 0
        return self._budget - self._asked


def open_and_lock(path: Path) -> IO[bytes]:
    """A journal's file, made if it does not exist; the lock ends when it is closed.

    Raises
    ------
    SafevarError
        If another live process works on the run, or the file cannot be locked or written.
    """
    lock = portalocker.Lock(
        path, "a+b", PATIENCE, SECONDS_BETWEEN_ATTEMPTS, buffering=0
    )
    with disk_errors(path, "opened"):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            return lock.acquire()
        except portalocker.AlreadyLocked:
            raise SafevarError(f"{path}: another process works on this run") from None
        except portalocker.LockException as error:
            raise SafevarError(
                f"{path}: cannot be locked: {error}; results need a disk that locks files"
            ) from None


def _read(
    data: bytes, path: Path, head: JsonObject, *, until_failure: bool = False
) -> JournalContent:
    """The contents of a journal; with `until_failure`, without the first batch that failed and all
    that came after it.
    """
    positions = list[int]()
    batches = []
    results = {}

    # The first line says to which run the journal belongs.
    head_line, *lines = data.splitlines(keepends=True) or [b""]
    owner = _decoded(head_line)
    if lines and owner != head:
        raise InputError(
            path,
            "belongs to another study, version or run, or is no journal",
            "the manifest.json and journals of one study, as it was run; or another `out`",
        )

    size = 0
    if owner == head:
        size = len(head_line)
    checksum = zlib.crc32(head_line.rstrip())
    for text in lines:
        line, checksum_of_line = _checked(text, checksum)
        try:
            if SOLUTIONS in line:
                if not {*line[SOLUTIONS]} <= {*positions}:
                    break
                results[line["budget"]] = line[SOLUTIONS]
            else:
                batch = _evaluations_of(line, head["characteristics"])
                if until_failure and batch.failed.any():
                    break
                positions += msgspec.convert(line[POSITION], list[int])
                batches.append(batch)
        except (KeyError, TypeError, ValueError, msgspec.ValidationError):
            break
        size += len(text)
        checksum = checksum_of_line
    empty = Evaluations.none(len(head["characteristics"]), METRICS)
    return JournalContent(
        positions, Evaluations.concatenate(batches or [empty]), results, size, checksum
    )


def _checked(text: bytes, checksum: int) -> tuple[JsonObject, int]:
    """A line after the first, and the checksum of the journal up to it; empty if the line is torn,
    damaged or altered. `checksum` is that of the lines before.
    """
    content, _, stated = text.rpartition(CHECKSUM_MARK)
    checksum = zlib.crc32(content + b"}", checksum)
    if stated != b"%d}\n" % checksum:
        return {}, checksum
    return _decoded(content + b"}\n"), checksum


def _decoded(text: bytes) -> JsonObject:
    """A line of a journal; empty if it is torn or damaged."""
    if not text.endswith(b"\n"):
        return {}
    try:
        return msgspec.json.decode(text, type=JsonObject)
    except msgspec.DecodeError:
        return {}


def _evaluations_of(line: JsonObject, characteristics: Sequence[str]) -> Evaluations:
    """The batch of evaluations in a line; raises an error if its columns are wrong or have
    different lengths.
    """
    if len(set(map(len, line.values()))) > 1:
        raise ValueError
    columns = {
        name: np.array(values, float)
        for name, values in line.items()
        if name not in (POSITION, OUTCOME, REASON, POINT)
    }
    settings = np.stack(list(map(columns.pop, characteristics)), axis=1)
    reasons = zip(
        map(bytes, settings), line.get(REASON, [None] * len(settings)), strict=True
    )
    worst_points = None
    if POINT in line:
        worst_points = np.array(line[POINT], np.intp)
    speed, f_diff, f_num_diff = map(columns.pop, OBJECTIVE_COLUMNS)
    return Evaluations(
        settings=settings,
        outcome=np.array(line[OUTCOME], "U16"),
        collision_speed=speed,
        f_diff=f_diff,
        f_num_diff=f_num_diff,
        metrics=columns,
        reasons={key: reason for key, reason in reasons if reason},
        worst_points=worst_points,
    )
