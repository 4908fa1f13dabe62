"""Units of quantities as text; the unit of a pure number is `-`."""

from __future__ import annotations


def unit_text(unit: str, layout: str = " {}") -> str:
    """A unit as text after a number or, in another `layout`, after a name; empty for a pure number."""
    return "" if unit == "-" else layout.format(unit)
