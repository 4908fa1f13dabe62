"""Oversights in user code, which `check` alone looks for: a study starts despite them, because its
results follow from its code, although probably not from what its author meant.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import product

import numpy as np

from safevar_sumo.check.trials import (
    TRIED_VALUES,
    Finding,
    reads_a_difference,
    search_with,
    trial_settings,
    trial_system,
)
from safevar_sumo.errors import UserCodeError
from safevar_sumo.plugins import Lookup
from safevar_sumo.records import (
    QUANTITIES,
    BoolArray,
    Command,
    Contact,
    FloatArray,
    Outcome,
    SimulationRuns,
)
from safevar_sumo.scenarios.simulated import TIME
from safevar_sumo.scenarios.trace_ways import lag_of_speed
from safevar_sumo.study import Study, label_of, user_code
from safevar_sumo.sumo.batch import drive_all
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.simulators import WatchedRun, watched_runs
from safevar_sumo.sumo.system import System
from safevar_sumo.vehicles import DRY_ROAD_FRICTION, STEP

MANY_SETTINGS = 20
"""Number of settings in which a metric must be defined at least once and change at least once, and
each characteristic must be read.
"""
FEW_SETTINGS = 5
"""The same number for simulations that take long: the original and four corners of the domains."""
PEDAL_TIME = 3.0
"""Time for which the throttle, and then the brake, is pressed with two time steps [s]."""
FASTER = 1.7
"""Largest change of the speed per time with half the step, over that with the step, from which on a
vehicle ignores the step. The ratio is 2 for such a vehicle, and nearly 1 for others.
"""


def find_oversights(
    study: Study,
) -> Iterator[tuple[Mapping[str, str], Iterator[Finding]]]:
    """The oversights in the user code of a study, each with the names, by their keys, of the code
    among which it is. Findings are computed one by one, when the caller asks for the next finding.
    """
    system = trial_system(study)
    number = FEW_SETTINGS if system.mover.takes_long else MANY_SETTINGS
    settings = trial_settings(system.characteristics, number)
    settings = system.region.repaired(settings)
    sample = f"{len(settings)} vehicles: the original, and others up to the ends of the domains"
    code = user_code(study)
    results = drive_and_score(system, settings).results

    stands = results["outcome"] == Outcome.NEVER_MOVED
    yield dict(code), _find_standing(settings, stands, sample)
    own_measures = _own_measures(study)
    labels = [
        label_of(name) for name in (*study.metrics.also, *study.search.objectives)
    ]
    for name in dict.fromkeys([*own_measures, *labels]):
        if name in results:
            values = results[name].astype(float)
            yield (
                own_measures.get(name, dict(code)),
                _find_undefined(name, values, sample),
            )
            if name in own_measures:
                yield own_measures[name], _find_constant(system, name, values, sample)
    if not system.mover.is_exact:
        yield dict(code), _find_misuse(list(watched_runs(system, settings)), sample)
    for key, name in code:
        if key == "vehicle.model":
            yield {key: name}, _find_ignored_step(system)
        if key == "search.algorithms":
            yield {key: name}, _find_duplicates(study, name)


def _own_measures(study: Study) -> dict[str, dict[str, str]]:
    """The names, by their keys, of the user's measures that a study names, by their columns."""
    lookup = Lookup.of(study)
    measures = {}
    for key, name in user_code(study):
        if key in ("metrics.also", "search.objectives"):
            measures[lookup.find({}, name, key).target.name] = {key: name}
    return measures


def _find_standing(
    settings: FloatArray, stands: BoolArray, sample: str
) -> Iterator[Finding]:
    """Find that changed vehicles never move, although the original vehicle does. `stands` says
    which of N settings never move; the first one is the original.
    """
    changed = (settings != settings[0]).any(axis=1)
    if changed.any() and stands[changed].all() and not stands[0]:
        problem = "no changed vehicle moves, although the original vehicle does"
        yield Finding("standing", problem, "changed vehicles that drive", input=sample)


def _find_undefined(name: str, values: FloatArray, sample: str) -> Iterator[Finding]:
    """Find that a metric is undefined in all runs."""
    if np.isnan(values).all():
        problem = f"{name} is undefined in all runs"
        yield Finding("undefined", problem, "a value in some run", input=sample)


