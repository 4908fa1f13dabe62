"""Files that results depend on: those that code from outside reads, and their digests by names that are the same on every machine.

The interpreter raises an audit event for every file that Python code opens and for every module that is loaded. Compiled code
raises none: files that a study's parameters name count in any case.
"""

from __future__ import annotations

import ast
import os
import sys
import sysconfig
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from safevar_sumo.shipped import NETWORKS, PACKAGE, STUDIES

DIGITS = 16
"""Length of a file's digest."""
Files = dict[str, str]
"""Digests of files by their names."""
LIBRARIES = ("site-packages", "dist-packages")
"""Names of folders of installed libraries, wherever they lie."""
NOT_FOREIGN = tuple(f"{place}{os.sep}" for place in sorted({
    str(PACKAGE), str(STUDIES), str(NETWORKS),
    *(os.path.realpath(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
    *(os.path.realpath(os.path.join(prefix, name)) for prefix in (sys.prefix, sys.base_prefix, "/", "/usr", "/usr/local")
      for name in ("bin", "etc", "include", "lib", "lib64", "sbin", "share")),
    "/dev", "/proc", "/sys", "/System", "/Library", os.environ.get("SYSTEMROOT", "/dev")}))
"""Folders of this package, the interpreter, installed libraries and the operating system (devices, fonts, time zones)."""
CACHES = ("__pycache__", ".cache", ".config")
"""Names of folders with programs' own caches and settings."""
WRITES = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
"""Flags of a file opened only for writing; a file opened for reading and writing counts as read."""


class Reading:
    """Absolute `paths` of the files that code from outside opened for reading, and names of the `modules` that it loaded."""

    def __init__(self) -> None:
        self.paths: set[str] = set()
        self.modules: set[str] = set()

    def files(self, packages: Sequence[str] = ()) -> set[str]:
        """Every input file: sources in place of Python's caches; of installed packages only those named in `packages`."""
        installed = {file for name in list(sys.modules) if name.partition(".")[0] in packages and not is_foreign(file := _file_of(name))}
        files = {*self.paths, *map(_file_of, self.modules), *installed} - {""}
        return {path for path in map(_source_of, files) if _counts(path, packages)}


def _file_of(module: str) -> str:
    return str(getattr(sys.modules.get(module), "__file__", None) or "")


class _Watch:
    """State of the process's one audit hook, which cannot be removed.

    `inside` counts the calls of code from outside under way; `written` are files that it wrote, which are no inputs; `imported` are
    names of all modules that it has loaded.
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
        target = arguments[0]
        if event == "import":
            self.imported.add(target)
            for one in self.readings:
                one.modules.add(target)
            target = arguments[1]
        if not isinstance(target, str | bytes | os.PathLike):
            return
        path = os.fsdecode(target)
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
    """Record the files and modules that code from outside opens and loads while a guard calls it."""
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
    """The source of a cached module; any other path unchanged."""
    folder, name = os.path.split(path)
    if os.path.basename(folder) == "__pycache__" and name.endswith(".pyc"):
        return os.path.join(os.path.dirname(folder), f"{name.partition('.')[0]}.py")
    return path


def _counts(path: str, packages: Sequence[str]) -> bool:
    parts = Path(path).parts
    if path in watch.written or any(name in parts for name in CACHES) or not os.path.isfile(path):
        return False
    return is_foreign(path) or any(parts[parts.index(name) + 1].partition(".")[0] in packages for name in LIBRARIES if name in parts)


def digest_of(path: Path | str) -> str:
    """Digest of a file's content; "" for a missing file.

    A Python file counts as its syntax tree without docstrings, any other file as its content without differences in line ends.
    """
    try:
        at = os.stat(path)
        return _digest(str(path), at.st_mtime_ns, at.st_size, at.st_ino)
    except OSError:
        return ""


@lru_cache(maxsize=4096)
def _digest(path: str, *_: int) -> str:
    """Digest of a file, cached by its time, size and inode."""
    content = Path(path).read_bytes()
    if path.endswith(".py"):
        with suppress(SyntaxError, ValueError, RecursionError):  # invalid Python counts as it is
            content = "".join(_tree(ast.parse(content))).encode()
    return sha256(content.replace(b"\r\n", b"\n")).hexdigest()[:DIGITS]


def _tree(node: Any) -> Iterator[str]:
    """A syntax tree without positions and docstrings as text, the same in all versions of Python."""
    if isinstance(node, list):
        yield "["
        for one in node:
            yield from _tree(one)
            yield ","
        yield "]"
    elif isinstance(node, ast.Constant):
        yield f"{type(node.value).__name__} {node.value!r}"
    elif isinstance(node, ast.AST):
        yield f"{type(node).__name__}("
        for name, value in ast.iter_fields(node):
            if name == "body" and isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                value = value[1:] if _is_docstring(value) else value
            if value is not None and value != [] and name not in ("type_comment", "type_ignores"):
                yield f"{name}="
                yield from _tree(value)
        yield ")"
    else:
        yield repr(node)


def _is_docstring(body: Sequence[ast.stmt]) -> bool:
    return bool(body) and isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant) and isinstance(body[0].value.value, str)


def digests(paths: Iterable[str], places: Sequence[str]) -> Files:
    """Digests of files by name.

    Parameters
    ----------
    places
        The folders of the study's file and of those that it extends.
    """
    named: dict[str, str] = {}
    for path in sorted(paths):
        parts = 0
        while named.setdefault(_name_of(path, places, parts), path) != path:
            parts += 1
    return {name: digest_of(path) for name, path in sorted(named.items())}


def _name_of(path: str, places: Sequence[str], more: int = 0) -> str:
    """A file's path relative to the first place that holds it; without one, its last two parts, and `more`."""
    for root in (*places, *_roots()):
        if not more and Path(path).is_relative_to(root):
            return Path(path).relative_to(root).as_posix()
    return Path(*Path(path).parts[-2 - more:]).as_posix()


def located(name: str, places: Sequence[str]) -> str:
    """The file of that name; "" if there is none."""
    return next((str(path) for root in (*places, *_roots()) if (path := Path(root, name)).is_file()), "")


def changed_files(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Names of files with different digests."""
    return [name for name in sorted({*before, *now}) if before.get(name) != now.get(name)]


def named_files(value: Any, places: Sequence[str]) -> Iterator[str]:
    """Files beside a study's file named by texts anywhere in a value."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for one in value:
            yield from named_files(one, places)
    elif isinstance(value, str):
        path = beside(value, places or (os.getcwd(),))
        if path:
            yield path


def beside(text: str, places: Sequence[str]) -> str:
    """The file named by a text, relative to the folder of the study's file or of a file that it extends; "" if there is none."""
    try:
        return next((os.path.abspath(path) for place in places if (path := Path(place, text)).is_file()), "")
    except (OSError, ValueError):  # the text is no path
        return ""


def _roots() -> list[str]:
    """Folders in which Python looks for modules."""
    return [os.getcwd(), *(place for place in sys.path if place)]
