"""Turns a name in a study into a class, function or record.

The name belongs to this package, or is `package.module:Name` of a module beside the study, in the
working directory or installed.
"""

from __future__ import annotations

import importlib.util
import inspect
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import chdir, contextmanager
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
from safevar_sumo.plugins.process import file_of_module, this_process
from safevar_sumo.plugins.time_limit import end_if_longer
from safevar_sumo.study import Study, convert_table, data_files
from safevar_sumo.study.encounters import Parameters

A_DAY = 86_400.0
"""The longest time limit [s]."""


class Member(NamedTuple):
    """The class or record that a name in a study stands for; `code` is how errors name it if it is
    user code, else None; `time_limit` is that of its `__init__` [s].
    """

    target: Any
    code: UserCode | None = None
    time_limit: float = A_DAY


class Lookup:
    """Looks up the names of a study, each class once.

    `folders`, searched before the working directory, are those of the study's file and of the files
    that it extends; `files` are the paths of its data files by the names that it gives them;
    `time_limit` is that of the import of user code [s].
    """

    def __init__(
        self,
        folders: Sequence[str] = (),
        files: Mapping[str, str] = MappingProxyType({}),
        time_limit: float = A_DAY,
    ) -> None:
        self._time_limit = time_limit
        self.folders = folders
        self.files = files
        self._classes = dict[tuple[str, tuple[type, ...]], Member]()

    @classmethod
    def of(cls, study: Study) -> Lookup:
        """The lookup for a study; raises an InputError if one of its data files is missing."""
        return cls(study.origin.places, data_files(study), study.search.time_limit)

    def find(self, shipped: Mapping[str, Any], name: str, key: str) -> Member:
        """The object called `name` among the `shipped` ones, or the object that
        `package.module:Name` names.

        Raises
        ------
        InputError
            If there is no such object or module.
        UserCodeError
            If the module fails while it is imported.
        """
        if name in shipped:
            return Member(shipped[name])
        expected = (
            f"{one_of(shipped)}, or package.module:Name"
            if shipped
            else "package.module:Name"
        )

        module_name, colon, attribute = name.partition(":")
        if colon and module_name.endswith(".py"):
            dotted = module_name.removesuffix(".py").replace("/", ".")
            raise InputError(
                "",
                f"{key} = {name!r} names a file",
                f"its module: '{dotted}:{attribute}'",
            )
        if not (
            colon
            and attribute.isidentifier()
            and all(part.isidentifier() for part in module_name.split("."))
        ):
            raise InputError(
                "", f"{key} = {name!r}{did_you_mean(name, shipped)}", expected
            )

        code = UserCode(f"{key} = {name!r}")
        module = self._import(module_name, code.name)
        module_name = module.__name__
        this_process.named_files.add(file_of_module(module_name))
        try:
            target = getattr(module, attribute)
        except AttributeError:
            raise InputError(
                "",
                f"{code.name} cannot be imported: {file_of_module(module_name)} has no"
                f" {attribute!r}",
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
        """A class by name; a user's class must meet the contract of the first base that it derives
        from, else of that which it meets, else of that of which it has an abstract method, else of
        the last one.

        `otherwise` is what the study may give in place of a class, for the error.
        """
        if (name, bases) in self._classes:
            return self._classes[name, bases]
        member = self.find(shipped, name, key)
        if member.code is None:
            return member
        base = _base_of(member.target, bases)
        if reason := violation(member.target, base):
            raise UserCodeError(
                "",
                f"{member.code.name} {reason}",
                "; or ".join([*map(contract_of, bases), *filter(None, [otherwise])]),
                member.code.definition(),
            )
        member = self._classes[name, bases] = member._replace(
            target=checked_class(member.code, base)
        )
        return member

    def with_paths(
        self, member: Member, parameters: Parameters, key: str
    ) -> Parameters:
        """Parameters of a member; the names of the study's data files become absolute paths: for
        user code all, otherwise that of the parameter `file`.

        Raises
        ------
        InputError
            If a text names a file that is none of the data files: results would depend on it
            unnoticed.
        """
        if member.code is not None:
            return dict(self._with_paths(parameters, key))
        file = parameters.get("file")
        path = {}
        if isinstance(file, str):
            path = {"file": self.files.get(file, file)}
        return {**parameters, **path}

    def _with_paths(self, value: Any, key: str) -> Any:
        if isinstance(value, dict):
            return {
                name: self._with_paths(item, f"{key}.{name}")
                for name, item in value.items()
            }
        if isinstance(value, list):
            return [self._with_paths(item, key) for item in value]
        # A network counts anyway.
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
        if name.partition(".")[0] == "__main__":
            raise InputError(
                "",
                f"{key}: other processes cannot import from __main__",
                "a module in a file of its own",
            )

        # Modules beside the study come before those of the working directory.
        folders = list(dict.fromkeys((*self.folders, os.getcwd())))
        importlib.invalidate_caches()
        add_import_folders(folders)
        modules_before = set(sys.modules)
        dont_write_bytecode = sys.dont_write_bytecode
        sys.dont_write_bytecode = True

        try:
            with (
                user_errors(subject()),
                np.errstate(),
                end_if_longer(self._time_limit, f"the import of {name}"),
            ):
                return _import_beside(name, folders) or importlib.import_module(name)
        except (ModuleNotFoundError, UserCodeError) as error:
            problem = (
                error.problem
                if isinstance(error, UserCodeError)
                else describe_error(error)
            )
            raise UserCodeError(
                "",
                f"{key} cannot be imported: {problem}",
                getattr(error, "legal", "")
                or f"a module in {' or '.join(folders)}, or an installed one",
            ) from error
        finally:
            sys.dont_write_bytecode = dont_write_bytecode
            this_process.modules |= sys.modules.keys() - modules_before


def _import_beside(name: str, folders: Sequence[str]) -> ModuleType | None:
    """A module beside the study with the name of one of Python or of a library that is loaded, such
    as random.py, which stays: under a name of its own. None for any other name.
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
    """The first base that a class derives from; else that whose contract it meets; else the only
    one of which it has an abstract method; else the last one.
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


def unload_user_modules() -> None:
    """Unload all modules that user code is made of, so that the next lookup loads them again."""
    for name in this_process.modules:
        if is_user_file(file_of_module(name)):
            del sys.modules[name]
    this_process.modules.clear()


def add_import_folders(folders: Iterable[str]) -> None:
    """Let modules import from `folders` and the working directory. The folders come directly before
    the working directory on Python's path: what is listed before it keeps precedence.
    """
    sys.path[:] = [
        folder for folder in sys.path if folder not in this_process.added_folders
    ]
    added = [
        folder
        for folder in dict.fromkeys((*folders, os.getcwd()))
        if folder not in sys.path
    ]
    this_process.added_folders = added
    indices = (i for i, folder in enumerate(sys.path) if folder in ("", os.getcwd()))
    start = next(indices, len(sys.path))
    sys.path[start:start] = added


class ImportPath(NamedTuple):
    """Python's path, and those of its folders that `add_import_folders` has added."""

    folders: list[str]
    added: list[str]

    @classmethod
    def here(cls) -> ImportPath:
        """The path of this process."""
        return cls(sys.path[:], this_process.added_folders)

    def inherit(self) -> None:
        """Make this the path of this process."""
        sys.path[:], this_process.added_folders = self


@contextmanager
def only_from(folder: str) -> Iterator[None]:
    """Within the block, also in processes that start in it, user code and files that it names
    without their folder are those of one folder, the working directory; only libraries are imported
    from elsewhere.
    """
    path = ImportPath.here()
    modules = dict(sys.modules)
    users = {
        name
        for name in modules
        if name != "__main__" and is_user_file(file_of_module(name))
    }
    for name in users:
        del sys.modules[name]
    ImportPath([*filter(_is_of_libraries, path.folders), folder], []).inherit()
    try:
        with chdir(folder):
            yield
    finally:
        path.inherit()
        for name in sys.modules.keys() - modules.keys():
            if is_user_file(file_of_module(name)):
                del sys.modules[name]
        sys.modules.update({name: modules[name] for name in users})


def _is_of_libraries(entry: str) -> bool:
    """Whether an entry of Python's path, "" for the working directory, holds no user code."""
    return bool(entry) and not is_user_file(os.path.join(entry, ""))


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
        user_errors(subject()),
        np.errstate(),
        end_if_longer(member.time_limit, "`__init__`"),
    ):
        # A class of the package forbids what it does not have.
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
                "", f"{name} does not take {key} = {dict(parameters)}: {error}"
            ) from None
