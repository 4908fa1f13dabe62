"""The tables of a study about its characteristics, and their checks: values and domains; how characteristics vary in
the world; constraints that they satisfy together; and limits that a user sets, under [limits] or on the command line as
`NAME >= X` and `NAME <= X`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from safevar_sumo.errors import InputError, one_of, unknown_name

PositiveNumber = Annotated[float, Meta(gt=0, le=1e6)]
Description = Annotated[str, Meta(max_length=200)]


class CharacteristicTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One row of the characteristics table: its `original` value, and the ends `lower` and `upper` of its domain, in
    `unit`; f_diff multiplies its change by `weight`.

    `meaning` describes the characteristic and begins with a short name (up to the first comma or bracket);
    `counterpart` is the part of a real vehicle that sets it.
    """

    unit: str
    original: float
    lower: float
    upper: float
    weight: PositiveNumber = 1.0
    meaning: Description = ""
    counterpart: Description = ""


def unit_text(unit: str, layout: str = " {}") -> str:
    """A unit as text after a number or, in another `layout`, after a name; empty for a pure number."""
    return "" if unit == "-" else layout.format(unit)


class Uniform(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="distribution", tag="uniform"):
    """Every value from `lower` to `upper` is equally likely; by default the whole domain."""

    lower: float | None = None
    upper: float | None = None


class Normal(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="distribution", tag="normal"):
    """A normal distribution with `mean`, by default the original, and standard deviation `deviation`, cut off at the
    ends of the domain.
    """

    deviation: PositiveNumber
    mean: float | None = None


class Triangular(
    Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="distribution", tag="triangular"
):
    """A triangular distribution from `lower` to `upper`, by default the domain, with its peak at `mode`, by default the
    original.
    """

    mode: float | None = None
    lower: float | None = None
    upper: float | None = None


class Lognormal(
    Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="distribution", tag="lognormal"
):
    """A lognormal distribution with `median`, by default the original, cut off at the ends of the domain.

    `sigma` [-] is the standard deviation of the value's logarithm.
    """

    sigma: PositiveNumber
    median: float | None = None


class Fixed(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="distribution", tag="fixed"):
    """The characteristic always has `value`, by default the original."""

    value: float | None = None


Distribution = Uniform | Normal | Triangular | Lognormal | Fixed


