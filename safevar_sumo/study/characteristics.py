"""The characteristics of a study: their rows in its table, and their units as texts show them."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct

PositiveNumber = Annotated[float, Meta(gt=0, le=1e6)]
Description = Annotated[str, Meta(max_length=200)]


class CharacteristicTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One row of the characteristics table; its values are in `unit`, and f_diff multiplies its change by `weight`.

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
