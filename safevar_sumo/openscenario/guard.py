"""The second line against files that nobody foresaw: a refusal in place of a traceback."""

from __future__ import annotations

import logging
import os
import traceback
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from safevar_sumo.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")
UNFORESEEN = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    MemoryError,
    RecursionError,
    TypeError,
    ValueError,
)
"""Errors of code that meets what a file should not have."""


def guarded(function: Callable[P, R]) -> Callable[P, R]:
    """A function that reads or plays a file: what it did not foresee is a refusal, too, which names
    the error and its line in the code; the log has the rest.
    """

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return function(*args, **kwargs)
        except UNFORESEEN as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{type(error).__name__} in {os.path.basename(place.filename)}:{place.lineno}"
            logging.getLogger(__name__).info(where, exc_info=error)
            problem = f"the file cannot be played: {where}"
            raise InputError("", problem, "a file as the schema of OpenSCENARIO says") from None

    return call
