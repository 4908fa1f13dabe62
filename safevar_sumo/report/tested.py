"""The section on the tested system: vehicle, driving system, scenario, search, and the characteristics with their
domains.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from safevar_sumo.ads import ADS
from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES
from safevar_sumo.analysis.words import number_of
from safevar_sumo.replay.comparison import format_number, superscript_powers
from safevar_sumo.report.input import ReportInput
from safevar_sumo.scenarios import SCENARIOS, Point, equals_clear, pre_crash_sentence
from safevar_sumo.study import unit_text
from safevar_sumo.sumo.matrix import vehicle_remarks
from safevar_sumo.vehicles import VEHICLES


def describe_tested_system(data: ReportInput) -> dict[str, Any]:
    """Describe the tested vehicle, driving system and scenario, and the search, in sentences.

    `characteristics` holds name, unit, original, lower, upper, threshold and meaning of each.
    """
    case, study = data.case, data.case.study
    return {
        "subject": f"Vehicle: {_first_sentence(VEHICLES, study.vehicle.model) or study.vehicle.model} "
        f"({number_of(len(case.characteristics), 'varied characteristic')}). "
        f"Driving system: {_name_and_sentence(ADS, study.ads.model)}. "
        f"Scenario: {_name_and_sentence(SCENARIOS, study.scenario.model)}; {describe_conditions(data)}.",
        "tags": "" if data.system is None else pre_crash_sentence(data.system.points),
        "search": _describe_search(data),
        "characteristics": [
            (
                item.name,
                superscript_powers(unit_text(item.unit, "{}")),
                *map(format_number, (item.original, item.lower, item.upper, item.threshold)),
                item.words,
            )
            for item in case.characteristics
        ],
        "remarks": [
            *case.remarks,
            *([data.problem] if data.problem else []),
            *(vehicle_remarks(data.system) if data.system else []),
        ],
    }


def describe_conditions(data: ReportInput) -> str:
    """Describe the weather or, by test, the points of the matrix."""
    points = () if data.system is None else data.system.matrix
    if data.point:
        return f"only at the point {data.point} of its matrix, at which all solutions are simulated again"
    if not points:
        no_effect = " (no effect on road and sensors; a driving system may have other parameters in it)"
        return f"weather: {data.case.weather.name}{no_effect if equals_clear(data.case.weather) else ''}"
    return f"every vehicle at all {len(points)} points of a matrix: {', '.join(_describe_tests(points))}"


def _describe_tests(points: Sequence[Point]) -> list[str]:
    """Describe each test of a matrix by its number of points and their weathers."""
    weathers_by_test: dict[str, list[str]] = {}
    for point in points:
        weathers_by_test.setdefault(str(dict(point.parameters)["test"]), []).append(point.weather.name)
    return [
        f"{test} ({len(weathers)}, {' and '.join(dict.fromkeys(weathers))})"
        for test, weathers in weathers_by_test.items()
    ]


def _describe_search(data: ReportInput) -> str:
    case, search = data.case, data.case.study.search
    versions = ", ".join(f"{name} {value}" for name, value in data.manifest["versions"].items())
    if not case.has_runs:
        return f"The {len(case.solutions)} solutions are imported ({versions})."
    runs = Counter(algorithm for algorithm, _ in case.finished_runs)
    names = [f"{ALGORITHM_TITLES.get(name, name)} ({number_of(count, 'run')})" for name, count in runs.items()]
    return (
        f"Searched by {', '.join(names) or 'no finished run'} of at most {search.evaluations} simulations each, "
        f"{len(case.evaluations)} different vehicles in all, from seed {search.seed}, with {versions}."
    )


def _name_and_sentence(models: Mapping[str, Any], name: str) -> str:
    return f"{name} ({description})" if (description := _first_sentence(models, name)) else name


def _first_sentence(models: Mapping[str, Any], name: str) -> str:
    """The first sentence of a model's description; empty for user code."""
    if name not in models:
        return ""
    sentence = (models[name].__doc__ or "").strip().partition("\n")[0].rstrip(".")
    return sentence[:1].lower() + sentence[1:] if not sentence[1:2].isupper() else sentence
