"""Parameters that tables of a study file name by their keys, and checks of the tables that a file states itself."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from safevar_sumo.errors import InputError

FITTED_TABLES = ("vehicle.parameters.", "ads.parameters.", "weather.")
"""Prefixes of the parameters that may be fitted."""


def locate_parameter(tables: Any, name: str) -> tuple[Any, int | str] | None:
    """The table or list that holds a parameter that may be fitted, and the parameter's key or index in it; None if
    there is none.
    """
    if not name.startswith(FITTED_TABLES):
        return None
    *path, last = name.split(".")
    table = tables
    try:
        for key in path:
            table = table[_key_or_index(table, key)]
        key_or_index = _key_or_index(table, last)
        is_number = isinstance(table[key_or_index], int | float)
    except (KeyError, IndexError, ValueError, TypeError):
        return None
    return (table, key_or_index) if is_number else None


def _key_or_index(table: Any, name: str) -> int | str:
    """The key in a table, or the index in a list; an index has one spelling, so that each parameter has one name."""
    return int(name) if isinstance(table, list) and name == str(int(name)) else name


def missing_parameter(source: object, table: str, name: str) -> InputError:
    """The error for a parameter that a table such as `spread` names and the study does not have."""
    return InputError(
        source,
        f"{table}.{name!r} is no parameter of the study",
        f"a number that is given under {', '.join(prefix.rstrip('.') for prefix in FITTED_TABLES)}",
    )


def contradictions_of_file(
    source: object, stated: Mapping[str, Any], tables: Mapping[str, Any]
) -> Iterator[InputError]:
    """Errors for tables that a file states itself, not inherits, and that do not fit the complete `tables` of its
    study.
    """
    for table in ("calibration", "spread"):
        values = stated.get(table)
        for name in values if isinstance(values, Mapping) else ():
            if name.startswith("weather.") and isinstance(tables.get("weather"), str):
                continue  # a shipped weather: its values are looked up later
            if locate_parameter(tables, name) is None:
                yield missing_parameter(source, table, name)
    rating, matrix = stated.get("rating"), tables.get("matrix")
    if (
        isinstance(rating, Mapping)
        and rating.get("claims")
        and not (isinstance(matrix, Mapping) and matrix.get("protocol"))
    ):
        yield InputError(source, "rating.claims: the study is not rated", "matrix.protocol, or no claims")
