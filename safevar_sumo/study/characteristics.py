"""The tables of a study about its characteristics, and the checks of these tables: domains,
variation between vehicles, and constraints on several characteristics. Limits are in `limits.py`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from safevar_sumo.errors import InputError, check_name, one_of
from safevar_sumo.study.marks import WITHOUT_EFFECT, Table

PositiveNumber = Annotated[float, Meta(gt=0, le=1e6)]
Proportion = Annotated[float, Meta(ge=0, le=1)]
"""A part of a whole [-]."""
PositiveProportion = Annotated[float, Meta(gt=0, le=1)]
"""A part of a whole that is not 0 [-]."""
ShortText = Annotated[str, Meta(max_length=200), WITHOUT_EFFECT]
LongText = Annotated[str, Meta(max_length=400)]
MAX_MAGNITUDE = 1e12
"""Largest magnitude of a characteristic's values, in its unit."""


def mistake(problem: str, legal: str) -> ValueError:
    """The error for a record whose values contradict each other. `convert_table` adds the record's
    path.
    """
    return ValueError(f"{problem}\n{legal}")


class Domain(Table, frozen=True, kw_only=True):
    """A domain is the range of a quantity that a search varies, from `lower` to `upper` in `unit`.
    `original` is the quantity's value for the original vehicle.

    `meaning` describes the quantity. `short_name` is the quantity's name in sentences, by default
    the beginning of `meaning` up to the first comma or bracket.
    """

    unit: str
    original: float
    lower: float
    upper: float
    meaning: ShortText = ""
    short_name: ShortText = ""

    def __post_init__(self) -> None:
        if max(abs(self.original), abs(self.lower), abs(self.upper)) > MAX_MAGNITUDE:
            raise mistake(
                f"{self.original} in [{self.lower}, {self.upper}]",
                f"numbers up to {MAX_MAGNITUDE:g}",
            )
        if self.lower >= self.upper:
            raise mistake(
                f"lower = {self.lower} and upper = {self.upper}", "lower < upper"
            )
        if not self.lower <= self.original <= self.upper:
            raise mistake(
                f"original = {self.original}",
                f"a value in [{self.lower}, {self.upper}]",
            )


Interval = tuple[float, float]
"""The smallest and the largest value of a range."""


class Precision(Table, frozen=True, kw_only=True):
    """A precision states how exactly a characteristic is measured. The true value of a vehicle may
    be greater or less than the measured one by `value`, in the characteristic's unit. `source` says
    where this value comes from, or that it is an assumption.
    """

    value: PositiveNumber
    source: Annotated[str, Meta(min_length=1, max_length=400)]


class CharacteristicTable(Domain, frozen=True, kw_only=True):
    """A characteristic is a property of the vehicle, such as tyre friction, with its `original`
    value and its domain (values from `lower` to `upper`).

    - `meaning` describes the characteristic, and `short_name` is its name in sentences.
    - `counterpart` is the part of a real vehicle that sets the characteristic.
    - `measurement` says how a workshop measures the characteristic. If `workshop` is false,
      `measurement` says who else measures the characteristic.
    - `precision` says how exactly the characteristic is measured.
    - `remedy` says what to do with a vehicle beyond the limit of the characteristic.
    """

    counterpart: ShortText = ""
    workshop: Annotated[bool, WITHOUT_EFFECT] = True
    measurement: ShortText = ""
    precision: Annotated[Precision | None, WITHOUT_EFFECT] = None
    remedy: ShortText = ""


def unit_text(unit: str) -> str:
    """A unit as text after a number; empty for a pure number."""
    if unit in ("-", ""):
        return ""
    return f" {unit}"


def number_within(lower: float, upper: float, row: Domain) -> str:
    """The legal values of a characteristic, in the words of an error."""
    return f"a number in [{lower:g}, {upper:g}]{unit_text(row.unit)}"


def check_characteristic(key: str, name: str, rows: Mapping[str, Domain]) -> None:
    check_name("", f"{key}{name}: there is no such characteristic", name, rows)


class _Distribution(Table, frozen=True, tag_field="distribution"):
    """How the value of a characteristic varies between vehicles."""


