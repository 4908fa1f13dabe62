"""Finds the parts of one version's tests that the other version lacks: test cases, weathers, ranges
and parameter sets; also the vehicles and encounters that a constraint or margin excludes.

A version whose failing tests were deleted would look safer, although nothing shows that it is
safer.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from safevar_sumo.questions.compare.words import LACKS
from safevar_sumo.questions.counterexamples import OF_ENCOUNTER
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.pairs import Titles
from safevar_sumo.questions.part import points_of_tests
from safevar_sumo.questions.sentence import Sentences
from safevar_sumo.questions.words import join_phrases, number_of
from safevar_sumo.scenarios import Point
from safevar_sumo.study import Study, Weather

MAX_PARTS_NAMED = 4
"""Maximum number of missing parts that a sentence names."""
OF_VEHICLE = "vehicle."
"""Prefix of the parameters of a parameter set that belong to the vehicle. Versions of a driving
system have these parameters in common.
"""


class TestCase(NamedTuple):
    """The encounter at a point of a matrix. It lacks the name of the test, which versions may
    change.
    """

    model: str
    parameters: dict[str, Any]
    weather: Weather
    allowed_impact_speed: float


def cases_of(side: Evaluator) -> Iterator[tuple[str, Point, TestCase]]:
    """Yield the test cases of a version, each with the name of its test (without tests: of its
    scenario) and its point.
    """
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


def missing_parts(side: Evaluator, reference: Evaluator) -> list[str]:
    """The parts of the version `reference` that the version `side` lacks, as phrases."""
    parts = [
        *_missing_cases(side, reference),
        *_missing_ranges(side, reference),
        *_excluded(side.study, reference.study),
        *_missing_sets(side.study, reference.study),
    ]
    return list(dict.fromkeys(parts))


def missing_in_words(a: Evaluator, b: Evaluator, titles: Titles) -> Sentences:
    """Yield a sentence for each version that lacks parts of the other version, such as `Version b
    lacks the test CCRs, which a has.` `titles` are the names of the versions.
    """
    for side, reference, names in ((a, b, "ab"), (b, a, "ba")):
        parts = missing_parts(side, reference)
        if len(parts) > MAX_PARTS_NAMED:
            parts[MAX_PARTS_NAMED:] = [f"{len(parts) - MAX_PARTS_NAMED} more"]
        if parts:
            version, reference_title = map(titles.__getitem__, names)
            yield LACKS(
                version=version,
                parts=join_phrases(parts),
                other=reference_title,
            )


def _missing_cases(side: Evaluator, reference: Evaluator) -> Iterator[str]:
    """Yield the weathers, test cases and tests of `reference` that `side` lacks, as phrases."""
    tests, _, cases = zip(*cases_of(side), strict=True)
    weathers = {case.weather for case in cases}
    for test, point, case in cases_of(reference):
        if case in cases:
            continue
        variants = [case._replace(weather=weather) for weather in weathers]
        if case.weather not in weathers and any(map(cases.__contains__, variants)):
            yield f"the weather {case.weather.name}"
        elif test in tests and point.name:
            yield f"the test case ({point.name})"
        else:
            yield f"the test {test}"


def _missing_ranges(side: Evaluator, reference: Evaluator) -> Iterator[str]:
    """Yield the ranges of `reference` that are no part of a range of `side`, as phrases."""
    tests = points_of_tests(side.study, side.system.points)
    by_name = {test and test.name: side.study.ranges_of(test) for test, _ in tests}
    for test, _ in points_of_tests(reference.study, reference.system.points):
        # If the version has no test of this name, its ranges for all tests count.
        ranges = by_name.get(test and test.name, side.study.ranges)
        for name, domain in reference.study.ranges_of(test).items():
            narrower = ranges.get(name)
            if (
                narrower is None
                or narrower.lower > domain.lower
                or narrower.upper < domain.upper
            ):
                where = f" in the test {test.name}" if test else ""
                yield f"the range of {name} from {domain.lower:g} to {domain.upper:g}{where}"


def _excluded(study: Study, reference: Study) -> Iterator[str]:
    """Yield the vehicles and encounters that a constraint or margin of `study` excludes, but no
    constraint or margin of `reference`, as phrases.
    """
    for constraint in study.constraints:
        low, high = constraint.ends
        if not any(
            (counterpart.sum, counterpart.tests) == (constraint.sum, constraint.tests)
            and low <= counterpart.ends[0]
            and counterpart.ends[1] <= high
            for counterpart in reference.constraints
        ):
            yield f"the vehicles that its constraint on {constraint.quantity} excludes"
    margin = study.scenario.margin
    reference_margin = reference.scenario.margin
    if (
        study.ranges
        and margin is not None
        and (reference_margin is None or margin > reference_margin)
    ):
        yield f"the encounters in which its original vehicle keeps less than {margin:g} m"


def _missing_sets(study: Study, reference: Study) -> Iterator[str]:
    """Yield the number of parameter sets of `reference` that `study` lacks, as a phrase."""
    sets = _sets_of_vehicle(reference) - _sets_of_vehicle(study)
    if sets:
        yield number_of(len(sets), "parameter set")


def _sets_of_vehicle(study: Study) -> set[tuple[tuple[str, float], ...]]:
    """The study's parameter sets, as far as they concern the vehicle: names with values."""
    of_vehicle = {
        name: values
        for name, values in study.spread.items()
        if name.startswith(OF_VEHICLE)
    }
    return {
        tuple(zip(of_vehicle, values, strict=True))
        for values in zip(*of_vehicle.values(), strict=True)
    }
