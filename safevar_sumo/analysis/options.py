"""Options of a question: one record with defaults, legal ranges and help texts.

Flags of the command, defaults and documentation of the Python function, the call of the report and the command that the report prints
all derive from the record, which stands in the `__init__.py` of the question's package. The help of a command reads it, so it loads
nothing heavy.
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
from safevar_sumo.shipped import RUN


class Option(NamedTuple):
    """One option as a flag: help, legal range, name and form of its flag.

    `kind` is the type of one value; `form` is "one" value, "commas" between several, or "repeated" flags. The ends `low` and
    `high` belong to the range unless it is `is_open`. `python` describes the argument of the Python function where it differs
    from the flag.
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
    def argument(self) -> str:
        """The option's description in the documentation of the Python function."""
        text = self.python or re.sub(r"\s+\[default: (.*)\]$", r" By default \1.", self.help)
        return fill(re.sub(r"--([a-z]+)", r"`\1`", text), 110, break_on_hyphens=False)

    def refusal(self, value: float) -> str:
        """The expected range, if a number is outside it (as NaN is); empty if the number is inside."""
        above = self.low is None or (value > self.low if self.is_open[0] else value >= self.low)
        below = self.high is None or (value < self.high if self.is_open[1] else value <= self.high)
        if above and below:
            return ""
        ends = [f"{'above' if self.is_open[0] else 'at least'} {self.low:,g}"] if self.low is not None else []
        ends += [f"{'below' if self.is_open[1] else 'at most'} {self.high:,g}"] if self.high is not None else []
        return f"a number {' and '.join(ends)}"


def option(default: Any, text: str, **how: Any) -> Any:
    return field(default=default, metadata={"option": Option(text, **how)})


def unsafe_option() -> Any:
    usual = "a collision if any evaluated setting collides, else half of the original's safety degree; of a rated study, any point lost"
    return option(None, f"What is unsafe: a collision, a safety degree below X, or at most X points of a rating.  [default: {usual}]",
                  metavar="collision|below=X|points=X",
                  python="What is unsafe: `\"collision\"`, or a number X for a safety degree below X [m, or minus a collision's speed in "
                         f"m/s], or an `Unsafe`. By default {usual}.")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of a question; refuses values outside their ranges.

    Raises
    ------
    InputError
        Names the option, its value and what is expected.
    """

    question: ClassVar[str]
    """The command that asks the question."""

    def __post_init__(self) -> None:
        for name, described in self.described().items():
            value = getattr(self, name)
            if described.form != "one" and value is not None and not isinstance(value, Mapping):
                object.__setattr__(self, name, (value,) if isinstance(value, str) else tuple(value))
            if value is not None and described.kind in (int, float):
                if isinstance(value, bool) or not isinstance(value, Integral if described.kind is int else Real):
                    raise InputError(name, repr(value), "a whole number" if described.kind is int else "a number")
                if expected := described.refusal(float(value)):
                    raise InputError(name, repr(value), expected)

    @classmethod
    def described(cls) -> Mapping[str, Option]:
        """Every option by its name."""
        return {item.name: item.metadata["option"] for item in fields(cls)}

    @classmethod
    def flags(cls) -> Mapping[str, str]:
        """The flag of every option."""
        return {name: option.flag or f"--{name.replace('_', '-')}" for name, option in cls.described().items()}

    def command_line(self, place: str, point: str = "") -> str:
        """The command that asks the same of a study or results directory; options that differ from their defaults become flags."""
        parts = [RUN, self.question, quote(place)]
        for item in fields(self):
            value, flag, described = getattr(self, item.name), self.flags()[item.name], item.metadata["option"]
            if value == item.default:
                continue
            if isinstance(value, Mapping):
                value = [f"{key}={number!r}" for key, number in value.items()]
            if described.kind is bool:
                parts.append(flag)
            elif described.form == "repeated":
                parts += [f"{flag} {quote(str(each))}" for each in value]
            else:
                parts.append(f"{flag} {quote(','.join(value) if described.form == 'commas' else str(value))}")
        return " ".join([*parts, *([f"--point {quote(point)}"] if point else [])])


EVERY_QUESTION = """pool
    Pool to simulate on; by default worker processes of its own.
jobs
    Worker processes, by default one for each core.
progress
    True for a bar on the terminal, or a function called with the stage, the number of its settings done, and their total.
as_it_is_now
    If inputs have changed since results were computed, simulate with the present ones and warn; by default an error is raised.

Raises
------
InputError
    If an argument is wrong, or inputs have changed since the results were computed.
SimulationError
    If the original vehicle cannot be simulated."""
QuestionFunction = TypeVar("QuestionFunction", bound=Callable[..., Any])


def documented(options: type[Options]) -> Callable[[QuestionFunction], QuestionFunction]:
    """Append the options, and the arguments common to all questions, to a function's docstring, which ends with its first argument."""
    def complete(function: QuestionFunction) -> QuestionFunction:
        arguments = [f"{name}\n{indent(described.argument, '    ')}" for name, described in options.described().items()]
        function.__doc__ = "\n".join([cleandoc(function.__doc__ or ""), *arguments, EVERY_QUESTION])
        return function

    return complete
