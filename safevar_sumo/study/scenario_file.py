"""`[scenario]` with a `file` of OpenSCENARIO: it becomes the scenario `openscenario`, its domains,
and a matrix.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from safevar_sumo.errors import InputError, unknown_name, warn
from safevar_sumo.openscenario import (
    EVERY,
    MOST,
    Source,
    constraints_of,
    open_file,
    originals,
    play,
    read,
    text_of,
)
from safevar_sumo.study.encounters import RANGES, TESTS, MatrixTest, Parameters, Weather
from safevar_sumo.study.parameters import free_parameters

MODEL = "openscenario"
"""The scenario that plays a file."""
MOST_POINTS = 2000
"""Largest number of combinations of a file's values in a matrix."""
MOST_NAMES = 50
"""Largest number of combinations that a warning names."""
WEATHER = tuple(free_parameters(Weather))
"""Parameters of the weather, which a study may search as well."""
Raw = Mapping[str, Any]


def path_of(name: str, places: Sequence[str]) -> str:
    """The path of a file that a study names, beside the study."""
    for place in places or (os.getcwd(),):
        path = Path(place, name)
        if path.is_file():
            return os.path.abspath(path)
    raise InputError(
        "", f"scenario.file: there is no file {name!r}", "the path of an OpenSCENARIO file (*.xosc)"
    )


def files_of_scenario(
    scenario: Parameters, tests: Sequence[MatrixTest], places: Sequence[str]
) -> dict[str, str]:
    """The paths of all files that a scenario from a file depends on at any point of a matrix, by
    themselves.

    Texts alone choose catalogs and roads, so points that differ in numbers are read once.
    """
    if not isinstance(scenario.get("file"), str):
        return {}

    # Texts alone choose files: points that differ in numbers are read once.
    points = {}
    for test in tests or (MatrixTest(name=""),):
        lists = {name: axis.at for name, axis in test.axes.items() if axis.at}
        axes = [
            column if any(isinstance(value, str) for value in column) else column[:1]
            for column in lists.values()
        ]
        for combination in product(*axes):
            point = {**scenario, **test.parameters, **dict(zip(lists, combination, strict=True))}
            points[frozenset(item for item in point.items() if isinstance(item[1], str))] = point

    # The file itself, its catalogs and its road.
    files: dict[str, str] = {}
    for point in points.values():
        path = path_of(point["file"], places)
        given = {
            name: text_of(value) for name, value in point.items() if name not in ("file", "ego")
        }
        try:
            document = read(path, given)
        except InputError as error:
            raise InputError(
                "", f"scenario.file = {point['file']!r}: {error.problem}", error.legal
            ) from None
        files |= {name: name for name in (path, *document.catalogs, document.road) if name}
    return files


def with_file(tables: Raw, places: Sequence[str]) -> Parameters:
    """The tables of a study whose scenario names a `file`, with all that the file says in its
    place.

    Where encounters are ranges, an axis of [scenario.over] gets the file's range; what has several
    values beside them becomes points of the matrix, without those that the file's constraints
    exclude.
    """
    scenario = tables.get("scenario")
    if not isinstance(scenario, dict) or "file" not in scenario:
        return dict(tables)

    # A file stands in place of a model.
    for key in ("model", "parameters", "files"):
        if scenario.get(key):
            raise InputError(
                "",
                f"scenario.{key} beside scenario.file",
                "one of the two; values stand in [scenario.values]",
            )
    name = scenario["file"]
    if not isinstance(name, str):
        raise InputError("", f"scenario.file = {name!r}", "a path")
    for key in ("values", "over"):
        value = scenario.get(key, {})
        if not isinstance(value, dict):
            raise InputError("", f"scenario.{key} = {value!r}", "a table")
    path = path_of(name, places)
    try:
        return _expanded(tables, path, places)
    except InputError as error:
        raise InputError("", f"scenario.file = {name!r}: {error.problem}", error.legal) from None


