"""A part of a study: in the ranges of its axes, at a test or a point, up to a value of an axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from difflib import get_close_matches

import numpy as np
from msgspec.structs import replace

from safevar_sumo.errors import InputError, check_name, check_text
from safevar_sumo.questions.scope import points_of_tests
from safevar_sumo.scenarios import searchable_in
from safevar_sumo.scenarios.declared import with_ranges
from safevar_sumo.study import RANGES, MatrixTest, Study, unit_text
from safevar_sumo.study.encounters import Axes, AxisTable, are_numbers
from safevar_sumo.sumo.system import assemble

N_SIMILAR_POINTS = 4
"""Number of similar points that the error about an unknown point lists."""
OPTION = "up_to"
FORM = "NAME=V: an axis of the study's encounters, and a number"
PARTS, DECIMALS = 5, 9
"""Number of parts of a searched range, and decimals of their ends, within the limits up to which
those up to larger values lie.
"""


def part_of_study(
    study: Study, ranges: bool, point: str | None, up_to: str | None
) -> Study:
    """A study in the ranges of its axes, at a test or point, and up to a value of an axis, as far
    as these are given.

    Raises
    ------
    InputError
        If the study has no such part.
    """
    if ranges and study.encounters != RANGES:
        whole = with_ranges(study)
        if whole.encounters != RANGES:
            raise InputError(
                "ranges",
                f"no axis of study {study.name!r} has a range",
                "a study with such an axis",
            )
        study = whole
    if point is not None:
        study = at_point(study, point)
    if up_to is None:
        return study
    cut = study_up_to(study, up_to)
    return replace(cut, origin=replace(cut.origin, up_to=up_to))


def at_point(study: Study, name: str) -> Study:
    """The study in a test, or at one point of its matrix, alone.

    Raises
    ------
    InputError
        If no test and no point has this name.
    """
    check_text("point", name)
    reduced = study
    alone = [test for test in study.tests if test.name == name]
    points = () if alone else assemble(study).matrix
    if not alone:  # a listed encounter has no ranges
        reduced = study.listed()
        at_points = [each for test in reduced.tests for each in reduced.points_of(test)]
        pairs = zip(points, at_points, strict=True)
        alone = [test for point, test in pairs if point.name == name]
    if not alone:
        names = [
            *{test.name: 0 for test in study.tests}
            | {point.name: 0 for point in points}
        ]
        similar = [one for one in names if name in one] or get_close_matches(
            name, names, N_SIMILAR_POINTS, 0
        )
        legal = f"one of {len(points)} points, such as {'; '.join(similar[:N_SIMILAR_POINTS])}"
        raise InputError(
            "point", repr(name), legal if points else "a study with a matrix"
        )

    return replace(reduced.with_tests(alone), origin=replace(study.origin, point=name))


def study_up_to(study: Study, text: str) -> Study:
    """The study with an axis that is cut at the value that an option states, such as `speed=40`.

    An original value above it becomes the value. A test whose axis begins above it is left out; one
    whose list reaches beyond it is driven at the value itself, too, if its scenario can move this
    axis.

    Raises
    ------
    InputError
        If the study does not vary the parameter, or the value is no number or beyond the values
        that are driven.
    """
    name, _, value = (part.strip() for part in text.partition("="))
    axes = [
        axis
        for test in study.tests
        for axis in study.axes_of(test)
        if _values(study, test, axis)
    ]
    known = [*dict.fromkeys([*study.ranges, *axes])]
    problem = f"study {study.name!r} does not vary {name!r}"
    if name and not known:
        in_ranges = ", with --ranges" if name in study.axes else ""
        raise InputError(OPTION, problem, f"an axis whose values are listed{in_ranges}")
    try:
        high = float(value)
    except ValueError:
        high = math.nan
    if not (name and math.isfinite(high)):
        raise InputError(OPTION, repr(text), FORM)
    check_name(OPTION, problem, name, known)
    if name in study.ranges:
        domain = study.ranges[name]
        low, highest, unit = domain.lower, domain.upper, unit_text(domain.unit)
        if not low < high <= highest:
            raise InputError(
                OPTION,
                f"{name}={high:g} is outside the domain of study {study.name!r}",
                f"a value above {low:g} and up to {highest:g}{unit}",
            )
    cut = study if name in study.ranges else _lists_up_to(study, name, high)
    return _ranges_up_to(cut, name, high)


def smaller_cuts(study: Study, text: str | None) -> list[Study]:
    """The study cut at smaller values than the one that an option states, in ascending order: those
    of the matrix, or ends of equal parts of the searched range. None without the option.
    """
    if text is None:
        return []
    name, _, high = (part.strip() for part in text.partition("="))
    if name in study.ranges:
        domain = study.ranges[name]
        values = (
            np.linspace(domain.lower, domain.upper, PARTS + 1)[1:]
            .round(DECIMALS)
            .tolist()
        )
    else:
        values = sorted(
            {value for test in study.tests for value in _values(study, test, name)}
        )
    return [
        study_up_to(study, f"{name}={each}") for each in values if each < float(high)
    ]


def names_left_out(study: Study, cut: Study) -> list[str]:
    """The names of the tests of a study that are left out where it is cut."""
    left = [test.name for test in cut.tests]
    return [test.name for test in study.tests if test.name not in left]


def _ranges_up_to(study: Study, name: str, high: float) -> Study:
    """The study whose ranges of a parameter end at a value; without tests that begin above it."""

    def cut(axes: dict[str, AxisTable]) -> Axes:
        axis = axes.get(name)
        domain = None if axis is None else axis.range
        if axis is None or domain is None or domain.upper <= high:
            return {**axes}
        if domain.lower >= high:  # a list may end where the range begins
            return {**axes, name: axis.at}
        original = min(domain.original, high)
        return {**axes, name: replace(axis, upper=high, original=original)}

    def begins_below(test: MatrixTest) -> bool:
        domain = study.ranges_of(test).get(name)
        return domain is None or domain.lower < high

    if study.tests:
        study = study.with_tests([test for test in study.tests if begins_below(test)])
    return study.mapped(cut)


def _lists_up_to(study: Study, name: str, high: float) -> Study:
    """The study whose lists of an axis end at a value; without tests that begin above it."""
    all_points = assemble(study).points
    by_test = [(test, own) for test, own in points_of_tests(study, all_points) if test]
    driven = [value for test, _ in by_test for value in _values(study, test, name)]
    if not min(driven) <= high <= max(driven):
        units = [searchable_in(points[0].scenario) for _, points in by_test]
        unit = next((unit_text(each[name].unit) for each in units if name in each), "")
        raise InputError(
            OPTION,
            f"{name}={high:g} is not among the values that study {study.name!r} drives",
            f"a value from {min(driven):g} to {max(driven):g}{unit}",
        )
    tests = list[MatrixTest]()
    for test, points in by_test:
        values = _values(study, test, name)
        kept = [value for value in values if value <= high]
        if kept and max(values) > high and name in searchable_in(points[0].scenario):
            kept = sorted({*kept, high})
        if kept or not values:
            tests.append(_with_list(study, test, name, kept) if values else test)
    return study.with_tests(tests)


def _with_list(
    study: Study, test: MatrixTest, name: str, values: list[float]
) -> MatrixTest:
    """A test with other values of an axis."""
    axis = replace(study.axes_of(test)[name], at=values)
    is_plain = axis.range is None
    return replace(test, over={**test.over, name: values if is_plain else axis})


def _values(study: Study, test: MatrixTest, name: str) -> Sequence[float]:
    """The listed values of an axis of a test; none without such an axis, or if they are no
    numbers.
    """
    values = study.lists_of(test).get(name, ())
    return values if are_numbers(values) else ()
