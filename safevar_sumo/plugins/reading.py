"""Which files other people's code reads: noted while it runs, as Python reports every file that is opened.

The interpreter raises an audit event for every file that Python code opens and for every module that is loaded. What compiled code
opens by itself raises none: files that a study's parameters name count in any case (`safevar_sumo.plugins.digests`).
"""

from __future__ import annotations

import os
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from safevar_sumo.shipped import NETWORKS, PACKAGE, STUDIES

LIBRARIES = ("site-packages", "dist-packages")
"""Names of folders of installed libraries, wherever they lie."""
NOT_FOREIGN = tuple(f"{place}{os.sep}" for place in sorted({
    str(PACKAGE), str(STUDIES), str(NETWORKS),
    *(os.path.realpath(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
    *(os.path.realpath(os.path.join(prefix, name)) for prefix in (sys.prefix, sys.base_prefix, "/", "/usr", "/usr/local")
      for name in ("bin", "etc", "include", "lib", "lib64", "sbin", "share")),
    "/dev", "/proc", "/sys", "/System", "/Library", os.environ.get("SYSTEMROOT", "/dev")}))
"""Where this package, the interpreter, installed libraries and the operating system's own files lie: devices, fonts, time zones."""
CACHES = ("__pycache__", ".cache", ".config")
"""Names of folders that programs keep for themselves."""
WRITES = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
"""A file that is opened to be written anew; one that is opened for both counts as read."""


class Reading:
    """What one stretch of other people's code has opened and loaded.

    Attributes
    ----------
    paths
        Files opened for reading, as absolute paths.
    modules
        Names of modules loaded.
    """

    def __init__(self) -> None:
        self.paths: set[str] = set()
        self.modules: set[str] = set()

    def files(self, own: Sequence[str] = ()) -> set[str]:
        """Every file that counts: of Python's caches the source, and of installed packages those in `own` alone, by name."""
        installed = {file for name in list(sys.modules) if name.partition(".")[0] in own and not is_foreign(file := _file_of(name))}
        files = {*self.paths, *map(_file_of, self.modules), *installed} - {""}
        return {path for path in map(_source_of, files) if _counts(path, own)}


def _file_of(module: str) -> str:
    return str(getattr(sys.modules.get(module), "__file__", None) or "")


class _Watch:
    """The state of the one audit hook, which cannot be taken out again.

    `inside` counts the calls of other people's code that are under way; `written` are files that they have written, which are no
    inputs; `imported` are names of all modules that they have loaded so far.
    """

    def __init__(self) -> None:
        self.inside, self._hooked = 0, False
        self.readings: list[Reading] = []
        self.written: set[str] = set()
        self.imported: set[str] = set()

    def hook(self) -> None:
        if not self._hooked:
            sys.addaudithook(self._note)
            self._hooked = True

    def _note(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.inside or event not in ("open", "import", "ctypes.dlopen", "sqlite3.connect"):
            return
        what = arguments[0]
        if event == "import":
            self.imported.add(what)
            for one in self.readings:
                one.modules.add(what)
            what = arguments[1]
        if not isinstance(what, str | bytes | os.PathLike):
            return
        path = os.fsdecode(what)
        if event == "sqlite3.connect" and path.startswith("file:"):
            path = unquote(urlsplit(path).path)
        path = os.path.abspath(path)
        if event == "open" and isinstance(arguments[2], int) and arguments[2] & WRITES:
            self.written.add(path)
            return
        for one in self.readings:
            one.paths.add(path)


watch = _Watch()


@contextmanager
def noted_reading() -> Iterator[Reading]:
    """Within, the files and modules that other people's code opens and loads, as far as it is called through a guard."""
    watch.hook()
    reading = Reading()
    watch.readings.append(reading)
    try:
        yield reading
    finally:
        watch.readings[:] = [one for one in watch.readings if one is not reading]


def is_foreign(path: str) -> bool:
    """Whether a file is neither the interpreter's, nor an installed library's, nor of this package, nor the system's."""
    return not path.startswith(NOT_FOREIGN) and not any(name in Path(path).parts for name in LIBRARIES)


def _source_of(path: str) -> str:
    """Of a cached module the file that it was compiled from."""
    folder, name = os.path.split(path)
    if os.path.basename(folder) == "__pycache__" and name.endswith(".pyc"):
        return os.path.join(os.path.dirname(folder), f"{name.partition('.')[0]}.py")
    return path


def _counts(path: str, own: Sequence[str]) -> bool:
    parts = Path(path).parts
    if path in watch.written or any(name in parts for name in CACHES) or not os.path.isfile(path):
        return False
    return is_foreign(path) or any(parts[parts.index(name) + 1].partition(".")[0] in own for name in LIBRARIES if name in parts)
