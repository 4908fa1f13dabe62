"""Limits: which values a characteristic may take. A user states limits under [limits] of a study,
or on the command line as `NAME >= X` and `NAME <= X`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from safevar_sumo.errors import InputError
from safevar_sumo.study.characteristics import (
    Domain,
    Interval,
    LongText,
    check_bounds,
    check_characteristic,
    number_within,
    unit_text,
)
from safevar_sumo.study.marks import Table

LIMIT_FORM = re.compile(
    r"\s*([^<>=]*[^\s<>=])\s*(>=|<=)\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*"
)
SIDES = {">=": "at_least", "<=": "at_most"}
FORMS = (
    '"NAME >= X" or "NAME <= X" with a number in the unit of the characteristic, such as'
    ' "treadDepth >= 3"'
)


class Limit(Table, frozen=True, kw_only=True):
    """A limit states which values a characteristic may take, in its unit: `at_least`, `at_most`, or
    both. `source` says who demands this limit.
    """

    at_least: float | None = None
    at_most: float | None = None
    source: LongText = ""

    def __post_init__(self) -> None:
        check_bounds(self.at_least, self.at_most)

    def interval(self, row: Domain) -> Interval:
        """The allowed interval of a characteristic [its unit]. A side without limit ends with the
        domain.
        """
        low, high = self.at_least, self.at_most
        if low is None:
            low = row.lower
        if high is None:
            high = row.upper
        return low, high


def limits_of(
    texts: Iterable[str],
    rows: Mapping[str, Domain],
    stated: Mapping[str, Limit] | None = None,
) -> dict[str, Limit]:
    """Combine typed and stated limits into one limit for each characteristic, in the order of
    `rows`. A limit that is typed (in `texts`, such as `treadDepth >= 3`) replaces the limit that is
    `stated` in a study.

    Raises
    ------
    InputError
        If a text is no limit, its characteristic is unknown, a limit is given twice, two limits of
        one characteristic cross, or a limit is outside the domain or excludes the original.
    """
    sides: dict[str, dict[str, Any]] = {}
    for text in texts:
        match = LIMIT_FORM.fullmatch(text)
        if match is None:
            raise InputError("", repr(text), FORMS)
        name = match[1]
        side = SIDES[match[2]]
        if side in sides.setdefault(name, {}):
            raise InputError("", f"{name} {match[2]} is given twice", "each limit once")
        sides[name][side] = float(match[3])
    try:
        typed = {name: Limit(**limit) for name, limit in sides.items()}
    except ValueError as error:
        problem, _, legal = str(error).partition("\n")
        raise InputError("", f"{', '.join(texts)}: {problem}", legal) from None

    # A typed limit replaces the stated limit of the same characteristic, with both of its sides.
    check_limits(rows, typed)
    limits = {**(stated or {}), **typed}
    return {name: limits[name] for name in rows if name in limits}


def check_limits(
    rows: Mapping[str, Domain], limits: Mapping[str, Limit], table: str = ""
) -> None:
    """Refuse limits of unknown characteristics, limits outside the domain, and limits that exclude
    the original value. `table` is the prefix of names in errors.
    """
    for name, limit in limits.items():
        check_characteristic(table, name, rows)
        row = rows[name]
        for side, opposite, lower, upper in (
            ("at_least", "<=", row.lower, row.original),
            ("at_most", ">=", row.original, row.upper),
        ):
            value = getattr(limit, side)
            if value is not None and not lower <= value <= upper:
                why = " is outside its domain"
                legal = number_within(lower, upper, row)
                if row.lower <= value <= row.upper:
                    original = f"{row.original:g}{unit_text(row.unit)}"
                    why = f": the original, {original}, does not keep it"
                    legal += f"; did you mean {opposite} {value:g}?"
                raise InputError("", f"{table}{name}.{side} = {value:g}{why}", legal)