def _expanded(tables: Raw, path: str, places: Sequence[str]) -> Parameters:
    """The tables of a study with what the file at `path` says; see `with_file`."""
    # The file offers values; the study fixes some and searches others.
    offered = open_file(path)
    scenario: Parameters = tables["scenario"]
    values = scenario.get("values", {})
    is_range = tables.get("encounters", TESTS) == RANGES
    search = scenario.get("over", {}) if is_range else {}
    for name in [*values, *(name for name in search if name not in WEATHER)]:
        if name not in offered.values:
            raise unknown_name(
                "scenario", f"the file declares no parameter {name}", name, offered.values
            )
    for name, value in values.items():
        is_text = isinstance(value, str)
        if not is_text and not (isinstance(value, int | float) and abs(value) <= MOST):
            problem = f"scenario.values.{name} = {value!r:.80}"
            raise InputError("scenario", problem, f"a text, or a number of at most {MOST:g}")
    domains = {
        name: table if name in WEATHER else _domain(name, table, offered)
        for name, table in search.items()
    }

    # Fixed values are parameters of the scenario.
    fixed = {
        name: value if isinstance(value, str) else _plain(value) for name, value in values.items()
    }
    rest = offered.without({**values, **search})
    parameters = {"file": _relative(offered.concrete, places), **fixed}
    if "ego" in scenario:
        parameters["ego"] = scenario["ego"]
    left_out = {"file", "ego", "values", *(() if is_range else ("margin",))}
    kept = {key: value for key, value in scenario.items() if key not in left_out}
    if path != offered.concrete:
        kept["files"] = [_relative(path, places)]  # results depend on it, and a pack has it

    # Searched ones have domains.
    result = {
        **tables,
        "scenario": {**kept, "model": MODEL, "parameters": parameters, "over": domains},
    }

    # All others are points of a matrix, if there are several.
    matrix = tables.get("matrix")
    searched = {
        name: domain["original"] for name, domain in domains.items() if name in offered.values
    }
    has_tests = isinstance(matrix, dict) and bool(matrix.get("tests"))
    points = [{}] if has_tests else _points(rest, {**fixed, **searched})
    if len(points) > 1:
        points = _playable(
            offered.concrete, scenario.get("ego", "Ego"), {**fixed, **searched}, points
        )
    if len(points) == 1:
        parameters.update(points[0])
    else:
        name = Path(scenario["file"]).stem
        tests = [
            {"name": name, "over": {key: [value] for key, value in point.items()}}
            for point in points
        ]
        result["matrix"] = {**(matrix or {}), "tests": tests}

    # Conditions of the file.
    constraints = _constraints(offered, fixed, domains, points)
    if constraints:
        result["constraints"] = [*tables.get("constraints", []), *constraints]
    return result


def _domain(name: str, table: object, offered: Source) -> Parameters:
    """The domain of a searched parameter: what the study leaves out comes from the file."""
    if not isinstance(table, dict):
        raise InputError(
            "scenario", f"scenario.over.{name} = {table!r}", "a table, which may be empty"
        )
    if name in offered.whole_numbers:
        problem = f"scenario.over.{name}: the file declares {name} as a whole number"
        raise InputError("scenario", problem, "a parameter of type double")

    # A number with a range, in the file or in the study.
    numbers = originals(offered)
    ends = offered.range_of(name)
    if name not in numbers:
        raise InputError(
            "scenario", f"{name} = {offered.values[name]!r} is no number", "a number to search"
        )
    if ends is None and not {"lower", "upper"} <= table.keys():
        raise InputError(
            "scenario", f"{name} has no range in the file", "lower and upper in [scenario.over]"
        )
    lower, upper = ends or (-np.inf, np.inf)

    # What the study says counts.
    domain = {
        "unit": "-",
        "original": numbers[name],
        "meaning": name,
        "lower": lower,
        "upper": upper,
        **table,
    }

    # Within the file's range.
    if all(isinstance(domain[key], int | float) for key in ("lower", "upper", "original")):
        if domain["lower"] < lower or domain["upper"] > upper:
            problem = f"scenario.over.{name}: {domain['lower']:g} to {domain['upper']:g}"
            raise InputError(
                "scenario", problem, f"a part of the file's range, {lower:g} to {upper:g}"
            )
        if not domain["lower"] <= domain["original"] <= domain["upper"]:
            problem = (
                f"scenario.over.{name}: the file's value {domain['original']:g} is not in its range"
            )
            raise InputError(
                "scenario",
                problem,
                f"original = a value from {domain['lower']:g} to {domain['upper']:g}",
            )
    return domain


