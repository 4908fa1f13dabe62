"""What user code uses though its text may not tell: modules imported by computed names, and files that it opens."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from safevar_sumo.plugins.files import Files, digests, is_user_file, name_of_file
from safevar_sumo.plugins.lookup import file_of_module, note_user_modules
from safevar_sumo.shipped import PACKAGE

WRITING = os.O_WRONLY | os.O_RDWR
"""Flags of a file that is not only read."""
_opened: set[str] | None = None
"""Paths that user code has opened to read, while they are recorded."""
_is_listening = False


class Use(NamedTuple):
    """What user code has used: digests of the modules in its folders by name, and names of the files that it has
    opened.
    """

    modules: Files
    opened: list[str]


@contextmanager
def record_use(folders: Sequence[str]) -> Iterator[Use]:
    """Record what user code uses within the block: the record is complete at its end.

    `folders` are those of the study's file and of the files that it extends; modules count from there and from the
    working directory.
    """
    global _opened, _is_listening
    if not _is_listening:
        sys.addaudithook(_listen)  # for the life of this process
        _is_listening = True
    use = Use({}, [])
    before = set(sys.modules)
    opened = _opened = set[str]()
    try:
        yield use
    finally:
        _opened = None
    loaded = sys.modules.keys() - before
    note_user_modules(loaded)
    own_folders = [f"{os.path.abspath(folder)}{os.sep}" for folder in (*folders, os.getcwd())]
    files = {file for file in map(file_of_module, loaded) if is_user_file(file) and file.startswith(tuple(own_folders))}
    use.modules.update(digests((Path(file) for file in files if os.path.isfile(file)), folders))
    data = (path for path in opened - files if os.path.isfile(path) and not path.endswith(".pyc"))
    use.opened.extend(sorted(name_of_file(Path(path), folders) for path in data if is_user_file(path)))


def _listen(event: str, arguments: tuple[Any, ...]) -> None:
    """Note a file that user code opens to read."""
    if event != "open" or _opened is None:
        return
    path, mode, flags = arguments
    is_read = not (set(mode or "") & set("wax+") or (flags or 0) & WRITING)
    if is_read and isinstance(path, str | bytes) and _is_from_user_code():
        _opened.add(os.path.abspath(os.fsdecode(path)))


def _is_from_user_code() -> bool:
    """Whether user code calls, itself or through a library, and not this package."""
    frame = sys._getframe(2)
    while frame is not None:
        file = frame.f_code.co_filename
        if is_user_file(file):
            return True
        if file.startswith(f"{PACKAGE}{os.sep}") and file != __file__:
            return False
        frame = frame.f_back  # type: ignore[assignment]
    return False
