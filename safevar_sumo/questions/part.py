"""A part of a study: in the ranges of its axes, at a test or a point, up to a value of an axis."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from itertools import chain
from typing import Any, NamedTuple, Self

import numpy as np
import pandas as pd
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


class UpperEnd(NamedTuple):
    """The largest value of an axis that encounters have; `--up-to` states it."""

    axis: str
    value: float

    @classmethod
    def of(cls, text: str) -> Self:
        """The end that an option states, such as `speed=40`.

        Raises
        ------
        InputError
            If the text is no name with a finite number.
        """
        name, _, number = map(str.strip, text.partition("="))
        value = pd.to_numeric(number, errors="coerce")
        if not (name and np.isfinite(value)):
            raise InputError(OPTION, repr(text), FORM)
        return cls(name, float(value))

    def __str__(self) -> str:
        return f"{self.axis}={self.value:g}"


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
        study = with_ranges(study)
        if study.encounters != RANGES:
            raise InputError(
                "ranges",
                f"no axis of study {study.name!r} has a range",
                "a study with such an axis",
            )
    if point is not None:
        study = at_point(study, point)
    if up_to is None:
        return study
    cut = study_up_to(study, UpperEnd.of(up_to))
    return replace(cut, origin=replace(cut.origin, up_to=up_to))


def at_point(study: Study, name: str) -> Study:
    """The study in a test, or at one point of its matrix, alone.

    Raises
    ------
    InputError
        If no test and no point has this name.
    """
    check_text("point", name)
    origin = replace(study.origin, point=name)
    tests = [test for test in study.tests if test.name == name]
    if tests:
        return replace(study.with_tests(tests), origin=origin)

    # A listed encounter has no ranges.
    listed = study.listed()
    points = assemble(study).matrix
    tests_at_points = chain.from_iterable(map(listed.points_of, listed.tests))
    for point, test in zip(points, tests_at_points, strict=True):
        if point.name == name:
            tests.append(test)
    if tests:
        return replace(listed.with_tests(tests), origin=origin)
    named: list[Any] = [*study.tests, *points]
    names = list(dict.fromkeys(item.name for item in named))
    similar = [text for text in names if name in text] or get_close_matches(
        name, names, N_SIMILAR_POINTS, 0
    )
    legal = (
        f"one of {len(points)} points, such as {'; '.join(similar[:N_SIMILAR_POINTS])}"
    )
    raise InputError("point", repr(name), legal if points else "a study with a matrix")


def study_up_to(study: Study, end: UpperEnd) -> Study:
    """The study whose axis ends at a value.

    An original value above it becomes the value. A test whose axis begins above it is left out; one
    whose list reaches beyond it is driven at the value itself, too, if its scenario can move this
    axis.

    Raises
    ------
    InputError
        If the study does not vary the parameter, or the value is beyond the values that are driven.
    """
    name, high = end
    axes = dict.fromkeys(study.ranges)
    for test in study.tests:
        for axis in study.axes_of(test):
            if _values(study, test, axis):
                axes[axis] = None
    problem = f"study {study.name!r} does not vary {name!r}"
    if not axes:
        in_ranges = ", with --ranges" if name in study.axes else ""
        raise InputError(OPTION, problem, f"an axis whose values are listed{in_ranges}")
    check_name(OPTION, problem, name, axes)
    if name not in study.ranges:
        return _ranges_up_to(_lists_up_to(study, name, high), name, high)
    domain = study.ranges[name]
    if not domain.lower < high <= domain.upper:
        raise InputError(
            OPTION,
            f"{end} is outside the domain of study {study.name!r}",
            f"a value above {domain.lower:g} and up to {domain.upper:g}"
            f"{unit_text(domain.unit)}",
        )
    return _ranges_up_to(study, name, high)


def smaller_cuts(study: Study, end: UpperEnd | None) -> list[Study]:
    """The study whose axis ends at smaller values, in ascending order: those of the matrix, or ends
    of equal parts of the searched range. None without an end.
    """
    if end is None:
        return []
    name, highest = end
    values = set[float]()
    for test in study.tests:
        values |= {*_values(study, test, name)}
    if name in study.ranges:
        domain = study.ranges[name]
        ends = np.linspace(domain.lower, domain.upper, PARTS + 1)[1:]
        values = {*ends.round(DECIMALS).tolist()}
    smaller_values = sorted(value for value in values if value < highest)
    return [study_up_to(study, UpperEnd(name, value)) for value in smaller_values]


def names_left_out(study: Study, cut: Study) -> list[str]:
    """The names of the tests of a study that are left out where it is cut."""
    names = [test.name for test in cut.tests]
    return [test.name for test in study.tests if test.name not in names]


def _ranges_up_to(study: Study, name: str, high: float) -> Study:
    """The study whose ranges of a parameter end at a value; without tests that begin above it."""

    def cut(axes: dict[str, AxisTable]) -> Axes:
        axis = axes.get(name)
        if axis is None or axis.range is None or axis.range.upper <= high:
            return {**axes}
        if axis.range.lower >= high:  # a list may end where the range begins
            return {**axes, name: axis.at}
        original = min(axis.range.original, high)
        return {**axes, name: replace(axis, upper=high, original=original)}

    def begins_below(test: MatrixTest) -> bool:
        domain = study.ranges_of(test).get(name)
        return domain is None or domain.lower < high

    if study.tests:
        study = study.with_tests([*filter(begins_below, study.tests)])
    return study.mapped(cut)


def _lists_up_to(study: Study, name: str, high: float) -> Study:
    """The study whose lists of an axis end at a value; without tests that begin above it."""
    tests = []
    all_values = list[float]()
    unit = ""
    for test, points in points_of_tests(study, assemble(study).points):
        if test is None:
            continue
        values = _values(study, test, name)
        if not values:
            tests.append(test)
            continue
        all_values += values
        values_up_to = [value for value in values if value <= high]
        axes = searchable_in(points[0].scenario)
        if name in axes:
            unit = unit or unit_text(axes[name].unit)
            if values_up_to and max(values) > high:
                values_up_to = sorted({*values_up_to, high})
        if values_up_to:
            tests.append(_with_list(study, test, name, values_up_to))
    low, highest = min(all_values), max(all_values)
    if not low <= high <= highest:
        raise InputError(
            OPTION,
            f"{name}={high:g} is not among the values that study {study.name!r} drives",
            f"a value from {low:g} to {highest:g}{unit}",
        )
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
    if are_numbers(values):
        return values
    return ()
