"""An instance of a class that a study names, with the parameters that it gives."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import msgspec

from safevar_sumo.errors import InputError
from safevar_sumo.plugins.guard import Guard
from safevar_sumo.plugins.lookup import Member
from safevar_sumo.plugins.reading import watch
from safevar_sumo.study import converted


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
