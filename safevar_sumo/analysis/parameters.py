"""Parameters of a study, named by their keys in the study file, such as `ads.parameters.brake_gap` or `ads.parameters.throttle.0`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from safevar_sumo.errors import InputError
from safevar_sumo.scenarios import weather_of
from safevar_sumo.study import Study, error_with_key

FITTED_TABLES = ("vehicle.parameters.", "ads.parameters.", "weather.")
"""Prefixes of the parameters that may be fitted."""


def with_values(study: Study, values: Mapping[str, float]) -> Study:
    """A study with other values of some parameters, named by their keys in the study file.

    Raises
    ------
    InputError
        If the study lacks a parameter, or a value is not allowed for its parameter.
    """
    tables = _as_tables(study)
    for name, value in values.items():
        table, key = _locate(study, tables, name)
        table[key] = value
    try:
        return msgspec.convert(tables, Study)
    except msgspec.ValidationError as error:
        raise error_with_key(study.source, tables, error) from None


def value_of(study: Study, name: str) -> float:
    """The value of a parameter in the study."""
    table, key = _locate(study, _as_tables(study), name)
    return float(table[key])


def _as_tables(study: Study) -> Any:
    """The study as plain tables; a weather's name is replaced by the weather's table."""
    return msgspec.to_builtins(msgspec.structs.replace(study, weather=weather_of(study.weather, study.source)))


def _locate(study: Study, tables: Any, name: str) -> tuple[Any, Any]:
    """The table or list that holds a parameter, and the parameter's key or index in it."""
    error = InputError(study.source, f"calibration.{name!r} is no parameter of the study",
                         f"a number that is given under {', '.join(prefix.rstrip('.') for prefix in FITTED_TABLES)}")
    if not name.startswith(FITTED_TABLES):
        raise error
    *path, last = name.split(".")
    table = tables
    try:
        for key in path:
            table = table[_key_or_index(table, key)]
        key_or_index = _key_or_index(table, last)
        if not isinstance(table[key_or_index], int | float):
            raise error
    except (KeyError, IndexError, ValueError, TypeError):
        raise error from None
    return table, key_or_index


def _key_or_index(table: Any, name: str) -> int | str:
    """The key in a table, or the index in a list; an index has one spelling, so that each parameter has one name."""
    return int(name) if isinstance(table, list) and name == str(int(name)) else name
