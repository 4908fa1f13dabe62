"""What each question may be asked with: the defaults, legal ranges and help texts of its options, as one record a question.

The flags of the commands, the defaults of the Python functions, the calls of the report and the commands that it prints are all
made from these records. Nothing here loads a heavy package: the help of a command reads it too.
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


def _option(default: Any, text: str, **how: Any) -> Any:
    return field(default=default, metadata={"option": Option(text, **how)})


def _unsafe_option() -> Any:
    return _option(None, "What is unsafe: a collision, or a safety degree below X.  [default: a collision if anything that is looked at "
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
        for name, option in self.described().items():
            value = getattr(self, name)
            if value is not None and option.kind in (int, float):
                if isinstance(value, bool) or not isinstance(value, Integral if option.kind is int else Real):
                    raise InputError(name, repr(value), "a whole number" if option.kind is int else "a number")
                if legal := option.refusal(float(value)):
                    raise InputError(name, repr(value), legal)

    @classmethod
    def described(cls) -> Mapping[str, Option]:
        """Every option by its name."""
        return {one.name: one.metadata["option"] for one in fields(cls)}

    @classmethod
    def flags(cls) -> Mapping[str, str]:
        """The flag of every option."""
        return {name: option.flag or f"--{name.replace('_', '-')}" for name, option in cls.described().items()}

    def keywords(self) -> dict[str, Any]:
        """The options as the function of the question takes them."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    def command_line(self, place: str, point: str = "") -> str:
        """The command that asks the same of a study or results directory: what differs from the defaults is a flag."""
        parts = [RUN, self.question, quote(place)]
        for one in fields(self):
            value, flag, option = getattr(self, one.name), self.flags()[one.name], one.metadata["option"]
            if value == one.default:
                continue
            if option.kind is bool:
                parts.append(flag)
            elif option.form == "repeated":
                parts += [f"{flag} {quote(str(each))}" for each in value]
            else:
                parts.append(f"{flag} {quote(','.join(value) if option.form == 'commas' else str(value))}")
        return " ".join([*parts, *([f"--point {quote(point)}"] if point else [])])


@dataclass(frozen=True, kw_only=True)
class ExplainOptions(Options):
    """How failures are explained."""

    question: ClassVar[str] = "explain"
    solutions: tuple[str, ...] = _option(
        (), "Explain the N-th solution of a run, from 0; may be repeated.  [default: the failures that matter]",
        flag="--solution", metavar="ALG:RUN:N", form="repeated")
    unsafe: str | None = _unsafe_option()
    top: int = _option(8, "How many failures are explained in full.", kind=int, low=1, high=1000)
    limit: int = _option(40_000, "Simulations, about, for the minimal causes of all failures; of more failures a random sample is looked "
                                 "into.", kind=int, low=1, metavar="N")


@dataclass(frozen=True, kw_only=True)
class ToleranceOptions(Options):
    """How tolerances are looked for."""

    question: ClassVar[str] = "tolerance"
    unsafe: str | None = _unsafe_option()
    characteristics: tuple[str, ...] | None = _option(
        None, "These characteristics alone, separated by commas.  [default: all]", metavar="A,B", form="commas")
    pairs: bool = _option(False, "Look at every pair too.", kind=bool)


@dataclass(frozen=True, kw_only=True)
class RiskOptions(Options):
    """How a risk is estimated."""

    question: ClassVar[str] = "risk"
    samples: int = _option(10_000, "Maximum number of vehicles to sample.", kind=int, low=1, high=100_000_000, metavar="N")
    confidence: float = _option(0.95, "Confidence of the intervals.", kind=float, low=0, high=1, is_open=(True, True))
    width: float | None = _option(
        None, "Stop as soon as the interval of the probability is no wider.", kind=float, low=0, high=1, is_open=(True, False))
    unsafe: str | None = _unsafe_option()


@dataclass(frozen=True, kw_only=True)
class RulesOptions(Options):
    """How rules are looked for."""

    question: ClassVar[str] = "rules"
    samples: int = _option(16_384, "Settings over the whole domain: half of them make the rules, the other half judges them.",
                           kind=int, low=2, high=10_000_000, metavar="N")
    unsafe: str | None = _unsafe_option()
