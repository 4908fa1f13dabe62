"""Options of a question: one record with defaults, legal ranges and help texts.

The record defines the flags of the command, the defaults and the documentation of the Python function, the report's
call of this function, and the command that the report prints. It stands in the `__init__.py` of the question's package.
Because the help of a command needs this module, the module imports nothing that loads slowly.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from inspect import cleandoc
from numbers import Integral, Real
from shlex import quote
from textwrap import fill, indent
from typing import Any, ClassVar, NamedTuple, TypeVar

from safevar_sumo.errors import InputError
from safevar_sumo.shipped import PROGRAM_COMMAND


class Option(NamedTuple):
    """One option: its help text, its legal range, and the name and form of its flag.

    - `kind` is the type of one value.
    - `low` and `high` are the ends of the range; an end belongs to the range unless its entry in `is_open` is true.
    - `form` is "one" for a single value, "commas" for several values separated by commas, or "repeated" for one flag
      per value.
    - `python` is the help text of the Python function's argument, if this argument differs from the flag.
    """

    help: str
    kind: type = str
    low: float | None = None
    high: float | None = None
    is_open: tuple[bool, bool] = (False, False)
    flag: str = ""
    metavar: str | None = None
    form: str = "one"
    python: str = ""

    @property
    def argument_text(self) -> str:
        """The option's description in the documentation of the Python function."""
        text = self.python or re.sub(r"\s+\[default: (.*)\]$", r" By default \1.", self.help)
        return fill(re.sub(r"--([a-z]+)", r"`\1`", text), 110, break_on_hyphens=False)

    def expected_range(self, value: float) -> str:
        """The expected range in words if the value is outside it (NaN always is); empty if the value is inside."""
        above_low = self.low is None or (value > self.low if self.is_open[0] else value >= self.low)
        below_high = self.high is None or (value < self.high if self.is_open[1] else value <= self.high)
        if above_low and below_high:
            return ""
        ends = []
        if self.low is not None:
            ends.append(f"{'above' if self.is_open[0] else 'at least'} {self.low:,g}")
        if self.high is not None:
            ends.append(f"{'below' if self.is_open[1] else 'at most'} {self.high:,g}")
        return f"a number {' and '.join(ends)}"


def option(default: Any, text: str, **properties: Any) -> Any:
    return field(default=default, metadata={"option": Option(text, **properties)})


def unsafe_option() -> Any:
    default = (
        "a collision if any evaluated setting collides, else half of the original's safety degree; of a rated "
        "study, any point lost"
    )
    return option(
        None,
        f"What is unsafe: a collision, a safety degree below X, or at most X points of a rating.  [default: {default}]",
        metavar="collision|below=X|points=X",
        python='What is unsafe: `"collision"`, or a number X for a safety degree below X [m, or minus a collision\'s '
        f"speed in m/s], or an `Unsafe`. By default {default}.",
    )


def margin_option() -> Any:
    return option(
        None,
        "Distance to keep from a collision [m], between bumpers where the safety degree is from centre to centre.  "
        "[default: the model's error that the study states, else 0.3]",
        kind=float,
        low=0,
        high=100,
        metavar="M",
    )


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of a question; a value outside its range raises an error.

    Raises
    ------
    InputError
        Names the option, its value and what is expected.
    """

    question: ClassVar[str]
    """The command that asks the question."""

    def __post_init__(self) -> None:
        for name, definition in self.definitions().items():
            value = getattr(self, name)
            if definition.form != "one" and value is not None and not isinstance(value, Mapping):
                object.__setattr__(self, name, (value,) if isinstance(value, str) else tuple(value))
            if value is not None and definition.kind in (int, float):
                number, words = (Integral, "a whole number") if definition.kind is int else (Real, "a number")
                if isinstance(value, bool) or not isinstance(value, number):
                    raise InputError(name, repr(value), words)
                if expected := definition.expected_range(float(value)):
                    raise InputError(name, repr(value), expected)

    @classmethod
    def definitions(cls) -> Mapping[str, Option]:
        """Every option by its name."""
        return {option_field.name: option_field.metadata["option"] for option_field in fields(cls)}

    @classmethod
    def flags(cls) -> Mapping[str, str]:
        """The flag of every option."""
        return {name: option.flag or f"--{name.replace('_', '-')}" for name, option in cls.definitions().items()}

    def command_line(self, subject: str, point: str = "") -> str:
        """The command that asks this question about a study or results directory; it has a flag for each option not at
        its default.
        """
        parts = [PROGRAM_COMMAND, self.question, quote(subject)]
        for name, definition in self.definitions().items():
            value, flag = getattr(self, name), self.flags()[name]
            if value == getattr(type(self), name):
                continue
            if isinstance(value, Mapping):
                value = [f"{key}={number!r}" for key, number in value.items()]
            if definition.kind is bool:
                parts.append(flag)
            elif definition.form == "repeated":
                parts += [f"{flag} {quote(str(element))}" for element in value]
            else:
                parts.append(f"{flag} {quote(','.join(value) if definition.form == 'commas' else str(value))}")
        if point:
            parts.append(f"--point {quote(point)}")
        return " ".join(parts)


COMMON_ARGUMENTS = """pool
    Pool that simulates; by default new worker processes.
jobs
    Number of worker processes, by default one for each core.
progress
    True for a bar on the terminal, or a function called with the stage, the number of its settings done, and their
    total.
as_it_is_now
    If inputs have changed since results were computed, simulate with the present inputs and warn; by default an error
    is raised.

Raises
------
InputError
    If an argument is wrong, or inputs have changed since the results were computed.
SimulationError
    If the original vehicle cannot be simulated."""
POINT_ARGUMENT = """point
    Name of the only point of the study's matrix to simulate; by default all."""
QuestionFunction = TypeVar("QuestionFunction", bound=Callable[..., Any])


def document_options(options: type[Options]) -> Callable[[QuestionFunction], QuestionFunction]:
    """Decorator: appends the options, and the arguments that all questions have, to the docstring of a function.

    The docstring must end with the first argument.
    """

    def append_arguments(function: QuestionFunction) -> QuestionFunction:
        arguments = [
            f"{name}\n{indent(definition.argument_text, '    ')}" for name, definition in options.definitions().items()
        ]
        point = [POINT_ARGUMENT] if "point" in function.__annotations__ else []
        function.__doc__ = "\n".join([cleandoc(function.__doc__ or ""), *arguments, *point, COMMON_ARGUMENTS])
        return function

    return append_arguments
