"""Equations compiled by Numba: kept in its cache for later processes, where that can be written.

No operation is fused or reordered, so results have the bits of Python's own floats, whatever unit
computes them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba
from numba.core import event

Function = TypeVar("Function", bound=Callable[..., Any])


class _NotCompiledError(Exception):
    """A function would have to be compiled."""


class _Refuser(event.Listener):
    """Ends calls that begin to compile."""

    def on_start(self, event: event.Event) -> None:
        raise _NotCompiledError

    def on_end(self, event: event.Event) -> None: ...


def equation(function: Function) -> Function:
    """Make a function a part of the compiled functions that call it."""
    part: Any = numba.njit(error_model="numpy", inline="always")(function)
    return part  # type: ignore[no-any-return]


def compiled(function: Function) -> Function:
    """Compile a function when it is first called with arguments of new types, unless the cache has
    it.
    """
    # Where no folder for a cache can be written, Numba refuses to use one.
    try:
        compiled_function: Any = numba.njit(error_model="numpy", cache=True)(function)
    except RuntimeError:
        compiled_function = numba.njit(error_model="numpy")(function)
    return compiled_function  # type: ignore[no-any-return]


def is_compiled(call: Callable[[], object]) -> bool:
    """Call compiled functions, and say whether all were compiled before; the call ends where one
    was not.
    """
    try:
        with event.install_listener("numba:compile", _Refuser()):
            call()
    except _NotCompiledError:
        return False
    return True