def _points(rest: Source, given: Parameters) -> list[Parameters]:
    """The combinations of all values that nothing else gives."""
    total = (
        int(np.prod([float(len(choice.sets)) for choice in rest.choices])) if rest.choices else 1
    )
    if total > 50 * MOST_POINTS:
        raise _too_many(rest, total)
    points = []
    for combination in rest.combinations({name: text_of(value) for name, value in given.items()}):
        points.append({name: _plain(value) for name, value in combination.items()})
        if len(points) > MOST_POINTS:
            raise _too_many(rest, total)
    if not points:
        raise InputError(
            "scenario",
            "the file's constraints exclude every combination of its values",
            "values that they allow",
        )
    return points


def _playable(
    file: str, ego: str, given: Parameters, points: Sequence[Parameters]
) -> list[Parameters]:
    """The points that can be played and at which something happens; a warning names the others.

    If nothing happens at any point, all that can be played are kept: they have no verdict.
    """
    # Each point is played once.
    playable = {}
    problems = {}
    errors = []
    for point in points:
        name = " and ".join(f"{name} = {value}" for name, value in point.items())
        try:
            scene = play(
                file,
                {name: text_of(value) for name, value in {**given, **point}.items()},
                ego,
                EVERY,
            )
            problems[name] = scene.uneventful
            playable[name] = point
        except InputError as error:
            problems[name] = error.problem
            errors.append(error)

    # Points at which something happens, and a warning about the others.
    if not playable:
        raise errors[0]
    kept = {name: point for name, point in playable.items() if not problems[name]} or playable
    left_out = [name for name in problems if name not in kept]
    if left_out:
        counts = f"{len(left_out)} of {len(points)} combinations of the file's values"
        others = "; ".join(left_out[1:MOST_NAMES]) or "none"
        warn(
            f"{counts} cannot be played, or nothing happens in them, and are left out; "
            f"the first is {left_out[0]}: {problems[left_out[0]]}; others: {others}"
        )
    return [*kept.values()]


def _too_many(rest: Source, total: int) -> InputError:
    sizes = ", ".join(
        f"{' and '.join(choice.names)} ({len(choice.sets)})" for choice in rest.choices
    )
    legal = (
        "parameters under [scenario.over], with encounters = 'ranges', or [scenario.values], so"
        " that fewer are left"
    )
    return InputError(
        "scenario", f"{total:,} combinations of {sizes}; at most {MOST_POINTS:,}", legal
    )


def _plain(value: Any) -> Any:
    """A value as a number if it is one."""
    if isinstance(value, str):
        try:
            number = float(value)
        except ValueError:
            return value
        return int(number) if number.is_integer() and "." not in value else number
    return value


def _relative(path: str, places: Sequence[str]) -> str:
    """A path as it is from the folder of the study."""
    return (
        os.path.relpath(path, places[0]) if places and path.startswith(places[0] + os.sep) else path
    )


def _constraints(
    offered: Source, fixed: Parameters, domains: Parameters, points: Sequence[Parameters]
) -> list[Parameters]:
    """The file's constraints on what is searched, which must be linear there, at all points."""
    names = [name for name in domains if name in offered.values]
    if not names:
        return []
    low = np.array([float(domains[name]["lower"]) for name in names])
    high = np.array([float(domains[name]["upper"]) for name in names])
    different: dict[str, Parameters] = {}
    for point in points:
        given = {name: text_of(value) for name, value in {**fixed, **point}.items()}
        for bound in constraints_of(offered.concrete, given, names, low, high):
            weights = {
                name: weight for name, weight in zip(names, bound.weights, strict=True) if weight
            }
            table = {"sum": weights, bound.kind: bound.limit, "unit": "-", "meaning": bound.text}
            different[repr(table)] = table
    return [*different.values()]
