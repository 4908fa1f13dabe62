"""The reading of a study. Axes of a study may leave out their ranges: classes of scenarios and the
weather declare ranges, which complete the study.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

import msgspec

from safevar_sumo.errors import InputError, about, warn
from safevar_sumo.plugins import Lookup
from safevar_sumo.scenarios import (
    SCENARIO_BASES,
    SCENARIOS,
    WEATHER_PARAMETERS,
    weather_of,
)
from safevar_sumo.study import (
    RANGES,
    TESTS,
    FreeParameter,
    MatrixTable,
    SearchTable,
    Study,
    StudyLike,
    StudyTables,
    Weather,
    checked_study,
    convert_table,
    free_parameters,
    read_tables,
    tables_of,
)
from safevar_sumo.study.encounters import Parameters, are_numbers


def read_study(study: StudyLike, **changes: Any) -> Study:
    """Read a study strictly. Unlike `safevar_sumo.load_study`, this function does not check the
    parameters of shipped models.
    """
    raw = read_tables(study, **changes)
    with about(raw.source):
        complete_study = checked_study(
            raw._replace(tables=_with_declared(raw.tables, raw.origin.places))
        )
    for remark in raw.remarks:
        warn(remark)
    for name in complete_study.scenario.over:
        if complete_study.tests and all(
            name in test.over for test in complete_study.tests
        ):
            warn(
                f"scenario.over.{name} has no effect: each test has an axis of this name"
            )
    return complete_study


def with_ranges(study: Study) -> Study:
    """The study whose vehicles meet any encounter in the ranges of its axes. The same study if no
    axis has a range.
    """
    if study.encounters == RANGES:
        return study
    tables = _with_declared(
        {**tables_of(study), "encounters": RANGES}, study.origin.places
    )
    axes: list[Any] = []
    for place in (tables["scenario"], *tables.get("matrix", {}).get("tests", [])):
        axes += place.get("over", {}).values()
    if not any(isinstance(axis, dict) and "lower" in axis for axis in axes):
        return study
    origin = msgspec.structs.replace(study.origin, ranges=True)
    return checked_study(StudyTables(study.source, tables, origin))


def _with_declared(tables: Parameters, places: Sequence[str]) -> Parameters:
    """Complete the axes of a study by the ranges that scenarios' classes and the weather declare.
    Axes that state a part of a range are completed. If encounters are ranges, lists of numbers get
    ranges, too.
    """
    scenario = tables.get("scenario")
    matrix = tables.get("matrix")
    if not isinstance(scenario, dict):
        return tables
    # An empty list of tests is legal only here: it removes the matrix that a study inherits.
    if matrix is not None and not (
        isinstance(matrix, dict) and matrix.get("tests") == []
    ):
        convert_table(matrix, MatrixTable, "matrix")
    tests = (matrix or {}).get("tests", [])
    is_range = tables.get("encounters", TESTS) == RANGES
    declared = _Declared(tables, places)

    def completed(over: Parameters, key: str, test: Parameters) -> Parameters:
        """Complete the axes of a test, or of [scenario.over]. `key` is their place, for errors."""
        axes = dict(over)
        for name, axis in over.items():
            if isinstance(axis, dict) or (is_range and isinstance(axis, list)):
                axes[name] = declared.completed(f"{key}.{name}", name, axis, test)
        return axes

    result = {**tables}
    shared = scenario.get("over")
    if isinstance(shared, dict):
        test: Parameters = next(iter(tests), {})
        result["scenario"] = {
            **scenario,
            "over": completed(shared, "scenario.over", test),
        }
    completed_tests = []
    for test in tests:
        key = f"matrix.tests: {test['name']!r}: over"
        over = completed(test.get("over", {}), key, test)
        completed_tests.append({**test, "over": over})
    if completed_tests:
        result["matrix"] = {**(matrix or {}), "tests": completed_tests}
    return result


class _Declared:
    """The ranges that classes of scenarios and the weather declare for the axes of a study."""

    def __init__(self, tables: Parameters, places: Sequence[str]) -> None:
        self._scenario: Parameters = tables["scenario"]
        weather = tables.get("weather", "")
        if not isinstance(weather, str):
            weather = convert_table(weather, Weather, "weather")
        self._weather = msgspec.structs.asdict(weather_of(weather))
        self._lookup = Lookup(places)
        # A study without a table [search] is refused later, with all other mistakes of the study.
        if "search" in tables:
            limit = convert_table(tables["search"], SearchTable, "search").time_limit
            self._lookup = Lookup(places, time_limit=limit)

    def completed(self, key: str, name: str, axis: Any, test: Parameters) -> Any:
        """Complete an axis by all keys of its range. A list stays if its values cannot vary: a
        single value, or values that are no numbers.

        The original value is by default the first value of a list, or else the test's own value.
        """
        table = axis
        is_list = isinstance(axis, list)
        if is_list:
            table = {"at": axis}
        values = table.get("at", [])
        is_single = len({str(value) for value in values}) < 2
        is_fixed = is_list and (is_single or not are_numbers(values))
        if is_fixed or {"unit", "original", "lower", "upper"} <= table.keys():
            return axis
        parameter, original = self._parameter(name, test)
        if parameter is None:
            if is_list:
                return axis
            raise InputError(
                "",
                f"{key}: no scenario or weather declares a range of {name}",
                "unit, original, lower and upper, or a list of values",
            )

        # Listed values win over the class's range, and keys that the study states win over both.
        declared = {
            "unit": parameter.unit,
            "lower": parameter.lower,
            "upper": parameter.upper,
            "meaning": parameter.meaning,
        }
        if isinstance(original, int | float):
            declared["original"] = original
        if values and are_numbers(values):
            declared |= {
                "lower": min(values),
                "upper": max(values),
                "original": values[0],
            }
        return {**declared, **table}

    def _parameter(
        self, name: str, test: Parameters
    ) -> tuple[FreeParameter | None, Any]:
        """The declared range of a parameter (None if nobody declares one), and the test's value of
        it.
        """
        if name in WEATHER_PARAMETERS:
            return WEATHER_PARAMETERS[name], self._weather[name]
        model = test.get("model") or self._scenario.get("model")
        # A scenario without a model is refused later, by the check of the whole study.
        if not isinstance(model, str):
            return None, None
        stated = test.get("parameters", {})
        if model == self._scenario.get("model"):
            stated = {**self._scenario.get("parameters", {}), **stated}
        member = self._lookup.class_of(
            SCENARIOS, model, "scenario.model", *SCENARIO_BASES
        )
        with self._lookup.modules.active():
            fields = inspect.signature(member.target).parameters
        original = stated.get(name)
        if name not in stated and name in fields:
            original = fields[name].default
        return free_parameters(member.target).get(name), original
