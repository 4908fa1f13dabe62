"""Turns a name in a study into a class, function or record.

The name belongs to this package, or is `package.module:Name` of a module beside the study, in the working directory or installed.
"""

from __future__ import annotations

import importlib
import inspect
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from hashlib import sha256
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import msgspec

from safevar_sumo.errors import InputError, UserCodeError, did_you_mean, one_of
from safevar_sumo.plugins.files import audit_hook, file_beside, is_user_file
from safevar_sumo.plugins.guard import Contract, Guard
from safevar_sumo.study import convert_table

_KNOWN_MODULES = {__name__.partition(".")[0], "__main__", "__mp_main__", *sys.stdlib_module_names}
"""Names of top modules that are no user code: this package, the script that runs, and Python's standard library."""


class Member(NamedTuple):
    """The class or record that a name in a study stands for.

    For user code, `guard` calls the member, `module` is the name of its module, and `folder` the folder of the module's top package. For
    a member of this package, `guard` is None and the texts are "". For an FMU, `file` is its path and `target` the class that simulates it.
    """

    target: Any
    guard: Guard | None = None
    module: str = ""
    folder: str = ""
    file: str = ""


class _LoadedModule(NamedTuple):
    """A module loaded from a user's folder, and the digest of its source at that time."""

    folder: str
    file: str
    digest: bytes


_NO_ATTRIBUTE = object()
_loaded_modules: dict[str, _LoadedModule] = {}
_added_folders: list[str] = []


class Lookup(NamedTuple):
    """Looks up the names of a study.

    `source` is the study, as errors name it; `folders`, searched first, are those of the study's file and of the files that it extends.
    """

    source: str
    folders: Sequence[str] = ()

    def find(self, shipped: Mapping[str, Any], name: str, key: str) -> Member:
        """The object called `name` among the `shipped` ones, or the object that `package.module:Name` names.

        Raises
        ------
        InputError
            If there is no such object or module.
        UserCodeError
            If the module fails while it is imported.
        """
        if name in shipped:
            return Member(shipped[name])
        expected = f"{one_of(shipped)}, or package.module:Name" if shipped else "package.module:Name"
        module_name, colon, attribute = name.partition(":")
        if not (colon and attribute.isidentifier() and all(part.isidentifier() for part in module_name.split("."))):
            raise InputError(self.source, f"{key} = {name!r}{did_you_mean(name, shipped)}", expected)
        folders = [*self.folders, os.getcwd()]
        module, folder = self._import(module_name, Guard(self.source, f"{key} = {name!r}"), folders)
        target = Guard(self.source, f"{key} = {name!r}", folder).call("import", getattr, module, attribute, _NO_ATTRIBUTE)
        if target is _NO_ATTRIBUTE:
            problem = f"{key} = {name!r} cannot be imported: AttributeError: {module.__file__ or module_name} has no {attribute!r}"
            raise InputError(self.source, problem, expected)
        return Member(target, Guard(self.source, f"{key} = {name!r}", folder, target), module_name, folder)

    def class_of(self, shipped: Mapping[str, Any], name: str, key: str, *contracts: Contract, otherwise: str = "") -> Member:
        """A class by name; a user's class must meet the first contract that applies to it.

        `otherwise` is what the study may give in place of a class, for the error.
        """
        member = self.find(shipped, name, key)
        contract = next(contract for contract in contracts if contract.applies_to(member.target))
        reason = contract.violation(member.target) if member.guard else ""
        if reason:
            raise InputError(self.source, f"{key} = {name!r} {reason}", "; or ".join([*map(str, contracts), *filter(None, [otherwise])]))
        return member

    def with_paths(self, member: Member, parameters: Mapping[str, Any], key: str) -> dict[str, Any]:
        """Parameters for a member that is user code, in which names of files beside the study's file are absolute paths.

        Raises
        ------
        InputError
            If a text names a file that is only in the working directory: elsewhere the study would read another file.
        """
        if member.guard is None or not self.folders:
            return dict(parameters)
        return {name: value if name == "network" else self._with_paths(value, f"{key}.{name}") for name, value in parameters.items()}

    def _with_paths(self, value: Any, key: str) -> Any:
        if isinstance(value, dict):
            return {name: self._with_paths(item, f"{key}.{name}") for name, item in value.items()}
        if isinstance(value, list):
            return [self._with_paths(item, key) for item in value]
        if not isinstance(value, str):
            return value
        path = file_beside(value, self.folders)
        if not path and file_beside(value, [os.getcwd()]):
            raise InputError(self.source, f"{key} = {value!r}: that file lies in the working directory, not beside the study's file",
                             f"a path relative to {self.folders[0]}")
        return path or value

    def _import(self, name: str, guard: Guard, folders: list[str]) -> tuple[ModuleType, str]:
        """The module and the folder of its top package."""
        importlib.invalidate_caches()
        top = name.partition(".")[0]
        if top == "__main__":
            raise InputError(self.source, f"{guard.name}: other processes cannot import from __main__", "a module in a file of its own")
        folder = _find_module_folder(top, folders)
        _unload_stale_modules(folders)
        add_import_folders(folders)
        if folder:
            self._refuse_installed_name(top, folder, guard)
        modules_before = set(sys.modules)
        dont_write_bytecode, sys.dont_write_bytecode = sys.dont_write_bytecode, True
        try:
            module = guard._replace(folder=folder).call("import", importlib.import_module, name)
        except UserCodeError as error:
            problem = error.problem.replace("raised in import", "cannot be imported", 1)
            expected = error.legal or f"a module in {' or '.join(dict.fromkeys(folders))}, or an installed one"
            raise UserCodeError(self.source, problem, expected) from error
        finally:
            sys.dont_write_bytecode = dont_write_bytecode
            note_user_modules(set(sys.modules) - modules_before, folders)
        return module, folder or _folder_of(sys.modules[top])

    def _refuse_installed_name(self, top: str, folder: str, guard: Guard) -> None:
        """Raise an `InputError` if a file has the name of an installed module; unload the file's module if other code imported it."""
        module = sys.modules.get(top)
        if module is None or top in _loaded_modules:
            return
        if _folder_of(module) != folder:
            raise InputError(self.source, f"{guard.name}: {top} in {folder} has the name of {module.__file__ or 'a part of Python'}",
                             "a file of another name")
        if not hasattr(module, "__path__"):
            del sys.modules[top]


