"""Finds the class, function or record that a name in a study stands for.

The name is a name of this package, or `package.module:Name`. The module is in a file beside the
study, in the working directory, or installed.
"""

from __future__ import annotations

import importlib.util
import inspect
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from types import MappingProxyType, ModuleType
from typing import Any, NamedTuple

import msgspec
import numpy as np

from safevar_sumo.errors import (
    InputError,
    UserCodeError,
    check_name,
    describe_error,
    did_you_mean,
    one_of,
    subject,
)
from safevar_sumo.output import file_beside
from safevar_sumo.plugins.contract import (
    ABSTRACT,
    UserCode,
    checked_class,
    contract_of,
    user_error_of,
    user_errors,
    violation,
)
from safevar_sumo.plugins.files import is_user_file
from safevar_sumo.plugins.modules import Modules
from safevar_sumo.plugins.process import file_of_module, this_process
from safevar_sumo.plugins.time_limit import end_if_longer
from safevar_sumo.study import Study, convert_table, data_files, free_parameters
from safevar_sumo.study.encounters import Parameters

A_DAY = 86_400.0
"""The longest time limit [s]."""


class Member(NamedTuple):
    """A class or record that a name in a study stands for.

    `code` is the user code as errors name it; None for code of this package. `time_limit` limits
    the time of the class's `__init__` [s].
    """

    target: Any
    code: UserCode | None = None
    time_limit: float = A_DAY


class Lookup:
    """Finds what the names of a study stand for, and checks each class only once.

    `folders` are the folders of the study's file and of the files that the study extends. They are
    searched before the working directory. `files` maps the names of the study's data files to their
    paths. `time_limit` limits the import of user code [s].
    """

    def __init__(
        self,
        folders: Sequence[str] = (),
        files: Mapping[str, str] = MappingProxyType({}),
        time_limit: float = A_DAY,
    ) -> None:
        self._time_limit = time_limit
        self.modules = Modules.of(folders)
        self.folders = folders
        self.files = files
        self._classes = dict[tuple[str, tuple[type, ...]], Member]()

    @classmethod
    def of(cls, study: Study) -> Lookup:
        """The lookup for a study; raises an InputError if one of its data files is missing."""
        return cls(study.origin.places, data_files(study), study.search.time_limit)

    def find(self, shipped: Mapping[str, Any], name: str, key: str) -> Member:
        """Find the object called `name` among the `shipped` objects, or the object that
        `package.module:Name` names. `key` is the study's key with this name, for errors.

        Raises
        ------
        InputError
            If there is no such object or module.
        UserCodeError
            If the module fails while it is imported.
        """
        if name in shipped:
            return Member(shipped[name])
        expected = "package.module:Name"
        if shipped:
            expected = f"{one_of(shipped)}, or {expected}"

        module_name, colon, attribute = name.partition(":")
        if colon and module_name.endswith(".py"):
            dotted = module_name.removesuffix(".py").replace("/", ".")
            raise InputError(
                "",
                f"{key} = {name!r} names a file",
                f"its module: '{dotted}:{attribute}'",
            )
        parts = [attribute, *module_name.split(".")]
        if not all(part.isidentifier() for part in parts):
            problem = f"{key} = {name!r}{did_you_mean(name, shipped)}"
            raise InputError("", problem, expected)

        code = UserCode(f"{key} = {name!r}", modules=self.modules)
        self.modules.is_used = True
        with self.modules.active():
            module = self._import(module_name, code.name)
            file = file_of_module(module.__name__)
            self.modules.note_files()
        this_process.named_files.add(file)
        try:
            target = getattr(module, attribute)
        except AttributeError:
            raise InputError(
                "",
                f"{code.name} cannot be imported: {file} has no {attribute!r}",
                expected,
            ) from None
        return Member(target, code._replace(target=target), self._time_limit)

    def class_of(
        self,
        shipped: Mapping[str, Any],
        name: str,
        key: str,
        *bases: type,
        otherwise: str = "",
    ) -> Member:
        """Find a class by its name. A user's class must meet the contract of one of the `bases`
        (see `_base_of`).

        `otherwise` says what the study may state instead of a class, for the error.
        """
        if (name, bases) in self._classes:
            return self._classes[name, bases]
        member = self.find(shipped, name, key)
        if member.code is None:
            return member
        base = _base_of(member.target, bases)
        reason = violation(member.target, base)
        if reason:
            legal_texts = [contract_of(base) for base in bases]
            if otherwise:
                legal_texts.append(otherwise)
            raise UserCodeError(
                "",
                f"{member.code.name} {reason}",
                "; or ".join(legal_texts),
                member.code.definition(),
            )
        member = self._classes[name, bases] = member._replace(
            target=checked_class(member.code, base)
        )
        # Annotations are evaluated while the class's module is loaded. Names that only type
        # checkers know are an error only if somebody asks for these parameters.
        with self.modules.active(), suppress(NameError, AttributeError, TypeError):
            free_parameters(member.target)
        return member

    def with_paths(
        self, member: Member, parameters: Parameters, key: str
    ) -> Parameters:
        """Replace the names of the study's data files in parameters by absolute paths. In
        parameters of user code, every text that names a data file is replaced; otherwise only the
        parameter `file`.

        Raises
        ------
        InputError
            If a text names an existing file that the study does not list as a data file.
            Results would depend on this file unnoticed.
        """
        if member.code is not None:
            return dict(self._with_paths(parameters, key))
        file = parameters.get("file")
        path = {}
        if isinstance(file, str):
            path = {"file": self.files.get(file, file)}
        return {**parameters, **path}

    def _with_paths(self, value: Any, key: str) -> Any:
        """Replace the names of data files in a value, at any depth of tables and lists."""
        if isinstance(value, dict):
            return {
                name: self._with_paths(item, f"{key}.{name}")
                for name, item in value.items()
            }
        if isinstance(value, list):
            return [self._with_paths(item, key) for item in value]
        # The files of a network belong to the identity of results without being listed.
        is_name = isinstance(value, str) and not key.endswith(".network")
        if (
            is_name
            and value not in self.files
            and file_beside(value, [*self.folders, os.getcwd()])
        ):
            problem = f"{key} = {value!r}: the study does not name this file"
            table = key.partition(".")[0]
            raise InputError("", problem, f"files = [{value!r}] in its table [{table}]")
        if is_name:
            return self.files.get(value, value)
        return value

    def _import(self, name: str, key: str) -> ModuleType:
        """Import a module of user code by its name. Errors name the `key` of the study."""
        if name.partition(".")[0] == "__main__":
            raise InputError(
                "",
                f"{key}: other processes cannot import from __main__",
                "a module in a file of its own",
            )

        # A module beside the study wins over a module of the same name in the working directory.
        folders = list(dict.fromkeys((*self.folders, os.getcwd())))
        importlib.invalidate_caches()
        try:
            with (
                user_errors(subject()),
                np.errstate(),
                end_if_longer(self._time_limit, f"the import of {name}"),
            ):
                return _import_beside(name, folders) or importlib.import_module(name)
        except (ModuleNotFoundError, UserCodeError) as error:
            problem = describe_error(error)
            if isinstance(error, UserCodeError):
                problem = error.problem
            raise UserCodeError(
                "",
                f"{key} cannot be imported: {problem}",
                getattr(error, "legal", "")
                or f"a module in {' or '.join(folders)}, or an installed one",
            ) from error


