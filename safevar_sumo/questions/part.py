"""Makes a part of a study: its encounters within ranges, a test or a point of its matrix, or its
encounters up to a value of an axis. `scope_of` states in words which encounters a study has.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from itertools import chain, islice
from typing import Any, NamedTuple, Self

import numpy as np
import pandas as pd
from msgspec.structs import replace

from safevar_sumo.errors import InputError, check_name, check_text
from safevar_sumo.questions.options import UP_TO
from safevar_sumo.questions.words import join_phrases
from safevar_sumo.records import KMH_PER_MS, significant
from safevar_sumo.scenarios import SPEED_DIMENSION, Point, searchable_in, unit_of
from safevar_sumo.scenarios.declared import with_ranges
from safevar_sumo.study import RANGES, Domain, MatrixTest, Study, Weather, unit_text
from safevar_sumo.study.encounters import Axes, AxisTable, are_numbers
from safevar_sumo.sumo.system import assemble

N_SIMILAR_POINTS = 4
"""Number of similar points that the error about an unknown point lists."""
FORM = "NAME=V: an axis of the study's encounters, and a number"
PARTS_OF_RANGE = 5
END_DECIMALS = 9
"""Number of equal parts of a searched range, and number of decimals of their ends. Limits are first
searched up to the end of the first part, then up to the second end, and so on. Limits up to a
larger value lie within those up to a smaller value.
"""


class UpperEnd(NamedTuple):
    """The largest value of an axis, such as the speed, that encounters may have (`--up-to`)."""

    axis: str
    value: float

    @classmethod
    def of(cls, text: str) -> Self:
        """The upper end that a text states, such as `speed=40`.

        Raises
        ------
        InputError
            If the text is no name with a finite number.
        """
        name, _, number = map(str.strip, text.partition("="))
        value = pd.to_numeric(number, errors="coerce")
        if not (name and np.isfinite(value)):
            raise InputError(UP_TO, repr(text), FORM)
        return cls(name, float(value))

    def __str__(self) -> str:
        return f"{self.axis}={self.value:g}"


def part_of_study(
    study: Study, ranges: bool, point: str | None, up_to: str | None
) -> Study:
    """The part of a study that a question is asked about.

    Parameters
    ----------
    ranges
        Whether to use all encounters within the ranges of the axes.
    point
        The name of the only test, or point of the matrix; None for all.
    up_to
        The largest value of an axis, such as "speed=40"; None without such a value.

    Raises
    ------
    InputError
        If the study has no such part.
    """
    if ranges:
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
    """The study with only one test, or with only one point of its matrix.

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

    # A point of the matrix is a listed encounter: the study must not vary it in ranges.
    listed = study.listed()
    points = assemble(study).matrix
    listed_tests = chain.from_iterable(map(listed.points_of, listed.tests))
    tests = [
        test
        for point, test in zip(points, listed_tests, strict=True)
        if point.name == name
    ]
    if tests:
        return replace(listed.with_tests(tests), origin=origin)
    legal = "a study with a matrix"
    if points:
        named: list[Any] = [*study.tests, *points]
        similar = _similar_names(name, [item.name for item in named])
        legal = f"one of {len(points)} points, such as {'; '.join(similar)}"
    raise InputError("point", repr(name), legal)


def _similar_names(name: str, names: Iterable[str]) -> list[str]:
    """The `N_SIMILAR_POINTS` names that are most similar to a name, first those that contain it."""
    distinct = dict.fromkeys(names)
    similar = [text for text in distinct if name in text][:N_SIMILAR_POINTS]
    return similar or get_close_matches(name, distinct, N_SIMILAR_POINTS, 0)


