"""The reading of a study: of its searched parameters, [scenario.search] may leave out what the
scenario's class declares, shipped or the user's own, or the weather.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import msgspec

from safevar_sumo.errors import about, warn
from safevar_sumo.plugins import Lookup
from safevar_sumo.scenarios import SCENARIO_BASES, SCENARIOS, weather_of
from safevar_sumo.study import (
    Domain,
    MatrixTable,
    SearchTable,
    Study,
    StudyLike,
    Weather,
    checked_study,
    convert_table,
    free_parameters,
    read_tables,
)
from safevar_sumo.study.schema import Parameters


def read_study(study: StudyLike, **changes: Any) -> Study:
    """Read a study strictly, as `safevar_sumo.load_study` does, but for the parameters of its
    shipped models.
    """
    raw = read_tables(study, **changes)
    with about(raw.source):
        complete_study = checked_study(
            raw._replace(tables=_with_declared(raw.tables, raw.origin.places))
        )
    for remark in raw.remarks:
        warn(remark)
    return complete_study


def _with_declared(tables: Parameters, places: Sequence[str]) -> Parameters:
    """The tables of a study, with what the scenario's class declares of parameters that the study
    searches.
    """
    scenario = tables.get("scenario")
    search = scenario.get("search") if isinstance(scenario, dict) else None
    if not isinstance(scenario, dict) or not isinstance(search, dict):
        return tables
    required = {field.name for field in msgspec.structs.fields(Domain) if field.required}
    domains = {
        name: _completed(domain, name, tables, places)
        if isinstance(domain, dict) and required - domain.keys()
        else domain
        for name, domain in search.items()
    }
    return {**tables, "scenario": {**scenario, "search": domains}}


def _completed(
    domain: Parameters, name: str, tables: Parameters, places: Sequence[str]
) -> Parameters:
    """The domain of a searched parameter with all keys that a scenario's class or the weather
    declares.

    The original is the class's default, or the value of the study's weather. In a matrix the class
    is that of the first test that has the parameter.
    """
    for model, values in _models(tables, places):
        parameter = free_parameters(model).get(name)
        if parameter is None:
            continue
        declared = {
            "unit": parameter.unit,
            "lower": parameter.lower,
            "upper": parameter.upper,
            "meaning": parameter.meaning,
        }
        if isinstance(values[name], int | float):
            declared["original"] = values[name]
        return {**declared, **domain}
    return domain


def _models(tables: Parameters, places: Sequence[str]) -> Iterator[tuple[type, Parameters]]:
    """The weather's class with its values, and those of the scenarios with their defaults."""
    # The weather's parameters.
    weather = tables.get("weather", "")
    table = weather_of(
        weather if isinstance(weather, str) else convert_table(weather, Weather, "weather")
    )
    yield Weather, msgspec.structs.asdict(table)

    # The scenarios of the tests, or the only one.
    matrix = tables.get("matrix")
    tests = convert_table(matrix, MatrixTable, "matrix").tests if matrix else []
    time_limit = convert_table(tables.get("search"), SearchTable, "search").time_limit
    lookup = Lookup(places, time_limit=time_limit)
    for name in dict.fromkeys([test.model for test in tests] or [""]):
        model = name or tables["scenario"].get("model")
        if not isinstance(model, str):
            return  # which the check of the whole study refuses
        member = lookup.class_of(SCENARIOS, model, "scenario.model", *SCENARIO_BASES)
        yield member.target, _defaults(member.target)


def _defaults(model: type) -> Parameters:
    """The defaults of a class's fields."""
    fields: Sequence[Any] = (
        msgspec.structs.fields(model) if issubclass(model, msgspec.Struct) else ()
    )
    if dataclasses.is_dataclass(model):
        fields = dataclasses.fields(model)
    return {field.name: field.default for field in fields}
