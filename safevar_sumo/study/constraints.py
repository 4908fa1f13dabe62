"""The constraints of a study, which the characteristics of one vehicle satisfy together, and their checks."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated

from msgspec import Meta, Struct

from safevar_sumo.errors import InputError, one_of, unknown

if TYPE_CHECKING:
    from safevar_sumo.study.schema import CharacteristicTable

LONGEST = 400
"""Largest number of characters of a constraint's meaning."""


class Constraint(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A quantity of several characteristics with its bounds `at_least` and `at_most`.

    The quantity is either `sum`, the characteristics in their units times these weights, or `function`, `package.module:Name` of a
    function that takes {name: array of shape (N,)} and returns such an array. `unit` is the unit of the quantity and its bounds: one of the
    characteristics', or "-"; optional if all characteristics of the sum have the same one. `meaning` explains the constraint, with its
    source.
    """

    sum: dict[str, float] = {}
    function: str = ""
    at_least: float | None = None
    at_most: float | None = None
    unit: str | None = None
    meaning: Annotated[str, Meta(max_length=LONGEST)] = ""

    @property
    def quantity(self) -> str:
        """The quantity in words, such as `mass - 2 radius`."""
        if self.function:
            return self.function
        terms = [f"{'-' if weight < 0 else '+'} {'' if abs(weight) == 1 else f'{abs(weight):g} '}{name}"
                 for name, weight in self.sum.items()]
        return re.sub("^- ", "-", " ".join(terms).removeprefix("+ "))

    def unit_of(self, rows: Mapping[str, CharacteristicTable]) -> str:
        """The unit of the quantity."""
        units = {rows[name].unit for name in self.sum if name in rows}
        return self.unit if self.unit is not None else next(iter(units), "-")

    def legal(self, rows: Mapping[str, CharacteristicTable]) -> str:
        """The bounds in words."""
        unit = "" if self.unit_of(rows) == "-" else f" {self.unit_of(rows)}"
        ends = {"at least": self.at_least, "at most": self.at_most}
        return " and ".join(f"{word} {value:g}{unit}" for word, value in ends.items() if value is not None)


def constraint_mistakes(source: object, rows: Mapping[str, CharacteristicTable], constraints: Sequence[Constraint]) -> Iterator[InputError]:
    """Constraints that name unknown characteristics, add different units or have no bounds."""
    for number, one in enumerate(constraints):
        key = f"constraints[{number}]"
        if bool(one.sum) == bool(one.function):
            yield InputError(source, f"{key}: {'both sum and function' if one.sum else 'neither sum nor function'}", "one of them")
        for name, weight in one.sum.items():
            if name not in rows:
                yield unknown(source, f"{key}.sum.{name}: there is no such characteristic", name, rows)
            if weight == 0:
                yield InputError(source, f"{key}.sum.{name} = 0", "a number other than 0")
        if one.at_least is None and one.at_most is None:
            yield InputError(source, f"{key}: neither at_least nor at_most", "one of them, or both")
        elif one.at_least is not None and one.at_most is not None and one.at_least > one.at_most:
            yield InputError(source, f"{key}: at_least = {one.at_least:g} and at_most = {one.at_most:g}", "at_least <= at_most")
        yield from _unit_mistakes(source, key, one, rows)


def _unit_mistakes(source: object, key: str, one: Constraint, rows: Mapping[str, CharacteristicTable]) -> Iterator[InputError]:
    units = dict.fromkeys(rows[name].unit for name in one.sum if name in rows)
    legal = list(dict.fromkeys(["-", *(row.unit for row in rows.values())]))
    if one.unit is None and len(units) > 1:
        members = ", ".join(f"{name} [{rows[name].unit}]" for name in one.sum if name in rows)
        yield InputError(source, f"{key}.sum adds {members}", "characteristics of one unit; or converting weights, with unit = "
                         f"{one_of(legal)}")
    elif one.unit is not None and len(units) == 1 and one.unit not in (*units, "-"):
        yield InputError(source, f"{key}.unit = {one.unit!r}", f"{next(iter(units))!r}, the unit of {' and '.join(one.sum)}, or '-'")
    elif one.unit is not None and one.unit not in legal:
        yield unknown(source, f"{key}.unit = {one.unit!r} is no unit of this study", one.unit, legal)