class Uniform(_Distribution, frozen=True, kw_only=True, tag="uniform"):
    """Every value from `lower` to `upper` is equally likely. By default `lower` and `upper` are the
    ends of the domain.
    """

    lower: float | None = None
    upper: float | None = None


class Normal(_Distribution, frozen=True, kw_only=True, tag="normal"):
    """The characteristic has a normal distribution, cut off at the ends of the domain. `deviation`
    is the standard deviation. `mean` is by default the original value of the characteristic.
    """

    deviation: PositiveNumber
    mean: float | None = None


class Triangular(_Distribution, frozen=True, kw_only=True, tag="triangular"):
    """The characteristic has a triangular distribution from `lower` to `upper`, by default the ends
    of the domain. The peak is at `mode`, by default the original value of the characteristic.
    """

    mode: float | None = None
    lower: float | None = None
    upper: float | None = None


class Lognormal(_Distribution, frozen=True, kw_only=True, tag="lognormal"):
    """The characteristic has a lognormal distribution, cut off at the ends of the domain. `median`
    is by default the original value of the characteristic. `sigma` [-] is the standard deviation of
    the value's logarithm.
    """

    sigma: PositiveNumber
    median: float | None = None


class Fixed(_Distribution, frozen=True, kw_only=True, tag="fixed"):
    """The characteristic has the same value in all vehicles: `value`, by default its original
    value.
    """

    value: float | None = None


Distribution = Uniform | Normal | Triangular | Lognormal | Fixed


def check_variation(
    rows: Mapping[str, Domain], variation: Mapping[str, Distribution]
) -> None:
    """Refuse distributions that do not fit the characteristics' domains."""
    for name, distribution in variation.items():
        check_characteristic("variation.", name, rows)
        _check_distribution(f"variation.{name}", rows[name], distribution)


def stated_values(distribution: Distribution) -> dict[str, float]:
    """The parameters of a distribution that a study states."""
    fields = msgspec.structs.asdict(distribution)
    return {name: value for name, value in fields.items() if value is not None}


def _check_distribution(key: str, row: Domain, distribution: Distribution) -> None:
    """Refuse a distribution whose values are outside of the domain, or contradict each other."""
    stated = stated_values(distribution)
    lower = stated.get("lower", row.lower)
    upper = stated.get("upper", row.upper)
    mode = stated.get("mode", row.original)
    for field, value in stated.items():
        if field not in ("deviation", "sigma") and not row.lower <= value <= row.upper:
            raise InputError(
                "",
                f"{key}.{field} = {value:g}",
                number_within(row.lower, row.upper, row),
            )
    if lower >= upper:
        raise InputError(
            "", f"{key}: lower = {lower:g} and upper = {upper:g}", "lower < upper"
        )
    if isinstance(distribution, Triangular) and not lower <= mode <= upper:
        raise InputError("", f"{key}.mode = {mode:g}", number_within(lower, upper, row))
    if isinstance(distribution, Lognormal) and row.lower <= 0:
        raise InputError(
            "",
            f"{key}: lognormal, with a domain that begins at {row.lower:g}",
            "a domain above 0",
        )