def study_up_to(study: Study, end: UpperEnd) -> Study:
    """The study without the encounters whose value of an axis is above `end`.

    If the original value of the axis is above `end`, `end` replaces it. A test whose axis begins
    above `end` is left out. A test with listed values on both sides of `end` is also driven at
    `end` itself, if its scenario can move this axis.

    Raises
    ------
    InputError
        If the study does not vary the axis, or `end` is outside of the values that are driven.
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
        raise InputError(UP_TO, problem, f"an axis whose values are listed{in_ranges}")
    check_name(UP_TO, problem, name, axes)
    domain = study.ranges.get(name)
    if domain is None:
        study = _lists_up_to(study, name, high)
    elif not domain.lower < high <= domain.upper:
        raise InputError(
            UP_TO,
            f"{end} is outside the domain of study {study.name!r}",
            f"a value above {domain.lower:g} and up to {domain.upper:g}"
            f"{unit_text(domain.unit)}",
        )
    return _ranges_up_to(study, name, high)


def smaller_cuts(study: Study, end: UpperEnd | None) -> list[Study]:
    """The study cut at each value of the axis that is smaller than `end`, in ascending order. The
    values are those of the matrix or, if the study searches a range, the ends of `PARTS_OF_RANGE`
    equal parts. There are no such studies if `end` is None.
    """
    if end is None:
        return []
    name, highest = end
    values = set[float]()
    for test in study.tests:
        values |= {*_values(study, test, name)}
    if name in study.ranges:
        domain = study.ranges[name]
        ends = np.linspace(domain.lower, domain.upper, PARTS_OF_RANGE + 1)[1:]
        values = {*ends.round(END_DECIMALS).tolist()}
    smaller_values = sorted(value for value in values if value < highest)
    return [study_up_to(study, UpperEnd(name, value)) for value in smaller_values]


def names_left_out(study: Study, cut: Study) -> list[str]:
    """The names of the tests of a study that its part `cut` lacks."""
    names = [test.name for test in cut.tests]
    return [test.name for test in study.tests if test.name not in names]


def _ranges_up_to(study: Study, name: str, high: float) -> Study:
    """The study whose ranges of an axis end at the value `high`. Tests whose range begins at `high`
    or above are left out.
    """

    def cut(axes: dict[str, AxisTable]) -> Axes:
        """Axes in which the range of `name` ends at `high`."""
        axis = axes.get(name)
        if axis is None or axis.range is None or axis.range.upper <= high:
            return {**axes}
        # The range begins above `high`: only the axis' listed values remain.
        if axis.range.lower >= high:
            return {**axes, name: axis.at}
        return {
            **axes,
            name: replace(axis, upper=high, original=min(axis.range.original, high)),
        }

    def begins_below(test: MatrixTest) -> bool:
        """Whether a test has no range of this axis, or its range begins below `high`."""
        domain = study.ranges_of(test).get(name)
        return domain is None or domain.lower < high

    if study.tests:
        study = study.with_tests(list(filter(begins_below, study.tests)))
    return study.mapped(cut)


def _lists_up_to(study: Study, name: str, high: float) -> Study:
    """The study whose lists of an axis end at the value `high`. Tests whose list begins above
    `high` are left out.
    """
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
            axis = replace(study.axes_of(test)[name], at=values_up_to)
            tests.append(replace(test, over={**test.over, name: axis}))
    low = min(all_values)
    highest = max(all_values)
    if not low <= high <= highest:
        raise InputError(
            UP_TO,
            f"{name}={high:g} is not among the values that study {study.name!r} drives",
            f"a value from {low:g} to {highest:g}{unit}",
        )
    return study.with_tests(tests)


def _values(study: Study, test: MatrixTest, name: str) -> Sequence[float]:
    """The listed values of an axis of a test; () if the test does not list this axis, or if the
    values are no numbers.
    """
    values = study.lists_of(test).get(name, ())
    if are_numbers(values):
        return values
    return ()


def points_of_tests(
    study: Study, points: Sequence[Point]
) -> Sequence[tuple[MatrixTest | None, Sequence[Point]]]:
    """Each test of a study with its points of the matrix. A study without tests gives None with all
    points.
    """
    if not study.tests:
        return [(None, points)]
    remaining_points = iter(points)
    return [
        (test, list(islice(remaining_points, len(study.points_of(test)))))
        for test in study.tests
    ]


def moving_axes(
    study: Study, test: MatrixTest | None, points: Sequence[Point]
) -> dict[str, Domain]:
    """The ranges of the listed axes of a test between whose values its scenario can drive.

    A range goes from the least to the greatest listed value. An axis with a single listed value has
    the scenario's legal range. There are no ranges if the study itself varies encounters in ranges.
    """
    searchable = {} if study.ranges else searchable_in(points[0].scenario)
    axes = {}
    for name, values in study.lists_of(test).items():
        legal = searchable.get(name)
        if legal is None or not are_numbers(values):
            continue
        ends = values if len(values) > 1 else (legal.lower, legal.upper)
        axes[name] = Domain(
            unit=legal.unit,
            original=float(values[0]),
            lower=float(min(ends)),
            upper=float(max(ends)),
        )
    return axes


def scope_of(study: Study, *, between: bool = True) -> str:
    """The encounters of a study, as a phrase for a manual: `the test CPFA (scenario crossing) at 10
    to 40 km/h; weather wet (71 % of the grip of a dry road, 1 mm of water), by day`.

    `between` says whether encounters between the values of a matrix were simulated, too. If not,
    the phrase lists the values.
    """
    points = assemble(study).points
    # Tests with the same scenario and parameters share a phrase.
    names = defaultdict[tuple[str, str], list[str]](list)
    for test, of_test in points_of_tests(study, points):
        model = (test and test.model) or study.scenario.model
        parameters = _parameters_in_words(study, test, of_test, between)
        names[model, parameters] += [test.name] if test else []
    phrases = [_tests_in_words(of_key, *key) for key, of_key in names.items()]
    if points[0].scenario.mover.has("weather"):
        weathers = dict.fromkeys(_weather_in_words(point.weather) for point in points)
        phrases.append(" or ".join(weathers))
    return "; ".join(phrases)


def _tests_in_words(names: Sequence[str], model: str, parameters: str) -> str:
    """The phrase for tests with the same scenario and parameters. Without tests it names only the
    scenario.
    """
    scenario = f"scenario {model.rpartition(':')[2].replace('_', ' ')}"
    tests = f"the {scenario}"
    if names:
        noun = "tests" if len(names) > 1 else "test"
        tests = f"the {noun} {join_phrases(names)} ({scenario})"
    return f"{tests} {parameters}".strip()


def _parameters_in_words(
    study: Study, test: MatrixTest | None, points: Sequence[Point], between: bool
) -> str:
    """The varied parameters of a test in words, the speed first: listed values and ranges. Ranges
    stand for listed values if `between` is true, and the scenario can move the axis.
    """
    moving = moving_axes(study, test, points) if between else {}
    texts = {}
    for name, values in study.lists_of(test).items():
        unit = unit_text(unit_of(points[0].scenario, name))
        texts[name] = f"{_values_in_words(values, name in moving)}{unit}"
    for name, domain in study.ranges_of(test).items():
        ends = f"{domain.lower:g} to {domain.upper:g}"
        texts[name] = f"{ends}{unit_text(domain.unit)}"
    speed = texts.pop(SPEED_DIMENSION, "") or _test_speeds_in_words(points)
    phrases = [f"{name.replace('_', ' ')} {text}" for name, text in texts.items()]
    if speed:
        phrases.insert(0, f"at {speed}")
    return ", ".join(phrases)


def _test_speeds_in_words(points: Sequence[Point]) -> str:
    """The speeds at which scenarios are driven that have no axis of speeds; "" without any."""
    stated = {point.scenario.test_speed for point in points}
    speeds = sorted(value for value in stated if value is not None)
    texts = dict.fromkeys(f"{significant(KMH_PER_MS * value, 4)}" for value in speeds)
    return f"{join_phrases(texts)} km/h" if texts else ""


def _values_in_words(values: Sequence[float | str], is_range: bool) -> str:
    """Listed values in words: as a range from the least to the greatest value if `is_range`, else
    as a list.
    """
    if is_range and len(values) > 1:
        return f"{min(values):g} to {max(values):g}"
    return join_phrases(map(_value_in_words, values))


def _value_in_words(value: float | str) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _weather_in_words(weather: Weather) -> str:
    """The weather with its effects, and the light: `weather clear (dry grip), by day`."""
    effects = ["dry grip"]
    if weather.road_friction != 1 or weather.water:
        effects = [f"{100 * weather.road_friction:g} % of the grip of a dry road"]
    if weather.water:
        effects.append(f"{weather.water:g} mm of water")
    if weather.visibility != 1:
        effects.append(
            f"sensors detect at {100 * weather.visibility:g} % of their range"
        )
    if weather.recognition_delay:
        effects.append(
            f"sensors recognise a person {weather.recognition_delay:g} s later"
        )
    name = weather.name.replace("_", " ")
    return f"weather {name} ({', '.join(effects)}), by {weather.light}"
