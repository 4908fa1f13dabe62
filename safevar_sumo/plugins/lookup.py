"""Turns a name in a study into a class or a record.

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
from safevar_sumo.plugins.files import file_beside, is_foreign, watch
from safevar_sumo.plugins.guard import Contract, Guard
from safevar_sumo.study import converted

_KNOWN_MODULES = {__name__.partition(".")[0], *sys.stdlib_module_names}
"""Names of top modules that are not foreign: of this package and of Python."""


class Member(NamedTuple):
    """The class or record that a name in a study stands for.

    For user code, `guard` calls the member, `module` is the name of its module, and `folder` the folder of the module's top package. For
    a member of this package, they are None and "". For an FMU, `file` is its path and `target` the class that simulates it.
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

    `source` is the study, as errors name it; `places` are the folders to search first: the folders of the study's file and of the
    files that it extends.
    """

    source: str
    places: Sequence[str] = ()

    def find(self, members: Mapping[str, Any], name: str, key: str) -> Member:
        """The member with that name, or the object that `package.module:Name` names.

        Raises
        ------
        InputError
            If there is no such member or module.
        UserCodeError
            If the module fails while it is imported.
        """
        if name in members:
            return Member(members[name])
        expected = f"{one_of(members)}, or package.module:Name" if members else "package.module:Name"
        module_name, colon, attribute = name.partition(":")
        if not (colon and attribute.isidentifier() and all(part.isidentifier() for part in module_name.split("."))):
            raise InputError(self.source, f"{key} = {name!r}{did_you_mean(name, members)}", expected)
        places = [*self.places, os.getcwd()]
        module, folder = self._import(module_name, Guard(self.source, f"{key} = {name!r}"), places)
        target = Guard(self.source, f"{key} = {name!r}", folder).call("import", getattr, module, attribute, _NO_ATTRIBUTE)
        if target is _NO_ATTRIBUTE:
            problem = f"{key} = {name!r} cannot be imported: AttributeError: {module.__file__ or module_name} has no {attribute!r}"
            raise InputError(self.source, problem, expected)
        return Member(target, Guard(self.source, f"{key} = {name!r}", folder, target), module_name, folder)

    def class_of(self, members: Mapping[str, Any], name: str, key: str, *contracts: Contract, otherwise: str = "") -> Member:
        """A class by name; a class from outside must meet the first contract that applies to it.

        `otherwise` names further expected values, which are no classes.
        """
        member = self.find(members, name, key)
        contract = next(contract for contract in contracts if contract.applies_to(member.target))
        reason = contract.violation(member.target) if member.guard else ""
        if reason:
            raise InputError(self.source, f"{key} = {name!r} {reason}", "; or ".join([*map(str, contracts), *filter(None, [otherwise])]))
        return member

    def with_paths(self, member: Member, parameters: Mapping[str, Any], key: str) -> dict[str, Any]:
        """Parameters for a member from outside, in which names of files beside the study's file are absolute paths.

        Raises
        ------
        InputError
            If a text names a file that is only in the working directory: elsewhere the study would read another file.
        """
        if member.guard is None or not self.places:
            return dict(parameters)
        return {name: value if name == "network" else self._with_paths(value, f"{key}.{name}") for name, value in parameters.items()}

    def _with_paths(self, value: Any, key: str) -> Any:
        if isinstance(value, dict):
            return {name: self._with_paths(item, f"{key}.{name}") for name, item in value.items()}
        if isinstance(value, list):
            return [self._with_paths(item, key) for item in value]
        if not isinstance(value, str):
            return value
        path = file_beside(value, self.places)
        if not path and file_beside(value, [os.getcwd()]):
            raise InputError(self.source, f"{key} = {value!r}: that file lies in the working directory, not beside the study's file",
                             f"a path relative to {self.places[0]}")
        return path or value

    def _import(self, name: str, guard: Guard, places: list[str]) -> tuple[ModuleType, str]:
        """The module and the folder of its top package."""
        importlib.invalidate_caches()
        top = name.partition(".")[0]
        if top == "__main__":
            raise InputError(self.source, f"{guard.name}: other processes cannot import from __main__", "a module in a file of its own")
        place = _module_folder(top, places)
        _forget_all_but(places)
        make_reachable(places)
        if place:
            self._refuse_installed_name(top, place, guard)
        before = set(sys.modules)
        dont_write_bytecode, sys.dont_write_bytecode = sys.dont_write_bytecode, True
        try:
            module = guard._replace(folder=place).call("import", importlib.import_module, name)
        except UserCodeError as error:
            problem = error.problem.replace("raised in import", "cannot be imported", 1)
            expected = f"a module in {' or '.join(dict.fromkeys(places))}, or an installed one"
            raise UserCodeError(self.source, problem, expected) from error
        finally:
            sys.dont_write_bytecode = dont_write_bytecode
            remember(set(sys.modules) - before, places)
        return module, place or _folder_of(sys.modules[top])

    def _refuse_installed_name(self, top: str, place: str, guard: Guard) -> None:
        """Raise an `InputError` if a file has the name of an installed module; unload the file's module if other code imported it."""
        module = sys.modules.get(top)
        if module is None or top in _loaded_modules:
            return
        if _folder_of(module) != place:
            raise InputError(self.source, f"{guard.name}: {top} in {place} has the name of {module.__file__ or 'a part of Python'}",
                             "a file of another name")
        if not hasattr(module, "__path__"):
            del sys.modules[top]


