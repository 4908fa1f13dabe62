"""Parameters of a study, named by their keys in the study file, such as `ads.parameters.brake_gap` or
`ads.parameters.throttle.0`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from safevar_sumo.scenarios import weather_of
from safevar_sumo.study import Study, convert_table, locate_parameter, missing_parameter


def with_values(study: Study, values: Mapping[str, float], stated_in: str = "calibration") -> Study:
    """A study with other values of some parameters, named by their keys in the study file; errors name the table
    `stated_in`.

    Raises
    ------
    InputError
        If the study lacks a parameter, or a value is not allowed for its parameter.
    """
    tables = _as_tables(study)
    for name, value in values.items():
        table, key = _locate(study, tables, name, stated_in)
        table[key] = value
    return convert_table(study.source, tables, Study)


def value_of(study: Study, name: str, stated_in: str = "calibration") -> float:
    """The value of a parameter in the study."""
    table, key = _locate(study, _as_tables(study), name, stated_in)
    return float(table[key])


def _as_tables(study: Study) -> Any:
    """The study as plain tables; a weather's name is replaced by the weather's table."""
    return msgspec.to_builtins(msgspec.structs.replace(study, weather=weather_of(study.weather, study.source)))


def _locate(study: Study, tables: Any, name: str, stated_in: str) -> tuple[Any, int | str]:
    """The table or list that holds a parameter, and the parameter's key or index in it."""
    place = locate_parameter(tables, name)
    if place is None:
        raise missing_parameter(study.source, stated_in, name)
    return place