def _find_constant(
    system: System, name: str, values: FloatArray, sample: str
) -> Iterator[Finding]:
    """Find that a metric has the same value in all runs, whatever happens in them."""
    if not (values == values[0]).all():
        return
    measure = system.measuring.measures[name]
    if measure.of == "runs":
        original = system.characteristics.original_settings
        runs = drive_all(system.at(system.points[0]), original)
        if name in runs.stated or reads_a_difference(
            measure, system, runs, _variants(runs)
        ):
            return
    problem = f"{name} is {values[0]:g} in all runs"
    expected = "a value that depends on the run or the setting"
    yield Finding("constant", problem, expected, input=sample)


def _variants(runs: SimulationRuns) -> Iterator[SimulationRuns]:
    """Variants of runs: in each, a quantity has other values, with each end of a run and a contact
    on each side.
    """
    alternating = np.resize([50.0, -50.0], (len(runs.trace.time), 1))
    number = np.full(len(runs), 1.0)
    for outcome, side in product(Outcome, ("front", "left", "right", "rear")):
        ended = replace(
            runs,
            outcome=np.full(len(runs), outcome.value),
            collision_speed=5.0 * number,
            contact=Contact(np.full(len(runs), side), 20.0 * number, number),
        )
        for quantity in QUANTITIES:
            for value in (*TRIED_VALUES, alternating):
                yield ended.with_all(quantity, value)


def _find_misuse(runs: list[WatchedRun], sample: str) -> Iterator[Finding]:
    """Find characteristics that a simulator reads in no run, a setting that it changes, and speeds
    that belong to another sample than the gap or the position.
    """
    unread = set.intersection(*(run.unread for run in runs))
    if unread:
        problem = f"simulate never reads {', '.join(sorted(unread))}"
        expected = "a simulator that reads each characteristic of its vehicle"
        yield Finding("unread", problem, expected, input=sample)
    for run in runs:
        for name, value in run.values.items():
            new_value = run.values_after.get(name)
            if new_value != value:
                problem = f"simulate changes {name} of its setting from {value} to {new_value}"
                expected = "a setting that stays as it is"
                yield Finding("modified", problem, expected)
        time = run.result.get(TIME, [])
        lag = ""
        if len(time) > 1:
            lag = lag_of_speed(run.result, time[1] - time[0])
        if lag:
            setting = ", ".join(f"{name} = {run.values[name]:g}" for name in run.values)
            problem = f"simulate returns a {lag}"
            expected = "in each sample, the quantities of one moment"
            yield Finding("shift", problem, expected, input=setting)


def _find_ignored_step(system: System) -> Iterator[Finding]:
    """Find a vehicle model that changes by the same in each step, whatever the length of the
    step.
    """
    # A model may refuse a step that it was not made for.
    try:
        changes = _largest_changes(system, STEP)
        changes_of_half = _largest_changes(system, STEP / 2)
    except UserCodeError:
        return
    for pedal, change in changes.items():
        change_of_half = changes_of_half[pedal]
        if change_of_half > FASTER * change:
            problem = (
                f"the {pedal} changes the speed by up to {change_of_half:.3g} m/s^2 in steps of"
                f" {STEP / 2:g} s, and by up to {change:.3g} m/s^2 in steps of {STEP:g} s"
            )
            expected = "nearly the same with any step"
            yield Finding("step", problem, expected, input="the original vehicle")


def _largest_changes(system: System, step: float) -> dict[str, float]:
    """The largest change of the original vehicle's speed per time [m/s^2], in a drive from rest in
    steps of `step` seconds, by the pressed pedal.
    """
    vehicle = system.vehicle
    members = system.characteristics.vehicle
    pressed = np.ones(1)
    released = np.zeros(1)
    largest = {"throttle": 0.0, "brake": 0.0}
    commands = {
        "throttle": Command(pressed, released),
        "brake": Command(released, pressed),
    }
    with system.user_code():
        original = members.columns(members.original_settings)
        prepared = vehicle.prepare(original, DRY_ROAD_FRICTION, step)
        state = vehicle.at_rest(prepared)
        for pedal, command in commands.items():
            for _ in range(round(PEDAL_TIME / step)):
                speed = float(state.speed[0])
                state = vehicle.advance(prepared, state, command)
                change = abs(float(state.speed[0]) - speed) / step
                largest[pedal] = max(largest[pedal], change)
    return largest


def _find_duplicates(study: Study, name: str) -> Iterator[Finding]:
    """Find solutions that an algorithm returns again."""
    solutions = search_with(study, name, seeds=(1,)).returned
    duplicate_count = len(solutions) - len(np.unique(solutions, axis=0))
    if duplicate_count:
        problem = (
            f"search returns {duplicate_count} of {len(solutions)} solutions again"
        )
        yield Finding("duplicates", problem, "each solution once")
