"""Describes unsafe vehicles (counterexamples) in words. The values of an unsafe vehicle are rounded
for readers, and the vehicle is simulated again, so that the printed vehicle is really unsafe.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.metrics.words import runs_in_words
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.case import Results
from safevar_sumo.questions.causes import find_minimal_causes
from safevar_sumo.questions.evaluator import open_evaluator
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.words import EXACT, OUTCOME_VERBS, join_phrases
from safevar_sumo.records import (
    KMH_PER_MS,
    Evaluations,
    FloatArray,
    JsonObject,
    NamedValues,
    Outcome,
    significant,
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

FURTHER_DIGITS = (0, 1, 2, 4, 7)
"""Numbers of digits beyond the digits of a limit. They are tried one after another, until the
vehicle with the rounded values is unsafe.
"""
OF_ENCOUNTER = ("test", "weather")
"""Keys of a point's parameters that are no parameters of the scenario."""
LEAST_IMPACT = 1.0
"""Slowest impact that is printed [km/h]. An impact just beyond a limit is slower, and says nothing.
"""
BEYOND_STAGE = "find what fails first"


class Failure(NamedTuple):
    """An unsafe vehicle, in words for readers.

    Attributes
    ----------
    failing_values
        The vehicle's values, and those of its encounter, as they are printed, by name.
    words
        How and where the vehicle fails, such as `the vehicle hits a pedestrian (impact at 12 km/h;
        test CPNA)`. If runs differ, the words also say how many fresh runs fail.
    point
        The parameters of the point of the matrix at which the vehicle fails.
    breach
        How the vehicle breaks the criterion, such as `collides at 3.21 m/s`.
    command
        The command that simulates the vehicle.
    """

    failing_values: NamedValues
    words: str
    point: JsonObject
    breach: str
    command: str


def describe(
    model: Model,
    settings: Sequence[FloatArray],
    box: Box | None = None,
    single_names: Mapping[int, str] = MappingProxyType({}),
    further: Sequence[int] = FURTHER_DIGITS,
) -> dict[int, Failure]:
    """Describe how unsafe settings of a model fail at their worst points, by the settings' rows.

    The values of the vehicle are rounded away from the original values, and simulated again. If the
    rounded vehicle is safe, it is rounded to further digits. A setting that is safe with all
    numbers of digits is left out.

    Parameters
    ----------
    box
        A value within this box stays in it when it is rounded; None for no box.
    single_names
        By a setting's row, the only characteristic that is rounded.
    further
        Numbers of digits beyond the digits of a limit, in the order in which they are tried.
    """
    failures = {}
    waiting = dict(enumerate(settings))
    for number in further:
        if not waiting:
            break
        members = model.characteristics
        candidates = np.array(
            [
                as_printed(members, setting, number, box, single_names.get(row, ""))
                for row, setting in waiting.items()
            ]
        )
        rows = list(waiting)
        for place, failure in failures_at(model, candidates).items():
            failures[rows[place]] = failure
            del waiting[rows[place]]
    return failures


def values_as_printed(
    model: Model,
    vehicles: Sequence[NamedValues],
    single_names: Sequence[str] = (),
    further: Sequence[int] = FURTHER_DIGITS,
) -> list[NamedValues]:
    """The values of unsafe vehicles as `describe` rounds them. All characteristics without a value
    are as in the original vehicle. A vehicle that no rounding leaves unsafe keeps its values.

    `single_names` are the only characteristics that are rounded, one for each vehicle; () if all
    are rounded. `further` are the numbers of further digits that `describe` tries. If runs differ,
    the first of them is used, and the caller simulates the rounded vehicles in fresh runs.
    """
    members = model.characteristics
    settings = [members.setting(vehicle, beyond=True) for vehicle in vehicles]
    names = dict(enumerate(single_names))
    if model.evaluator.has_repeats:
        return [
            members.named(
                as_printed(members, setting, further[0], None, names.get(row, ""))
            )
            for row, setting in enumerate(settings)
        ]
    printed = describe(model, settings, single_names=names, further=further)
    return [
        printed[row].failing_values if row in printed else members.named(setting)
        for row, setting in enumerate(settings)
    ]


