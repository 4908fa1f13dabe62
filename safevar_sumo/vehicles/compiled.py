"""Compilation of equations by Numba, whose cache keeps compiled functions for later processes.

No operation is fused or reordered: results have the same bits as with Python's own floats,
whichever unit of the processor computes them.
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
    """Raises an error as soon as Numba begins to compile a function."""

    def on_start(self, event: event.Event) -> None:
        raise _NotCompiledError

    def on_end(self, event: event.Event) -> None: ...


def equation(function: Function) -> Function:
    """Make a function that Numba compiles into each compiled function that calls it."""
    return numba.njit(error_model="numpy", inline="always")(function)  # type: ignore[return-value]


def compiled(function: Function) -> Function:
    """Make a function that Numba compiles when it is first called with arguments of new types,
    unless the cache has the compiled function.
    """
    # Numba raises an error for `cache=True` if no folder for its cache can be written.
    try:
        return numba.njit(error_model="numpy", cache=True)(function)  # type: ignore[return-value]
    except RuntimeError:
        return numba.njit(error_model="numpy")(function)  # type: ignore[return-value]


def is_compiled(call: Callable[[], object]) -> bool:
    """Call compiled functions, and return whether all of them had been compiled before. The call
    ends at the first function that would have to be compiled.
    """
    try:
        with event.install_listener("numba:compile", _Refuser()):
            call()
    except _NotCompiledError:
        return False
    return True
