"""The cache of simulations: what questions have simulated, on disk, by its content. A question that
is asked again, or was interrupted, simulates only what it lacks.

What user code reads cannot be known, so that its simulations are kept for the running command
alone, in a folder of their own, which is removed at the end of the command. A command that was
killed or interrupted leaves it, and the same command continues from it within a day.
"""

from __future__ import annotations

import os
import platform
import shutil
import sqlite3
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from hashlib import sha256
from importlib.metadata import distributions
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import diskcache
import msgspec
import numpy as np
import platformdirs
import portalocker
from diskcache.core import MODE_BINARY, MODE_RAW

from safevar_sumo.campaign.evaluation import Selection, system_of
from safevar_sumo.campaign.inputs import manifest_now
from safevar_sumo.errors import warn
from safevar_sumo.plugins import digests, file_by_name, files_in
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.records.evaluations import COLUMNS
from safevar_sumo.results import identity_digest
from safevar_sumo.shipped import PACKAGE
from safevar_sumo.study import Study, user_code_names

FOLDER_VARIABLE = "SAFEVAR_CACHE"
"""The environment variable that names the cache's folder."""
OFF = "off"
"""The value of this variable with which nothing is kept."""
SIZE_LIMIT = 1_000_000_000
"""Size from which on the simulations that have not been asked for the longest make room [bytes]."""
DIGEST_SIZE = 32
"""Size of the digest with which an entry begins [bytes]."""
FAST = 1
"""The level of zlib's compression: results take a sixth of their size, at 100 MB/s."""
COMMANDS, DAY = "commands", 86_400.0
"""Name of the folder of what commands with user code have simulated, and how long they may be
continued [s].
"""
NUMBER = b"number"
"""The key of an entry with the number of settings that a command has kept."""
METRIC, POINTS = "metric ", "worst_points"
"""Names of an entry's further arrays, or their beginnings."""
UNUSABLE = (OSError, sqlite3.Error, diskcache.Timeout)
"""What a cache raises that cannot be read or written."""


class _PlainBytes(diskcache.Disk):  # type: ignore[misc]
    """Reads bytes alone: the library would unpickle what somebody else has written."""

    def fetch(self, mode: int, filename: str | None, value: Any, read: bool) -> Any:
        if mode not in (MODE_RAW, MODE_BINARY):
            return b""
        return super().fetch(mode, filename, value, read)