def solution_with_fewest_changes(case: Results) -> FloatArray | None:
    """The unsafe solution with the fewest changes, shape (n,), as a search returned it. None if no
    solution is unsafe.
    """
    if not case.unsafe.rows(case.solutions).any():
        return None
    handle = choose_handle(case.solutions, case.unsafe, "fewest")
    row = case.solutions.iloc[row_of_handle(case.solutions, handle)]
    setting: FloatArray = row[list(case.characteristics.names)].to_numpy(dtype=float)
    return setting


def fewest_changes(case: Results, jobs: int | None = None) -> Evaluations | None:
    """The evaluation of the smallest minimal cause of the unsafe solution with the fewest changes.
    Its values are rounded as they are printed. None if no solution is unsafe, or if the solution is
    safe in this simulation, or (if runs differ) in all fresh runs.
    """
    setting = solution_with_fewest_changes(case)
    if setting is None:
        return None
    with open_evaluator(case.study, jobs=jobs) as evaluator:
        (causes,) = find_minimal_causes(evaluator, setting[np.newaxis], case.unsafe)
        if not causes:
            return None
        worst = min(causes, key=lambda cause: (len(cause.changes), cause.safety_degree))
        model = Model(0, evaluator, case.unsafe)
        (printed,) = values_as_printed(model, [worst.changes | worst.encounter])
        settings = case.characteristics.setting(printed, beyond=True)[np.newaxis]
        if not evaluator.has_repeats:
            return evaluator.evaluate(settings, BEYOND_STAGE)
        fresh_runs = evaluator.evaluate_anew(settings)
        return fresh_runs if case.unsafe.of(fresh_runs)[0] else None


def limit_text(item: Characteristic, value: float) -> str:
    """A value with its unit as it is printed, without trailing zeros."""
    return f"{value:{EXACT}}{item.suffix}"


def values_in_words(members: CharacteristicSet, values: NamedValues) -> str:
    """Values by name in words: `brake torque at 0.5 and payload at 525 kg`."""
    return join_phrases(
        f"{item.short_name} at {limit_text(item, values[item.name])}"
        for item in members
        if item.name in values
    )


def as_printed(
    members: CharacteristicSet,
    setting: FloatArray,
    further: int,
    box: Box | None,
    single_name: str,
) -> FloatArray:
    """A setting whose values are rounded to the digits of limits, plus `further` digits. Values of
    the vehicle are rounded away from the original, and values of the encounter to the nearest. With
    `single_name` only this characteristic is rounded.
    """
    printed = setting.copy()
    for column, item in enumerate(members):
        value = setting[column]
        lower = item.lower
        upper = item.upper
        if box is not None and box.lower[column] <= value <= box.upper[column]:
            lower = box.lower[column]
            upper = box.upper[column]
        is_rounded = single_name in ("", item.name)
        if is_rounded and value not in (item.original, lower, upper):
            scale = 10.0 ** (item.digits + further)
            # A value such as 0.07, scaled to 7.000000000000001, must not be rounded up to 0.08:
            # hence rounding errors are removed first.
            scaled = np.round(value * scale, 6)
            rounded_away = (
                np.ceil(scaled) if value > item.original else np.floor(scaled)
            )
            rounded = (np.round(scaled) if item.is_scenario else rounded_away) / scale
            printed[column] = min(max(rounded, lower), upper)
    return printed