class Correlation(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The correlation, `value`, of the two characteristics `between` after each is transformed to a standard normal
    variable (Gaussian copula).
    """

    between: tuple[str, str]
    value: Annotated[float, Meta(gt=-1, lt=1)]


def variation_mistakes(
    source: object,
    rows: Mapping[str, CharacteristicTable],
    variation: Mapping[str, Distribution],
    correlations: Sequence[Correlation],
) -> Iterator[InputError]:
    """Errors for distributions and correlations that do not fit the characteristics' domains, or each other."""
    for name, distribution in variation.items():
        if name in rows:
            yield from _distribution_mistakes(source, f"variation.{name}", rows[name], distribution)
        else:
            yield unknown_name(source, f"variation.{name}: there is no such characteristic", name, rows)
    yield from _correlation_mistakes(source, list(rows), correlations)


def stated_values(distribution: Distribution) -> dict[str, float]:
    """The parameters of a distribution that a study states."""
    return {name: value for name, value in msgspec.structs.asdict(distribution).items() if value is not None}


def _distribution_mistakes(
    source: object, key: str, row: CharacteristicTable, distribution: Distribution
) -> Iterator[InputError]:
    unit = unit_text(row.unit)
    stated = stated_values(distribution)
    lower, upper = stated.get("lower", row.lower), stated.get("upper", row.upper)
    mode = stated.get("mode", row.original)
    for field, value in stated.items():
        if field not in ("deviation", "sigma") and not row.lower <= value <= row.upper:
            yield InputError(source, f"{key}.{field} = {value:g}", f"a number in [{row.lower:g}, {row.upper:g}]{unit}")
    if lower >= upper:
        yield InputError(source, f"{key}: lower = {lower:g} and upper = {upper:g}", "lower < upper")
    elif isinstance(distribution, Triangular) and not lower <= mode <= upper:
        yield InputError(source, f"{key}.mode = {mode:g}", f"a number in [{lower:g}, {upper:g}]{unit}")
    elif isinstance(distribution, Lognormal) and row.lower <= 0:
        yield InputError(source, f"{key}: lognormal, with a domain that begins at {row.lower:g}", "a domain above 0")


def _correlation_mistakes(
    source: object, names: Sequence[str], correlations: Sequence[Correlation]
) -> Iterator[InputError]:
    pairs = set[frozenset[str]]()
    for correlation in correlations:
        between, pair = correlation.between, frozenset(correlation.between)
        for name in between:
            if name not in names:
                yield unknown_name(source, f"correlations.between: there is no characteristic {name!r}", name, names)
        if len(pair) < len(between) or pair in pairs:
            yield InputError(source, f"correlations.between = {list(between)}", "two characteristics, each pair once")
        pairs.add(pair)


class Constraint(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The bounds `at_least` and `at_most` of a weighted sum of characteristics.

    `sum` holds a weight for each characteristic in its unit. `unit`, the unit of the sum and its bounds, is the unit of
    a characteristic or "-"; it may be omitted if all characteristics of the sum have the same unit. `meaning` explains
    the constraint and names its source.
    """

    sum: Annotated[dict[str, float], Meta(min_length=1)]
    at_least: float | None = None
    at_most: float | None = None
    unit: str | None = None
    meaning: Annotated[str, Meta(max_length=400)] = ""

    @property
    def quantity(self) -> str:
        """The sum in words, such as `mass - 2 radius`."""
        terms = [
            f"{'-' if weight < 0 else '+'} {'' if abs(weight) == 1 else f'{abs(weight):g} '}{name}"
            for name, weight in self.sum.items()
        ]
        return re.sub("^- ", "-", " ".join(terms).removeprefix("+ "))  # the first term has its sign without a space

    def unit_of(self, rows: Mapping[str, CharacteristicTable]) -> str:
        """The unit of the sum; `rows` are the characteristics of the vehicle."""
        units = {rows[name].unit for name in self.sum if name in rows}
        return self.unit if self.unit is not None else next(iter(units), "-")

    def bounds_in_words(self, rows: Mapping[str, CharacteristicTable]) -> str:
        """The bounds in words."""
        unit = unit_text(self.unit_of(rows))
        bounds = {"at least": self.at_least, "at most": self.at_most}
        return " and ".join(f"{word} {value:g}{unit}" for word, value in bounds.items() if value is not None)


def constraint_mistakes(
    source: object, rows: Mapping[str, CharacteristicTable], constraints: Sequence[Constraint]
) -> Iterator[InputError]:
    """Errors for constraints that name unknown characteristics, add quantities of different units, or have no
    bounds.
    """
    for index, constraint in enumerate(constraints):
        key = f"constraints[{index}]"
        for name, weight in constraint.sum.items():
            if name not in rows:
                yield unknown_name(source, f"{key}.sum.{name}: there is no such characteristic", name, rows)
            if weight == 0:
                yield InputError(source, f"{key}.sum.{name} = 0", "a number other than 0")
        at_least, at_most = constraint.at_least, constraint.at_most
        if at_least is None and at_most is None:
            yield InputError(source, f"{key}: neither at_least nor at_most", "one of them, or both")
        elif at_least is not None and at_most is not None and at_least > at_most:
            yield InputError(source, f"{key}: at_least = {at_least:g} and at_most = {at_most:g}", "at_least <= at_most")
        yield from _unit_mistakes(source, key, constraint, rows)


def _unit_mistakes(
    source: object, key: str, constraint: Constraint, rows: Mapping[str, CharacteristicTable]
) -> Iterator[InputError]:
    units = {rows[name].unit for name in constraint.sum if name in rows}
    legal_units = {"-", *(units if len(units) == 1 else (row.unit for row in rows.values()))}
    if (constraint.unit is None and len(units) > 1) or constraint.unit not in (None, *legal_units):
        terms = ", ".join(f"{name} [{rows[name].unit}]" for name in constraint.sum if name in rows)
        problem = f"{key}: unit = {constraint.unit!r} for the sum of {terms}"
        yield InputError(source, problem, f"{one_of(legal_units)}; weights may convert units")


LIMIT_FORM = re.compile(r"\s*([^<>=]*[^\s<>=])\s*(>=|<=)\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*")
FORMS = '"NAME >= X" or "NAME <= X" with a number in the unit of the characteristic, such as "treadDepth >= 3"'


class Limit(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The values that a characteristic may take, in its unit: `at_least`, `at_most`, or both; `source` says who demands
    it.
    """

    at_least: float | None = None
    at_most: float | None = None
    source: Annotated[str, Meta(max_length=400)] = ""

    def interval(self, row: CharacteristicTable) -> tuple[float, float]:
        """The limited interval [unit]; a side without a limit ends with the domain."""
        low = row.lower if self.at_least is None else self.at_least
        high = row.upper if self.at_most is None else self.at_most
        return low, high


def limits_of(
    texts: Iterable[str],
    rows: Mapping[str, CharacteristicTable],
    stated: Mapping[str, Limit] | None = None,
    source: str = "limits",
) -> dict[str, Limit]:
    """Limits by characteristic, in the order of `rows`: those of `texts`, such as `treadDepth >= 3`, and where a text
    does not replace them, those `stated` in a study.

    Raises
    ------
    InputError
        If a text is no limit, its characteristic is unknown, a limit is given twice, two limits of one characteristic
        cross, or a limit is outside the domain or excludes the original.
    """
    typed: dict[str, Limit] = {}
    for text in texts:
        match = LIMIT_FORM.fullmatch(text)
        if match is None:
            raise InputError(source, repr(text), FORMS)
        name, side = match[1], "at_least" if match[2] == ">=" else "at_most"
        limit = typed.get(name, Limit())
        if getattr(limit, side) is not None:
            raise InputError(source, f"{name} {match[2]} is given twice", "each limit once")
        typed[name] = msgspec.structs.replace(limit, **{side: float(match[3])})
    for mistake in limit_mistakes(source, rows, typed):
        raise mistake
    limits = {**(stated or {}), **typed}
    return {name: limits[name] for name in rows if name in limits}


def limit_mistakes(
    source: object, rows: Mapping[str, CharacteristicTable], limits: Mapping[str, Limit], table: str = ""
) -> Iterator[InputError]:
    """Errors for limits that are of unknown characteristics, have no number, cross, are outside the domain, or exclude
    the original.
    """
    for name, limit in limits.items():
        key = f"{table}{name}"
        if name not in rows:
            yield unknown_name(source, f"{key}: there is no such characteristic", name, rows)
            continue
        row, unit = rows[name], unit_text(rows[name].unit)
        low, high = limit.interval(row)
        if limit.at_least is None and limit.at_most is None:
            yield InputError(source, f"{key}: neither at_least nor at_most", "one of them, or both")
        elif low > high and None not in (limit.at_least, limit.at_most):
            yield InputError(source, f"{key}: at least {low:g} and at most {high:g}{unit}", "at_least <= at_most")
        legal_sides = ((">=", "at_least", row.lower, row.original), ("<=", "at_most", row.original, row.upper))
        for sign, side, lower, upper in legal_sides:
            value = getattr(limit, side)
            if value is not None and not lower <= value <= upper:
                text = f"{key}.{side} = {value:g}" if table else f"{key} {sign} {value:g}"
                why = " is outside its domain"
                if row.lower <= value <= row.upper:
                    why = f": the original, {row.original:g}{unit}, does not keep it"
                yield InputError(source, f"{text}{why}", f"a number in [{lower:g}, {upper:g}]{unit}")
