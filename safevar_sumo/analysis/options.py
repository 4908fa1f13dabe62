"""Options of a question: one record with defaults, legal ranges and help texts.

Flags of the command, defaults of the Python function, the call of the report and the command that the report prints all derive
from the record, which stands in `options.py` of the question's package. The help of a command reads it, so it loads nothing heavy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from numbers import Integral, Real
from shlex import quote
from typing import Any, ClassVar, NamedTuple

from safevar_sumo.errors import InputError

RUN = "python -m safevar_sumo"
"""How a command of this package is called."""


class Option(NamedTuple):
    """How one option is asked for: help, legal range, name and form of its flag.

    `kind` is the type of one value; `form` is "one" value, "commas" between several, or "repeated" flags. The ends `low` and
    `high` belong to the range unless it is `is_open`.
    """

    help: str
    kind: type = str
    low: float | None = None
    high: float | None = None
    is_open: tuple[bool, bool] = (False, False)
    flag: str = ""
    metavar: str | None = None
    form: str = "one"

    def refusal(self, value: float) -> str:
        """What would be legal, if a number is outside of the range; nothing if it is inside. NaN is outside."""
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
    return option(None, "What is unsafe: a collision, or a safety degree below X.  [default: a collision if anything that is looked at "
                         "collides, else half of the original's safety degree]", metavar="collision|below=X")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of a question; refuses values outside of their ranges.

    Raises
    ------
    InputError
        Naming the option, its value and what is legal.
    """

    question: ClassVar[str]
    """The command that asks it."""

    def __post_init__(self) -> None:
        for name, described in self.described().items():
            value = getattr(self, name)
            if value is not None and described.kind in (int, float):
                if isinstance(value, bool) or not isinstance(value, Integral if described.kind is int else Real):
                    raise InputError(name, repr(value), "a whole number" if described.kind is int else "a number")
                if legal := described.refusal(float(value)):
                    raise InputError(name, repr(value), legal)

    @classmethod
    def described(cls) -> Mapping[str, Option]:
        """Every option by its name."""
        return {one.name: one.metadata["option"] for one in fields(cls)}

    @classmethod
    def flags(cls) -> Mapping[str, str]:
        """The flag of every option."""
        return {name: one.flag or f"--{name.replace('_', '-')}" for name, one in cls.described().items()}

    def keywords(self) -> dict[str, Any]:
        """The options as the function of the question takes them."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    def command_line(self, place: str, point: str = "") -> str:
        """The command that asks the same of a study or results directory: what differs from the defaults is a flag."""
        parts = [RUN, self.question, quote(place)]
        for one in fields(self):
            value, flag, described = getattr(self, one.name), self.flags()[one.name], one.metadata["option"]
            if value == one.default:
                continue
            if described.kind is bool:
                parts.append(flag)
            elif described.form == "repeated":
                parts += [f"{flag} {quote(str(each))}" for each in value]
            else:
                parts.append(f"{flag} {quote(','.join(value) if described.form == 'commas' else str(value))}")
        return " ".join([*parts, *([f"--point {quote(point)}"] if point else [])])
