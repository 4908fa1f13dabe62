"""The journal of one run: a file of JSON lines, one for each evaluated batch, written before the search continues.

The first line names the study, the run and the characteristics. A batch is a table: a list for each column of
`solutions.csv`, the number of each evaluation in its run, the collision's speed and the reason of a failure; an
undefined value is null. The last line of a finished run lists its solutions. A torn last line, left by a killed process
or a full disk, is cut off; any other damage is an error.
"""

from __future__ import annotations

import errno
import os
import time
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
from safevar_sumo.results.manifest import FORMAT, disk_errors

PATIENCE = 2.0
"""Time within which the workers of a killed process end, which hold locks until then [s]."""
SECONDS_BETWEEN_ATTEMPTS = 0.05
"""Time between two attempts to lock a journal [s]."""
POSITION, OUTCOME, REASON = "evaluation", "outcome", "reason"
FIRST_BYTES = b'{"format"'
"""What every journal begins with."""
UNDAMAGED = "the file as it was, or no file: the run is then simulated again"
ANOTHER_OWNER = "belongs to another study, version or run"
OBJECTIVE_COLUMNS = ("collision_speed", "f_diff", "f_num_diff")


def journal_head(study: str, run: str, characteristics: Iterable[str]) -> JsonObject:
    """The first line of a journal: what it belongs to, the digest of a study's identity and the name of a run; and the
    characteristics.
    """
    return {"format": FORMAT, "study": study, "run": run, "characteristics": list(characteristics)}


class JournalContent(NamedTuple):
    """The contents of a journal.

    Attributes
    ----------
    positions
        The number of each evaluation in its run, from 0.
    evaluations
        The evaluations, in the order in which they were written.
    results
        By budget, the positions of the run's solutions, and the number of evaluations that the run requested.
    tail_size
        Size of a torn last line [bytes].
    """

    positions: list[int]
    evaluations: Evaluations
    results: Mapping[int, tuple[list[int], int]]
    tail_size: int = 0

    def take_positions(self, positions: Sequence[int]) -> Evaluations:
        """The evaluations at `positions`, in this order."""
        row_of = {position: row for row, position in enumerate(self.positions)}
        return self.evaluations.take([row_of[position] for position in positions])

    def requested_within(self, budget: int) -> tuple[list[int], Evaluations]:
        """Positions and evaluations that a run with this budget requested, in the order of its requests."""
        positions = sorted(position for position in self.positions if position < budget)
        return positions, self.take_positions(positions)


class JournalBusyError(SafevarError):
    """Another live process works on this run."""


class Journal:
    """An open, locked journal; the lock ends with the process.

    Parameters
    ----------
    path
        The file, made if it does not exist. A journal without evaluations passes to the owner in `head`.
    head
        The owner of the journal, as `journal_head` names it.
    deadline
        Time of `time.monotonic` until which to wait for another process that holds the lock.

    Attributes
    ----------
    content
        The journal's contents when it was opened; `tail_size` is the size of the torn tail that was cut off.

    Raises
    ------
    JournalBusyError
        If another live process works on the run.
    InputError
        If the journal belongs to another study or is damaged before its tail.
    """

    def __init__(self, path: Path, head: JsonObject, deadline: float = 0.0) -> None:
        self.path, self._head = path, head
        self._file = _open_and_lock(path, deadline)
        try:
            with disk_errors(path, "read"):
                self.content = self._read_and_claim()
        except BaseException:
            self._file.close()
            raise

    def append(self, positions: Sequence[int], evaluations: Evaluations) -> None:
        """Add a batch."""
        self._write(_batch_line(positions, evaluations, self._head["characteristics"]))

    def finish(self, positions: Sequence[int], asked: int, budget: int) -> None:
        """Add the result: the positions of the solutions, the number of requested evaluations, and their allowed
        number; sync all.
        """
        self._write({"solutions": list(positions), "asked": asked, "budget": budget}, sync=True)

    def retry(self) -> None:
        """Drop the first failed evaluation and all that came after it."""
        self._write({"retry": True})
        self._file.seek(0)
        self.content = _content_of(_parse(self._file.read(), self.path)[0], self.path, self._head)

    @property
    def remark_on_tail(self) -> str:
        """What the user is told about a torn tail."""
        return f"{self.path}: the last {self.content.tail_size} bytes were torn; what they held is simulated again"

    def close(self) -> None:
        """Release the lock."""
        self._file.close()

    def _read_and_claim(self) -> JournalContent:
        """Read the contents, cut off a torn tail, and write the head into a journal without evaluations."""
        data = self._file.read()
        lines, end = _parse(data, self.path)
        if lines and lines[0] != self._head:
            if any(POSITION in line for line in lines):
                raise InputError(self.path, ANOTHER_OWNER, "another `out`")
            lines, end, data = [], 0, b""
            self._truncate(0)
        if end < len(data):
            self._truncate(end)
        if not lines:
            self._write(self._head)
        return _content_of(lines, self.path, self._head)._replace(tail_size=len(data) - end)

    def _write(self, line: JsonObject, *, sync: bool = False) -> None:
        with disk_errors(self.path, "written"):
            start, remainder = self._file.tell(), memoryview(msgspec.json.encode(line) + b"\n")
            try:
                while remainder:
                    remainder = remainder[self._file.write(remainder) :]
                if not self.path.exists():
                    raise OSError(errno.ENOENT, "the file is gone")
                if sync:
                    os.fsync(self._file.fileno())
            except OSError:
                with suppress(OSError):  # if this fails too, the next reader cuts off the torn line
                    self._truncate(start)
                raise

    def _truncate(self, end: int) -> None:
        self._file.truncate(end)
        self._file.seek(end)


