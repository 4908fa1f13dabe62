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
    rest = iter(points)
    return [(test, [*islice(rest, len(study.points_of(test)))]) for test in study.tests]


def moving_axes(
    study: Study, test: MatrixTest | None, points: Sequence[Point]
) -> dict[str, Domain]:
    """The listed axes of a test that its scenario can move, each from its least to its greatest
    value, or with a single value as far as is legal; none where encounters are ranges.
    """
    searchable = {} if study.ranges else searchable_in(points[0].scenario)
    return {
        name: Domain(
            unit=searchable[name].unit,
            original=float(values[0]),
            lower=float(min(values) if len(values) > 1 else searchable[name].lower),
            upper=float(max(values) if len(values) > 1 else searchable[name].upper),
        )
        for name, values in study.lists_of(test).items()
        if name in searchable and are_numbers(values)
    }


def scope_of(study: Study, *, between: bool = True) -> str:
    """What a claim about a study covers, as a phrase for a manual: `crossing (CPFA) at 10 to 40
    km/h; weather wet (friction 0.71, water 1 mm), by day`.

    Without `between`, nothing was simulated between the values of a matrix, which are then listed.
    """
    # What drives in each test.
    points = assemble(study).points
    drives = [
        (
            _model_in_words((test and test.model) or study.scenario.model),
            test.name if test else "",
            _parameters_in_words(study, test, own, between),
        )
        for test, own in points_of_tests(study, points)
    ]

    # Tests with the same scenario and parameters share a phrase.
    phrases = []
    for model, parameters in dict.fromkeys(
        (model, parameters) for model, _, parameters in drives
    ):
        names = [
            name
            for other, name, same in drives
            if (other, same) == (model, parameters) and name
        ]
        tests = f" ({join_phrases(names)})" if names else ""
        phrases.append(f"{model}{tests}{f' {parameters}' if parameters else ''}")
    if not points[0].scenario.mover.has("weather"):
        return "; ".join(phrases)
    weathers = dict.fromkeys(_weather_in_words(point.weather) for point in points)
    return f"{'; '.join(phrases)}; {' or '.join(weathers)}"


def _model_in_words(model: str) -> str:
    return model.rpartition(":")[2].replace("_", " ")


def _parameters_in_words(
    study: Study, test: MatrixTest | None, points: Sequence[Point], between: bool
) -> str:
    """The speeds and other parameters of a test that vary: over its axes, and in a search over the
    scenario.
    """
    # Axes that are listed, and those of which any value may occur.
    over = study.lists_of(test)
    moving = moving_axes(study, test, points) if between else {}
    phrases = {}
    for name, values in over.items():
        unit = unit_text(unit_of(points[0].scenario, name))
        phrases[name] = f"{_values_in_words(values, name in moving)}{unit}"
    for name, domain in study.ranges_of(test).items():
        phrases[name] = f"{domain.lower:g} to {domain.upper:g}{unit_text(domain.unit)}"

    # Speeds of tests that state none, first.
    speeds = sorted(
        {
            point.scenario.test_speed
            for point in points
            if point.scenario.test_speed is not None
        }
    )
    if SPEED_DIMENSION not in phrases and speeds:
        driven = dict.fromkeys(f"{KMH_PER_MS * speed:.4g}" for speed in speeds)
        phrases = {SPEED_DIMENSION: f"{join_phrases(driven)} km/h", **phrases}
    return ", ".join(
        f"at {text}" if name == SPEED_DIMENSION else f"{name.replace('_', ' ')} {text}"
        for name, text in phrases.items()
    )


def _values_in_words(values: Sequence[float | str], is_range: bool) -> str:
    if is_range and len(values) > 1:
        return f"{min(values):g} to {max(values):g}"
    return join_phrases(
        f"{value:g}" if isinstance(value, float) else str(value) for value in values
    )


def _weather_in_words(weather: Weather) -> str:
    """The weather with its effects, and the light: `weather wet (friction 0.71, water 1 mm), by
    day`, `weather clear (grip of a dry road), by day`.
    """
    is_dry = weather.road_friction == 1 and not weather.water
    effects = [
        "grip of a dry road" if is_dry else f"friction {weather.road_friction:g}"
    ]
    effects += [f"water {weather.water:g} mm"] if weather.water else []
    effects += [f"visibility {weather.visibility:g}"] if weather.visibility != 1 else []
    effects += (
        [f"recognition {weather.recognition_delay:g} s later"]
        if weather.recognition_delay
        else []
    )
    name = weather.name.replace("_", " ")
    return f"weather {name} ({', '.join(effects)}), by {weather.light}"
