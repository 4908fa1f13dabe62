"""Finds the files that user code reads, on which results depend, and names them alike on every machine.

The interpreter raises an audit event for every file that Python code opens and for every module that it loads. Compiled
code raises no event, so all files that a study's parameters name count as read.
"""

from __future__ import annotations

import os
import sys
import sysconfig
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from hashlib import file_digest
from pathlib import Path
from typing import Any

from safevar_sumo.output import file_beside
from safevar_sumo.shipped import NETWORKS, PACKAGE, STUDIES

DIGEST_LENGTH = 16
"""Length of a file's digest."""
Files = dict[str, str]
"""Digests of files by the names that `digests` gives them."""
LIBRARY_FOLDERS = ("site-packages", "dist-packages")
"""Names of folders of installed libraries; such folders may be anywhere."""
KNOWN_FOLDERS = tuple(
    f"{folder}{os.sep}"
    for folder in sorted(
        {
            str(PACKAGE),
            str(STUDIES),
            str(NETWORKS),
            *(os.path.realpath(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
            *(
                os.path.realpath(os.path.join(prefix, name))
                for prefix in (sys.prefix, sys.base_prefix, "/", "/usr", "/usr/local")
                for name in ("bin", "etc", "include", "lib", "lib64", "sbin", "share")
            ),
            "/dev",
            "/proc",
            "/sys",
            "/System",
            "/Library",
            os.environ.get("SYSTEMROOT", "/dev"),
        }
    )
)
"""Folders without user code: of this package, the interpreter, installed libraries and the operating system."""
CACHE_FOLDERS = ("__pycache__", ".cache", ".config")
"""Names of folders in which programs keep caches and settings."""
WRITE_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
"""Flags of a file that is opened for writing only; a file opened for reading and writing counts as read."""


class InputFiles:
    """The absolute `paths` of files that user code opens."""

    def __init__(self) -> None:
        self.paths: set[str] = set()

    def files(self, packages: Sequence[str]) -> set[str]:
        """Every input file: sources in place of Python's caches, and of installed packages only the files of
        `packages`.
        """
        modules = {file_of_module(name) for name in list(sys.modules) if name.partition(".")[0] in packages}
        return {path for path in map(_source_of, self.paths | modules) if _is_input(path, packages)}


class _AuditHook:
    """The process's only audit hook, which cannot be removed.

    `call_depth` is the number of calls of user code under way, `modules` the names of all modules that it has loaded,
    `written` the files that it wrote, which are no inputs; `recordings` are those of `note_inputs` that are not over.
    """

    def __init__(self) -> None:
        self.call_depth, self.modules, self.written, self.recordings = 0, set[str](), set[str](), list[InputFiles]()
        sys.addaudithook(self._note)

    def _note(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.call_depth or event not in ("open", "import"):
            return
        if event == "import":
            self.modules.add(arguments[0])
        path = arguments[1] if event == "import" else arguments[0]
        if not isinstance(path, str | bytes | os.PathLike):
            return
        path = os.path.abspath(os.fsdecode(path))
        if event == "open" and isinstance(arguments[2], int) and arguments[2] & WRITE_FLAGS:
            self.written.add(path)
            return
        for recording in self.recordings:
            recording.paths.add(path)


audit_hook = _AuditHook()


@contextmanager
def note_inputs() -> Iterator[InputFiles]:
    """Record the files that user code opens while a guard calls it."""
    recording = InputFiles()
    audit_hook.recordings.append(recording)
    try:
        yield recording
    finally:
        audit_hook.recordings.remove(recording)


def unload_user_modules() -> None:
    """Unload all modules that user code is made of, so that the next lookup loads them again."""
    for name in sorted(audit_hook.modules):
        if (
            (file := file_of_module(name))
            and is_user_file(file)
            and name.partition(".")[0] not in ("safevar_sumo", "__main__")
        ):
            sys.modules.pop(name)
    audit_hook.modules.clear()


def file_of_module(name: str) -> str:
    """The file of a loaded module, or the folder of a package without __init__.py; "" for a module of the
    interpreter.
    """
    module = sys.modules.get(name)
    return str(getattr(module, "__file__", None) or next(iter(getattr(module, "__path__", ())), ""))


def is_user_file(path: str) -> bool:
    """Whether a file belongs neither to the interpreter or an installed library nor to this package or the operating
    system.
    """
    return not path.startswith(KNOWN_FOLDERS) and not any(name in Path(path).parts for name in LIBRARY_FOLDERS)


def _source_of(path: str) -> str:
    """The source of a cached module; any other path unchanged."""
    folder, name = os.path.split(path)
    if os.path.basename(folder) == "__pycache__" and name.endswith(".pyc"):
        return os.path.join(os.path.dirname(folder), f"{name.partition('.')[0]}.py")
    return path


def _is_input(path: str, packages: Sequence[str]) -> bool:
    parts = Path(path).parts
    if path in audit_hook.written or any(name in parts for name in CACHE_FOLDERS) or not os.path.isfile(path):
        return False
    library_members = [parts[parts.index(folder) + 1] for folder in LIBRARY_FOLDERS if folder in parts]
    return is_user_file(path) or any(member.partition(".")[0] in packages for member in library_members)


def digest_of(path: Path | str) -> str:
    """Digest of a file's bytes; "" for a missing file."""
    try:
        with open(path, "rb") as file:
            return file_digest(file, "sha256").hexdigest()[:DIGEST_LENGTH]
    except OSError:
        return ""


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


def _name_of(path: str, folders: Sequence[str], extra_parts: int) -> str:
    """A file's path relative to the first of `folders` that contains the file; if none does, or with `extra_parts`, the
    path's last 2 + `extra_parts` parts.
    """
    for folder in (*folders, *_import_folders()):
        if not extra_parts and Path(path).is_relative_to(folder):
            return Path(path).relative_to(folder).as_posix()
    return Path(*Path(path).parts[-2 - extra_parts :]).as_posix()


def file_by_name(name: str, folders: Sequence[str]) -> str:
    """The path of the file that `digests` calls `name`; "" if there is no such file."""
    return file_beside(name, (*folders, *_import_folders()))


def changed_files(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Names of files with different digests."""
    return [name for name in sorted({*before, *now}) if before.get(name) != now.get(name)]


def files_named_in(value: Any, folders: Sequence[str]) -> Iterator[str]:
    """Files in `folders` whose names occur as texts anywhere in a value."""
    if isinstance(value, dict | list | tuple):
        items = value.values() if isinstance(value, dict) else value
        for item in items:
            yield from files_named_in(item, folders)
    elif isinstance(value, str) and (path := file_beside(value, folders or (os.getcwd(),))):
        yield path


def _import_folders() -> list[str]:
    """Folders in which Python looks for modules."""
    return [os.getcwd(), *(folder for folder in sys.path if folder)]
