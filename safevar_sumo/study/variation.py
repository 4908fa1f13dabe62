"""How characteristics vary in the world, as a study's `[variation]` table gives it: data only, quantities in the unit of each."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct


class Uniform(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="distribution", tag="uniform"):
    """Evenly from `lower` to `upper`, by default over the whole domain."""

    lower: float | None = None
    upper: float | None = None


class Normal(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="distribution", tag="normal"):
    """Around `mean`, by default the original, with standard deviation `deviation`; cut off at the ends of the domain."""

    deviation: Annotated[float, Meta(gt=0)]
    mean: float | None = None


class Triangular(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="distribution", tag="triangular"):
    """Most often `mode`, by default the original, never beyond `lower` and `upper`, by default the domain's."""

    mode: float | None = None
    lower: float | None = None
    upper: float | None = None


class Lognormal(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="distribution", tag="lognormal"):
    """Half of it below `median`, by default the original; `sigma` [-] is the standard deviation of its logarithm. Cut off as `Normal`."""

    sigma: Annotated[float, Meta(gt=0)]
    median: float | None = None


class Fixed(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="distribution", tag="fixed"):
    """Always `value`, by default the original."""

    value: float | None = None


Distribution = Uniform | Normal | Triangular | Lognormal | Fixed


class Correlation(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The correlation of two characteristics once either is a standard normal variable (Gaussian copula)."""

    between: tuple[str, str]
    value: Annotated[float, Meta(gt=-1, lt=1)]
