"""What a study inherits from the one that it extends."""

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
"""Parameters of the weather, which a study may search as well."""


class StudyTables(NamedTuple):
    """The tables of a study before they are checked, with its source in errors, its origin, and
    remarks for the user on what they do not inherit.
    """

    source: object
    tables: Parameters
    origin: Origin = Origin()
    remarks: tuple[str, ...] = ()


def with_overrides(base: StudyTables, overrides: Tables, source: object) -> StudyTables:
    """Override a study's tables, but for those that the new study does not inherit: their marks in
    the records say when; of another weather not the axes of its parameters.
    """
    # Keys about this one study, and keys about its scenario, if the overrides name another one.
    left_out = {*keys_with(OF_STUDY, Study)}
    if _names_scenario(overrides.get("scenario"), base.tables.get("scenario")):
        left_out.update(keys_with(OF_SCENARIO, Study))
    inherited = {key: value for key, value in base.tables.items() if key not in left_out}
    scenario = inherited.get("scenario")
    if isinstance(scenario, dict) and "over" in scenario:
        inherited["scenario"] = _with_axes_for(overrides, scenario)
    tables = _merge(inherited, overrides)

    # Keys about the parts of the system that differ now.
    parts = [
        key
        for key in keys_with(PART_OF_SYSTEM, Study)
        if _model_and_network(tables.get(key)) != _model_and_network(inherited.get(key))
    ]
    marks = [OF_SYSTEM] if parts else []
    marks += [OF_VEHICLE_AND_ADS] if {"vehicle", "ads"} & {*parts} else []
    for key in {key for mark in marks for key in keys_with(mark, Study)} - overrides.keys():
        tables.pop(key, None)
    if "matrix" in parts:
        tables |= _for_tests(tables, overrides)

    # A study without a title of its own is called by its name.
    if parts or base.tables.get("title", "") == base.tables.get("name"):
        tables["title"] = overrides.get("title", tables.get("name", ""))
    remarks = base.remarks
    dropped = [
        f"[{key}]"
        for key, value in base.tables.items()
        if isinstance(value, dict)
        and key not in {*tables, *keys_with(OF_STUDY, Study)}  # which no study inherits
    ]
    lost = _set_in(base.tables.get("scenario")) - _set_in(tables.get("scenario"))
    dropped += [f"{name} of [scenario]" for name in sorted(lost)]
    if parts and dropped:
        differences = " and a different ".join("ADS" if key == "ads" else key for key in parts)
        of_base = f"than {base.tables.get('name')!r}, so not its {', '.join(dropped)}"
        remarks = (*remarks, f"{source}: has a different {differences} {of_base}")
    return StudyTables(source, tables, base.origin, remarks)


def _with_axes_for(overrides: Tables, scenario: Parameters) -> Parameters:
    """A table [scenario] that a study inherits: of another weather without the axes of its
    parameters, and for tests of other models with these alone.
    """
    names = scenario["over"].keys() - (WEATHER if "weather" in overrides else ())
    tests = _tables_in(_table_in(overrides, "matrix"), "tests")
    if tests and all(test.get("model") not in (None, scenario.get("model")) for test in tests):
        names &= {*WEATHER}
    return {
        **scenario,
        "over": {name: scenario["over"][name] for name in scenario["over"] if name in names},
    }


def _for_tests(tables: Tables, overrides: Tables) -> Parameters:
    """The constraints and distributions that a study with tests of its own inherits: of what can
    vary in these tests.
    """
    # What can vary, the vehicle's characteristics and the axes.
    tests = _tables_in(_table_in(tables, "matrix"), "tests")
    known = {*_table_in(_table_in(tables, "vehicle"), "characteristics")}
    for place in (_table_in(tables, "scenario"), *tests):
        known |= {*_table_in(place, "over")}

    # Constraints in tests that are still there.
    names = {str(test.get("name")) for test in tests}
    kept = [
        {**one, "tests": [name for name in _list_in(one, "tests") if str(name) in names]}
        for one in _tables_in(tables, "constraints")
        if known >= {*_table_in(one, "sum")}
        and (not one.get("tests") or names & {*map(str, _list_in(one, "tests"))})
    ]
    chosen = known | {*_table_in(overrides, "variation")}
    varied = _table_in(tables, "variation")
    return {
        "constraints": tables.get("constraints") if "constraints" in overrides else kept,
        "variation": {name: varied[name] for name in varied if name in chosen},
    }


def _tables_in(tables: Tables, key: str) -> list[Parameters]:
    """A list of tables; empty where there is none."""
    return [row for row in _list_in(tables, key) if isinstance(row, dict)]


def _list_in(tables: Tables, key: str) -> list[Any]:
    value = tables.get(key)
    return value if isinstance(value, list) else []


def _table_in(tables: object, key: str) -> Parameters:
    """An inner table; empty where there is none."""
    table = tables.get(key) if isinstance(tables, dict) else None
    return dict(table) if isinstance(table, dict) else {}


def _names_scenario(table: object, base_table: object) -> bool:
    """Whether a table [scenario] names another model than that of its base, whose matrix is not
    about it.
    """
    if not isinstance(table, dict):
        return False
    base_model = base_table.get("model") if isinstance(base_table, dict) else None
    return table.get("model", base_model) != base_model


def _set_in(scenario: object) -> set[str]:
    """The parameters that a table [scenario] sets or searches."""
    inner_tables = scenario.values() if isinstance(scenario, dict) else ()
    return {name for table in inner_tables if isinstance(table, dict) for name in table}


def _model_and_network(table: object) -> object:
    """The model and network that a table names; instead of a model, a weather or matrix itself."""
    if not isinstance(table, dict):
        return table
    parameters = table.get("parameters")
    return table.get("model", table), (
        parameters.get("network") if isinstance(parameters, dict) else None
    )


def _merge(base: Tables, overrides: Tables) -> Parameters:
    """Override `base` by `overrides`; another `model` or `distribution`, and the tables
    that are inherited as a whole, replace a whole table; false in place of a table leaves it out.
    """
    result = dict(base)
    for key, value in overrides.items():
        if value is False and isinstance(result.get(key), dict):
            del result[key]
            continue
        result[key] = _merge(base[key], value) if _refines(key, base.get(key), value) else value
    return result


def _refines(key: str, base_value: object, override: object) -> bool:
    """Whether an override changes single keys of the table that it overrides."""
    if key in keys_with(WHOLE, Study) or not (
        isinstance(base_value, dict) and isinstance(override, dict)
    ):
        return False
    return all(
        override.get(choice, base_value.get(choice)) == base_value.get(choice)
        for choice in ("model", "distribution")
    )
