"""Oversights in user code, which `check` alone looks for: a study starts despite them, because its
results follow from its code, although probably not from what its author meant.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.random import default_rng

from safevar_sumo.check.findings import (
    Code,
    Finding,
    Findings,
    own_measures,
    pieces_of_code,
)
from safevar_sumo.check.trials import (
    TRIED_VALUES,
    differs_in,
    search_with,
    trial_settings,
    trial_system,
)
from safevar_sumo.errors import UserCodeError
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
from safevar_sumo.study import Study, label_of
from safevar_sumo.sumo.batch import drive_all
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.simulators import WatchedRun, watched_runs
from safevar_sumo.sumo.system import System
from safevar_sumo.vehicles import DRY_ROAD_FRICTION, STEP, Vehicle
from safevar_sumo.vehicles.base import Characteristics

MANY = 20
"""Number of settings in which a metric must be defined at least once and change at least once, and
each characteristic must be read.
"""
FEW = 5
"""The same number for simulations that take long: the original and four corners of the domains."""
PEDALS = ((1.0, 0.0), (0.0, 1.0))
"""Throttle and brake of the two phases in which a vehicle drives with two time steps [-]."""
PHASE = 3.0
"""Length of such a phase [s]."""
FASTER = 1.7
"""Largest change of the speed per time with half the step, over that with the step, from which on a
vehicle ignores the step. The ratio is 2 for such a vehicle, and nearly 1 for others.
"""
AGAIN = 0.25
"""Share of settings that may be repetitions, in addition to those among uniform settings."""


def find_oversights(study: Study) -> Iterator[tuple[list[Code], Findings]]:
    """The oversights in the user code of a study, each with the pieces of code among which it is.
    Findings are computed one by one, when the caller asks for the next finding.
    """
    system = trial_system(study)
    code = pieces_of_code(study)
    settings = trial_settings(
        system.characteristics, FEW if system.mover.takes_long else MANY
    )
    settings = system.region.repaired(settings)
    sample = f"{len(settings)} vehicles: the original, and others up to the ends of the domains"

    results = drive_and_score(system, settings).results
    stands = results["outcome"] == Outcome.NEVER_MOVED
    yield code, _find_standing(settings, stands, sample)
    own = own_measures(study)
    named = map(label_of, (*study.metrics.also, *study.search.objectives))
    for name in dict.fromkeys([*own, *named]):
        if name in results:
            values = results[name].astype(float)
            of_measure = [own[name]] if name in own else code
            yield of_measure, _find_undefined(name, values, sample)
            if name in own:
                yield of_measure, _find_constant(system, name, values, sample)

    if not system.mover.is_exact:
        scenarios = [piece for piece in code if piece.key == "scenario.model"]
        runs = list(watched_runs(system, settings))
        yield scenarios, _find_unread(runs, sample)
        yield scenarios, _find_modified(runs)
        yield scenarios, _find_shifted(runs)
    for piece in code:
        if piece.key == "vehicle.model":
            yield [piece], _find_ignored_step(system)
        if piece.key == "search.algorithms":
            yield [piece], _find_duplicates(study, system, piece.name)


def _find_standing(settings: FloatArray, stands: BoolArray, sample: str) -> Findings:
    """Find that changed vehicles never move, although the original vehicle does. `stands` says
    which of N settings never move; the first one is the original.
    """
    changed = (settings != settings[0]).any(axis=1)
    if changed.any() and stands[changed].all() and not stands[0]:
        problem = "no changed vehicle moves, although the original vehicle does"
        yield Finding("standing", problem, "", sample, "changed vehicles that drive")


def _find_undefined(name: str, values: FloatArray, sample: str) -> Findings:
    """Find that a metric is undefined in all runs."""
    if np.isnan(values).all():
        got = f"{name} is undefined in all runs"
        yield Finding("undefined", got, "", sample, "a value in some run")


def _find_constant(
    system: System, name: str, values: FloatArray, sample: str
) -> Findings:
    """Find that a measure has the same value in all runs, whatever happens in them."""
    if not (values == values[0]).all():
        return
    measure = system.measuring.measures[name]
    if measure.of == "runs":
        original = system.characteristics.original_settings
        runs = drive_all(system.at(system.points[0]), original)
        if name in runs.stated and not np.isnan(runs.stated[name]).all():
            return
        if differs_in(_variants(runs), measure, system, runs):
            return
    got = f"{name} is {values[0]:g} in all runs"
    expected = "a value that depends on the run or the setting"
    yield Finding("constant", got, "", sample, expected)


def _variants(runs: SimulationRuns) -> Iterator[SimulationRuns]:
    """Variants of runs in which all that a metric can read has other values, alone and together
    with another end of the run.
    """
    trace = runs.trace
    samples = len(trace.time)
    first_half = np.arange(samples) < samples // 2
    ends: list[dict[str, Any]] = [
        {},
        {
            "outcome": np.full(len(runs), Outcome.STOPPED.value),
            "collision_speed": np.full(len(runs), np.nan),
        },
        {"trace": replace(trace, active=trace.active & first_half[:, None])},
    ]
    for side in ("front", "left", "right", "rear"):
        contact = Contact(
            np.full(len(runs), side), np.full(len(runs), 20.0), np.full(len(runs), 1.0)
        )
        collision = {
            "outcome": np.full(len(runs), Outcome.COLLISION.value),
            "collision_speed": np.full(len(runs), 5.0),
            "contact": contact,
        }
        ends.append(collision)
    for name in ("warning_ttc", "test_speed_error", "allowed_impact_speed"):
        ends.append({name: np.full(len(runs), 1.5)})
    falls = np.linspace(50.0, -50.0, samples)[:, None]
    alternates = np.resize([50.0, -50.0], (samples, 1))
    values = (*TRIED_VALUES, falls, -falls, np.abs(falls), alternates)
    for end in ends:
        ended = replace(runs, **end)
        yield ended
        for value in values:
            all_changed = ended
            for quantity in QUANTITIES:
                all_changed = all_changed.with_all(quantity, value)
                yield ended.with_all(quantity, value)
            yield all_changed


def _find_unread(runs: list[WatchedRun], sample: str) -> Findings:
    """Find characteristics that a simulator reads in no run."""
    unread = set.intersection(*(run.unread for run in runs))
    if unread:
        got = f"simulate never reads {', '.join(sorted(unread))}"
        expected = "a simulator that reads each characteristic of its vehicle"
        yield Finding("unread", got, "", sample, expected)


def _find_modified(runs: list[WatchedRun]) -> Findings:
    """Find a setting that a simulator changes."""
    for run in runs:
        for name, value in run.values.items():
            after = run.values_after.get(name)
            if after != value:
                got = f"simulate changes {name} of its setting from {value:.6g} to {after}"
                yield Finding("modified", got, "", "", "a setting that stays as it is")


def _find_shifted(runs: list[WatchedRun]) -> Findings:
    """Find speeds that belong to another sample than the gap or the position."""
    for run in runs:
        time = run.result.get(TIME, [])
        if len(time) < 2:
            continue
        if lag := lag_of_speed(run.result, float(time[1] - time[0])):
            expected = "in each sample, the quantities of one moment"
            setting = ", ".join(f"{name} = {run.values[name]:g}" for name in run.values)
            yield Finding("shift", f"simulate returns a {lag}", "", setting, expected)


def _find_ignored_step(system: System) -> Findings:
    """Find a vehicle model that changes by the same in each step, whatever the length of the
    step.
    """
    vehicle = system.vehicle
    members = system.characteristics.vehicle
    original = members.columns(members.original_settings)
    changes = []
    for step in (STEP, STEP / 2):
        # A model may refuse a step that it was not made for.
        try:
            with system.user_code():
                changes.append(_largest_changes(vehicle, original, step))
        except UserCodeError:
            return
    for pedal, change, change_of_half in zip(
        ("accelerates", "brakes"), *changes, strict=True
    ):
        if change_of_half > FASTER * change:
            got = (
                f"the vehicle {pedal} with up to {change_of_half:.3g} m/s^2 in steps of"
                f" {STEP / 2:g} s, and with up to {change:.3g} m/s^2 in steps of {STEP:g} s"
            )
            expected = "nearly the same with any step"
            yield Finding("step", got, "", "the original vehicle", expected)


def _largest_changes(
    vehicle: Vehicle, characteristics: Characteristics, step: float
) -> list[float]:
    """The largest change of the speed per time [m/s^2] with the throttle pressed, and then with the
    brake pressed, in a drive from rest in steps of `step` seconds.
    """
    prepared = vehicle.prepare(characteristics, DRY_ROAD_FRICTION, step)
    state = vehicle.at_rest(prepared)
    largest_changes = []
    for throttle, brake in PEDALS:
        command = Command(np.full(1, throttle), np.full(1, brake))
        largest = 0.0
        for _ in range(round(PHASE / step)):
            speed = float(state.speed[0])
            state = vehicle.advance(prepared, state, command)
            largest = max(largest, abs(float(state.speed[0]) - speed) / step)
        largest_changes.append(largest)
    return largest_changes


def _find_duplicates(study: Study, system: System, name: str) -> Findings:
    """Find settings that an algorithm requests again, and solutions that it returns again."""
    members = system.characteristics
    searched = search_with(study, name, seeds=(1,))
    for verb, noun, settings in (
        ("yields", "settings", searched.requested),
        ("returns", "solutions", searched.returned),
    ):
        # Domains with few values, and the filter, let settings of any algorithm repeat.
        rng = default_rng(1)
        uniform = rng.uniform(members.lower, members.upper, settings.shape)
        usual = _repetitions(members.filter(uniform), members.original)
        again = _repetitions(settings, members.original)
        if again > usual + AGAIN * len(settings):
            got = f"search {verb} {again} of {len(settings)} {noun} again"
            expected = "a setting that differs from those before it"
            yield Finding("duplicates", got, "", "", expected)


def _repetitions(settings: FloatArray, original: FloatArray) -> int:
    """How many of N settings, shape (N, n), repeat an earlier one that is not the original."""
    changed = settings[(settings != original).any(axis=1)]
    return len(changed) - len(np.unique(changed, axis=0))
