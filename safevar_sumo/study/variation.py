"""How characteristics vary in the world: the distributions and correlations of a study, in the characteristics' units,
and their checks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from safevar_sumo.errors import InputError, unknown_name
from safevar_sumo.study.characteristics import CharacteristicTable, unit_text

MAX_WIDTHS = 100
"""Largest standard deviation of a normal distribution truncated to the domain [widths of the domain]. A wider
distribution differs from the uniform one by less than 1/20,000, and its quantiles lose precision.
"""


class Uniform(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="distribution", tag="uniform"):
    """Every value from `lower` to `upper` is equally likely; by default the whole domain."""

    lower: float | None = None
    upper: float | None = None


class Normal(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="distribution", tag="normal"):
    """A normal distribution with `mean`, by default the original, and standard deviation `deviation`, cut off at the
    ends of the domain.
    """

    deviation: Annotated[float, Meta(gt=0)]
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

    sigma: Annotated[float, Meta(gt=0)]
    median: float | None = None


class Fixed(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="distribution", tag="fixed"):
    """The characteristic always has `value`, by default the original."""

    value: float | None = None


Distribution = Uniform | Normal | Triangular | Lognormal | Fixed


class Correlation(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The correlation of two characteristics after each is transformed to a standard normal variable (Gaussian
    copula).
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


def _distribution_mistakes(
    source: object, key: str, row: CharacteristicTable, distribution: Distribution
) -> Iterator[InputError]:
    domain_lower, domain_upper, unit = row.lower, row.upper, unit_text(row.unit)
    for field, value in msgspec.structs.asdict(distribution).items():
        if field not in ("deviation", "sigma") and value is not None and not domain_lower <= value <= domain_upper:
            yield InputError(
                source, f"{key}.{field} = {value:g}", f"a number in [{domain_lower:g}, {domain_upper:g}]{unit}"
            )
    if isinstance(distribution, Uniform | Triangular):
        lower = domain_lower if distribution.lower is None else distribution.lower
        upper = domain_upper if distribution.upper is None else distribution.upper
        if lower >= upper:
            yield InputError(source, f"{key}: lower = {lower:g} and upper = {upper:g}", "lower < upper")
        elif isinstance(distribution, Triangular) and not (
            lower <= (mode := row.original if distribution.mode is None else distribution.mode) <= upper
        ):
            yield InputError(source, f"{key}.mode = {mode:g}", f"a number in [{lower:g}, {upper:g}]{unit}")
    elif isinstance(distribution, Lognormal) and domain_lower <= 0:
        yield InputError(source, f"{key}: lognormal, with a domain that begins at {domain_lower:g}", "a domain above 0")
    elif isinstance(distribution, Normal | Lognormal) and domain_upper > domain_lower:
        field, width = (
            ("deviation", domain_upper - domain_lower)
            if isinstance(distribution, Normal)
            else ("sigma", math.log(domain_upper / domain_lower))
        )
        if (deviation := getattr(distribution, field)) > MAX_WIDTHS * width:
            yield InputError(
                source,
                f"{key}.{field} = {deviation:g}",
                f"at most {MAX_WIDTHS * width:g}, {MAX_WIDTHS} times the domain's width; "
                'beyond that, use distribution = "uniform"',
            )


def _correlation_mistakes(
    source: object, names: Sequence[str], correlations: Sequence[Correlation]
) -> Iterator[InputError]:
    value_of_pair: dict[frozenset[str], float] = {}
    for correlation in correlations:
        between, pair = correlation.between, frozenset(correlation.between)
        unknown_names = [name for name in between if name not in names]
        if unknown_names:
            yield unknown_name(
                source,
                f"correlations.between: there is no characteristic {unknown_names[0]!r}",
                unknown_names[0],
                names,
            )
        elif len(pair) == 1:
            yield InputError(source, f"correlations.between = {list(between)}", "two different characteristics")
        elif pair in value_of_pair:
            yield InputError(
                source,
                f"correlations: {between[0]} and {between[1]} are given twice, "
                f"with {value_of_pair[pair]:g} and {correlation.value:g}",
                "each pair once",
            )
        value_of_pair.setdefault(pair, correlation.value)
