"""Decides what a study inherits from the study that it extends."""

from __future__ import annotations

from typing import Any, NamedTuple

from safevar_sumo.study.encounters import Parameters, Weather
from safevar_sumo.study.marks import (
    OF_SCENARIO,
    OF_STUDY,
    OF_SYSTEM,
    OF_VEHICLE_AND_ADS,
    PART_OF_SYSTEM,
    WHOLE,
    keys_with,
)
from safevar_sumo.study.parameters import free_parameters
from safevar_sumo.study.schema import Origin, Study, Tables

WEATHER = tuple(free_parameters(Weather))
"""Parameters of the weather that a study may search."""


class StudyTables(NamedTuple):
    """The tables of a study before they are checked.

    Attributes
    ----------
    source
        The name of the study in errors.
    tables
        The tables as in a file.
    origin
        The origin of the study.
    remarks
        Remarks for the user on tables that the study did not inherit.
    """

    source: object
    tables: Parameters
    origin: Origin = Origin()
    remarks: tuple[str, ...] = ()


def with_overrides(base: StudyTables, overrides: Tables, source: object) -> StudyTables:
    """Override tables of a study (`base`) by tables of a study that extends it.

    Marks of the records say which tables the new study does not inherit. With another weather, the
    new study does not inherit axes of the weather's parameters.
    """
    inherited = _inherited(base, overrides)
    tables = _merge(inherited, overrides)

    # Keys about a system are wrong for a system with another vehicle, ADS, scenario or weather.
    parts = _different_parts(inherited, tables)
    base_keys: tuple[str, ...] = ()
    if parts:
        base_keys += keys_with(OF_SYSTEM, Study)
    if {"vehicle", "ads"} & {*parts}:
        base_keys += keys_with(OF_VEHICLE_AND_ADS, Study)
    for key in {*base_keys} - overrides.keys():
        tables.pop(key, None)
    if "matrix" in parts:
        tables |= _for_tests(tables, overrides)

    # A study that does not state a title has its name as title.
    if parts or base.tables.get("title", "") == base.tables.get("name"):
        tables["title"] = overrides.get("title", tables.get("name", ""))
    remarks = base.remarks
    dropped = _dropped_keys(base.tables, tables)
    if parts and dropped:
        differences = " and a different ".join(parts).replace("ads", "ADS")
        comparison = (
            f"than {base.tables.get('name')!r}, so not its {', '.join(dropped)}"
        )
        remarks = (*remarks, f"{source}: has a different {differences} {comparison}")
    return StudyTables(source, tables, base.origin, remarks)


def _inherited(base: StudyTables, overrides: Tables) -> dict[str, Any]:
    """The tables of the base that the new study inherits, before it overrides any."""
    inherited = dict(base.tables)
    own_keys = keys_with(OF_STUDY, Study)
    # Keys about the scenario of the base are wrong for another scenario.
    base_model = table_in(base.tables, "scenario").get("model")
    if table_in(overrides, "scenario").get("model", base_model) != base_model:
        own_keys += keys_with(OF_SCENARIO, Study)
    for key in own_keys:
        inherited.pop(key, None)
    scenario = inherited.get("scenario")
    if isinstance(scenario, dict) and "over" in scenario:
        inherited["scenario"] = _with_axes_for(overrides, scenario)
    return inherited


def _different_parts(inherited: Tables, tables: Tables) -> list[str]:
    """The parts of the system, such as `vehicle`, whose model or network the new study changes."""
    return [
        key
        for key in keys_with(PART_OF_SYSTEM, Study)
        if _model_and_network(tables.get(key)) != _model_and_network(inherited.get(key))
    ]


def _dropped_keys(base: Tables, tables: Tables) -> list[str]:
    """The tables and parameters of the base that the new study lacks, as a remark names them."""
    # Keys of a single study are dropped without a remark, because no study inherits them.
    named_keys = {*tables, *keys_with(OF_STUDY, Study)}
    dropped = [
        f"[{key}]"
        for key, value in base.items()
        if isinstance(value, dict) and key not in named_keys
    ]
    parameters = _scenario_parameters(base) - _scenario_parameters(tables)
    return [*dropped, *(f"{name} of [scenario]" for name in sorted(parameters))]


