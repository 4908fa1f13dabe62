"""A name in a study becomes a class or a record.

It is one of ours, or `package.module:Name` from beside the study, from the working directory or from what is installed.
"""

from __future__ import annotations

import importlib
import inspect
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from hashlib import sha256
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import msgspec

from safevar_sumo.errors import ForeignError, InputError, did_you_mean, one_of
from safevar_sumo.plugins.contract import Contract
from safevar_sumo.plugins.digests import beside
from safevar_sumo.plugins.guard import Guard
from safevar_sumo.plugins.reading import is_foreign, watch
from safevar_sumo.study import converted

_NOT_FOREIGN = {__name__.partition(".")[0], *sys.stdlib_module_names}


class Member(NamedTuple):
    """What a name in a study stands for.

    Attributes
    ----------
    what
        The class or record itself.
    guard
        Through which it is called; None for one that comes with the package.
    module
        The module that it was found in, by name; "" for one of ours.
    folder
        Where that module's top package lies.
    """

    what: Any
    guard: Guard | None = None
    module: str = ""
    folder: str = ""


class _Loaded(NamedTuple):
    """A module that was loaded from a user's folder, and its source then."""

    folder: str
    file: str
    digest: bytes


_NOTHING = object()
_loaded: dict[str, _Loaded] = {}
_reachable: list[str] = []


class Lookup(NamedTuple):
    """Where a study's names are looked up.

    Attributes
    ----------
    source
        How errors call the study.
    places
        Folders that come first: the study file's own, then those of the files that it extends.
    """

    source: str
    places: Sequence[str] = ()

    def find(self, members: Mapping[str, Any], name: str, key: str) -> Member:
        """The member of ours by that name, or what `package.module:Name` stands for.

        Raises
        ------
        InputError
            If there is no such member or module.
        ForeignError
            If the module fails while it is imported.
        """
        if name in members:
            return Member(members[name])
        legal = f"{one_of(members)}, or package.module:Name" if members else "package.module:Name"
        module_name, colon, attribute = name.partition(":")
        if not (colon and attribute.isidentifier() and all(part.isidentifier() for part in module_name.split("."))):
            raise InputError(self.source, f"{key} = {name!r}{did_you_mean(name, members)}", legal)
        places = [*self.places, os.getcwd()]
        module, folder = self._imported(module_name, Guard(self.source, f"{key} = {name!r}"), places)
        what = Guard(self.source, f"{key} = {name!r}", folder).call("import", getattr, module, attribute, _NOTHING)
        if what is _NOTHING:
            problem = f"{key} = {name!r} cannot be imported: AttributeError: {module.__file__ or module_name} has no {attribute!r}"
            raise InputError(self.source, problem, legal)
        return Member(what, Guard(self.source, f"{key} = {name!r}", folder), module_name, folder)

    def class_of(self, members: Mapping[str, Any], name: str, key: str, *contracts: Contract, otherwise: str = "") -> Member:
        """A class by name; one from outside meets a contract, which is looked at before anything of it is called.

        Of several contracts the first that concerns the class counts. `otherwise` tells what else there is than a class.
        """
        found = self.find(members, name, key)
        contract = next(contract for contract in contracts if contract.concerns(found.what))
        reason = contract.lacking(found.what) if found.guard else ""
        if reason:
            raise InputError(self.source, f"{key} = {name!r} {reason}", "; or ".join([*map(str, contracts), *filter(None, [otherwise])]))
        return found

    def with_paths(self, member: Member, parameters: Mapping[str, Any], key: str) -> dict[str, Any]:
        """Parameters for a member from outside: texts that name files beside the study's file as whole paths.

        Raises
        ------
        InputError
            If a text names a file of the working directory alone, which would be another file in another one.
        """
        if member.guard is None or not self.places:
            return dict(parameters)
        return {name: self._with_paths(value, f"{key}.{name}") for name, value in parameters.items() if name != "network"} | {
            name: value for name, value in parameters.items() if name == "network"}

    def _with_paths(self, value: Any, key: str) -> Any:
        if isinstance(value, dict):
            return {name: self._with_paths(one, f"{key}.{name}") for name, one in value.items()}
        if isinstance(value, list):
            return [self._with_paths(one, key) for one in value]
        if not isinstance(value, str):
            return value
        found = beside(value, self.places)
        if not found and beside(value, [os.getcwd()]):
            raise InputError(self.source, f"{key} = {value!r}: that file lies in the working directory, not beside the study's file",
                             f"a path relative to {self.places[0]}")
        return found or value

    def _imported(self, name: str, guard: Guard, places: list[str]) -> tuple[ModuleType, str]:
        """The module, and the folder that its top package lies in."""
        importlib.invalidate_caches()
        top = name.partition(".")[0]
        if top == "__main__":
            raise InputError(self.source, f"{guard.name}: other processes cannot import from __main__", "a module in a file of its own")
        place = _place_of(top, places)
        _forget_all_but(places)
        make_reachable(places)
        if place:
            self._refuse_taken(top, place, guard)
        before = set(sys.modules)
        writes_bytecode, sys.dont_write_bytecode = sys.dont_write_bytecode, True
        try:
            module = guard._replace(folder=place).call("import", importlib.import_module, name)
        except ForeignError as error:
            problem = error.problem.replace("raised in import", "cannot be imported", 1)
            legal = f"a module in {' or '.join(dict.fromkeys(places))}, or an installed one"
            raise ForeignError(self.source, problem, legal) from error
        finally:
            sys.dont_write_bytecode = writes_bytecode
            remember(set(sys.modules) - before, places)
        return module, place or _folder_of(sys.modules[top])

    def _refuse_taken(self, top: str, place: str, guard: Guard) -> None:
        """Refuse a file whose module name stands for another, installed one; import anew what somebody else has imported."""
        loaded = sys.modules.get(top)
        if loaded is None or top in _loaded:
            return
        if _folder_of(loaded) != place:
            raise InputError(self.source, f"{guard.name}: {top} in {place} has the name of {loaded.__file__ or 'a part of Python'}",
                             "a file of another name")
        if not hasattr(loaded, "__path__"):
            del sys.modules[top]


