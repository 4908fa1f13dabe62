"""A study up to a value: the range of a searched parameter, or of an axis of the matrix, is cut."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from safevar_sumo.errors import InputError, check_name
from safevar_sumo.questions.scope import are_numbers, points_of_tests
from safevar_sumo.scenarios import searchable_in
from safevar_sumo.study import MatrixTest, Study, unit_text
from safevar_sumo.sumo.system import assemble

OPTION = "up_to"
FORM = "NAME=V: a searched parameter or an axis of the matrix, and a number"
PARTS, DECIMALS = 5, 9
"""Number of parts of a searched range, and decimals of their ends, within the limits up to which
those up to larger values lie.
"""


def study_up_to(study: Study, text: str) -> Study:
    """The study with a range that is cut at the value that an option states, such as `speed=40`.

    A searched original value above it becomes the value. A test whose axis begins above it is left
    out; one whose axis reaches beyond it is driven at the value itself, too, if its scenario can
    move this axis.

    Raises
    ------
    InputError
        If the study is rated or at one point, does not vary the parameter, or the value is no
        number or beyond the values that are driven.
    """
    name, _, value = (part.strip() for part in text.partition("="))
    if study.matrix is not None and study.matrix.protocol:
        problem = f"{text!r}: study {study.name!r} is rated, at the points of its protocol"
        raise InputError(OPTION, problem, "a study that is not rated")
    if study.origin.point or (study.matrix is not None and study.matrix.point):
        problem = f"{text!r} beside a point, which has one value"
        raise InputError(OPTION, problem, "the option without a point")
    tests = [] if study.matrix is None else study.matrix.tests
    axes = [axis for test in tests for axis in test.over if _values(test, axis)]
    known = [*dict.fromkeys([*study.scenario.search, *axes])]
    problem = f"study {study.name!r} does not vary {name!r}"
    if name and not known:
        legal = "a study that searches it ([scenario.search]) or has it as an axis of its matrix"
        raise InputError(OPTION, problem, legal)
    try:
        high = float(value)
    except ValueError:
        high = math.nan
    if not (name and math.isfinite(high)):
        raise InputError(OPTION, repr(text), FORM)
    check_name(OPTION, problem, name, known)
    return (_search_up_to if name in study.scenario.search else _matrix_up_to)(study, name, high)


def smaller_cuts(study: Study, text: str | None) -> list[Study]:
    """The study cut at smaller values than the one that an option states, in ascending order: those
    of the matrix, or ends of equal parts of the searched range. None without the option.
    """
    if text is None:
        return []
    name, _, high = (part.strip() for part in text.partition("="))
    if name in study.scenario.search:
        domain = study.scenario.search[name]
        values = np.linspace(domain.lower, domain.upper, PARTS + 1)[1:].round(DECIMALS).tolist()
    else:
        assert study.matrix is not None
        values = sorted({value for test in study.matrix.tests for value in _values(test, name)})
    return [study_up_to(study, f"{name}={each}") for each in values if each < float(high)]


def names_left_out(study: Study, cut: Study) -> list[str]:
    """The names of the tests of a study that are left out where it is cut."""
    if study.matrix is None or cut.matrix is None:
        return []
    left = [test.name for test in cut.matrix.tests]
    return [test.name for test in study.matrix.tests if test.name not in left]


def _search_up_to(study: Study, name: str, high: float) -> Study:
    domain = study.scenario.search[name]
    if not domain.lower < high <= domain.upper:
        legal = f"a value above {domain.lower:g} and up to {domain.upper:g}{unit_text(domain.unit)}"
        raise InputError(
            OPTION, f"{name}={high:g} is outside the domain of study {study.name!r}", legal
        )
    domain = replace(domain, upper=high, original=min(domain.original, high))
    search = {**study.scenario.search, name: domain}
    return replace(study, scenario=replace(study.scenario, search=search))


def _matrix_up_to(study: Study, name: str, high: float) -> Study:
    assert study.matrix is not None
    by_test = points_of_tests(study, assemble(study).points)
    driven = [value for test, _ in by_test for value in _values(test, name)]
    if not min(driven) <= high <= max(driven):
        units = [searchable_in(points[0].scenario) for _, points in by_test]
        unit = next((unit_text(each[name].unit) for each in units if name in each), "")
        problem = f"{name}={high:g} is not among the values that study {study.name!r} drives"
        raise InputError(OPTION, problem, f"a value from {min(driven):g} to {max(driven):g}{unit}")
    tests = list[MatrixTest]()
    for test, points in by_test:
        values = _values(test, name)
        kept = [value for value in values if value <= high]
        if kept and max(values) > high and name in searchable_in(points[0].scenario):
            kept = sorted({*kept, high})
        if kept or not values:
            tests.append(replace(test, over={**test.over, name: kept} if values else test.over))
    return replace(study, matrix=replace(study.matrix, tests=tests))


def _values(test: MatrixTest, name: str) -> Sequence[float]:
    """The values of an axis of a test; none without such an axis, or if they are no numbers."""
    values = test.over.get(name, ())
    return values if are_numbers(values) else ()
