"""Turns a name in a study into a class, function or record.

The name belongs to this package, or is `package.module:Name` of a module beside the study, in the working directory or
installed.
"""

from __future__ import annotations

import importlib
import inspect
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import msgspec

from safevar_sumo.errors import InputError, UserCodeError, did_you_mean, one_of
from safevar_sumo.output import file_beside
from safevar_sumo.plugins.files import audit_hook, file_of_module
from safevar_sumo.plugins.guard import Guard, completed, contract_of, violation
from safevar_sumo.study import convert_table
from safevar_sumo.study.schema import Parameters


class Member(NamedTuple):
    """The class or record that a name in a study stands for.

    For user code, `guard` calls the member; for a member of this package it is None.
    """

    target: Any
    guard: Guard | None = None


_NO_ATTRIBUTE = object()
_added_folders: list[str] = []


class Lookup(NamedTuple):
    """Looks up the names of a study.

    `source` is the study, as errors name it; `folders`, searched first, are those of the study's file and of the files
    that it extends.
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
        guard = Guard(self.source, f"{key} = {name!r}")
        module = self._import(module_name, guard)
        guard = guard._replace(folder=os.path.dirname(file_of_module(module_name.partition(".")[0])))
        target = guard.call("import", getattr, module, attribute, _NO_ATTRIBUTE)
        if target is _NO_ATTRIBUTE:
            problem = (
                f"{guard.name} cannot be imported: AttributeError: {file_of_module(module_name) or module_name} "
                f"has no {attribute!r}"
            )
            raise InputError(self.source, problem, expected)
        return Member(target, guard._replace(target=target))

    def class_of(self, shipped: Mapping[str, Any], name: str, key: str, *bases: type, otherwise: str = "") -> Member:
        """A class by name; a user's class must meet the contract of the first base that it derives from, else of the
        last one.

        `otherwise` is what the study may give in place of a class, for the error.
        """
        member = self.find(shipped, name, key)
        if member.guard is None:
            return member
        base = next(
            (base for base in bases if inspect.isclass(member.target) and issubclass(member.target, base)), bases[-1]
        )
        if reason := violation(member.target, base):
            expected = "; or ".join([*map(contract_of, bases), *filter(None, [otherwise])])
            raise UserCodeError(self.source, f"{member.guard.name} {reason}", expected, member.guard.definition(""))
        return member._replace(target=completed(member.target, base))

    def with_paths(self, member: Member, parameters: Parameters, key: str) -> Parameters:
        """Parameters for a member that is user code, in which names of files beside the study's file are absolute
        paths.

        Raises
        ------
        InputError
            If a text names a file that is only in the working directory: elsewhere the study would read another file.
        """
        if member.guard is None or not self.folders:
            return dict(parameters)
        return {
            name: value if name == "network" else self._with_paths(value, f"{key}.{name}")
            for name, value in parameters.items()
        }

    def _with_paths(self, value: Any, key: str) -> Any:
        if isinstance(value, dict):
            return {name: self._with_paths(item, f"{key}.{name}") for name, item in value.items()}
        if isinstance(value, list):
            return [self._with_paths(item, key) for item in value]
        if not isinstance(value, str):
            return value
        path = file_beside(value, self.folders)
        if not path and file_beside(value, [os.getcwd()]):
            raise InputError(
                self.source,
                f"{key} = {value!r}: that file lies in the working directory, not beside the study's file",
                f"a path relative to {self.folders[0]}",
            )
        return path or value

    def _import(self, name: str, guard: Guard) -> ModuleType:
        if name.partition(".")[0] == "__main__":
            raise InputError(
                self.source,
                f"{guard.name}: other processes cannot import from __main__",
                "a module in a file of its own",
            )
        folders = list(dict.fromkeys((*self.folders, os.getcwd())))
        importlib.invalidate_caches()
        add_import_folders(folders)
        modules_before, dont_write_bytecode = set(sys.modules), sys.dont_write_bytecode
        sys.dont_write_bytecode = True
        try:
            return guard._replace(folder=folders[0]).call("import", importlib.import_module, name)
        except UserCodeError as error:
            problem = error.problem.replace("raised in import", "cannot be imported", 1)
            expected = error.legal or f"a module in {' or '.join(folders)}, or an installed one"
            raise UserCodeError(self.source, problem, expected, error.place) from error
        finally:
            sys.dont_write_bytecode = dont_write_bytecode
            audit_hook.modules |= sys.modules.keys() - modules_before  # `import_module` raises no audit event


def add_import_folders(folders: Iterable[str]) -> None:
    """Let modules import from `folders` and the working directory. The folders come directly before the working
    directory on Python's path: what is listed before it keeps precedence.
    """
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


def instance_of(member: Member, parameters: Parameters, name: str, key: str, source: str) -> Any:
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
        is_user_code = member.guard is not None
        audit_hook.call_depth += is_user_code  # without its guard, which would hide the errors of `convert_table`
        try:
            return convert_table(source, parameters, cls, key)
        finally:
            audit_hook.call_depth -= is_user_code
    check_parameters(cls, (), parameters, name, key, source)
    return (member.guard or Guard(source, name)).call("__init__", cls, **parameters)


def check_parameters(
    function: Callable[..., object],
    arguments: tuple[object, ...],
    parameters: Parameters,
    name: str,
    key: str,
    source: str,
) -> None:
    """Raise an `InputError` if a class or function does not take these parameters besides the arguments."""
    try:
        inspect.signature(function).bind(*arguments, **parameters)
    except TypeError as error:
        raise InputError(source, f"{name} does not take {key} = {dict(parameters)}: {error}") from None
    except ValueError:  # compiled code, without a signature: the call itself checks them
        pass
