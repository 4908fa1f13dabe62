"""The cache of simulations keeps results of simulations on disk. A question that is asked again, or
that was interrupted, simulates only the settings that the cache lacks. A digest of everything that
results depend on is the key of an entry.

Nobody can know which files user code reads. Therefore the simulations of user code are kept for the
running command only, in a separate folder. The end of the command removes this folder. After a kill
or an interruption the folder stays, and the same command continues from it within a day.
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

import diskcache
import msgspec
import numpy as np
import platformdirs
import portalocker
from diskcache.core import MODE_BINARY, MODE_RAW

from safevar_sumo.campaign.evaluation import Selection, system_of
from safevar_sumo.campaign.inputs import manifest_now
from safevar_sumo.errors import hint, warn
from safevar_sumo.plugins import digests, file_by_name, files_in
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.records.evaluations import COLUMNS
from safevar_sumo.results import identity_digest
from safevar_sumo.shipped import PACKAGE
from safevar_sumo.study import Study, user_code_names

FOLDER_VARIABLE = "SAFEVAR_CACHE"
"""The environment variable that names the folder of the cache."""
OFF = "off"
"""The value of this variable that turns the cache off."""
SIZE_LIMIT = 1_000_000_000
"""Largest size of the cache [bytes]. Beyond this size, the entries that have not been read for the
longest time are removed.
"""
DIGEST_SIZE = 32
"""Size of the digest at the beginning of an entry [bytes]."""
FAST = 1
"""The level of zlib's compression. Compressed results take a sixth of their size, at 100 MB/s."""
COMMANDS = "commands"
"""Name of the folder for simulations of commands with user code."""
DAY = 86_400.0
"""Time within which an interrupted command can be continued [s]."""
GUARD = "guard.lock"
"""Name of the file that a process locks while it looks at the locks of commands."""
NUMBER = b"number"
"""The key of the entry that counts the settings whose results a cache has."""
METRIC = "metric "
"""Beginning of the name of an entry's array with the values of a metric."""
POINTS = "worst_points"
"""Name of an entry's array with the worst points."""
UNUSABLE = (OSError, sqlite3.Error, diskcache.Timeout)
"""The exceptions of a cache that cannot be read or written."""


class _PlainBytes(diskcache.Disk):  # type: ignore[misc]
    """Reads only bytes. The library would unpickle other entries, and an entry that somebody else
    wrote could then run code.
    """

    def fetch(self, mode: int, filename: str | None, value: Any, read: bool) -> Any:
        if mode not in (MODE_RAW, MODE_BINARY):
            return b""
        return super().fetch(mode, filename, value, read)


