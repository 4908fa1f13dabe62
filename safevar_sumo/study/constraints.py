"""The constraints of a study: conditions on several characteristics of a vehicle, and their validation."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated

from msgspec import Meta, Struct

from safevar_sumo.errors import InputError, one_of, unknown_name
from safevar_sumo.study.characteristics import CharacteristicTable, unit_text

MAX_MEANING_LENGTH = 400
"""Largest number of characters of a constraint's meaning."""


class Constraint(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The bounds `at_least` and `at_most` of a quantity that depends on several characteristics.

    The quantity is either a weighted sum, where `sum` holds a weight for each characteristic in its unit, or the result
    of `function`. A function is named `package.module:Name`; it takes {name: array of shape (N,)} for N settings and
    returns an array of shape (N,). `unit`, the unit of the quantity and its bounds, is the unit of a characteristic or
    "-"; it may be omitted if all characteristics of the sum have the same unit. `meaning` explains the constraint and
    names its source.
    """

    sum: dict[str, float] = {}
    function: str = ""
    at_least: float | None = None
    at_most: float | None = None
    unit: str | None = None
    meaning: Annotated[str, Meta(max_length=MAX_MEANING_LENGTH)] = ""

    @property
    def quantity(self) -> str:
        """The quantity in words, such as `mass - 2 radius`."""
        if self.function:
            return self.function
        terms = [
            f"{'-' if weight < 0 else '+'} {'' if abs(weight) == 1 else f'{abs(weight):g} '}{name}"
            for name, weight in self.sum.items()
        ]
        return re.sub("^- ", "-", " ".join(terms).removeprefix("+ "))

    def unit_of(self, table: Mapping[str, CharacteristicTable]) -> str:
        """The unit of the quantity; `table` holds the vehicle's characteristics."""
        units = {table[name].unit for name in self.sum if name in table}
        return self.unit if self.unit is not None else next(iter(units), "-")

    def bounds_in_words(self, table: Mapping[str, CharacteristicTable]) -> str:
        """The bounds in words."""
        unit = unit_text(self.unit_of(table))
        bounds = {"at least": self.at_least, "at most": self.at_most}
        return " and ".join(f"{word} {value:g}{unit}" for word, value in bounds.items() if value is not None)


def constraint_mistakes(
    source: object, table: Mapping[str, CharacteristicTable], constraints: Sequence[Constraint]
) -> Iterator[InputError]:
    """Errors for constraints that name unknown characteristics, add quantities of different units, or have no
    bounds.
    """
    for index, constraint in enumerate(constraints):
        key = f"constraints[{index}]"
        if bool(constraint.sum) == bool(constraint.function):
            yield InputError(
                source,
                f"{key}: {'both sum and function' if constraint.sum else 'neither sum nor function'}",
                "one of them",
            )
        for name, weight in constraint.sum.items():
            if name not in table:
                yield unknown_name(source, f"{key}.sum.{name}: there is no such characteristic", name, table)
            if weight == 0:
                yield InputError(source, f"{key}.sum.{name} = 0", "a number other than 0")
        if constraint.at_least is None and constraint.at_most is None:
            yield InputError(source, f"{key}: neither at_least nor at_most", "one of them, or both")
        elif (
            constraint.at_least is not None
            and constraint.at_most is not None
            and constraint.at_least > constraint.at_most
        ):
            yield InputError(
                source,
                f"{key}: at_least = {constraint.at_least:g} and at_most = {constraint.at_most:g}",
                "at_least <= at_most",
            )
        yield from _unit_mistakes(source, key, constraint, table)


def _unit_mistakes(
    source: object, key: str, constraint: Constraint, table: Mapping[str, CharacteristicTable]
) -> Iterator[InputError]:
    units = dict.fromkeys(table[name].unit for name in constraint.sum if name in table)
    known_units = list(dict.fromkeys(["-", *(row.unit for row in table.values())]))
    if constraint.unit is None and len(units) > 1:
        terms = ", ".join(f"{name} [{table[name].unit}]" for name in constraint.sum if name in table)
        yield InputError(
            source,
            f"{key}.sum adds {terms}",
            f"characteristics of the same unit, or weights that convert units, and unit = {one_of(known_units)}",
        )
    elif constraint.unit is not None and len(units) == 1 and constraint.unit not in (*units, "-"):
        yield InputError(
            source,
            f"{key}.unit = {constraint.unit!r}",
            f"{next(iter(units))!r}, the unit of {' and '.join(constraint.sum)}, or '-'",
        )
    elif constraint.unit is not None and constraint.unit not in known_units:
        yield unknown_name(
            source, f"{key}.unit = {constraint.unit!r} is no unit of this study", constraint.unit, known_units
        )