def read_journal(path: Path, head: JsonObject) -> JournalContent:
    """The contents of a journal that another process may be writing.

    Raises
    ------
    InputError
        If the journal cannot be read, is damaged, or belongs to another study or run.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror}") from None
    lines, end = _parse(data, path)
    if lines and lines[0] != head:
        raise InputError(path, ANOTHER_OWNER, "the manifest.json and journals of one study, as it was run")
    return _content_of(lines, path, head)._replace(tail_size=len(data) - end)


def _open_and_lock(path: Path, deadline: float) -> IO[bytes]:
    with disk_errors(path, "opened"):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = open(path, "a+b", buffering=0)  # noqa: SIM115
    while True:
        try:
            portalocker.lock(file, portalocker.LOCK_EX | portalocker.LOCK_NB)
        except portalocker.AlreadyLocked:
            if time.monotonic() > deadline:
                file.close()
                raise JournalBusyError(f"{path}: another process works on this run") from None
            time.sleep(SECONDS_BETWEEN_ATTEMPTS)
        except portalocker.LockException as error:
            file.close()
            raise SafevarError(
                f"{path}: cannot be locked: {error.strerror or error}; results need a disk whose files can be locked"
            ) from None
        else:
            file.seek(0)
            return file


def _parse(data: bytes, path: Path) -> tuple[list[JsonObject], int]:
    """All whole lines, and the offset at which they end.

    Raises
    ------
    InputError
        If a line is damaged that is not the last one, or the file is no journal.
    """
    lines: list[JsonObject] = []
    end = 0
    for text in data.splitlines(keepends=True):
        try:
            line = msgspec.json.decode(text, type=JsonObject)
        except msgspec.DecodeError as error:
            if end + len(text) == len(data):
                break  # the last line is torn
            problem = f"is damaged in line {len(lines) + 1}: {error}"
            raise InputError(path, problem, UNDAMAGED) from None
        if not text.endswith(b"\n"):
            break
        lines.append(line)
        end += len(text)
    # A crash of the machine may leave zeros at the end of a file.
    is_journal = "format" in lines[0] if lines else FIRST_BYTES.startswith(data.strip(b"\0")[: len(FIRST_BYTES)])
    if not is_journal:
        raise InputError(path, "is no journal", "a file that the command `study` has written, or another directory")
    return lines, end


def _batch_line(positions: Sequence[int], evaluations: Evaluations, characteristics: Iterable[str]) -> JsonObject:
    """A batch of evaluations as a table."""
    line = {
        POSITION: list(positions),
        OUTCOME: evaluations.outcome.tolist(),
        **dict(zip(characteristics, evaluations.settings.T.tolist(), strict=True)),
        **{name: getattr(evaluations, name).tolist() for name in OBJECTIVE_COLUMNS},
        **{name: values.tolist() for name, values in evaluations.metrics.items()},
    }
    if evaluations.reasons:
        reasons = [evaluations.reasons.get(setting.tobytes()) for setting in evaluations.settings]
        line |= {REASON: reasons} if any(reasons) else {}
    return line


def _evaluations_of(line: JsonObject, characteristics: Sequence[str]) -> Evaluations:
    """The batch of evaluations in a line."""
    if len({len(values) for values in line.values()}) > 1:
        raise ValueError("columns of different lengths")
    columns = {
        name: np.array(values, dtype=float) for name, values in line.items() if name not in (POSITION, OUTCOME, REASON)
    }
    settings = np.stack([columns.pop(name) for name in characteristics], axis=1)
    reasons = line.get(REASON, [None] * len(settings))
    speed, f_diff, f_num_diff = (columns.pop(name) for name in OBJECTIVE_COLUMNS)
    return Evaluations(
        settings=settings,
        outcome=np.array(line[OUTCOME], dtype="U16"),
        collision_speed=speed,
        f_diff=f_diff,
        f_num_diff=f_num_diff,
        metrics=columns,
        reasons={setting.tobytes(): reason for setting, reason in zip(settings, reasons, strict=True) if reason},
    )


def _content_of(lines: Sequence[JsonObject], path: Path, head: JsonObject) -> JournalContent:
    """The contents of a journal from its lines in order."""
    characteristics, positions, results = head["characteristics"], list[int](), dict[int, tuple[list[int], int]]()
    empty = Evaluations.none(len(characteristics), METRICS)
    batches = list[Evaluations]()
    try:
        for line in lines:
            if POSITION in line:
                positions += line[POSITION]
                batches.append(_evaluations_of(line, characteristics))
            elif "solutions" in line:
                results[line["budget"]] = (line["solutions"], line["asked"])
            elif "retry" in line:
                evaluations = Evaluations.concatenate(batches)
                first_failed = int(np.argmax(evaluations.failed))
                positions, batches, results = positions[:first_failed], [evaluations.take(range(first_failed))], {}
        return JournalContent(positions, Evaluations.concatenate(batches) if positions else empty, results)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(path, f"was edited: {error!r}", UNDAMAGED) from None
