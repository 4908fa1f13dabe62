"""Counterexamples in sentences: unsafe vehicles with the values that are printed, simulated again
with these values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.causes import find_minimal_causes
from safevar_sumo.questions.evaluator import open_evaluator
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.words import EXACT, join_phrases
from safevar_sumo.records import (
    KMH_PER_MS,
    Evaluations,
    FloatArray,
    JsonObject,
    NamedValues,
)
from safevar_sumo.results import choose_handle, row_of_handle
from safevar_sumo.scenarios import (
    FROM_CENTRES,
    SPEED_DIMENSION,
    Point,
    Scenario,
    searchable_in,
    unit_of,
)
from safevar_sumo.study import PHASE, unit_text
from safevar_sumo.sumo.encounters import encounter
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

if TYPE_CHECKING:
    from safevar_sumo.questions.case import Case

FURTHER_DIGITS = (0, 1, 2, 4, 7)
"""Digits beyond those of a limit with which a value is tried in turn, until the printed vehicle is
unsafe.
"""
OF_ENCOUNTER = ("test", "weather")
"""Keys of a point's parameters that are no numbers of its scenario."""
STAGE = "what fails first"


class Failure(NamedTuple):
    """An unsafe vehicle, shape (n,), with the values that are printed, how it fails, in words with
    the encounter, the parameters of the point of the matrix where it does, its breach of the
    criterion alone, and the command that simulates it.
    """

    setting: FloatArray
    words: str
    point: JsonObject
    breach: str
    command: str


def describe(
    model: Model,
    settings: Mapping[str, FloatArray],
    within: Box | None = None,
    only: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, Failure]:
    """How unsafe settings of a model fail at their worst points, by the same names.

    Values are rounded as they are printed, away from the original, and simulated again; where the
    rounded vehicle is safe, with further digits. A setting that is safe with all of them is left
    out. A value that lies `within` a box stays there; of a setting that has a name in `only`, this
    characteristic alone is rounded.
    """
    failures = dict[str, Failure]()
    waiting = dict(settings)
    for further in FURTHER_DIGITS:
        if not waiting:
            break
        members = model.characteristics
        rows = np.array(
            [
                as_printed(members, setting, further, within, only.get(name, ""))
                for name, setting in waiting.items()
            ]
        )
        found = failures_at(model, rows)
        failures |= {
            name: found[row] for row, name in enumerate(waiting) if row in found
        }
        waiting = {
            name: setting for name, setting in waiting.items() if name not in failures
        }
    return failures


def values_as_printed(
    model: Model, vehicles: Sequence[NamedValues], only: Sequence[str] = ()
) -> list[NamedValues]:
    """Values of unsafe vehicles, all else as in the original, as `describe` prints them; as they
    are where it prints none, and but for one characteristic of each if `only` names them.
    """
    members = model.characteristics
    settings = {
        str(row): members.setting(one, beyond=True) for row, one in enumerate(vehicles)
    }
    printed = describe(model, settings, only=dict(zip(settings, only, strict=False)))
    settings |= {name: failure.setting for name, failure in printed.items()}
    return [members.named(one) for one in settings.values()]


def fewest_changes(case: Case, jobs: int | None = None) -> Evaluations | None:
    """The evaluation of the unsafe solution with the fewest changes, of which as many as possible
    are undone; its values are those that are printed. None if no solution is unsafe, or it is safe
    here.
    """
    if not case.unsafe.rows(case.solutions).any():
        return None
    handle = choose_handle(case.solutions, case.unsafe, "fewest")
    row = case.solutions.iloc[row_of_handle(case.solutions, handle)]
    setting = row[[*case.characteristics.names]].to_numpy(dtype=float)
    with open_evaluator(case.study, jobs=jobs) as evaluator:
        (causes,) = find_minimal_causes(evaluator, setting[np.newaxis], case.unsafe)
        if not causes:
            return None
        worst = min(causes, key=lambda cause: (len(cause.changes), cause.safety_degree))
        model = Model(0, evaluator, case.unsafe)
        (printed,) = values_as_printed(model, [worst.changes | worst.encounter])
        settings = case.characteristics.setting(printed, beyond=True)[np.newaxis]
        return evaluator.evaluate(settings, STAGE)


def limit_text(item: Characteristic, value: float) -> str:
    """A value as it is printed, without further zeros, as in tables."""
    return f"{value:{EXACT}}{item.suffix}"


def values_in_words(members: CharacteristicSet, values: NamedValues) -> str:
    """Values of some characteristics: `brake torque at 0.5 and payload at 525 kg`."""
    return join_phrases(
        f"{item.short_name} at {limit_text(item, values[item.name])}"
        for item in members
        if item.name in values
    )


