"""Checks the arguments of public functions before the functions use them. The type that a function
annotates says which values an argument may have.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from os import PathLike
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from safevar_sumo.errors import InputError, unknown_name

PublicFunction = TypeVar("PublicFunction", bound=Callable[..., Any])


class Kind(NamedTuple):
    """The legal values of an argument.

    Attributes
    ----------
    accepts
        Whether a value other than None is legal. None is legal if the type names it.
    legal
        The legal values in words.
    """

    accepts: Callable[[Any], bool]
    legal: str


def is_flag(value: object) -> bool:
    """Whether a value is True or False. The numbers 1 and 0 are none of the two."""
    return isinstance(value, bool | np.bool_)


def _is_progress(value: object) -> bool:
    return is_flag(value) or callable(value)


def _is_path(value: object) -> bool:
    return isinstance(value, str | PathLike)


def _is_mapping(value: object) -> bool:
    # A Series of pandas has names, too.
    return isinstance(value, Mapping) or hasattr(value, "keys")


def _object_of(name: str) -> Callable[[object], bool]:
    """The function that says whether a value is an object of the class with this name."""

    def accepts(value: object) -> bool:
        return name in [kind.__name__ for kind in type(value).__mro__]

    return accepts


FLAG = "bool"
PROGRESS = "bool | Progress"
POOL = "Pool | None"
KINDS = {
    FLAG: Kind(is_flag, "True or False"),
    PROGRESS: Kind(
        _is_progress,
        "True for a bar, False for none, or a function of a phase, the number of simulations done,"
        " and their total",
    ),
    POOL: Kind(_object_of("Pool"), "a Pool, or None for new worker processes"),
    "str": Kind(_is_path, "a text"),
    "str | Path": Kind(_is_path, "a text or a path"),
    "Path | None": Kind(_is_path, "a text or a path, or None"),
    "str | None": Kind(_is_path, "a text, or None"),
    "str | Path | None": Kind(_is_path, "a text or a path, or None"),
    "Mapping[str, float] | None": Kind(
        _is_mapping, "values by name, such as {'mass': 2500}, or None"
    ),
    "Comparison": Kind(
        _object_of("Comparison"),
        "a Comparison, which sv.comparison_of(simulation) returns",
    ),
    "Simulation": Kind(
        _object_of("Simulation"),
        "a Simulation, which sv.simulate(study, changes) returns",
    ),
}
"""The legal values of arguments, by the annotated type. A function itself checks arguments with
other types.
"""


def check_kind(argument: str, value: object, kind: str) -> None:
    """Refuse a value that an argument with the annotated type `kind` cannot have."""
    if value is None and kind.endswith("| None"):
        return
    if kind in KINDS and not KINDS[kind].accepts(value):
        raise InputError(argument, repr(value), KINDS[kind].legal)


def unknown_argument(function: str, name: str, names: Iterable[str]) -> InputError:
    """The error for an argument that a function does not have."""
    return unknown_name(f"{function}()", f"there is no argument {name!r}", name, names)


def checked(function: PublicFunction) -> PublicFunction:
    """Decorator of a public function: an InputError names an argument that the function does not
    have, that is missing, or whose value is of another kind than the annotated type.
    """
    signature = inspect.signature(function)
    parameters = signature.parameters
    takes_any_name = any(
        parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()
    )

    @wraps(function)
    def call(*values: Any, **named: Any) -> Any:
        for name in named:
            if name not in parameters and not takes_any_name:
                raise unknown_argument(function.__name__, name, parameters)
        try:
            given = signature.bind(*values, **named).arguments
        except TypeError as error:
            title = f"{function.__name__}()"
            raise InputError(title, str(error), ", ".join(parameters)) from None
        for name, value in given.items():
            check_kind(name, value, str(parameters[name].annotation))
        return function(*values, **named)

    return cast("PublicFunction", call)