class Constraint(Table, frozen=True, kw_only=True):
    """A constraint bounds a weighted sum of characteristics, from `at_least` to `at_most`.

    - `sum` has a weight for each characteristic of the sum.
    - `unit` is the unit of the sum and of its bounds: the unit of a characteristic, or "-". The key
      `unit` may be omitted if all characteristics in `sum` have the same unit.
    - `meaning` explains the constraint and names its source.
    - `tests` names the tests in which the constraint applies. By default a constraint applies in
      all tests.
    """

    sum: Annotated[dict[str, float], Meta(min_length=1)]
    at_least: float | None = None
    at_most: float | None = None
    unit: str | None = None
    meaning: LongText = ""
    tests: list[str] = []

    def __post_init__(self) -> None:
        if 0 in self.sum.values():
            raise mistake(f"sum = {self.sum}", "weights other than 0")
        check_bounds(self.at_least, self.at_most)

    @property
    def quantity(self) -> str:
        """The sum in words, such as `mass - 2 radius`."""
        text = " ".join(_term(name, weight) for name, weight in self.sum.items())
        # "- mass" reads as a difference: a sign at the beginning of the sum stands without a space.
        return re.sub("^- ", "-", text.removeprefix("+ "))

    @property
    def ends(self) -> Interval:
        """The least and the largest allowed sum; infinite for a bound that is not stated."""
        low = -math.inf if self.at_least is None else self.at_least
        return low, math.inf if self.at_most is None else self.at_most

    def total(self, values: Mapping[str, Any]) -> Any:
        """The weighted sum of values, which are numbers or arrays of shape (N,). It is added term
        by term, because the last bits of a product of matrices depend on the number of settings.
        """
        return sum(weight * values[name] for name, weight in self.sum.items())

    def allows(self, values: Mapping[str, Any]) -> Any:
        """Whether the sum is within its bounds. The `values` are numbers or arrays of shape (N,). A
        constraint allows everything if one of its characteristics has no value.
        """
        if not self.sum.keys() <= values.keys():
            return True
        total = self.total(values)
        low, high = self.ends
        return (total >= low) & (total <= high)

    def unit_of(self, rows: Mapping[str, Domain]) -> str:
        """The unit of the sum: the stated unit, or that of its first characteristic among
        `rows`.
        """
        if self.unit is not None:
            return self.unit
        for name in self.sum:
            if name in rows:
                return rows[name].unit
        return "-"

    def bounds_in_words(self, rows: Mapping[str, Domain]) -> str:
        """The bounds in words."""
        unit = unit_text(self.unit_of(rows))
        bounds = {"at least": self.at_least, "at most": self.at_most}
        return " and ".join(
            f"{word} {value:g}{unit}"
            for word, value in bounds.items()
            if value is not None
        )


def _term(name: str, weight: float) -> str:
    """A term of a sum with its sign, such as `- 2 radius`."""
    factor = f"{abs(weight):g} {name}"
    if abs(weight) == 1:
        factor = name
    sign = "-" if weight < 0 else "+"
    return f"{sign} {factor}"


def check_bounds(at_least: float | None, at_most: float | None) -> None:
    """Refuse a pair of missing bounds, and a lower bound above the upper bound."""
    if at_least is None and at_most is None:
        raise mistake("neither at_least nor at_most", "one of them, or both")
    if at_least is not None and at_most is not None and at_least > at_most:
        raise mistake(
            f"at_least = {at_least:g} and at_most = {at_most:g}", "at_least <= at_most"
        )


def check_constraints(
    rows: Mapping[str, Domain], constraints: Sequence[Constraint]
) -> None:
    """Refuse constraints that name unknown characteristics or add quantities of different units."""
    for index, constraint in enumerate(constraints):
        key = f"constraints[{index}]"
        for name in constraint.sum:
            check_characteristic(f"{key}.sum.", name, rows)
        units = {rows[name].unit for name in constraint.sum}
        is_mixed = len(units) > 1
        legal_units = units | {"-"}
        if is_mixed:
            legal_units |= {row.unit for row in rows.values()}
        if constraint.unit not in legal_units and (
            constraint.unit is not None or is_mixed
        ):
            terms = ", ".join(f"{name} [{rows[name].unit}]" for name in constraint.sum)
            raise InputError(
                "",
                f"{key}: unit = {constraint.unit!r} for the sum of {terms}",
                f"{one_of(legal_units)}; weights may convert units",
            )


class UnmeasuredValue(Table, frozen=True, kw_only=True):
    """The `value`, in its unit, that `permit` assumes of a characteristic that nobody measured in a
    car. `source` says where this value comes from, or that it is an assumption.
    """

    value: float
    source: LongText = ""


def check_unmeasured(rows: Mapping[str, Domain], values: Mapping[str, float]) -> None:
    """Refuse values of unknown characteristics, or outside of their domains."""
    for name, value in values.items():
        check_characteristic("unmeasured.", name, rows)
        row = rows[name]
        if not row.lower <= value <= row.upper:
            raise InputError(
                "",
                f"unmeasured.{name} = {value:g} is outside its domain",
                number_within(row.lower, row.upper, row),
            )
