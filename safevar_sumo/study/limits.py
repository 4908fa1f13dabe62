"""Limits that a user sets for characteristics: `NAME >= X` and `NAME <= X` on the command line, [limits] in a study."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from safevar_sumo.errors import InputError, unknown_name
from safevar_sumo.study.characteristics import CharacteristicTable, unit_text

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
        If a text is no limit or its characteristic is unknown, limits of one characteristic are double or cross, or a
        limit is outside the domain or broken by the original.
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
    both = {**(stated or {}), **typed}
    return {name: both[name] for name in rows if name in both}


def limit_mistakes(
    source: object, rows: Mapping[str, CharacteristicTable], limits: Mapping[str, Limit], table: str = ""
) -> Iterator[InputError]:
    """Errors for limits of unknown characteristics, without a number, that cross, or that the domain or the original
    breaks.
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
                inside = row.lower <= value <= row.upper
                why = (
                    f": the original, {row.original:g}{unit}, does not keep it" if inside else " is outside its domain"
                )
                yield InputError(source, f"{text}{why}", f"a number in [{lower:g}, {upper:g}]{unit}")