class Cache:
    """The entries of a folder. Several processes may use the folder at the same time. If the folder
    cannot be read or written, the user gets one warning, and the cache keeps nothing any more.

    Parameters
    ----------
    is_read
        Whether entries are read; entries are written in any case.
    is_counted
        Whether the entry `NUMBER` counts the settings whose results are kept.
    """

    def __init__(
        self, folder: Path, *, is_read: bool = True, is_counted: bool = False
    ) -> None:
        self._folder = folder
        self._is_read = is_read
        self._keys = dict[bytes, bytes]()
        self._is_counted = is_counted
        self._entries: diskcache.Cache | None = self._guarded(self._open, None)

    def key_of(self, study: Study, opened: Sequence[str]) -> bytes:
        """The digest of everything that simulations of a study depend on, except their settings.
        `opened` are the names of the files that the study's user code opens.
        """
        packed_study = msgspec.msgpack.encode(study)
        if packed_study not in self._keys:
            # The key contains the identity of results (the study and its files). The key also
            # contains the places of the files, this package's files, and the versions of Python and
            # of all installed distributions.
            manifest = manifest_now(study, system_of(study), opened)
            paths = [
                os.path.abspath(file_by_name(name, study.origin.places))
                for name in manifest["files"]
            ]
            parts = [identity_digest(manifest), paths, _environment()]
            self._keys[packed_study] = sha256(msgspec.json.encode(parts)).digest()
        return self._keys[packed_study]

    def get(self, key: bytes) -> bytes | None:
        """The content of an entry; None if the entry is missing, or somebody has altered it."""
        # Another thread may set `_entries` to None during this call, after an error of the folder.
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
        """Keep an entry. `settings` is the number of settings whose results the entry has."""
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
        """The number of settings whose results a counted cache has."""
        return int(self.get(NUMBER) or 0)

    def extent(self) -> tuple[int, int]:
        """The number of entries, and their size on disk [bytes]."""
        if self._entries is None:
            return 0, 0
        extent: tuple[int, int] = self._guarded(
            lambda entries: (len(entries), entries.volume()), (0, 0), self._entries
        )
        return extent

    def close(self) -> None:
        if self._entries is not None:
            self._guarded(self._entries.close, None)

    def _open(self) -> diskcache.Cache:
        """Open the folder. Beyond `SIZE_LIMIT`, entries that were read least recently are
        removed.
        """
        return diskcache.Cache(
            str(self._folder),
            disk=_PlainBytes,
            size_limit=SIZE_LIMIT,
            eviction_policy="least-recently-used",
        )

    def _guarded(
        self, function: Callable[..., Any], otherwise: Any, *arguments: Any
    ) -> Any:
        """Call a function that uses the folder, and return its result. If the folder fails, the
        cache ends, and the result is `otherwise`.
        """
        try:
            return function(*arguments)
        except UNUSABLE as error:
            self._entries = None
            reason = getattr(error, "strerror", None) or str(error) or "it is in use"
            warn(f"simulations are not kept: {self._folder}: {reason}")
            return otherwise


class CommandCache:
    """The caches of a command. Simulations of shipped code go to a cache that all commands share.
    Simulations of user code go to a cache of this command alone.

    Parameters
    ----------
    command
        The text of the command line.
    is_fresh
        Whether to ignore all results of earlier commands.
    """

    def __init__(self, folder: Path, command: str, *, is_fresh: bool) -> None:
        self._folder = folder / COMMANDS
        self._command = command
        self._is_fresh = is_fresh
        self._lock: portalocker.Lock | None = None
        self._own: Cache | None = None
        self._own_folder: Path | None = None
        self._common = Cache(folder, is_read=not is_fresh)

    def of(self, study: Study, opened: Sequence[str]) -> Cache | None:
        """The cache for the simulations of a study; None if another process runs the same command
        with the same code. `opened` are the names of the files that the study's user code opens.
        """
        if not user_code_names(study):
            return self._common
        if self._own_folder is None:
            self._open_own(self._common.key_of(study, opened))
        return self._own

    def end(self, *, is_interrupted: bool) -> None:
        """Close the caches. Unless the command was interrupted, remove the cache of its user
        code.
        """
        self._common.close()
        if self._own is not None and self._own_folder is not None:
            self._own.close()
            if not is_interrupted:
                shutil.rmtree(self._own_folder, ignore_errors=True)
        if self._lock is not None:
            self._lock.release()

    def _open_own(self, key: bytes) -> None:
        """Open the cache of this command's user code, and lock it. If another process has the lock,
        the command has no such cache. A cache that an interrupted command left is continued.
        """
        self._own_folder = (
            self._folder / sha256(key + self._command.encode()).hexdigest()
        )
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            # One process at a time looks at the locks. Otherwise a process that only looks whether
            # somebody has a lock would take the lock from the process that needs it.
            with (self._folder / GUARD).open("a") as guard:
                portalocker.lock(guard, portalocker.LOCK_EX)
                self._remove_old()
                self._lock = _lock_of(self._own_folder)
        except (OSError, portalocker.LockException):
            return
        if self._lock is None:
            return
        if self._is_fresh:
            shutil.rmtree(self._own_folder, ignore_errors=True)
        begin = None
        if self._own_folder.is_dir():
            begin = self._own_folder.stat().st_mtime
        self._own = Cache(self._own_folder, is_counted=True)
        if begin is None:
            return
        number = self._own.number_kept()
        if number:
            clock = time.strftime("%H:%M", time.localtime(begin))
            hint(f"continues: {number:,} simulated at {clock}")

    def _remove_old(self) -> None:
        """Remove caches into which nobody has written for a day, because no command continues from
        them. The cache of a running command stays.
        """
        paths = [path for path in self._folder.iterdir() if path.name != GUARD]
        for folder in {path.with_suffix("") for path in paths}:
            lock = _lock_of(folder)
            if lock is None:
                continue
            lock_file = Path(lock.filename)
            last_written = max(
                path.stat().st_mtime for path in (lock_file, *folder.glob("*"))
            )
            lock.release()
            if time.time() - last_written > DAY:
                shutil.rmtree(folder, ignore_errors=True)
                lock_file.unlink()