def _module_folder(top: str, places: Iterable[str]) -> str:
    """The first folder with a module or package named `top`; "" if only an installed module can have this name.

    An installed module takes precedence over a package without __init__.py.
    """
    specs = {place: spec for place in places if (spec := PathFinder.find_spec(top, [place]))}
    regular_folders = [place for place, spec in specs.items() if spec.origin is not None]
    if regular_folders or not specs:
        return next(iter(regular_folders), "")
    installed = PathFinder.find_spec(top, [place for place in sys.path if place and place not in _added_folders])
    return "" if installed else next(iter(specs))


def _folder_of(module: ModuleType) -> str:
    """The folder of a top module or package."""
    paths = list(getattr(module, "__path__", []))
    return str(Path(paths[0] if paths else module.__file__ or "").resolve().parent)


def make_reachable(places: Iterable[str]) -> None:
    """Let modules import from `places` and the working directory; folders before the working directory in Python's path come first."""
    sys.path[:] = [place for place in sys.path if place not in _added_folders]
    _added_folders[:] = [place for place in dict.fromkeys((*places, os.getcwd())) if place not in sys.path]
    indices = [i for i, place in enumerate(sys.path) if place in ("", os.getcwd())]
    start = indices[0] if indices else len(sys.path)
    sys.path[start:start] = _added_folders


def reachable() -> list[str]:
    """The folders that `make_reachable` has added to Python's path."""
    return list(_added_folders)


def inherit_reachable(folders: Iterable[str]) -> None:
    """Record the folders that `make_reachable` added in another process, from which this process inherited its path."""
    _added_folders[:] = folders


def forget_foreign() -> None:
    """Unload all modules from outside the package: the next lookup loads them again."""
    _forget(list(_loaded_modules))
    for name in sorted(watch.imported_modules):
        module = sys.modules.get(name)
        place = getattr(module, "__file__", None) or next(iter(getattr(module, "__path__", [])), "")  # a namespace package has no file
        if place and is_foreign(str(place)) and name.partition(".")[0] not in _KNOWN_MODULES:
            del sys.modules[name]
    watch.imported_modules.clear()


def _forget_all_but(places: Iterable[str]) -> None:
    """Unload modules from folders of other studies, and all modules of a folder in which a file has changed."""
    stale_folders = {module.folder for module in _loaded_modules.values()
                     if module.folder not in places or _digest(module.file) != module.digest}
    _forget({name for name, module in _loaded_modules.items() if module.folder in stale_folders})


def _forget(names: Iterable[str]) -> None:
    for name in names:
        if _loaded_modules.pop(name, None) is not None:
            sys.modules.pop(name, None)


def foreign_modules(top: str) -> list[str]:
    """Names of the modules loaded from users' folders and, if `top` is an installed package, of the modules of `top`."""
    if top in _loaded_modules:
        return list(_loaded_modules)
    return [*_loaded_modules, *(name for name in list(sys.modules) if name.partition(".")[0] == top)]


def remember(names: Iterable[str], places: Iterable[str]) -> None:
    """Record the modules among `names` that come from users' folders."""
    for name in names:
        if name in _loaded_modules:
            continue
        file = str(getattr(sys.modules.get(name), "__file__", None) or "")
        folder = next((place for place in places if file and Path(place) in Path(file).parents), "")
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
        watch.call_depth += member.guard is not None
        try:
            return converted(source, parameters, cls, key)
        finally:
            watch.call_depth -= member.guard is not None
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


class OwnModules:
    """A copy of the user's modules for one of many vehicles, so that each vehicle has its own variables of these modules.

    Parameters
    ----------
    attribute
        Name of the member in its module.
    places
        The user's folders, as for `Lookup`.
    other_names
        Names of all other modules; this object adds names to the set.
    """

    def __init__(self, member: Member, attribute: str, places: Sequence[str], other_names: set[str]) -> None:
        self._member, self._attribute, self._places, self._other_names = member, attribute, places, other_names
        self._modules: dict[str, ModuleType] = {}

    def load(self) -> Any:
        """The member from its own copy of the module; call this method within the context `inside`."""
        return getattr(importlib.import_module(self._member.module), self._attribute)

    @contextmanager
    def inside(self) -> Iterator[None]:
        """A context in which imports find these copies; a module imported for the first time is added to them."""
        shared = self._remove()
        sys.modules.update(self._modules)
        number, dont_write_bytecode, sys.dont_write_bytecode = len(sys.modules), sys.dont_write_bytecode, True
        try:
            yield
        finally:
            sys.dont_write_bytecode = dont_write_bytecode
            if len(sys.modules) != number:
                remember(sys.modules.keys() - self._other_names, self._places)
            self._modules = self._remove()
            if len(sys.modules) + len(self._modules) != number:
                self._other_names.update(sys.modules)
            sys.modules.update(shared)

    def _remove(self) -> dict[str, ModuleType]:
        names = foreign_modules(self._member.module.partition(".")[0])
        return {name: sys.modules.pop(name) for name in names if name in sys.modules}
