"""Values of a searched parameter or of an axis, such as speeds, up to which limits are asked; the
study between two.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace

from safevar_sumo.errors import InputError, check_name
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.scope import points_of_tests, scope_of
from safevar_sumo.questions.words import join_phrases
from safevar_sumo.scenarios import Point, searchable_in
from safevar_sumo.study import MatrixTest, Study, unit_text
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet, FeasibleRegion

FORM = "NAME=V1,V2,...: a searched parameter or an axis of the matrix, and values of it"
MAX_VALUES = 4
"""Largest number of values of a question that states none."""


class Parameter(NamedTuple):
    """A searched parameter of a study, or an axis of its matrix, and values of it, the least first.

    Attributes
    ----------
    lowest
        The lower end of the domain, or the lowest point of any test.
    """

    name: str
    unit: str
    values: tuple[float, ...]
    lowest: float

    @classmethod
    def parse(cls, text: str, study: Study) -> Parameter:
        """The parameter that an option states: `speed=20,30,40`.

        Raises
        ------
        InputError
            If the study is rated, or does not vary this parameter, or a value is no number, given
            twice, or outside what it covers.
        """
        if is_rated(study):
            legal = "a study that is not rated"
            raise InputError(
                "by",
                f"{text!r}: study {study.name!r} is rated, at the points of its protocol",
                legal,
            )
        if study.matrix is not None and study.matrix.point:
            raise InputError(
                "by", f"{text!r} beside a point, which has one value", "the option without a point"
            )
        name, _, listed = (part.strip() for part in text.partition("="))
        if not (name and listed):
            raise InputError("by", repr(text), FORM)
        known = parameters_of(study)
        if not known:
            legal = (
                "a study that searches it ([scenario.search]) or has it as an axis of its matrix"
            )
            raise InputError("by", f"study {study.name!r} does not vary {name!r}", legal)
        check_name("by", f"study {study.name!r} does not vary {name!r}", name, known)
        values = tuple(sorted(_number(value, text) for value in listed.split(",")))
        if len(set(values)) < len(values):
            raise InputError("by", f"{text!r} has a value twice", "each value once")
        if name in study.scenario.search:
            domain = study.scenario.search[name]
            if values[0] <= domain.lower or values[-1] > domain.upper:
                legal = (
                    f"values above {domain.lower:g} and up to"
                    f" {domain.upper:g}{unit_text(domain.unit)}"
                )
                raise InputError(
                    "by", f"{text!r} is outside the domain of study {study.name!r}", legal
                )
            return cls(name, domain.unit, values, domain.lower)
        return cls._of_axis(name, values, study)

    @classmethod
    def _of_axis(cls, name: str, values: tuple[float, ...], study: Study) -> Parameter:
        """The parameter of a matrix, within the points of all its tests."""
        tests = [(test, points) for test, points in _points_by_test(study, name) if points]
        searchable = searchable_in(assemble(study).points[0].scenario)
        unit = searchable[name].unit if name in searchable else ""
        lowest = min(min(points) for _, points in tests)
        highest = min(max(points) for _, points in tests)
        suffix = unit_text(unit)
        if values[-1] > highest:
            ending = join_phrases(test.name for test, points in tests if max(points) == highest)
            problem = (
                f"{name}={values[-1]:g} is beyond the points of {ending}, which end at"
                f" {highest:g}{suffix}"
            )
            wider = f", or the study {study.wider}, whose scope is wider" if study.wider else ""
            raise InputError("by", problem, f"values up to {highest:g}{suffix}{wider}")
        if values[0] < lowest:
            problem = f"{name}={values[0]:g} is below every point of study {study.name!r}"
            raise InputError("by", problem, f"values from {lowest:g} to {highest:g}{suffix}")
        return cls(name, unit, values, lowest)

    def text(self, value: float) -> str:
        """A value with its unit."""
        return f"{value:g}{unit_text(self.unit)}"

    def scope(self, study: Study, value: float, *, between: bool) -> str:
        """What limits up to a value cover, in words; `between` two points of a matrix an attack
        drives.
        """
        words = scope_of(study_between(study, self, None, value), between=between)
        if self.name in study.scenario.search:
            return words
        by_test = _points_by_test(study, self.name) if between else []
        above = [
            test.name
            for test, points in by_test
            if points and min(points) < value and value not in points
        ]
        return (
            f"{words}; up to {self.text(value)} in {join_phrases(above)} only what the attack drove"
            if above
            else words
        )


def parameters_of(study: Study) -> list[str]:
    """The names of a study's searched parameters, and of the axes of its matrix that have
    numbers.
    """
    tests = [] if study.matrix is None else study.matrix.tests
    axes = [
        name for test in tests for name, values in test.over.items() if all(map(_is_number, values))
    ]
    return [*dict.fromkeys([*study.scenario.search, *axes])]


def usual_values(study: Study, name: str) -> list[float]:
    """Up to `MAX_VALUES` values of a searched parameter or an axis, the least first, for a question
    that states none: of a domain the middle below the original's value, that value and the upper
    end; of an axis its points. None if the study does not vary it.
    """
    if name not in parameters_of(study):
        return []
    if name in study.scenario.search:
        domain = study.scenario.search[name]
        values = {(domain.lower + domain.original) / 2, domain.original, domain.upper}
        return sorted(value for value in values if value > domain.lower)
    points = [points for _, points in _points_by_test(study, name) if points]
    highest = min(map(max, points))
    reached = sorted({value for values in points for value in values if value <= highest})
    return reached[:: len(reached) // -MAX_VALUES][::-1]


def study_between(
    study: Study, by: Parameter, low: float | None, high: float, *, at_end: bool = False
) -> Study:
    """The study at values of a parameter above `low`, or from its lowest on, up to `high`.

    In a searched domain the original encounter has the nearest such value. Of a matrix the points
    remain, and with `at_end` each test also drives at `high`, where that is between two of its
    points; the least values have the tests that lack the parameter, too. The matrix may have no
    test.
    """
    if by.name in study.scenario.search:
        domain = study.scenario.search[by.name]
        low = domain.lower if low is None else low
        domain = replace(
            domain, lower=low, upper=high, original=min(max(domain.original, low), high)
        )
        return replace(
            study,
            scenario=replace(study.scenario, search={**study.scenario.search, by.name: domain}),
        )
    assert study.matrix is not None
    tests = list[MatrixTest]()
    for test, points in _points_by_test(study, by.name):
        values = [value for value in points if (low is None or value > low) and value <= high]
        if at_end and points and min(points) < high < max(points):
            values = sorted({*values, high})
        if values or (low is None and not points):
            over = {**test.over, by.name: values} if by.name in test.over else test.over
            tests.append(replace(test, over=over))
    return replace(study, matrix=replace(study.matrix, tests=tests))


def cells_between(study: Study, by: Parameter, low: float | None, high: float) -> list[MatrixTest]:
    """The tests of a matrix with the ends of all cells of an axis between two values, which need
    not be points.
    """
    tests = list[MatrixTest]()
    for test, points in _points_by_test(study, by.name):
        if by.name not in test.over:
            continue
        start = min(points) if low is None else max(low, min(points))
        if start < high:
            ends = {value for value in points if start < value < high}
            tests.append(
                replace(
                    test,
                    over={**test.over, by.name: sorted({start, *ends, min(high, max(points))})},
                )
            )
    return tests


def with_feasible_encounter(study: Study, region: FeasibleRegion) -> Study:
    """A study between two values of a searched parameter, with another original encounter if
    constraints forbid its own; `region` is that of the whole study.

    Raises
    ------
    InputError
        If no encounter between the values satisfies them.
    """
    members = CharacteristicSet.of(study)
    if region.feasible(members.original[np.newaxis])[0]:
        return study
    lower, upper = (
        np.where(members.of_vehicle, members.original, end)
        for end in (members.lower, members.upper)
    )
    drawn = Box(region, lower, upper).draw(1, np.random.default_rng(study.search.seed))
    if not len(drawn):
        raise InputError(
            "by", f"no encounter satisfies the constraints of study {study.name!r}", "other values"
        )
    values = dict(zip(members.names, drawn[0].tolist(), strict=True))
    search = {
        name: replace(one, original=values[name]) for name, one in study.scenario.search.items()
    }
    return replace(study, scenario=replace(study.scenario, search=search))


def _points_by_test(study: Study, name: str) -> list[tuple[MatrixTest, list[float]]]:
    """The tests of a matrix whose scenario has a parameter, each with the values of its points."""
    tests = points_of_tests(study, assemble(study).points)
    by_test = [
        (test, sorted({_value_at(point, name) for point in points})) for test, points in tests
    ]
    return [
        (test, [value for value in values if not math.isnan(value)]) for test, values in by_test
    ]


def _value_at(point: Point, name: str) -> float:
    value: float = dict(point.parameters).get(name, getattr(point.scenario, name, math.nan))
    return value if _is_number(value) else math.nan  # as it is: a point's name has it


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _number(text: str, whole: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise InputError("by", f"{whole!r}: {text!r} is no number", FORM)
    return number


def largest_tried(by: Parameter, points: Sequence[tuple[Point, bool]]) -> float | None:
    """The largest value of an axis such that all points up to it, and those that lack it, hold;
    None without one.
    """
    values = [(_value_at(point, by.name), holds) for point, holds in points]
    reached = [value for value in by.values if all(holds for at, holds in values if not at > value)]
    return reached[-1] if reached else None