def _lock_of(folder: Path) -> portalocker.Lock | None:
    """Lock the cache of a command; None if another process has locked it. The operating system
    releases the lock when the process ends, even if the process is killed.
    """
    lock = portalocker.Lock(
        folder.with_suffix(".lock"), "a", timeout=0, fail_when_locked=True
    )
    try:
        lock.acquire()
    except portalocker.AlreadyLocked:
        return None
    return lock


_cache = ContextVar[CommandCache | None]("cache", default=None)
_is_forbidden = ContextVar("is_forbidden", default=False)


def cache_folder() -> Path | None:
    """The folder of the cache; None if the user turned the cache off."""
    named = os.environ.get(FOLDER_VARIABLE, "")
    if named == OFF:
        return None
    if named:
        return Path(named)
    return platformdirs.user_cache_path("safevar_sumo") / "simulations"


@contextmanager
def keep_simulations(command: str = "", *, fresh: bool = False) -> Iterator[None]:
    """Within the block, which carries out a command, keep the results of simulations, and use kept
    results instead of new simulations. With `fresh`, ignore results of earlier commands.
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
    """Within the block, read and write no cache. Otherwise a check would compare results with
    themselves.
    """
    token = _is_forbidden.set(True)
    try:
        yield
    finally:
        _is_forbidden.reset(token)


def cache_of(study: Study, opened: Sequence[str]) -> Cache | None:
    """The cache for the simulations of a study; None if nothing is kept. `opened` are the names of
    the files that the study's user code opens.
    """
    cache = _cache.get()
    if cache:
        return cache.of(study, opened)
    return None


def key_of_settings(
    study_key: bytes, selection: Selection, settings: FloatArray
) -> bytes:
    """The key of settings of a study. A `selection` says with which points and variations the
    settings are simulated.
    """
    digest = sha256(study_key)
    digest.update(msgspec.json.encode([selection, settings.shape]))
    digest.update(np.ascontiguousarray(settings).tobytes())
    return digest.digest()


def content_of(evaluations: Evaluations) -> bytes:
    """Convert evaluations without failures into the content of an entry."""
    arrays = {name: getattr(evaluations, name) for name in COLUMNS}
    for name, values in evaluations.metrics.items():
        arrays[f"{METRIC}{name}"] = values
    if evaluations.worst_points is not None:
        arrays[POINTS] = evaluations.worst_points
    buffer = BytesIO()
    np.savez(buffer, **arrays)
    return zlib.compress(buffer.getvalue(), FAST)


def evaluations_in(content: bytes | None) -> Evaluations | None:
    """Read the evaluations in the content of an entry; None if there is no content. The cache has
    compared the content with its digest: it is as `content_of` has written it.
    """
    if content is None:
        return None
    with np.load(BytesIO(zlib.decompress(content)), allow_pickle=False) as file:
        arrays = dict(file)
    metrics = {
        name.removeprefix(METRIC): values
        for name, values in arrays.items()
        if name.startswith(METRIC)
    }
    columns = {name: arrays[name] for name in COLUMNS}
    return Evaluations(**columns, metrics=metrics, worst_points=arrays.get(POINTS))


def _digest(key: bytes, content: bytes) -> bytes:
    return sha256(key + content).digest()


def package_digest() -> str:
    """A digest of the version of Python, and of this package's files."""
    python, _, files = _environment()
    return sha256(msgspec.json.encode([python, files])).hexdigest()


@lru_cache(maxsize=1)
def _environment() -> Any:
    """The version of Python, the versions of all installed distributions, and the digests of this
    package's files.
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