class Cache:
    """The entries of a folder, which several processes may use at the same time. Where it cannot be
    read or written, the user is warned once, and nothing is kept any more.

    Parameters
    ----------
    is_read
        Whether entries are read, besides written.
    is_counted
        Whether an entry, `NUMBER`, counts the settings that are kept.
    """

    def __init__(
        self, folder: Path, *, is_read: bool = True, is_counted: bool = False
    ) -> None:
        self._folder = folder
        self._is_read = is_read
        self._entries: diskcache.Cache | None = None
        self._keys = dict[bytes, bytes]()
        self._is_counted = is_counted
        self._guarded(self._open, None)

    def key_of(self, study: Study, opened: Sequence[str]) -> bytes:
        """What the simulations of a study depend on besides their settings, as a digest; `opened`
        are the names of the files that its user code opens.
        """
        packed_study = msgspec.msgpack.encode(study)
        if packed_study not in self._keys:
            # The study and its files count as in the identity of results, and besides that where
            # the files are, this package's own files, and the versions of Python and of all that
            # is installed.
            manifest = manifest_now(study, system_of(study), opened)
            paths = [
                os.path.abspath(file_by_name(name, study.origin.places))
                for name in manifest["files"]
            ]
            parts = [identity_digest(manifest), paths, _environment()]
            self._keys[packed_study] = sha256(msgspec.json.encode(parts)).digest()
        return self._keys[packed_study]

    def get(self, key: bytes) -> bytes | None:
        """The content of an entry; None if there is none, or it has been altered."""
        # Another thread may end the cache meanwhile.
        entries = self._entries
        if entries is None or not self._is_read:
            return None
        entry = self._guarded(entries.get, None, key)
        if not isinstance(entry, bytes):
            return None
        content = entry[DIGEST_SIZE:]
        if entry[:DIGEST_SIZE] == _digest(key, content):
            return content
        return None

    def put(self, key: bytes, content: bytes, settings: int = 0) -> None:
        """Keep an entry, with the results of so many settings."""
        entries = self._entries
        if entries is not None:
            self._guarded(entries.set, None, key, _digest(key, content) + content)
        if settings and self._is_counted:
            self.put(NUMBER, str(self.number_kept() + settings).encode())

    def forget(self) -> None:
        """Remove all entries."""
        if self._entries is not None:
            self._guarded(self._entries.clear, None)

    def number_kept(self) -> int:
        """Number of settings whose results a counted cache has."""
        return int(self.get(NUMBER) or 0)

    def extent(self) -> tuple[int, int]:
        """How many entries there are, and their size on disk [bytes]."""
        if self._entries is None:
            return 0, 0
        extent: tuple[int, int] = self._guarded(
            lambda entries: (len(entries), entries.volume()), (0, 0), self._entries
        )
        return extent

    def close(self) -> None:
        if self._entries is not None:
            self._guarded(self._entries.close, None)

    def _open(self) -> None:
        self._entries = diskcache.Cache(
            str(self._folder),
            disk=_PlainBytes,
            size_limit=SIZE_LIMIT,
            eviction_policy="least-recently-used",
        )

    def _guarded(
        self, function: Callable[..., Any], otherwise: Any, *arguments: Any
    ) -> Any:
        """What a function returns; where the folder is at fault, the cache ends."""
        try:
            return function(*arguments)
        except UNUSABLE as error:
            self._entries = None
            reason = getattr(error, "strerror", None) or str(error) or "it is in use"
            warn(f"simulations are not kept: {self._folder}: {reason}")
            return otherwise


class CommandCache:
    """What a command keeps: simulations of shipped parts for everybody, those of user code for
    itself.

    Parameters
    ----------
    command
        The command line.
    is_fresh
        Whether nothing is read that an earlier command has simulated.
    """

    def __init__(self, folder: Path, command: str, *, is_fresh: bool) -> None:
        self._folder = folder / COMMANDS
        self._command = command
        self._is_fresh = is_fresh
        self._lock: portalocker.Lock | None = None
        self._own: Cache | None = None
        self._own_folder: Path | None = None
        self._of_everybody = Cache(folder, is_read=not is_fresh)

    def of(self, study: Study, opened: Sequence[str]) -> Cache | None:
        """The cache of a study's simulations; `opened` are the names of the files that its user
        code opens. None if another process runs the same command with the same code.
        """
        if not user_code_names(study):
            return self._of_everybody
        if self._own_folder is None:
            self._open_own(self._of_everybody.key_of(study, opened))
        return self._own

    def end(self, *, is_interrupted: bool) -> None:
        """Close the caches; that of user code is removed unless the command was interrupted."""
        self._of_everybody.close()
        if self._own is not None and self._own_folder is not None:
            self._own.close()
            if not is_interrupted:
                shutil.rmtree(self._own_folder, ignore_errors=True)
        if self._lock is not None:
            self._lock.release()

    def _open_own(self, key: bytes) -> None:
        self._own_folder = (
            self._folder / sha256(key + self._command.encode()).hexdigest()
        )
        try:
            # Nobody continues what is older than a day.
            self._folder.mkdir(parents=True, exist_ok=True)
            for old in self._folder.iterdir():
                if time.time() - old.stat().st_mtime > DAY:
                    (shutil.rmtree if old.is_dir() else Path.unlink)(old)

            # The lock of a process ends with it.
            lock_file = self._own_folder.with_suffix(".lock")
            lock = portalocker.Lock(lock_file, "a", timeout=0, fail_when_locked=True)
            lock.acquire()
            self._lock = lock
        except (OSError, portalocker.LockException):
            return
        if self._is_fresh:
            shutil.rmtree(self._own_folder, ignore_errors=True)
        begin = None
        if self._own_folder.is_dir():
            begin = self._own_folder.stat().st_mtime
        self._own = Cache(self._own_folder, is_counted=True)
        if begin is not None and (number := self._own.number_kept()):
            at = time.strftime("%H:%M", time.localtime(begin))
            warn(f"continues: {number:,} simulated at {at}")


