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
    `high` belong to the range unless it is `is_open`. `python` describes the argument of the Python function where that takes
    something else than the flag.
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
        """What the documentation of the Python function says of the option."""
        text = self.python or re.sub(r"\s+\[default: (.*)\]$", r" By default \1.", self.help)
        return fill(re.sub(r"--([a-z]+)", r"`\1`", text), 110, break_on_hyphens=False)

    def refusal(self, value: float) -> str:
        """What is expected, if a number is outside the range (as NaN is); empty if it is inside."""
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
    usual = "a collision if anything that is looked at collides, else half of the original's safety degree"
    return option(None, f"What is unsafe: a collision, or a safety degree below X.  [default: {usual}]", metavar="collision|below=X",
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
    """The command that asks it."""

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
        """The command that asks the same of a study or results directory: what differs from the defaults is a flag."""
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
    Where to simulate, if not in worker processes of its own.
jobs
    Worker processes, by default one for each core.
progress
    True for a bar on the terminal, or a function called with the stage, how much of it is done, and how much there is.
as_it_is_now
    Simulate with what is there now if results were computed with something else, and warn; by default that is refused.

Raises
------
InputError
    If something that is asked for is not there or cannot be used, or has changed since the results were computed.
SimulationError
    If the original vehicle cannot be simulated."""
Function = TypeVar("Function", bound=Callable[..., Any])


def documented(options: type[Options]) -> Callable[[Function], Function]:
    """Complete the docstring of a question's function, which ends with its first argument: its options, and what all questions take."""
    def complete(function: Function) -> Function:
        arguments = [f"{name}\n{indent(described.argument, '    ')}" for name, described in options.described().items()]
        function.__doc__ = "\n".join([cleandoc(function.__doc__ or ""), *arguments, EVERY_QUESTION])
        return function

    return complete
