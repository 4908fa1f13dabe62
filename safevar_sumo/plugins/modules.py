"""The modules of user code in this process: each system has modules of its own, which are in
`sys.modules` only while its code runs.

Two versions of a study may have modules with the same names. Late imports, in a method or in a
thread, and pickled classes find modules by these names in `sys.modules`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import chdir, contextmanager
from pathlib import Path
from threading import RLock
from types import ModuleType
from typing import NamedTuple

from safevar_sumo.plugins.files import is_user_file
from safevar_sumo.plugins.process import file_of_module, this_process

ONE_AT_A_TIME = RLock()
"""Lock for user code: `sys.modules` holds the modules of one system at a time. Assembling a system
may start SUMO, and takes the lock, too.
"""
_newest = dict[tuple[str, ...], "Modules"]()
"""The modules that were begun last, by their folders."""


class ImportPath(NamedTuple):
    """Python's path (`folders`), and the entries that `add_import_folders` has inserted
    (`added`).
    """

    folders: list[str]
    added: list[str]

    @classmethod
    def here(cls) -> ImportPath:
        """The present path of this process."""
        return cls(sys.path[:], this_process.added_folders)

    def inherit(self) -> None:
        """Set Python's path of this process to this path."""
        sys.path[:] = self.folders
        this_process.added_folders = self.added


def add_import_folders(folders: Iterable[str]) -> None:
    """Let modules import from `folders` and the working directory. The folders are inserted into
    Python's path before its first folder of the user, such as the folder of a script. Entries
    before this place still win.
    """
    for folder in this_process.added_folders:
        if folder in sys.path:
            sys.path.remove(folder)
    added = list(dict.fromkeys((*folders, os.getcwd())))
    start = _first_entry_of_user()
    sys.path[start:start] = added
    this_process.added_folders = added


def _first_entry_of_user() -> int:
    """The index of the first folder of the user in Python's path; the path's length without one."""
    for index, folder in enumerate(sys.path):
        if os.path.isdir(folder or os.curdir) and not _is_of_libraries(folder):
            return index
    return len(sys.path)


class Modules:
    """The modules that the user code of one system has imported, and the path from which it
    imports.

    `folders` are the folders of the study's file and of the files that the study extends.
    """

    def __init__(self, folders: Sequence[str]) -> None:
        self.folders = folders
        self.is_used = False
        self._loaded = dict[str, ModuleType]()
        self._stamps = dict[str, int]()
        # What user code has added to Python's path, before and after the study's folders:
        self._path_before = list[str]()
        self._path_after = list[str]()
        # The surroundings to which the process returns:
        self._hidden = dict[str, ModuleType]()
        self._names = set[str]()
        self._outer_path = ImportPath.here()
        self._writes_no_bytecode = False

    @classmethod
    def begin(cls, folders: Sequence[str]) -> Modules:
        """New modules: the next lookup in these folders loads user code anew."""
        modules = cls(folders)
        _newest[tuple(folders)] = modules
        return modules

    @classmethod
    def of(cls, folders: Sequence[str]) -> Modules:
        """The modules that were begun last for these folders; new ones if a file was edited."""
        newest = _newest.get(tuple(folders))
        if newest is None or newest.are_edited:
            return cls.begin(folders)
        return newest

    @property
    def are_edited(self) -> bool:
        """Whether a file of the modules was edited after its import."""
        return any(_stamp_of(file) != stamp for file, stamp in self._stamps.items())

    @contextmanager
    def active(self) -> Iterator[None]:
        """Within the block, `sys.modules` and Python's path are those of this user code. Nothing
        happens before the first import.

        In a worker, they stay after the block, until other user code runs there: a thread of user
        code may still import.
        """
        if not self.is_used:
            yield
            return
        with ONE_AT_A_TIME:
            outer = this_process.running_modules
            this_process.running_modules = self
            _show(self)
            try:
                yield
            finally:
                this_process.running_modules = outer
                if outer is not None or not this_process.is_worker:
                    _show(outer)

    def note_files(self) -> None:
        """Note when the files of the loaded modules were edited, while the block is active."""
        for name in self._own_names():
            file = file_of_module(name)
            self._stamps.setdefault(file, _stamp_of(file))

    def show(self) -> None:
        """Put the modules into `sys.modules`, in place of all modules that could have their
        names.
        """
        self._outer_path = ImportPath.here()
        self._writes_no_bytecode = sys.dont_write_bytecode
        own_names = {name.partition(".")[0] for name in self._loaded}
        for folder in {*self.folders, os.getcwd()}:
            if os.path.isdir(folder):
                own_names |= {path.stem for path in Path(folder).iterdir()}
        namesakes = [
            name for name in sys.modules if name.partition(".")[0] in own_names
        ]
        self._hidden = _take_modules(_modules_of_user(namesakes))
        self._names = {*sys.modules}
        sys.modules.update(self._loaded)
        # A compiled file would hide an edit in the second in which it was written.
        sys.dont_write_bytecode = True
        add_import_folders(self.folders)
        sys.path[:] = [*self._path_before, *sys.path, *self._path_after]

    def hide(self) -> None:
        """Take the modules out of `sys.modules`, and restore what was there before."""
        self.note_files()
        self._loaded = _take_modules(self._own_names())
        sys.modules.update(self._hidden)
        self._note_path()
        self._outer_path.inherit()
        sys.dont_write_bytecode = self._writes_no_bytecode

    def _note_path(self) -> None:
        """Note the entries that user code has added to Python's path."""
        path = ImportPath.here()
        known = {*self._outer_path.folders, *path.added}
        # `add_import_folders` has inserted the study's folders in one place.
        start = 0
        if path.added[0] in path.folders:
            start = path.folders.index(path.added[0])
        before = path.folders[:start]
        new = [entry for entry in dict.fromkeys(path.folders) if entry not in known]
        self._path_before = [entry for entry in new if entry in before]
        self._path_after = [entry for entry in new if entry not in before]

    def _own_names(self) -> list[str]:
        """The names of these modules in `sys.modules`."""
        return _modules_of_user(sys.modules.keys() - self._names)