_cache = ContextVar[CommandCache | None]("cache", default=None)
_is_forbidden = ContextVar("is_forbidden", default=False)


def cache_folder() -> Path | None:
    """The folder of the cache; None if nothing is to be kept."""
    named = os.environ.get(FOLDER_VARIABLE, "")
    if named == OFF:
        return None
    if named:
        return Path(named)
    return platformdirs.user_cache_path("safevar_sumo") / "simulations"


@contextmanager
def keep_simulations(command: str = "", *, fresh: bool = False) -> Iterator[None]:
    """Within the block, which carries out a command, simulations are kept, and those that were kept
    are not simulated again; with `fresh` they are.
    """
    folder = cache_folder()
    if folder is None or _is_forbidden.get() or _cache.get() is not None:
        yield
        return
    cache = CommandCache(folder, command, is_fresh=fresh)
    token = _cache.set(cache)
    is_interrupted = False
    try:
        yield
    except KeyboardInterrupt:
        is_interrupted = True
        raise
    finally:
        _cache.reset(token)
        cache.end(is_interrupted=is_interrupted)


@contextmanager
def simulate_anew() -> Iterator[None]:
    """Within the block, no cache is read or written: evidence must not check itself."""
    token = _is_forbidden.set(True)
    try:
        yield
    finally:
        _is_forbidden.reset(token)


def cache_of(study: Study, opened: Sequence[str]) -> Cache | None:
    """Where simulations of a study are kept while a question is asked, if they are; `opened` are
    the names of the files that its user code opens.
    """
    cache = _cache.get()
    if cache:
        return cache.of(study, opened)
    return None


def key_of_settings(
    study_key: bytes, selection: Selection, settings: FloatArray
) -> bytes:
    """The key of settings of a study, as a selection restricts and varies them."""
    digest = sha256(study_key)
    digest.update(msgspec.json.encode([selection, settings.shape]))
    digest.update(np.ascontiguousarray(settings).tobytes())
    return digest.digest()


def content_of(evaluations: Evaluations) -> bytes:
    """Evaluations without failures as the content of an entry."""
    arrays = {name: getattr(evaluations, name) for name in COLUMNS}
    for name, values in evaluations.metrics.items():
        arrays[f"{METRIC}{name}"] = values
    if evaluations.worst_points is not None:
        arrays[POINTS] = evaluations.worst_points
    buffer = BytesIO()
    np.savez(buffer, **arrays)
    return zlib.compress(buffer.getvalue(), FAST)


def evaluations_in(content: bytes | None) -> Evaluations | None:
    """The evaluations in an entry's content; None if it holds none, or there is no entry."""
    if content is None:
        return None
    try:
        with np.load(BytesIO(zlib.decompress(content)), allow_pickle=False) as file:
            arrays = dict(file)
        metrics = {
            name.removeprefix(METRIC): values
            for name, values in arrays.items()
            if name.startswith(METRIC)
        }
        columns = {name: arrays[name] for name in COLUMNS}
        return Evaluations(**columns, metrics=metrics, worst_points=arrays.get(POINTS))
    except (ValueError, KeyError, TypeError, EOFError, BadZipFile, zlib.error):
        return None


def _digest(key: bytes, content: bytes) -> bytes:
    return sha256(key + content).digest()


def package_digest() -> str:
    """A digest of the version of Python and of this package's files."""
    python, _, files = _environment()
    return sha256(msgspec.json.encode([python, files])).hexdigest()


@lru_cache(maxsize=1)
def _environment() -> Any:
    """The versions of Python and of all installed distributions, and the digests of this package's
    files.
    """
    # A distribution may lack a name or a version.
    versions = sorted(
        [package.metadata.get_all("Name", []), package.metadata.get_all("Version", [])]
        for package in distributions()
    )
    return (
        platform.python_version(),
        versions,
        digests(files_in(PACKAGE), [str(PACKAGE)]),
    )
