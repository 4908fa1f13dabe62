"""The scope of a claim in words: the tests with their speeds and impact locations, the road, and
the light.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

from safevar_sumo.questions.words import join_phrases
from safevar_sumo.records import KMH_PER_MS
from safevar_sumo.scenarios import SPEED_DIMENSION, Point, searchable_in, unit_of
from safevar_sumo.study import Domain, MatrixTest, Study, Weather, unit_text
from safevar_sumo.study.encounters import are_numbers
from safevar_sumo.sumo.system import assemble


def points_of_tests(
    study: Study, points: Sequence[Point]
) -> Sequence[tuple[MatrixTest | None, Sequence[Point]]]:
    """The tests of a study, each with its points; all points of one without tests of its own."""
    if not study.tests:
        return [(None, points)]
    remaining_points = iter(points)
    return [
        (test, [*islice(remaining_points, len(study.points_of(test)))])
        for test in study.tests
    ]


def moving_axes(
    study: Study, test: MatrixTest | None, points: Sequence[Point]
) -> dict[str, Domain]:
    """The listed axes of a test that its scenario can move, each from its least to its greatest
    value, or with a single value as far as is legal; none where encounters are ranges.
    """
    searchable = {} if study.ranges else searchable_in(points[0].scenario)
    axes = dict[str, Domain]()
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
    """What a claim about a study covers, as a phrase for a manual: `the test CPFA (scenario
    crossing) at 10 to 40 km/h; weather wet (71 % of the grip of a dry road, 1 mm of water), by
    day`.

    Without `between`, nothing was simulated between the values of a matrix, which are then listed.
    """
    # Tests with the same scenario and parameters share a phrase.
    points = assemble(study).points
    groups = dict[tuple[str, str], list[str]]()
    for test, of_test in points_of_tests(study, points):
        model = (test and test.model) or study.scenario.model
        key = model, _parameters_in_words(study, test, of_test, between)
        groups.setdefault(key, []).extend([test.name] if test else [])
    phrases = [_tests_in_words(names, *key) for key, names in groups.items()]
    if points[0].scenario.mover.has("weather"):
        weathers = dict.fromkeys(_weather_in_words(point.weather) for point in points)
        phrases.append(" or ".join(weathers))
    return "; ".join(phrases)


def _tests_in_words(names: Sequence[str], model: str, parameters: str) -> str:
    """Tests with the same scenario and parameters; the scenario alone without tests."""
    scenario = f"scenario {model.rpartition(':')[2].replace('_', ' ')}"
    tests = f"the {scenario}"
    if names:
        noun = "tests" if len(names) > 1 else "test"
        tests = f"the {noun} {join_phrases(names)} ({scenario})"
    return f"{tests} {parameters}".strip()


def _parameters_in_words(
    study: Study, test: MatrixTest | None, points: Sequence[Point], between: bool
) -> str:
    """The speeds and other parameters of a test that vary: over its axes, and in a search over the
    scenario.
    """
    # Axes that are listed, and those of which any value may occur.
    moving = moving_axes(study, test, points) if between else {}
    texts = {}
    for name, values in study.lists_of(test).items():
        unit = unit_text(unit_of(points[0].scenario, name))
        texts[name] = f"{_values_in_words(values, name in moving)}{unit}"
    for name, domain in study.ranges_of(test).items():
        texts[name] = f"{domain.lower:g} to {domain.upper:g}{unit_text(domain.unit)}"

    # Speeds first, also of tests that state none.
    speed = texts.pop(SPEED_DIMENSION, "")
    stated = (point.scenario.test_speed for point in points)
    speeds = sorted({value for value in stated if value is not None})
    if speeds and not speed:
        driven = dict.fromkeys(f"{KMH_PER_MS * value:.4g}" for value in speeds)
        speed = f"{join_phrases(driven)} km/h"
    phrases = [f"{name.replace('_', ' ')} {text}" for name, text in texts.items()]
    if speed:
        phrases.insert(0, f"at {speed}")
    return ", ".join(phrases)


def _values_in_words(values: Sequence[float | str], is_range: bool) -> str:
    if is_range and len(values) > 1:
        return f"{min(values):g} to {max(values):g}"
    return join_phrases(
        f"{value:g}" if isinstance(value, float) else str(value) for value in values
    )


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
