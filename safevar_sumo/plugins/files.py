"""The user's files on which results depend: code, and the data files that a study names. A file has
a name that is the same on every machine.
"""

from __future__ import annotations

import ast
import os
import re
import sys
import sysconfig
from collections.abc import Iterable, Iterator, Sequence
from hashlib import sha256
from pathlib import Path

from safevar_sumo.output import file_beside
from safevar_sumo.shipped import NETWORKS, PACKAGE

DIGEST_LENGTH = 16
"""Length of the digest of a file [characters]."""
CACHE = "__pycache__"
"""The name of Python's folders for compiled files."""
HIDDEN_PATH = re.compile(rf"(^|/)(\.|{CACHE}(/|\Z))")
"""Matches the path of a hidden file or folder, or of a folder with compiled files."""
LIBRARY_FOLDERS = {"site-packages", "dist-packages"}
"""Names of folders with installed libraries. Such folders may be anywhere."""
KNOWN_FOLDERS = tuple(
    f"{folder}{os.sep}"
    for folder in (
        PACKAGE,
        sysconfig.get_path("stdlib"),
        sysconfig.get_path("platstdlib"),
        Path(sys.base_prefix, "DLLs"),
    )
)
"""The folders of this package and of Python itself."""


def is_user_file(path: str) -> bool:
    """Return whether a file belongs to the user: neither to Python, nor to an installed library,
    nor to this package.
    """
    is_known = path.startswith(KNOWN_FOLDERS)
    is_in_library = not LIBRARY_FOLDERS.isdisjoint(Path(path).parts)
    return os.path.isabs(path) and not is_known and not is_in_library


def code_files(modules: Iterable[str], folders: Sequence[str]) -> set[Path]:
    """Find the files of user code: the files of the `modules`, wherever they are, and of all
    modules in the study's folders that they import.

    A module has one file. Of a package, all files count.
    """
    own_folders = (*folders, os.getcwd())
    paths = set()
    visited = {PACKAGE.name, *sys.stdlib_module_names}
    waiting = [(module, (*own_folders, *sys.path)) for module in modules]
    while waiting:
        module, search_path = waiting.pop()
        name = module.partition(".")[0]
        if name in visited:
            continue
        visited.add(name)
        files = _files_of_first(name, search_path)
        paths |= files
        for path in files:
            if path.suffix == ".py":
                for imported in _imported_modules(path):
                    waiting.append((imported, own_folders))
    return paths


def _files_of_first(name: str, folders: Iterable[str]) -> set[Path]:
    """The files of a module in the first folder that has it; no files if no folder has it."""
    for folder in folders:
        files = _files_of_module(Path(folder, name))
        if files:
            return files
    return set()


def _files_of_module(path: Path) -> set[Path]:
    """The file of a module, or all files of a package. `path` is the path without the ending; the
    set is empty if no such module exists.
    """
    module = path.with_suffix(".py")
    if module.is_file():
        return {module}
    if any(path.rglob("*.py")):
        return set(files_in(path))
    return set()


def _imported_modules(path: Path) -> Iterator[str]:
    """The names of the modules that a file imports by their full names, not relative to the
    file.
    """
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module


def files_in(path: Path) -> list[Path]:
    """All files in a folder, except hidden files and compiled files. If `path` is a file, this
    file.
    """
    if path.is_file():
        return [path]
    return [
        file
        for file in path.rglob("*")
        if file.is_file() and not HIDDEN_PATH.search(file.relative_to(path).as_posix())
    ]


def digests(paths: Iterable[Path], folders: Sequence[str]) -> dict[str, str]:
    """The digests of files, by their names.

    Parameters
    ----------
    folders
        The folders of the study's file and of the files that the study extends.
    """
    named_paths = {
        name_of_file(Path(os.path.abspath(path)), folders): path for path in paths
    }
    return {
        name: sha256(path.read_bytes()).hexdigest()[:DIGEST_LENGTH]
        for name, path in sorted(named_paths.items())
    }


def name_of_file(path: Path, folders: Sequence[str]) -> str:
    """The path of a file relative to the first folder that contains the file; the whole path if no
    folder does.
    """
    for folder in _naming_folders(folders):
        # The root of the file system contains every file, so that it gives no shorter name.
        if folder == path.anchor:
            break
        if path.is_relative_to(folder):
            return path.relative_to(folder).as_posix()
    return path.as_posix()


def file_by_name(name: str, folders: Sequence[str]) -> str:
    """The path of the file to which `digests` gives this name; "" if no such file exists."""
    return file_beside(name, _naming_folders(folders))


def is_of_shipped_network(name: str) -> bool:
    """Return whether `digests` gives this name to a file of a shipped network."""
    return (NETWORKS / name).is_file()


def _naming_folders(folders: Sequence[str]) -> list[str]:
    """The folders to which names of files are relative, the first one that has a file first."""
    on_path = [folder for folder in sys.path if os.path.isabs(folder)]
    return [str(NETWORKS), *folders, os.getcwd(), *on_path]
