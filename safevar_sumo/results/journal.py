"""The journal of one run: a file of JSON lines. A line has one evaluated batch, and is written
before the search continues.

The first line names the study, the run and the characteristics. A batch is a table: a list for each
column of `solutions.csv`, the number of each evaluation in its run, the collision's speed and the
reason of a failure; an undefined value is null. The last line of a finished run lists its
solutions. Each line after the first ends with a checksum of the journal up to this line. A line may
be unreadable, or contradict its checksum, after a process, a disk or a power supply has failed, or
because somebody has altered it. This line and all lines after it are dropped, and their evaluations
are simulated again.
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
"""Longest time to wait for a lock [s]: workers of a killed process hold locks until they end."""
SECONDS_BETWEEN_ATTEMPTS = 0.05
"""Time between two attempts to lock a journal [s]."""
# Keys of lines, most of them names of columns.
POSITION = "evaluation"
OUTCOME = "outcome"
REASON = "reason"
POINT = "point"
SOLUTIONS = "solutions"
CHECKSUM_MARK = b',"crc32":'
FIXED_COLUMNS = ("collision_speed", "f_diff", "f_num_diff")


def journal_head(study: str, run: str, characteristics: Iterable[str]) -> JsonObject:
    """The first line of a journal, its head. `study` is the digest of the study's identity, `run`
    the name of the run: together they are the owner of the journal.
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
    solutions
        The positions of the run's solutions, by the budget (number of evaluations) of the search
        that returned them.
    size
        Size of the valid lines [bytes].
    checksum
        The CRC-32 of these lines without their checksums and line ends.
    """

    positions: list[int]
    evaluations: Evaluations
    solutions: Mapping[int, list[int]]
    size: int
    checksum: int

    def take_positions(self, positions: Sequence[int]) -> Evaluations:
        """The evaluations at `positions`, in this order."""
        row_of = {position: row for row, position in enumerate(self.positions)}
        return self.evaluations.take([row_of[position] for position in positions])

    def requested_within(self, budget: int) -> tuple[list[int], Evaluations]:
        """Positions and evaluations that a run with this budget requested, in the order of its
        requests.

        A journal may have more evaluations, from a search with a larger budget.
        """
        positions = sorted(position for position in self.positions if position < budget)
        return positions, self.take_positions(positions)


class Journal:
    """An open, locked journal; the lock ends with the process.

    Parameters
    ----------
    path
        The file; it is made if it does not exist.
    head
        The head, from `journal_head`. A file that has no line after its head gets this head.
    retry_failed
        Whether to drop the first batch with a failed evaluation, and all batches after it, so that
        their evaluations are simulated again.

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
        line: JsonObject = {
            POSITION: positions,
            OUTCOME: evaluations.outcome.tolist(),
            **dict(
                zip(self._characteristics, evaluations.settings.T.tolist(), strict=True)
            ),
        }
        for name in FIXED_COLUMNS:
            line[name] = getattr(evaluations, name).tolist()
        for name, values in evaluations.metrics.items():
            line[name] = values.tolist()
        if evaluations.worst_points is not None:
            line[POINT] = evaluations.worst_points.tolist()
        reasons = [
            evaluations.reasons.get(setting.tobytes())
            for setting in evaluations.settings
        ]
        if any(reasons):
            line[REASON] = reasons
        self._add(line)

    def finish(self, positions: Sequence[int], budget: int) -> None:
        """Add the result of a finished run: the positions of its solutions, and the budget. Then
        flush the file to the disk.
        """
        self._add({SOLUTIONS: positions, "budget": budget})
        with disk_errors(self.path, "written"):
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Release the lock."""
        self._file.close()

    def _add(self, line: JsonObject) -> None:
        text = msgspec.json.encode(line)
        self._checksum = zlib.crc32(text, self._checksum)
        # For example {"solutions":[1,5],"budget":9} becomes
        # {"solutions":[1,5],"budget":9,"crc32":123}.
        self._write(text[:-1] + CHECKSUM_MARK + b"%d}" % self._checksum)

    def _write(self, text: bytes) -> None:
        remainder = memoryview(text + b"\n")
        with disk_errors(self.path, "written"):
            while remainder:
                remainder = remainder[self._file.write(remainder) :]


def read_journal(
    path: Path, head: JsonObject, *, head_only: bool = False
) -> JournalContent:
    """The contents of a journal that another process may be writing; for `path` and `head` see
    `Journal`. With `head_only`, only the owner is checked, and the contents are incomplete.

    Raises
    ------
    InputError
        If the journal cannot be read, or belongs to another study or run.
    """
    try:
        with path.open("rb") as file:
            # One byte after the head suffices to see that lines follow, as `_read` requires.
            data = file.readline() + file.read(1)
            if not head_only:
                data += file.read()
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror}") from None
    return _read(data, path, head)


class _Progress(msgspec.Struct):
    """The keys of a journal's line that state the progress of its run: `evaluation` has the
    positions of a batch, `budget` is the budget of a finished run (0 in other lines).
    """

    evaluation: list[int] = []
    budget: int = 0


class JournalReader:
    """Reads the progress of a run from a journal that another process writes; `is_finished` says
    whether the run has written its solutions.
    """

    def __init__(self, path: Path, budget: int) -> None:
        self._path = path
        self._budget = budget
        self._end = 0
        self._asked = 0
        self.is_finished = False

    def asked(self) -> int:
        """Number of evaluations that the run has requested so far, at most its budget."""
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
        """Number of evaluations that the run may still request."""
        if self.is_finished:
            return 0
        return self._budget - self._asked


def open_and_lock(path: Path) -> IO[bytes]:
    """Open and lock the file of a journal, which is made if it does not exist. Closing the file
    ends the lock.

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
            file = lock.acquire()
            # The process that had the lock before may have removed the file meanwhile.
            while os.fstat(file.fileno()).st_nlink == 0:
                lock.release()
                file = lock.acquire()
            return file
        except portalocker.AlreadyLocked:
            raise SafevarError(f"{path}: another process works on this run") from None
        except portalocker.LockException as error:
            raise SafevarError(
                f"{path}: cannot be locked: {error}; results need a disk that locks files"
            ) from None