def failures_at(model: Model, settings: FloatArray) -> dict[int, Failure]:
    """The failures of those of M settings that are unsafe, or never move, by their row. If runs
    differ, failures are those in fresh runs.
    """
    points = model.evaluator.system.points
    members = model.characteristics
    if model.evaluator.has_repeats:
        runs = model.evaluator.evaluate_anew(settings)
    else:
        runs = model.evaluate(settings, BEYOND_STAGE)
    failures = {}
    is_told = model.are_unsafe_by(runs) | runs.standing
    for row in np.flatnonzero(is_told).tolist():
        setting = settings[row]
        point = points[runs.points[row]]
        values = members.encounter_of(setting)
        scenario = encounter(point, values).scenario
        run = runs.take([row])
        collided = runs.collided[row]
        if runs.standing[row]:
            event = breach = OUTCOME_VERBS[Outcome.NEVER_MOVED]
        else:
            breach = model.unsafe.breach_in_words(run)
            event = _event_in_words(scenario, model.unsafe, collided)
        impact = ""
        speed = -KMH_PER_MS * runs.f_safe[row]
        if collided and model.unsafe.is_of_impacts:
            event = breach
        elif collided and speed >= LEAST_IMPACT:
            impact = f"impact at {float(f'{speed:.2g}'):g} km/h"
        place = place_of(points, point, scenario, values, model.fit)
        if details := "; ".join(filter(None, (impact, place))):
            event += f" ({details})"
        if fails_in := runs_in_words(model.unsafe.failing_runs(run)[:, 0]):
            event += f" and {fails_in}"
        failures[row] = Failure(
            members.named(setting),
            f"the vehicle {event}",
            point.parameters,
            breach,
            _command(model, setting, point),
        )
    return failures


def _command(model: Model, setting: FloatArray, point: Point) -> str:
    """The command that simulates a setting, shape (n,). It sets the parameters of the point that
    the command `simulate` can set.
    """
    system = model.evaluator.system
    words = [system.command, model.characteristics.options(setting)]
    searchable = searchable_in(point.scenario)
    for name, value in point.parameters.items():
        if name in searchable and isinstance(value, int | float):
            words.append(f"--set {name}={value!r}")
    if model.fit:
        words.append(f"--fit {model.fit}")
    return " ".join(filter(None, words))


def place_of(
    points: Sequence[Point],
    point: Point,
    scenario: Scenario,
    values: NamedValues,
    fit: int = 0,
) -> str:
    """The place of a failure in words, such as `test CPNA, driven at 40 km/h, impact location 25 %;
    parameter set 9`; "" if there is only one place. Parameter set 0 is not named.

    No sentence states the phase: the command of the failure has it.

    Parameters
    ----------
    points
        All points of the matrix.
    point
        The point at which the vehicle fails.
    scenario
        The scenario of the failing encounter.
    values
        The searched parameters of the encounter, by name.
    fit
        The number of the parameter set.
    """
    numbers = {**point.parameters, **values}
    test = numbers.pop("test", "")
    # The weather is named only if the points differ in it.
    for name in ("weather", PHASE):
        numbers.pop(name, None)
    if len({other_point.weather.name for other_point in points}) > 1:
        numbers["weather"] = point.weather.name
    texts = texts_of(point, numbers)
    speed = texts.pop(SPEED_DIMENSION, "")
    if not speed and scenario.test_speed is not None:
        speed = f"{significant(KMH_PER_MS * scenario.test_speed, 4)} km/h"
    phrases = [f"{name} {text}".replace("_", " ") for name, text in texts.items()]
    if speed:
        phrases.insert(0, f"driven at {speed}")
    if test:
        phrases.insert(0, f"test {test}")
    set_name = f"parameter set {fit}" if fit else ""
    return "; ".join(filter(None, (", ".join(phrases), set_name)))


def texts_of(point: Point, values: JsonObject) -> dict[str, str]:
    """The values of an encounter at a point as texts with their units, by name."""
    texts = {}
    for name, value in values.items():
        texts[name] = str(value)
        if isinstance(value, int | float):
            unit = unit_text(unit_of(point.scenario, name))
            texts[name] = f"{value:{EXACT}}{unit}"
    return texts


def _event_in_words(scenario: Scenario, unsafe: Unsafe, collided: bool) -> str:
    """How a vehicle fails in a scenario, such as `hits a pedestrian`."""
    if collided:
        return f"hits {scenario.obstacle()}"
    if unsafe.bound is not None:
        return f"has {unsafe.bound}"
    measured = FROM_CENTRES if unsafe.contact and unsafe.degree else ""
    clearance = f"{significant(unsafe.degree or unsafe.distance, 3)} m{measured}"
    return f"keeps less than {clearance} from {scenario.obstacle()}"
