"""The cache of simulations: what questions have simulated, on disk, by its content. A question that
is asked again, or was interrupted, simulates only what it lacks.
"""

from __future__ import annotations

import os
import platform
import sqlite3
import zlib
from collections.abc import Callable, Iterator
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
from diskcache.core import MODE_BINARY, MODE_RAW

from safevar_sumo.campaign.evaluation import Selection, system_of
from safevar_sumo.campaign.identity import identity_of
from safevar_sumo.errors import warn
from safevar_sumo.plugins import Use, digests, digests_by_name, files_in
from safevar_sumo.records import CellResults, Evaluations, FloatArray
from safevar_sumo.records.evaluations import COLUMNS
from safevar_sumo.results import identity_digest, manifest_of
from safevar_sumo.shipped import PACKAGE
from safevar_sumo.study import Study

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
METRIC, CELLS, POINTS = "metric ", "cells ", "worst_points"
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
    """

    def __init__(self, folder: Path, *, is_read: bool = True) -> None:
        self._folder = folder
        self._is_read = is_read
        self._entries: diskcache.Cache | None = None
        self._keys = dict[bytes, bytes]()
        self._guarded(self._open, None)

    def key_of(self, study: Study, use: Use) -> bytes:
        """What the simulations of a study depend on besides their settings, as a digest; `use` is
        what its user code uses.
        """
        packed_study = msgspec.msgpack.encode(study)
        if packed_study not in self._keys:
            self._keys[packed_study] = _key_of_study(study, use)
        return self._keys[packed_study]

    def get(self, key: bytes) -> bytes | None:
        """The content of an entry; None if there is none, or it has been altered."""
        entries = self._entries  # which another thread may end
        if entries is None or not self._is_read:
            return None
        entry = self._guarded(entries.get, None, key)
        if not isinstance(entry, bytes):
            return None
        content = entry[DIGEST_SIZE:]
        return content if entry[:DIGEST_SIZE] == _digest(key, content) else None

    def put(self, key: bytes, content: bytes) -> None:
        """Keep an entry."""
        entries = self._entries
        if entries is not None:
            self._guarded(entries.set, None, key, _digest(key, content) + content)

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

    def _guarded(self, function: Callable[..., Any], otherwise: Any, *arguments: Any) -> Any:
        """What a function returns; where the folder is at fault, the cache ends."""
        try:
            return function(*arguments)
        except UNUSABLE as error:
            self._entries = None
            reason = getattr(error, "strerror", None) or str(error) or "it is in use"
            warn(f"simulations are not kept: {self._folder}: {reason}")
            return otherwise


_cache = ContextVar[Cache | None]("cache", default=None)
_is_forbidden = ContextVar("is_forbidden", default=False)


def cache_folder() -> Path | None:
    """The folder of the cache; None if nothing is to be kept."""
    named = os.environ.get(FOLDER_VARIABLE, "")
    if named == OFF:
        return None
    return Path(named) if named else platformdirs.user_cache_path("safevar_sumo") / "simulations"


@contextmanager
def keep_simulations(*, fresh: bool = False) -> Iterator[None]:
    """Within the block, simulations are kept, and those that were kept are not simulated again;
    with `fresh` they are.
    """
    folder = cache_folder()
    if folder is None or _is_forbidden.get() or _cache.get() is not None:
        yield
        return
    cache = Cache(folder, is_read=not fresh)
    token = _cache.set(cache)
    try:
        yield
    finally:
        _cache.reset(token)
        cache.close()


@contextmanager
def simulate_anew() -> Iterator[None]:
    """Within the block, no cache is read or written: evidence must not check itself."""
    token = _is_forbidden.set(True)
    try:
        yield
    finally:
        _is_forbidden.reset(token)


def cache_in_use() -> Cache | None:
    """The cache of the question that is being asked, if it has one."""
    return _cache.get()


def key_of_settings(study_key: bytes, selection: Selection, settings: FloatArray) -> bytes:
    """The key of settings of a study, as a selection restricts and varies them."""
    digest = sha256(study_key)
    digest.update(msgspec.json.encode([selection, settings.shape]))
    digest.update(np.ascontiguousarray(settings).tobytes())
    return digest.digest()


def content_of(evaluations: Evaluations) -> bytes:
    """Evaluations without failures as the content of an entry."""
    arrays = {name: getattr(evaluations, name) for name in COLUMNS}
    arrays |= {f"{METRIC}{name}": values for name, values in evaluations.metrics.items()}
    if evaluations.cells is not None:
        arrays |= {f"{CELLS}{name}": one for name, one in evaluations.cells._asdict().items()}
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
        cells = {
            name.removeprefix(CELLS): one for name, one in arrays.items() if name.startswith(CELLS)
        }
        return Evaluations(
            **{name: arrays[name] for name in COLUMNS},
            metrics={
                name.removeprefix(METRIC): one
                for name, one in arrays.items()
                if name.startswith(METRIC)
            },
            cells=CellResults(**cells) if cells else None,
            worst_points=arrays.get(POINTS),
        )
    except (ValueError, KeyError, TypeError, EOFError, BadZipFile, zlib.error):
        return None


def _key_of_study(study: Study, use: Use) -> bytes:
    """What the simulations of a study depend on besides their settings, as a digest.

    The study and its files count as in the identity of results, and besides that the files that
    user code `use`s, this package's own files, and the versions of Python and of all that is
    installed.
    """
    places = study.origin.places
    identity = identity_of(study, system_of(study), use.modules)
    parts = [
        identity_digest(manifest_of(study, identity)),
        digests_by_name(use.opened, places),
        digests_by_name(use.elsewhere, places),
        _environment(),
    ]
    return sha256(msgspec.json.encode(parts)).digest()


def _digest(key: bytes, content: bytes) -> bytes:
    return sha256(key + content).digest()


@lru_cache(maxsize=1)
def _environment() -> Any:
    """The versions of Python and of all installed distributions, and the digests of this package's
    files.
    """
    versions = sorted((one.metadata["Name"] or "", one.version or "") for one in distributions())
    return platform.python_version(), versions, digests(files_in(PACKAGE), [str(PACKAGE)])