def _with_axes_for(overrides: Tables, scenario: Parameters) -> Parameters:
    """The inherited table [scenario] with fewer axes. If the study states another weather, axes of
    the weather's parameters are dropped. If all tests of the study have other models, only these
    axes may stay.
    """
    axes = dict(scenario["over"])
    tests = _tables_in(table_in(overrides, "matrix"), "tests")
    models = [test.get("model") for test in tests]
    has_other_models = tests and not (None in models or scenario.get("model") in models)
    for name in scenario["over"]:
        is_dropped = has_other_models
        if name in WEATHER:
            is_dropped = "weather" in overrides
        if is_dropped:
            del axes[name]
    return {**scenario, "over": axes}


def _for_tests(tables: Tables, overrides: Tables) -> Parameters:
    """The constraints and distributions that a study with its own tests inherits. Their names must
    be characteristics of the vehicle, or axes of these tests.
    """
    # Only characteristics of the vehicle and axes of encounters can vary.
    tests = _tables_in(table_in(tables, "matrix"), "tests")
    variables = {*table_in(table_in(tables, "vehicle"), "characteristics")}
    for place in (table_in(tables, "scenario"), *tests):
        variables |= {*table_in(place, "over")}
    names = {str(test.get("name")) for test in tests}
    constraints: Any = []
    for constraint in _tables_in(tables, "constraints"):
        common = [name for name in _list_in(constraint, "tests") if str(name) in names]
        has_test = common or not constraint.get("tests")
        if has_test and variables >= {*table_in(constraint, "sum")}:
            constraints.append({**constraint, "tests": common})
    if "constraints" in overrides:
        constraints = tables.get("constraints")
    variables |= {*table_in(overrides, "variation")}
    variation = tables.get("variation", {})
    if isinstance(variation, dict):
        variation = {name: variation[name] for name in variation if name in variables}
    return {"constraints": constraints, "variation": variation}


def _tables_in(tables: Tables, key: str) -> list[Parameters]:
    """A list of tables; an empty list if the key is missing."""
    return [row for row in _list_in(tables, key) if isinstance(row, dict)]


def _list_in(tables: Tables, key: str) -> list[Any]:
    value = tables.get(key)
    if isinstance(value, list):
        return value
    return []


def table_in(tables: object, key: str) -> Parameters:
    """An inner table; an empty table if the key is missing."""
    if isinstance(tables, dict) and isinstance(tables.get(key), dict):
        return dict(tables[key])
    return {}


def _scenario_parameters(tables: Tables) -> set[str]:
    """The names of parameters that the table [scenario] states or searches."""
    scenario = table_in(tables, "scenario")
    return {name for key in scenario for name in table_in(scenario, key)}


def _model_and_network(table: object) -> object:
    """The model and the network that a table names. For a weather or a matrix, which have no model:
    the whole value.
    """
    if not isinstance(table, dict):
        return table
    return table.get("model", table), table_in(table, "parameters").get("network")


def _merge(base: Tables, overrides: Tables) -> Parameters:
    """Override `base` by `overrides`, key by key in inner tables. Some values replace a whole
    table: tables with another `model` or `distribution`, and tables with the mark WHOLE. The value
    false removes a table.
    """
    result = dict(base)
    for key, value in overrides.items():
        if value is False and isinstance(result.get(key), dict):
            del result[key]
            continue
        if _refines(key, base.get(key), value):
            result[key] = _merge(base[key], value)
        else:
            result[key] = value
    return result


def _refines(key: str, base_value: object, override: object) -> bool:
    """Return whether an override changes single keys of the table that it overrides."""
    if key in keys_with(WHOLE, Study) or not (
        isinstance(base_value, dict) and isinstance(override, dict)
    ):
        return False
    return all(
        override.get(choice, base_value.get(choice)) == base_value.get(choice)
        for choice in ("model", "distribution")
    )