def as_printed(
    members: CharacteristicSet,
    setting: FloatArray,
    further: int,
    within: Box | None = None,
    only: str = "",
) -> FloatArray:
    """A setting with its values, or `only` one, rounded to the digits of limits and some further
    ones: the vehicle's away from the original, those of the encounter to the nearest.
    """
    printed = setting.copy()
    for column, item in enumerate(members):
        value = setting[column]
        lower = item.lower
        upper = item.upper
        if within is not None and within.lower[column] <= value <= within.upper[column]:
            lower = within.lower[column]
            upper = within.upper[column]
        if value not in (item.original, lower, upper) and only in ("", item.name):
            scale = 10.0 ** (item.digits + further)
            away = (
                np.round
                if item.is_scenario
                else np.ceil
                if value > item.original
                else np.floor
            )
            # What is a rounding error of the scaled value is none of the value.
            printed[column] = min(
                max(away(np.round(value * scale, 6)) / scale, lower), upper
            )
    return printed


def failures_at(model: Model, settings: FloatArray) -> dict[int, Failure]:
    """How those of M settings fail that are unsafe, by their row."""
    points = model.evaluator.system.points
    members = model.characteristics
    runs = model.evaluate(settings, STAGE)
    is_unsafe = model.evaluator.region.feasible(settings) & (
        model.robustness_by(runs) < 0
    )
    fit = f" (parameter set {model.fit})" if model.fit else ""
    failures = dict[int, Failure]()
    for row in np.flatnonzero(is_unsafe).tolist():
        point = points[runs.points[row]]
        values = members.scenario.named(settings[row, ~members.of_vehicle])
        scenario = encounter(point, values).scenario
        how = _failure_in_words(
            scenario, model.unsafe, bool(runs.collided[row]), float(runs.f_safe[row])
        )
        breach = model.unsafe.breach_in_words(runs.take(np.array([row])))
        if model.unsafe.is_of_impacts and runs.collided[row]:
            how = f"the car {breach}"
        where = where_in_words(points, point, scenario, values)
        failures[row] = Failure(
            settings[row],
            f"{how}{where}{fit}",
            dict(point.parameters),
            breach,
            _command(model, settings[row], point, values),
        )
    return failures


def _command(
    model: Model, setting: FloatArray, point: Point, values: Mapping[str, float]
) -> str:
    """The command that simulates a setting, shape (n,), in the encounter with these values of
    searched parameters, where the place of a matrix can be set.
    """
    system = model.evaluator.system
    members = model.evaluator.characteristics
    axes = {
        name: value
        for name, value in point.parameters
        if name in searchable_in(point.scenario) and isinstance(value, int | float)
    }
    words = [system.command, members.options(setting)]
    words += [f"--set {name}={value!r}" for name, value in axes.items()]
    words += [f"--fit {model.fit}"] * (model.fit > 0)
    return " ".join(word for word in words if word)


def where_in_words(
    points: Sequence[Point], point: Point, scenario: Scenario, values: NamedValues
) -> str:
    """The encounter of a failure, such as ` in the test CPNA at 40 km/h with impact location 25 %`,
    from one of the points of a matrix, the values of searched parameters, and the scenario with
    them; empty where there is but one.
    """
    own = dict(point.parameters)
    numbers = {
        **{name: value for name, value in own.items() if name not in OF_ENCOUNTER},
        **values,
    }
    if not numbers.get(PHASE, 1):
        del numbers[PHASE]
    texts = texts_of(point, numbers)
    speed = texts.pop(SPEED_DIMENSION, "")
    if not speed and scenario.test_speed is not None:
        speed = f"{KMH_PER_MS * scenario.test_speed:.4g} km/h"
    test = own.get("test", "")
    at = f" at {speed}" if speed else ""
    rest = [f"{name.replace('_', ' ')} {text}" for name, text in texts.items()]
    if len({each.weather.name for each in points}) > 1:
        rest.append(f"weather {point.weather.name.replace('_', ' ')}")
    beside = f" with {join_phrases(rest)}" if rest else ""
    if test:
        return f" in the test {test}{at}{beside}"
    return f" in an encounter{at}{beside}" if at or beside else ""


def texts_of(point: Point, values: JsonObject) -> dict[str, str]:
    """Values of an encounter at a point, by name, as they are printed."""
    return {
        name: (
            f"{value:{EXACT}}{unit_text(unit_of(point.scenario, name))}"
            if isinstance(value, int | float)
            else str(value)
        )
        for name, value in values.items()
    }


def _failure_in_words(
    scenario: Scenario, unsafe: Unsafe, collided: bool, degree: float
) -> str:
    """A failure at a safety degree, such as `the car hits a pedestrian at 12 km/h`."""
    if unsafe.bound is not None and not collided:
        return f"the car has {unsafe.bound}"
    if collided:
        impact_speed = (
            -KMH_PER_MS * degree
        )  # nearly 0 at the limit itself: then it says nothing
        impact = (
            "" if impact_speed < 1 else f" at {float(f'{impact_speed:.2g}'):g} km/h"
        )
        return f"the car hits {scenario.obstacle()}{impact}"
    measured = FROM_CENTRES if unsafe.contact and unsafe.degree else ""
    return (
        f"the car keeps less than {unsafe.degree or unsafe.distance:.3g} m{measured} from"
        f" {scenario.obstacle()}"
    )