def _show(modules: Modules | None) -> None:
    """Let `sys.modules` hold these modules, and no others of user code that a study names."""
    shown_modules = this_process.shown_modules
    if shown_modules is modules:
        return
    if shown_modules is not None:
        shown_modules.hide()
    this_process.shown_modules = modules
    if modules is not None:
        modules.show()


def running_modules() -> Modules:
    """The modules of the user code that runs in this process; empty ones if none runs."""
    return this_process.running_modules or Modules(())


@contextmanager
def only_from(folder: str) -> Iterator[None]:
    """Within the block, find user code and its files in one folder only, which becomes the working
    directory. Other folders only provide libraries. Processes that start within the block do the
    same.
    """
    path = ImportPath.here()
    names = {*sys.modules}
    user_modules = _take_modules(_modules_of_user(names))
    libraries = [entry for entry in path.folders if _is_of_libraries(entry)]
    ImportPath([*libraries, folder], added=[]).inherit()
    try:
        with chdir(folder):
            yield
    finally:
        path.inherit()
        _take_modules(_modules_of_user(sys.modules.keys() - names))
        sys.modules.update(user_modules)


def _modules_of_user(names: Iterable[str]) -> list[str]:
    """The modules of user code among imported ones, except the main module.

    The whole list is made before any module is removed: Python finds the path of a package without
    `__init__.py` only as long as its parent is there.
    """
    return [
        name
        for name in names
        if name != "__main__" and is_user_file(file_of_module(name))
    ]


def _take_modules(names: Iterable[str]) -> dict[str, ModuleType]:
    """Remove modules from `sys.modules`, and return them by their names."""
    return {name: sys.modules.pop(name) for name in names}


def _is_of_libraries(entry: str) -> bool:
    """Return whether an entry of Python's path has libraries, but no user code. "" stands for the
    working directory, which may have user code.
    """
    return bool(entry) and not is_user_file(os.path.join(entry, ""))


def _stamp_of(file: str) -> int:
    """The time of the last edit of a file [ns]; 0 if the file is gone."""
    try:
        return os.stat(file).st_mtime_ns
    except OSError:
        return 0
