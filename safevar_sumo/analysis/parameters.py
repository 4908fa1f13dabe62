"""A study's parameters by their keys in its file, such as `ads.parameters.brake_gap` or `ads.parameters.throttle.0`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from safevar_sumo.errors import InputError
from safevar_sumo.scenarios import weather_of
from safevar_sumo.study import Study, invalid

FITTED = ("vehicle.parameters.", "ads.parameters.", "weather.")
"""Tables whose numbers may be fitted."""


def with_values(study: Study, values: Mapping[str, float]) -> Study:
    """A study with other values of some parameters, named by their keys in the study file.

    Raises
    ------
    InputError
        If there is no such parameter, or it does not take the value.
    """
    raw = _raw(study)
    for name, value in values.items():
        table, key = _place(study, raw, name)
        table[key] = value
    try:
        return msgspec.convert(raw, Study)
    except msgspec.ValidationError as error:
        raise invalid(study.source, raw, error) from None


def value_of(study: Study, name: str) -> float:
    """The value of a parameter in the study."""
    table, key = _place(study, _raw(study), name)
    return float(table[key])


def _raw(study: Study) -> Any:
    """The study as tables; the name of a weather is replaced by the weather's table."""
    return msgspec.to_builtins(msgspec.structs.replace(study, weather=weather_of(study.weather, study.source)))


def _place(study: Study, raw: Any, name: str) -> tuple[Any, Any]:
    """The table or list that holds a parameter, and its key or index there."""
    refused = InputError(study.source, f"calibration.{name!r} is no parameter of the study",
                         f"a number that is given under {', '.join(prefix.rstrip('.') for prefix in FITTED)}")
    if not name.startswith(FITTED):
        raise refused
    *path, last = name.split(".")
    table = raw
    try:
        for key in path:
            table = table[_key(table, key)]
        place = _key(table, last)
        if not isinstance(table[place], int | float):
            raise refused
    except (KeyError, IndexError, ValueError, TypeError):
        raise refused from None
    return table, place


def _key(table: Any, name: str) -> int | str:
    """The key, or the index of a list; an index has only one spelling, else two names of one parameter could be fitted at once."""
    return int(name) if isinstance(table, list) and name == str(int(name)) else name