def _place_of(top: str, places: Iterable[str]) -> str:
    """The first folder that holds a module or package of that name; "" if only an installed one can be meant."""
    specs = {place: PathFinder.find_spec(top, [place]) for place in places}
    regular = [place for place, spec in specs.items() if spec is not None and spec.origin is not None]
    if regular:
        return regular[0]
    without_init = [place for place, spec in specs.items() if spec is not None]
    return without_init[0] if without_init and _installed(top) is None else ""


def _installed(top: str) -> ModuleSpec | None:
    return PathFinder.find_spec(top, [place for place in sys.path if place and place not in _reachable])


def _folder_of(module: ModuleType) -> str:
    """The folder that a top module or package lies in."""
    paths = list(getattr(module, "__path__", []))
    return str(Path(paths[0] if paths else module.__file__ or "").resolve().parent)


def make_reachable(places: Iterable[str]) -> None:
    """Let modules import what lies beside them, or in the working directory, but nothing there hides what is installed."""
    sys.path[:] = [place for place in sys.path if place not in _reachable]
    _reachable[:] = [place for place in dict.fromkeys((*places, os.getcwd())) if place not in sys.path]
    here = [i for i, place in enumerate(sys.path) if place in ("", os.getcwd())]
    start = here[0] if here else len(sys.path)
    sys.path[start:start] = _reachable


def reachable() -> list[str]:
    """The folders that `make_reachable` has put into Python's path."""
    return list(_reachable)


def inherit_reachable(folders: Iterable[str]) -> None:
    """In a process that was given another one's path: those are what `make_reachable` had put there, for a study of its own."""
    _reachable[:] = folders


def forget_foreign() -> None:
    """Drop all modules that other people's code consists of: who looks one up next has it loaded anew."""
    _forget(list(_loaded))
    for name in sorted(watch.imported):
        module = sys.modules.get(name)
        place = getattr(module, "__file__", None) or next(iter(getattr(module, "__path__", [])), "")  # a namespace package has no file
        if place and is_foreign(str(place)) and name.partition(".")[0] not in _NOT_FOREIGN:
            del sys.modules[name]
    watch.imported.clear()


def _forget_all_but(places: Iterable[str]) -> None:
    """Drop what was loaded from folders that are not this study's, and all of a folder in which a file has changed."""
    stale = {one.folder for one in _loaded.values() if one.folder not in places or _digest(one.file) != one.digest}
    _forget({name for name, one in _loaded.items() if one.folder in stale})


def _forget(names: Iterable[str]) -> None:
    for name in names:
        if _loaded.pop(name, None) is not None:
            sys.modules.pop(name, None)


def foreign_modules(top: str) -> list[str]:
    """Names of the modules that were loaded from users' folders, and of an installed package of theirs as far as it is loaded."""
    if top in _loaded:
        return list(_loaded)
    return [*_loaded, *(name for name in list(sys.modules) if name.partition(".")[0] == top)]


def remember(names: Iterable[str], places: Iterable[str]) -> None:
    """Take note of those modules that were loaded from users' folders."""
    for name in names:
        if name in _loaded:
            continue
        file = str(getattr(sys.modules.get(name), "__file__", None) or "")
        folder = next((place for place in places if file and Path(place) in Path(file).parents), "")
        if folder and name.partition(".")[0] not in _NOT_FOREIGN and "site-packages" not in Path(file).parts:
            _loaded[name] = _Loaded(folder, file, _digest(file))


def _digest(file: str) -> bytes:
    try:
        return sha256(Path(file).read_bytes()).digest()
    except OSError:
        return b""


def made(member: Member, parameters: Mapping[str, Any], name: str, key: str, source: str) -> Any:
    """An instance.

    Parameters
    ----------
    name
        The member as the study names it, such as `ads.model = 'my_ads:Careful'`.
    key
        Where its parameters stand in the study, such as `ads.parameters`.

    Raises
    ------
    InputError
        If the class does not take the parameters.
    """
    cls = member.what
    if issubclass(cls, msgspec.Struct):
        watch.inside += member.guard is not None
        try:
            return converted(source, parameters, cls, key)
        finally:
            watch.inside -= member.guard is not None
    check_parameters(cls, (), parameters, name, key, source)
    return (member.guard or Guard(source, name)).call("__init__", partial(cls, **parameters))


def check_parameters(function: Callable[..., Any], arguments: tuple[Any, ...], parameters: Mapping[str, Any], name: str, key: str,
                     source: str) -> None:
    """Refuse parameters that a class or function does not take beside its arguments; otherwise as `made`."""
    try:
        inspect.signature(function).bind(*arguments, **parameters)
    except TypeError as error:
        raise InputError(source, f"{name} does not take {key} = {dict(parameters)}: {error}") from None
    except ValueError:  # compiled, without a signature: it tells itself when it is called
        pass