def _find_module_folder(top: str, folders: Iterable[str]) -> str:
    """The first folder with a module or package named `top`; "" if only an installed module can have this name.

    An installed module takes precedence over a package without __init__.py.
    """
    specs = {folder: spec for folder in folders if (spec := PathFinder.find_spec(top, [folder]))}
    regular_folders = [folder for folder, spec in specs.items() if spec.origin is not None]
    if regular_folders or not specs:
        return next(iter(regular_folders), "")
    installed = PathFinder.find_spec(top, [folder for folder in sys.path if folder and folder not in _added_folders])
    return "" if installed else next(iter(specs))


def _folder_of(module: ModuleType) -> str:
    """The folder of a top module or package."""
    paths = list(getattr(module, "__path__", []))
    return str(Path(paths[0] if paths else module.__file__ or "").resolve().parent)


def add_import_folders(folders: Iterable[str]) -> None:
    """Let modules import from `folders` and the working directory; folders that Python's path lists before the latter keep precedence."""
    sys.path[:] = [folder for folder in sys.path if folder not in _added_folders]
    _added_folders[:] = [folder for folder in dict.fromkeys((*folders, os.getcwd())) if folder not in sys.path]
    indices = [i for i, folder in enumerate(sys.path) if folder in ("", os.getcwd())]
    start = indices[0] if indices else len(sys.path)
    sys.path[start:start] = _added_folders


def added_import_folders() -> list[str]:
    """The folders that `add_import_folders` has added to Python's path."""
    return list(_added_folders)


def inherit_import_folders(folders: Iterable[str]) -> None:
    """Record the folders that `add_import_folders` added in the process from which this one inherited Python's path."""
    _added_folders[:] = folders


def unload_user_modules() -> None:
    """Unload all user modules, so that the next lookup loads them again."""
    _unload(list(_loaded_modules))
    for name in sorted(audit_hook.imported_modules):
        module = sys.modules.get(name)
        path = getattr(module, "__file__", None) or next(iter(getattr(module, "__path__", [])), "")  # a namespace package has no file
        if path and is_user_file(str(path)) and name.partition(".")[0] not in _KNOWN_MODULES:
            del sys.modules[name]
    audit_hook.imported_modules.clear()


