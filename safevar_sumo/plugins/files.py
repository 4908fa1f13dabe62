"""Files that results depend on: finds the files that user code reads, and names them alike on every machine.

The interpreter raises an audit event for every file that Python code opens and for every module that it loads. Compiled code
raises no event, so all files that a study's parameters name count as read.
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

DIGEST_LENGTH = 16
"""Length of a file's digest."""
Files = dict[str, str]
"""Digests of files by the names that `digests` gives them."""
LIBRARY_FOLDERS = ("site-packages", "dist-packages")
"""Names of folders of installed libraries; such folders may be anywhere."""
KNOWN_FOLDERS = tuple(f"{folder}{os.sep}" for folder in sorted({
    str(PACKAGE), str(STUDIES), str(NETWORKS),
    *(os.path.realpath(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
    *(os.path.realpath(os.path.join(prefix, name)) for prefix in (sys.prefix, sys.base_prefix, "/", "/usr", "/usr/local")
      for name in ("bin", "etc", "include", "lib", "lib64", "sbin", "share")),
    "/dev", "/proc", "/sys", "/System", "/Library", os.environ.get("SYSTEMROOT", "/dev")}))
"""Folders without user code: of this package, the interpreter, installed libraries and the operating system."""
CACHE_FOLDERS = ("__pycache__", ".cache", ".config")
"""Names of folders in which programs keep caches and settings."""
WRITE_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
"""Flags of a file that is opened for writing only; a file opened for reading and writing counts as read."""


class InputFiles:
    """The files that user code reads: absolute `paths` of opened files, and names of loaded `modules`."""

    def __init__(self) -> None:
        self.paths: set[str] = set()
        self.modules: set[str] = set()

    def files(self, packages: Sequence[str] = ()) -> set[str]:
        """Every input file: sources in place of Python's caches, and of installed packages only the files of `packages`."""
        installed = {file for name in list(sys.modules) if name.partition(".")[0] in packages and not is_user_file(file := _file_of(name))}
        files = {*self.paths, *map(_file_of, self.modules), *installed} - {""}
        return {path for path in map(_source_of, files) if _is_input(path, packages)}


def _file_of(module: str) -> str:
    return str(getattr(sys.modules.get(module), "__file__", None) or "")


class _AuditHook:
    """The process's only audit hook, which cannot be removed.

    `call_depth` is the number of calls of user code under way; `recordings` are those of `note_inputs` that are not over.
    `written_files` are files that user code wrote, hence no inputs; `imported_modules` are the names of all modules that it has loaded.
    """

    def __init__(self) -> None:
        self.call_depth, self._is_installed = 0, False
        self.recordings: list[InputFiles] = []
        self.written_files: set[str] = set()
        self.imported_modules: set[str] = set()

    def install(self) -> None:
        if not self._is_installed:
            sys.addaudithook(self._note)
            self._is_installed = True

    def _note(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.call_depth or event not in ("open", "import", "ctypes.dlopen", "sqlite3.connect"):
            return
        target = arguments[0]
        if event == "import":
            self.imported_modules.add(target)
            for recording in self.recordings:
                recording.modules.add(target)
            target = arguments[1]
        if not isinstance(target, str | bytes | os.PathLike):
            return
        path = os.fsdecode(target)
        if event == "sqlite3.connect" and path.startswith("file:"):
            path = unquote(urlsplit(path).path)
        path = os.path.abspath(path)
        if event == "open" and isinstance(arguments[2], int) and arguments[2] & WRITE_FLAGS:
            self.written_files.add(path)
            return
        for recording in self.recordings:
            recording.paths.add(path)


audit_hook = _AuditHook()


@contextmanager
def note_inputs() -> Iterator[InputFiles]:
    """Record the files and modules that user code opens and loads while a guard calls it."""
    audit_hook.install()
    recording = InputFiles()
    audit_hook.recordings.append(recording)
    try:
        yield recording
    finally:
        audit_hook.recordings[:] = [other for other in audit_hook.recordings if other is not recording]


def is_user_file(path: str) -> bool:
    """Whether a file belongs neither to the interpreter or an installed library nor to this package or the operating system."""
    return not path.startswith(KNOWN_FOLDERS) and not any(name in Path(path).parts for name in LIBRARY_FOLDERS)


def _source_of(path: str) -> str:
    """The source of a cached module; any other path unchanged."""
    folder, name = os.path.split(path)
    if os.path.basename(folder) == "__pycache__" and name.endswith(".pyc"):
        return os.path.join(os.path.dirname(folder), f"{name.partition('.')[0]}.py")
    return path


def _is_input(path: str, packages: Sequence[str]) -> bool:
    parts = Path(path).parts
    if path in audit_hook.written_files or any(name in parts for name in CACHE_FOLDERS) or not os.path.isfile(path):
        return False
    library_members = [parts[parts.index(folder) + 1] for folder in LIBRARY_FOLDERS if folder in parts]
    return is_user_file(path) or any(member.partition(".")[0] in packages for member in library_members)


def digest_of(path: Path | str) -> str:
    """Digest of a file's content; "" for a missing file.

    The digest of a Python file covers its syntax tree without docstrings; digests of other files do not depend on the kind of line ends.
    """
    try:
        status = os.stat(path)
        return _digest(str(path), status.st_mtime_ns, status.st_size, status.st_ino)
    except OSError:
        return ""


@lru_cache(maxsize=4096)
def _digest(path: str, *_: int) -> str:
    """Digest of a file, cached by its time, size and inode."""
    content = Path(path).read_bytes()
    if path.endswith(".py"):
        with suppress(SyntaxError, ValueError, RecursionError):  # the digest of invalid Python covers the file's content
            content = "".join(_syntax_text(ast.parse(content))).encode()
    return sha256(content.replace(b"\r\n", b"\n")).hexdigest()[:DIGEST_LENGTH]


def _syntax_text(node: Any) -> Iterator[str]:
    """Pieces of text that describe a syntax tree without positions and docstrings, equal in all versions of Python."""
    if isinstance(node, list):
        yield "["
        for child in node:
            yield from _syntax_text(child)
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
                yield from _syntax_text(value)
        yield ")"
    else:
        yield repr(node)


def _is_docstring(body: Sequence[ast.stmt]) -> bool:
    return bool(body) and isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant) and isinstance(body[0].value.value, str)


def digests(paths: Iterable[str], folders: Sequence[str]) -> Files:
    """Digests of files by name.

    Parameters
    ----------
    folders
        The folders of the study's file and of the files that it extends.
    """
    named: dict[str, str] = {}
    for path in sorted(paths):
        extra_parts = 0
        while named.setdefault(_name_of(path, folders, extra_parts), path) != path:
            extra_parts += 1
    return {name: digest_of(path) for name, path in sorted(named.items())}


def _name_of(path: str, folders: Sequence[str], extra_parts: int = 0) -> str:
    """A file's path relative to the first of `folders` that contains the file; if none does, the path's last 2 + `extra_parts` parts."""
    for folder in (*folders, *_import_folders()):
        if not extra_parts and Path(path).is_relative_to(folder):
            return Path(path).relative_to(folder).as_posix()
    return Path(*Path(path).parts[-2 - extra_parts:]).as_posix()


def file_by_name(name: str, folders: Sequence[str]) -> str:
    """The path of the file that `digests` calls `name`; "" if there is no such file."""
    return next((str(path) for folder in (*folders, *_import_folders()) if (path := Path(folder, name)).is_file()), "")


def changed_files(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Names of files with different digests."""
    return [name for name in sorted({*before, *now}) if before.get(name) != now.get(name)]


def files_named_in(value: Any, folders: Sequence[str]) -> Iterator[str]:
    """Files in `folders` whose names occur as texts anywhere in a value."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for item in value:
            yield from files_named_in(item, folders)
    elif isinstance(value, str):
        path = file_beside(value, folders or (os.getcwd(),))
        if path:
            yield path


def file_beside(text: str, folders: Sequence[str]) -> str:
    """The file that a text names, relative to the folder of the study's file or of a file that it extends; "" if there is none."""
    try:
        return next((os.path.abspath(path) for folder in folders if (path := Path(folder, text)).is_file()), "")
    except (OSError, ValueError):  # the text is no path
        return ""


def _import_folders() -> list[str]:
    """Folders in which Python looks for modules."""
    return [os.getcwd(), *(folder for folder in sys.path if folder)]
