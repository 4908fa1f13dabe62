"""What one of two systems is simulated in and the other is not: test cases, weathers, ranges,
what a constraint or a margin excludes, and parameter sets.

A version whose failing tests were deleted looks safer, although nothing shows that it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from safevar_sumo.questions.compare.words import LACKS
from safevar_sumo.questions.counterexamples import OF_ENCOUNTER
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.scope import points_of_tests
from safevar_sumo.questions.sentence import Sentence
from safevar_sumo.questions.words import join_phrases, number_of
from safevar_sumo.scenarios import Point
from safevar_sumo.study import Study, Weather

MAX_PARTS_NAMED = 4
"""Maximum number of missing parts that a sentence names."""
OF_VEHICLE = "vehicle."
"""Prefix of the parameters of a set that belong to the vehicle, which versions of a driving system
have in common.
"""


class TestCase(NamedTuple):
    """What vehicles meet at a point, without the name of its test, which versions may change."""

    model: str
    parameters: dict[str, Any]
    weather: Weather
    allowed_impact_speed: float


def cases_of(side: Evaluator) -> Iterator[tuple[str, Point, TestCase]]:
    """The test cases of a system, each with the name of its test and its point."""
    scenario = side.study.scenario
    for test, points in points_of_tests(side.study, side.system.points):
        model = (test and test.model) or scenario.model
        stated = {**scenario.parameters, **(test.parameters if test else {})}
        for point in points:
            driven = {
                key: value for key, value in point.parameters if key not in OF_ENCOUNTER
            }
            parameters = stated | driven
            case = TestCase(
                model, parameters, point.weather, point.allowed_impact_speed
            )
            yield (test.name if test else model), point, case


def missing_parts(side: Evaluator, other: Evaluator) -> list[str]:
    """What the other system is simulated in and this one is not, as phrases."""
    parts = [
        *_missing_cases(side, other),
        *_missing_ranges(side, other),
        *_excluded(side.study, other.study),
        *_missing_sets(side.study, other.study),
    ]
    return [*dict.fromkeys(parts)]


def missing_in_words(
    a: Evaluator, b: Evaluator, titles: Mapping[str, str]
) -> Iterator[Sentence]:
    """What each of two systems lacks: `Version b lacks the test CCRs, which a has.`"""
    for side, other, names in ((a, b, "ab"), (b, a, "ba")):
        parts = missing_parts(side, other)
        if len(parts) > MAX_PARTS_NAMED:
            parts[MAX_PARTS_NAMED:] = [f"{len(parts) - MAX_PARTS_NAMED} more"]
        if parts:
            version, another = map(titles.__getitem__, names)
            yield LACKS.fill(version=version, parts=join_phrases(parts), other=another)


def _missing_cases(side: Evaluator, other: Evaluator) -> Iterator[str]:
    tests, _, cases = zip(*cases_of(side), strict=True)
    weathers = {case.weather for case in cases}
    for test, point, case in cases_of(other):
        in_weathers = (case._replace(weather=weather) for weather in weathers)
        if case in cases:
            continue
        if case.weather not in weathers and any(same in cases for same in in_weathers):
            yield f"the weather {case.weather.name}"
        elif test in tests and point.name:
            yield f"the test case ({point.name})"
        else:
            yield f"the test {test}"


def _missing_ranges(side: Evaluator, other: Evaluator) -> Iterator[str]:
    tests = points_of_tests(side.study, side.system.points)
    by_name = {test and test.name: side.study.ranges_of(test) for test, _ in tests}
    for test, _ in points_of_tests(other.study, other.system.points):
        # Those of all tests, where none has this name.
        own = by_name.get(test and test.name, side.study.ranges)
        for name, domain in other.study.ranges_of(test).items():
            narrower = own.get(name)
            if (
                narrower is None
                or narrower.lower > domain.lower
                or narrower.upper < domain.upper
            ):
                where = f" in the test {test.name}" if test else ""
                yield f"the range of {name} from {domain.lower:g} to {domain.upper:g}{where}"


def _excluded(study: Study, other: Study) -> Iterator[str]:
    """What a constraint or the margin of the original vehicle excludes in one study alone."""
    for one in study.constraints:
        low, high = one.ends
        if not any(
            (own.sum, own.tests) == (one.sum, one.tests)
            and low <= own.ends[0]
            and own.ends[1] <= high
            for own in other.constraints
        ):
            yield f"the vehicles that its constraint on {one.quantity} excludes"
    margin = study.scenario.margin
    others = other.scenario.margin
    if study.ranges and margin is not None and (others is None or margin > others):
        yield f"the encounters in which its original vehicle keeps less than {margin:g} m"


def _missing_sets(study: Study, other: Study) -> Iterator[str]:
    missing = _sets_of_vehicle(other) - _sets_of_vehicle(study)
    if missing:
        yield number_of(len(missing), "parameter set")


def _sets_of_vehicle(study: Study) -> set[tuple[tuple[str, float], ...]]:
    of_vehicle = {
        name: values
        for name, values in study.spread.items()
        if name.startswith(OF_VEHICLE)
    }
    return {
        tuple(zip(of_vehicle, values, strict=True))
        for values in zip(*of_vehicle.values(), strict=True)
    }