def _unload_stale_modules(folders: Iterable[str]) -> None:
    """Unload modules from folders of other studies, and all modules of a folder in which a file has changed."""
    stale_folders = {module.folder for module in _loaded_modules.values()
                     if module.folder not in folders or _digest(module.file) != module.digest}
    _unload({name for name, module in _loaded_modules.items() if module.folder in stale_folders})


def _unload(names: Iterable[str]) -> None:
    for name in names:
        if _loaded_modules.pop(name, None) is not None:
            sys.modules.pop(name, None)


def user_module_names(top: str) -> list[str]:
    """Names of the modules loaded from users' folders and, if `top` is an installed package, of the modules of `top`."""
    if top in _loaded_modules:
        return list(_loaded_modules)
    return [*_loaded_modules, *(name for name in list(sys.modules) if name.partition(".")[0] == top)]


def note_user_modules(names: Iterable[str], folders: Iterable[str]) -> None:
    """Record the modules among `names` that come from users' folders."""
    for name in names:
        if name in _loaded_modules:
            continue
        file = str(getattr(sys.modules.get(name), "__file__", None) or "")
        folder = next((folder for folder in folders if file and Path(folder) in Path(file).parents), "")
        if folder and name.partition(".")[0] not in _KNOWN_MODULES and "site-packages" not in Path(file).parts:
            _loaded_modules[name] = _LoadedModule(folder, file, _digest(file))


def _digest(file: str) -> bytes:
    try:
        return sha256(Path(file).read_bytes()).digest()
    except OSError:
        return b""


def instance_of(member: Member, parameters: Mapping[str, Any], name: str, key: str, source: str) -> Any:
    """An instance of a class.

    Parameters
    ----------
    name
        The class as the study names it, such as `ads.model = 'my_ads:Careful'`.
    key
        Key of the class's parameters in the study, such as `ads.parameters`.

    Raises
    ------
    InputError
        If the class does not take the parameters.
    """
    cls = member.target
    if issubclass(cls, msgspec.Struct):
        audit_hook.call_depth += member.guard is not None
        try:
            return convert_table(source, parameters, cls, key)
        finally:
            audit_hook.call_depth -= member.guard is not None
    check_parameters(cls, (), parameters, name, key, source)
    return (member.guard or Guard(source, name)).call("__init__", partial(cls, **parameters))


def check_parameters(function: Callable[..., Any], arguments: tuple[Any, ...], parameters: Mapping[str, Any], name: str, key: str,
                     source: str) -> None:
    """Raise an `InputError` if a class or function does not take these parameters besides the arguments."""
    try:
        inspect.signature(function).bind(*arguments, **parameters)
    except TypeError as error:
        raise InputError(source, f"{name} does not take {key} = {dict(parameters)}: {error}") from None
    except ValueError:  # compiled code, without a signature: the call itself checks them
        pass


class ModuleCopies:
    """Copies of the user's modules for one vehicle, so that the vehicles of a batch share no variables of these modules.

    Parameters
    ----------
    attribute
        Name of the member in its module.
    folders
        The user's folders, as for `Lookup`.
    other_names
        Names of all other modules; this object adds names to the set.
    """

    def __init__(self, member: Member, attribute: str, folders: Sequence[str], other_names: set[str]) -> None:
        self._member, self._attribute, self._folders, self._other_names = member, attribute, folders, other_names
        self._modules: dict[str, ModuleType] = {}

    def load(self) -> Any:
        """The member from its own copy of the module; call this method within the context `inside`."""
        return getattr(importlib.import_module(self._member.module), self._attribute)

    @contextmanager
    def inside(self) -> Iterator[None]:
        """A context in which imports find these copies; it adds modules that are imported for the first time."""
        shared = self._remove()
        sys.modules.update(self._modules)
        module_count, dont_write_bytecode, sys.dont_write_bytecode = len(sys.modules), sys.dont_write_bytecode, True
        try:
            yield
        finally:
            sys.dont_write_bytecode = dont_write_bytecode
            if len(sys.modules) != module_count:
                note_user_modules(sys.modules.keys() - self._other_names, self._folders)
            self._modules = self._remove()
            if len(sys.modules) + len(self._modules) != module_count:
                self._other_names.update(sys.modules)
            sys.modules.update(shared)

    def _remove(self) -> dict[str, ModuleType]:
        names = user_module_names(self._member.module.partition(".")[0])
        return {name: sys.modules.pop(name) for name in names if name in sys.modules}
