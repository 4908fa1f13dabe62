"""The journal of one run: every evaluated batch, appended and synced before the search goes on.

The first frame tells whose journal it is, the last one of a finished run which evaluations are its result. A torn tail,
as a kill or a full disk leaves it, is cut off; damage before intact frames is an error.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import IO

import portalocker

from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.records import Evaluations
from safevar_sumo.results.files import make_durable, sync_directory
from safevar_sumo.results.frames import (
    FORMAT,
    MAGIC,
    READABLE,
    Batch,
    Content,
    Frame,
    Owner,
    Result,
    Retry,
    batch_of,
    content_of,
    encoded,
    read_frames,
)
from safevar_sumo.study import refuse_other_than_file


class JournalBusy(SafevarError):
    """Another live process works on this run."""


class Journal:
    """An open, locked journal; a dead process's lock is gone with it.

    Parameters
    ----------
    path
        The file; it is made if it does not exist. One without evaluations changes its owner.
    study, run
        Whose journal it is.

    Attributes
    ----------
    content
        What it held when it was opened.
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
            self.content = self._take_in(Owner(format=FORMAT, study=study, run=run))
        except OSError as error:
            self.close()
            raise SafevarError(f"{path}: cannot be read: {error.strerror}; what was written before stays valid") from None
        except BaseException:
            self.close()
            raise

    def append(self, positions: list[int], evaluations: Evaluations) -> None:
        """Add a batch and sync it to the disk."""
        self._write(batch_of(positions, evaluations))

    def finish(self, positions: list[int], asked: int, budget: int) -> None:
        """Add the result of the run with a budget of evaluations."""
        self._write(Result(positions=positions, asked=asked, budget=budget))

    def retry(self) -> None:
        """Let failed evaluations count no more, and all that the search made of them."""
        self._write(Retry())
        self._file.seek(0)
        self.content = content_of(read_frames(self._file.read(), self.path)[0])

    def close(self) -> None:
        """Give the lock back."""
        self._file.close()

    def _take_in(self, owner: Owner) -> Content:
        data = self._file.read()
        size = len(data)
        frames, end = read_frames(data, self.path)
        if not frames and data.strip(b"\0") and not data.startswith(MAGIC[:len(data)]):
            raise InputError(self.path, "is no journal", "another --out")
        if frames and frames[0] != owner:
            if any(isinstance(frame, Batch) for frame in frames):
                raise InputError(self.path, "belongs to another study, run or version", "another --out")
            frames, end, size = [], 0, 0
            self._cut_at(0)
        if end < size:
            self.cut = size - end
            self._cut_at(end)
        if not frames:
            self._write(owner)
            sync_directory(self.path.parent)
        return content_of(frames)

    def _write(self, frame: Frame) -> None:
        start = self._file.tell()
        try:
            rest = memoryview(encoded(frame))
            while rest:
                rest = rest[self._file.write(rest):]
            os.fsync(self._file.fileno())
            if not self.path.exists():
                raise OSError(errno.ENOENT, "the file is gone")
        except OSError as error:
            self._undo(start)
            raise SafevarError(f"{self.path}: cannot be written: {error.strerror}; what was written before stays valid") from None

    def _undo(self, start: int) -> None:
        """Cut a half-written frame off again; where that fails too, the next reader does it."""
        try:
            self._cut_at(start)
        except OSError:
            return

    def _cut_at(self, end: int) -> None:
        self._file.truncate(end)
        self._file.seek(end)


def read_journal(path: Path, study: str, run: str) -> Content:
    """What a journal holds that somebody may still write to.

    Raises
    ------
    InputError
        If it cannot be read, is damaged, or belongs to another study or run.
    """
    frames = _frames_of(path)
    if frames and not (isinstance(frames[0], Owner) and frames[0].format in READABLE):
        raise InputError(path, "is of a format that this version does not read", "the version that wrote it")
    if frames and frames[0] not in [Owner(format=known, study=study, run=run) for known in READABLE]:
        raise InputError(path, "belongs to another study, run or version than the manifest beside it", "the journals of this study alone")
    return content_of(frames)


def owner_of(path: Path) -> str | None:
    """The study that a journal in other hands belongs to; None while that is not written yet."""
    frames = _frames_of(path)
    return frames[0].study if frames and isinstance(frames[0], Owner) else None


def _frames_of(path: Path) -> list[Frame]:
    try:
        refuse_other_than_file(path)
        return read_frames(path.read_bytes(), path)[0]
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror}") from None


def _opened(path: Path) -> IO[bytes]:
    try:
        refuse_other_than_file(path)
        make_durable(path.parent)
        file = open(path, "a+b", buffering=0)  # noqa: SIM115
    except OSError as error:
        raise SafevarError(f"{path}: cannot be opened: {error.strerror}") from None
    try:
        portalocker.lock(file, portalocker.LOCK_EX | portalocker.LOCK_NB)
    except portalocker.AlreadyLocked:
        file.close()
        raise JournalBusy(f"{path}: another process works on this run") from None
    except portalocker.LockException as error:
        file.close()
        raise SafevarError(f"{path}: cannot be locked: {error.strerror or error}; results need a disk whose files can be locked") from None
    file.seek(0)
    return file
