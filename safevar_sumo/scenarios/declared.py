"""Searched parameters of a study: what [scenario.search] leaves out is what the scenario's class
declares, shipped or the user's own, and the weather.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import msgspec

from safevar_sumo.plugins import Lookup
from safevar_sumo.scenarios import SCENARIOS, TrackScenario, WorldScenario, weather_of
from safevar_sumo.study import MatrixTable, SearchTable, Weather, convert_table, free_parameters
from safevar_sumo.study.schema import Parameters


def with_declared(
    domain: Parameters, name: str, tables: Mapping[str, Any], places: Sequence[str]
) -> Parameters:
    """The domain of a searched parameter with all keys that a scenario's class or the weather
    declares.

    The original is the class's default, or the value of the study's weather. In a matrix the class
    is that of the first test that has the parameter.

    Raises
    ------
    InputError
        If a scenario or the weather cannot be used.
    """
    for model, values in _models(tables, places):
        free = free_parameters(model)
        if name in free:
            one = free[name]
            declared = {
                "unit": one.unit,
                "lower": one.lower,
                "upper": one.upper,
                "meaning": one.meaning,
            }
            if isinstance(values[name], int | float):
                declared["original"] = values[name]
            return {**declared, **domain}
    return domain


def _models(tables: Mapping[str, Any], places: Sequence[str]) -> Iterator[tuple[type, Parameters]]:
    """The weather's class with its values, and those of the scenarios with their defaults."""
    weather = tables.get("weather")
    table = weather_of(
        weather if isinstance(weather, str) else convert_table(weather, Weather, "weather")
    )
    yield Weather, msgspec.structs.asdict(table)
    matrix = tables.get("matrix")
    tests = convert_table(matrix, MatrixTable, "matrix").tests if matrix else []
    time_limit = convert_table(tables.get("search"), SearchTable, "search").time_limit
    lookup = Lookup(places, time_limit=time_limit)
    for name in dict.fromkeys([one.model for one in tests] or [""]):
        model = name or tables["scenario"].get("model")
        if not isinstance(model, str):
            return  # which the check of the whole study refuses
        member = lookup.class_of(SCENARIOS, model, "scenario.model", TrackScenario, WorldScenario)
        yield member.target, _defaults(member.target)


def _defaults(model: type) -> Parameters:
    """The defaults of a class's fields."""
    fields: Sequence[Any] = (
        msgspec.structs.fields(model) if issubclass(model, msgspec.Struct) else ()
    )
    if dataclasses.is_dataclass(model):
        fields = dataclasses.fields(model)
    return {field.name: field.default for field in fields}