def _read(
    data: bytes, path: Path, head: JsonObject, *, until_failure: bool = False
) -> JournalContent:
    """The contents of a journal, from its bytes. With `until_failure`, the first batch with a
    failed evaluation and all lines after it are left out.
    """
    positions = list[int]()
    batches = []
    solutions = {}

    # The first line says to which run the journal belongs. A file without another line holds no
    # evaluations: it may be of any run, and `Journal` writes this run's head if `size` is 0.
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
        if not line:
            break
        try:
            if SOLUTIONS in line:
                # Only somebody who also made the checksum can have written other positions.
                if not {*line[SOLUTIONS]} <= {*positions}:
                    break
                solutions[line["budget"]] = line[SOLUTIONS]
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
        positions,
        Evaluations.concatenate(batches or [empty]),
        solutions,
        size,
        checksum,
    )


def _checked(text: bytes, checksum: int) -> tuple[JsonObject, int]:
    """Decode a line after the head, and return its content and the checksum of the journal up to
    this line. The content is empty if the line is torn, damaged or altered. `checksum` is the
    checksum of all lines before it.
    """
    content, _, stated_checksum = text.rpartition(CHECKSUM_MARK)
    checksum = zlib.crc32(content + b"}", checksum)
    if stated_checksum != b"%d}\n" % checksum:
        return {}, checksum
    return _decoded(content + b"}\n"), checksum


def _decoded(text: bytes) -> JsonObject:
    """The content of a line of a journal; empty if the line is torn or damaged."""
    if not text.endswith(b"\n"):
        return {}
    try:
        return msgspec.json.decode(text, type=JsonObject)
    except msgspec.DecodeError:
        return {}


def _evaluations_of(line: JsonObject, characteristics: Sequence[str]) -> Evaluations:
    """The batch of evaluations in a line. Raises an error if a column is missing or wrong, or if
    columns have different lengths.
    """
    if len({len(value) for value in line.values()}) > 1:
        raise ValueError
    columns = {
        name: np.array(values, float)
        for name, values in line.items()
        if name not in (POSITION, OUTCOME, REASON, POINT)
    }
    # Each `pop` takes a column that is no metric: the columns that remain are metrics.
    settings = np.stack([columns.pop(name) for name in characteristics], axis=1)
    worst_points = None
    if POINT in line:
        worst_points = np.array(line[POINT], np.intp)
    speed, f_diff, f_num_diff = (columns.pop(name) for name in FIXED_COLUMNS)
    return Evaluations(
        settings=settings,
        outcome=np.array(line[OUTCOME], "U16"),
        collision_speed=speed,
        f_diff=f_diff,
        f_num_diff=f_num_diff,
        metrics=columns,
        reasons={
            setting.tobytes(): reason
            for setting, reason in zip(settings, line.get(REASON, ()), strict=False)
            if reason
        },
        worst_points=worst_points,
    )
