"""Reads the options of a function from its signature and docstring: types, ranges, defaults and
meanings. The module also defines the types that options share.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Mapping
from numbers import Integral, Real
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin

from safevar_sumo.errors import MAX_JOBS, InputError, check_text
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.arguments import FLAG, check_kind


class Range(NamedTuple):
    """The range of a number. The ends belong to it, unless `is_open`."""

    low: float
    high: float
    is_open: bool = False

    def holds(self, number: float) -> bool:
        """Whether a number is in the range."""
        if self.is_open:
            return self.low < number < self.high
        return self.low <= number <= self.high

    def __str__(self) -> str:
        low, high = map(_with_commas, (self.low, self.high))
        if self.is_open:
            return f"between {low} and {high}"
        return f"from {low} to {high}"


def _with_commas(number: float) -> str:
    """A number as help shows it: thousands have commas."""
    if isinstance(number, int):
        return f"{number:,}"
    return f"{number:,.12g}"


Count = Annotated[int, Range(1, 100_000_000)]
"""A number of vehicles, solutions or attempts."""
Fraction = Annotated[float, Range(0, 1, is_open=True)]
"""A share such as a confidence."""
Margin = Annotated[float | None, Range(0, 100)]
"""A distance to keep from a collision [m]."""
CRITERION = '"METRIC < X"|collision|below=X'
"""The form of a criterion, as help shows it."""
CARS_FILE = "FILE.csv"
"""The form of a list of cars, as help shows it. In the library the list may also be a DataFrame or
a mapping.
"""
LimitTexts = Annotated[tuple[str, ...], '"NAME >= X"']
"""Texts that state limits of characteristics."""
ValueTexts = Annotated[tuple[str, ...], "NAME=VALUE"]
"""Texts that state values of characteristics."""
Fits = Annotated[int | None, Range(0, 1000)]
"""A number of parameter sets; None for all."""
PointName = Annotated[str | None, "NAME"]
"""The name of a test, or of a point, of a study's matrix."""
UpTo = Annotated[str | None, "NAME=V"]
"""The largest value of an axis that encounters may have."""
Jobs = Annotated[int | None, Range(1, MAX_JOBS)]
"""A number of worker processes."""
Cluster = Annotated[str | None, "ADDRESS"]
"""The address of a Dask scheduler."""
UP_TO = "up_to"
"""The name of the option that states the largest value of an axis."""
Simulations = Annotated[int | None, Range(1, 1_000_000_000)]
"""The largest number of simulations."""


def flag_of(name: str) -> str:
    """The flag of an option on the command line."""
    return f"--{name.replace('_', '-')}"


class Option(NamedTuple):
    """An option of a function.

    Attributes
    ----------
    kind
        The type of a value.
    limits
        The range of a number; None without a range.
    choices
        All allowed texts; () if other texts are allowed.
    metavar
        The form of a text, as help shows it; None without a form.
    is_repeated
        Whether the option may be given several times.
    is_optional
        Whether the value may be None.
    meaning
        The text of the docstring.
    """

    name: str
    kind: type
    limits: Range | None
    choices: tuple[str, ...]
    metavar: str | None
    is_repeated: bool
    is_optional: bool
    default: Any
    meaning: str

    @property
    def flag(self) -> str:
        """The flag of the option on the command line."""
        return flag_of(self.name)

    def check(self, value: Any) -> Any:
        """The value in its final form. A value of another type, or outside of the range, is
        refused.

        The value of a repeated option becomes a tuple of texts; a mapping becomes texts NAME=VALUE.
        A criterion becomes an `Unsafe`.
        """
        if value is None and self.is_optional:
            return value
        if self.kind is bool:
            check_kind(self.name, value, FLAG)
            return value
        if self.is_repeated:
            return self._texts(value)
        if self.kind in (int, float):
            return self._number(value)
        return self._text(value)

    def _text(self, value: Any) -> Any:
        """The value of an option that takes a text. A list of cars may be another object."""
        if self.metavar == CRITERION:
            return Unsafe.parse(value)
        if self.metavar == CARS_FILE and not isinstance(value, str):
            return value
        return check_text(self.name, value)

    def _number(self, value: Any) -> Any:
        """The value of an option that takes a number within `limits`."""
        number, words = Real, "a number"
        if self.kind is int:
            number, words = Integral, "a whole number"
        is_legal = isinstance(value, number) and not isinstance(value, bool)
        if self.limits:
            words += f" {self.limits}"
            is_legal = is_legal and self.limits.holds(value)
        if not is_legal:
            raise InputError(self.name, repr(value), words)
        return value

    def _texts(self, value: Any) -> tuple[str, ...]:
        """The values of a repeated option."""
        texts: list[Any] = [value]
        if isinstance(value, Mapping):
            texts = [f"{name}={number}" for name, number in value.items()]
        elif isinstance(value, Iterable) and not isinstance(value, str):
            texts = list(value)
        for text in texts:
            if not isinstance(text, str):
                legal = "a text, or a list of texts"
                if self.metavar:
                    legal += f" such as {self.metavar}"
                raise InputError(self.name, repr(value), legal)
            if texts.count(text) > 1:
                raise InputError(
                    self.name, f"{text!r} is given twice", "each value once"
                )
        return tuple(texts)


def options_of(function: Callable[..., Any]) -> dict[str, Option]:
    """The options of a function by name: its keyword-only parameters. The signature has their types
    and defaults, and the numpydoc docstring has their meanings.
    """
    pattern = re.compile(r"^(\w+)\n((?:    .*\n?)+)", re.MULTILINE)
    texts = dict(pattern.findall(inspect.cleandoc(function.__doc__ or "")))
    names = globals() | inspect.unwrap(function).__globals__
    options = {}
    for parameter in inspect.signature(function).parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY:
            hint = parameter.annotation
            # A module with postponed annotations has a text in place of the type.
            if isinstance(hint, str):
                hint = eval(hint, names)
            meaning = " ".join(texts.get(parameter.name, "").split())
            options[parameter.name] = _option(parameter, hint, meaning)
    return options


def _option(parameter: inspect.Parameter, hint: Any, meaning: str) -> Option:
    """The option of a parameter with the type `hint` and the text `meaning`."""
    limits = None
    metavar = None
    if get_origin(hint) is Annotated:
        hint, extra = get_args(hint)
        if isinstance(extra, Range):
            limits = extra
        else:
            metavar = str(extra)
    hints = (hint, *get_args(hint))
    is_repeated = any(get_origin(kind) is tuple for kind in hints)
    # A type that is none of these is that of a text.
    kinds = [kind for kind in (bool, int, float, Path) if kind in hints]
    kind = kinds[0] if kinds else str
    choices = ()
    if get_origin(hint) is Literal:
        choices = get_args(hint)
    return Option(
        parameter.name,
        kind,
        limits,
        choices,
        metavar,
        is_repeated,
        parameter.default is None or type(None) in hints,
        parameter.default,
        meaning,
    )