def _import_beside(name: str, folders: Sequence[str]) -> ModuleType | None:
    """Import a module beside the study whose name equals the name of a loaded module of Python or
    of a library, such as random.py. The loaded module stays: the user's module gets another name.
    None if no such file or no such loaded module exists.
    """
    file = file_beside(f"{name}.py", folders)
    if not file or name not in sys.modules or is_user_file(file_of_module(name)):
        return None
    own_name = f"{name}_beside_the_study"
    if file_of_module(own_name) != file:
        spec = importlib.util.spec_from_file_location(own_name, file)
        assert spec is not None
        assert spec.loader is not None
        sys.modules[own_name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[own_name])
    return sys.modules[own_name]


def _base_of(candidate: Any, bases: Sequence[type]) -> type:
    """The base whose contract a class has to meet: the first base that the class derives from. If
    the class derives from none, the first base whose contract it meets. Otherwise the only base of
    which the class has an abstract method. Otherwise the last base.
    """
    for base in bases:
        if isinstance(candidate, type) and issubclass(candidate, base):
            return base
    for base in bases:
        if not violation(candidate, base):
            return base
    similar = [base for base in bases if _has_some(candidate, base)]
    if len(similar) == 1:
        return similar[0]
    return bases[-1]


def _has_some(candidate: Any, base: type) -> bool:
    """Whether a class has a method that is abstract in a base."""
    return any(
        hasattr(method, ABSTRACT) and hasattr(candidate, name)
        for name, method in vars(base).items()
    )


def instance_of(member: Member, parameters: Parameters, name: str, key: str) -> Any:
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
    with (
        member.code.modules.active() if member.code else nullcontext(),
        user_errors(subject()),
        np.errstate(),
        end_if_longer(member.time_limit, "`__init__`"),
    ):
        # Classes of the package refuse unknown parameters by themselves.
        if member.code is not None:
            accepted = inspect.signature(member.target).parameters
            if not any(item.kind is item.VAR_KEYWORD for item in accepted.values()):
                for parameter in parameters:
                    problem = f"{key}.{parameter}: {name} has no such parameter"
                    check_name("", problem, parameter, accepted)
        if issubclass(member.target, msgspec.Struct):
            return convert_table(parameters, member.target, key)
        try:
            return member.target(**parameters)
        except TypeError as error:
            if user_error_of(error):
                raise
            raise InputError(
                "", f"{name} does not take {key} = {parameters}: {error}"
            ) from None
