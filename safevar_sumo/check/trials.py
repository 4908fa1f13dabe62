"""Trials of user code. Simulations are repeated, in another order and alone, and searches are
repeated: results must be the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.random import default_rng

from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.metrics import Measure
from safevar_sumo.plugins import Lookup, instance_of
from safevar_sumo.records import (
    QUANTITIES,
    FloatArray,
    IntArray,
    ResultColumns,
    SimulationRuns,
    differences,
)
from safevar_sumo.search import ALGORITHMS, Algorithm, Problem
from safevar_sumo.study import Study, label_of
from safevar_sumo.sumo import reason_against_scenes
from safevar_sumo.sumo.batch import drive_all
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.simulators import simulations_of_setting
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.sumo.verification import verify_in_sumo
from safevar_sumo.terminal import Progress, show_no_progress
from safevar_sumo.vehicles import CharacteristicSet, region_of

SIMULATED = 100
"""Number of settings that are simulated, if this takes at most `LONGEST_CHECK`."""
LONGEST_CHECK = 60.0
"""Time after which the simulations should end [s]."""
LEAST_SIMULATED = 3
"""Least number of settings, however slow the code is: the original and two corners of the
domains.
"""
TIMED = 5
"""Number of settings whose time is taken."""
RUNS_OF_ALL = 5
"""Approximate number of times that all checks together simulate each setting."""
SMALLER_BATCHES = 4
"""Number of parts into which the settings are divided for the check `alone`."""
MATRIX_POINTS = 2
"""Approximate number of a study's points that are simulated."""
TRIED_VALUES = np.nan, 0.0, -1e6, 1e6
"""Values that replace a quantity at all samples. If a metric changes, it reads this quantity."""
MAX_TRIED_EVALUATIONS = 57
"""Largest number of evaluations of an algorithm's run."""
MAX_POPULATION = 20
"""Largest population of an algorithm's run."""


class Finding(NamedTuple):
    """A failed check.

    Attributes
    ----------
    check
        The name of the check.
    finding
        The wrong result.
    expected
        The right result.
    where
        The file and line of the user code; "" in a finding of a trial, which does not know the
        place.
    input
        The vehicle with the wrong result, in words.
    """

    check: str
    finding: str
    expected: str
    where: str = ""
    input: str = ""

    def __str__(self) -> str:
        """The finding with its input and place on one line."""
        line = f"{self.check}: {self.finding}"
        if self.input:
            line += f", with {self.input}"
        if self.where not in self.finding:
            line += f" ({self.where})"
        return line


class Extent(NamedTuple):
    """The size of a trial.

    Attributes
    ----------
    vehicles, points
        The numbers of vehicles and of the study's points that are simulated.
    all_vehicles, all_points
        The numbers without a limit of time.
    seconds
        The expected duration of the simulations [s].
    """

    vehicles: int
    all_vehicles: int
    points: int
    all_points: int
    seconds: float


def try_simulations(
    study: Study,
    vehicles: int | None = None,
    progress: Progress = show_no_progress,
    tell: Callable[[Extent], None] = lambda extent: None,
    limit: int | None = None,
) -> Iterator[Finding]:
    """Simulate a study with the original vehicle, the corners of the domains and random settings,
    and compare repeated simulations.

    The number of settings is `vehicles`, by default as many as fit into the time. In a simulator of
    the user's own, at most `limit` simulations are done. `tell` is called with the size of the
    trial.
    """
    region = region_of(study)
    settings = trial_settings(region.characteristics, max(vehicles or 0, SIMULATED))
    settings = region.repaired(region.characteristics.filter(settings))
    system = trial_system(study)
    if system.mover.takes_long and limit is not None:
        # Each vehicle takes part in four runs; the first and the last vehicle also drive alone.
        simulations = simulations_of_setting(system)
        remaining_simulations = limit - system.repeats - 2 * simulations
        vehicles = remaining_simulations // (
            simulations * (1 if system.repeats > 1 else 4)
        )
        if vehicles < 1:
            return
    own_metrics = [
        name for name in (*study.metrics.also, *study.search.objectives) if ":" in name
    ]
    if own_metrics:
        yield from find_unstated_needs(
            system, drive_all(system.at(system.points[0]), settings[:1])
        )
    number, seconds = (1, 0.0) if limit is not None else _affordable(system, settings)
    if vehicles is not None:
        vehicles = min(vehicles, len(settings))
        seconds = seconds * vehicles / number
        number = vehicles
    settings = settings[:number]
    tell(
        Extent(
            number,
            vehicles or SIMULATED,
            len(system.points),
            len(assemble(study).points),
            seconds,
        )
    )

    # With repeats, the study says that results of its simulator differ: nothing can be compared.
    if system.repeats > 1:
        drive_and_score(system, settings[:LEAST_SIMULATED])
        return

    def load() -> Callable[[IntArray], ResultColumns]:
        system = trial_system(study)
        return lambda rows: drive_and_score(system, settings[rows]).results

    expected = "the same, to the bit"
    if not system.mover.is_exact:
        expected += (
            "; or repeats = N in [scenario], where the share of unsafe runs counts"
        )
    yield from _try(load, region.characteristics, settings, progress, expected)

    # Recorded scenes of a user's scenario must give the same results as SUMO.
    system = trial_system(study)
    if ":" in study.scenario.model and not reason_against_scenes(system):
        try:
            verify_in_sumo(system, settings, drive_and_score(system, settings).points)
        except InputError as error:
            problem, _, setting = error.problem.partition(", with ")
            expected = (
                "reactive_actors = True where somebody reacts to the vehicle under test"
            )
            yield Finding("contract", problem, expected, input=setting)


def find_unstated_needs(system: System, runs: SimulationRuns) -> Iterator[Finding]:
    """Find metrics that read a quantity that their `needs` do not state."""
    for measure in system.measuring.measures.values():
        if measure.of == "settings":
            continue
        for quantity in QUANTITIES:
            if quantity in measure.quantities:
                continue
            variants = (runs.with_all(quantity, value) for value in TRIED_VALUES)
            if reads_a_difference(measure, system, runs, variants):
                got = f"the metric {measure.name} reads {quantity}, which its needs do not state"
                expected = f"needs = {(*measure.quantities, quantity)}"
                yield Finding("contract", got, expected, input="the original vehicle")


def reads_a_difference(
    measure: Measure,
    system: System,
    runs: SimulationRuns,
    variants: Iterable[SimulationRuns],
) -> bool:
    """Whether a metric of runs has another value for one of their variants, or refuses it."""
    with system.user_code():
        values = measure.of_runs(runs, system.metrics_table)
        for variant in variants:
            try:
                other_values = measure.of_runs(variant, system.metrics_table)
            except UserCodeError:
                return True
            if not np.array_equal(values, other_values, equal_nan=True):
                return True
    return False


def _affordable(system: System, settings: FloatArray) -> tuple[int, float]:
    """Measure the time of a few settings, and return how many settings take at most
    `LONGEST_CHECK`, and their time [s]. In a simulator of the user's own, only one setting is
    measured.
    """
    timed = settings[: 1 if system.mover.takes_long else TIMED]
    # The first simulation takes longer, because it loads libraries. Its time limit is short, in
    # case the driving system never ends. A simulator of the user's own has simulated before.
    if not system.mover.takes_long:
        short = replace(system, time_limit=min(system.time_limit, LONGEST_CHECK))
        drive_and_score(short, timed[:1])
    start = time.perf_counter()
    drive_and_score(system, timed)
    seconds = RUNS_OF_ALL * (time.perf_counter() - start) / len(timed)
    number = min(max(int(LONGEST_CHECK / seconds), LEAST_SIMULATED), SIMULATED)
    return number, number * seconds


def try_algorithm(study: Study, name: str) -> Iterator[Finding]:
    """Let an algorithm search twice with the same seed, the second time after a run with another
    seed. Both searches must request and return the same settings.
    """
    outputs = np.concatenate(search_with(study, name, seeds=(1,)))
    repeated = np.concatenate(search_with(study, name, seeds=(2, 1)))
    expected = "the same in every run with the same random numbers, to the bit"
    if len(outputs) != len(repeated):
        difference = (
            f"{len(repeated)} settings instead of {len(outputs)} in another run"
        )
        yield Finding("repetition", difference, expected)
    elif (outputs != repeated).any():
        row = int(np.argmax((outputs != repeated).any(axis=1)))
        difference = f"setting {row} is {repeated[row].tolist()} instead of {outputs[row].tolist()}"
        yield Finding("repetition", f"{difference} in another run", expected)


class _Repetition(NamedTuple):
    """Another run of settings.

    Attributes
    ----------
    simulate
        The function that simulates rows of settings.
    check
        The name of the check that fails if results differ.
    circumstance
        What is different in this run, in words.
    rows
        The rows of the settings that are simulated.
    """

    simulate: Callable[[IntArray], ResultColumns]
    check: str
    circumstance: str
    rows: IntArray


def _try(
    load: Callable[[], Callable[[IntArray], ResultColumns]],
    characteristics: CharacteristicSet,
    settings: FloatArray,
    progress: Progress,
    expected: str,
) -> Iterator[Finding]:
    """Compare a run of all settings with other runs of the same settings. `load` loads all user
    code again, and returns a function that simulates rows of settings.
    """
    run = load()
    all_rows = np.arange(len(settings))
    total = RUNS_OF_ALL * len(settings)
    number = 0
    progress("vehicles", number, total)
    outputs = run(all_rows)
    run_anew = load()
    repetitions = [
        _Repetition(run, "repetition", "in a second run", all_rows),
        _Repetition(run_anew, "order", "in another order", all_rows[::-1]),
    ]
    for rows in np.array_split(all_rows, min(SMALLER_BATCHES, len(all_rows))):
        repetitions.append(_Repetition(run_anew, "alone", "in a smaller batch", rows))
    for rows in (all_rows[:1], all_rows[-1:]):
        repetitions.append(_Repetition(run_anew, "alone", "alone", rows))
    for repetition in repetitions:
        rows = repetition.rows
        number += len(rows)
        progress("vehicles", number, total)
        expected_outputs = {name: values[rows] for name, values in outputs.items()}
        for row, difference in differences(expected_outputs, repetition.simulate(rows)):
            changes = characteristics.changes_in_words(settings[rows[row]])
            yield Finding(
                repetition.check,
                f"{difference} {repetition.circumstance}",
                expected,
                input=changes or "the original vehicle",
            )


def trial_settings(characteristics: CharacteristicSet, count: int) -> FloatArray:
    """The original, four corners of the domains, and random settings, shape (count, n)."""
    lower = characteristics.lower
    upper = characteristics.upper
    is_odd = np.arange(len(characteristics)) % 2 == 1
    corners = [
        characteristics.original,
        lower,
        upper,
        np.where(is_odd, lower, upper),
        np.where(is_odd, upper, lower),
    ]
    return np.concatenate(
        [corners, default_rng(0).uniform(lower, upper, (count, len(lower)))]
    )[:count]


def trial_system(study: Study) -> System:
    """Assemble the system of a study with only a few points of its matrix. This loads user code
    again.
    """
    system = assemble(study)
    points = system.points[:: max(len(system.points) // MATRIX_POINTS, 1)]
    return replace(system, points=points)


class Searched(NamedTuple):
    """The settings that a run of an algorithm requests, and those that it returns, both of shape
    (k, n).
    """

    requested: FloatArray
    returned: FloatArray


def search_with(study: Study, name: str, seeds: tuple[int, ...]) -> Searched:
    """Run an algorithm with one seed after another. Return the settings of the last run."""
    system = trial_system(study)
    lookup = Lookup.of(study)
    label = label_of(name)
    member = lookup.class_of(ALGORITHMS, name, "search.algorithms", Algorithm)
    parameters = lookup.with_paths(
        member, study.search.parameters.get(label, {}), f"search.{label}"
    )
    problem = Problem(
        region=system.region,
        original=drive_and_score(system, system.characteristics.original_settings),
        population=min(study.search.population, MAX_POPULATION),
        evaluations=min(study.search.evaluations, MAX_TRIED_EVALUATIONS),
        scoring=system.measuring.scoring,
    )

    for seed in seeds:
        algorithm = instance_of(
            member, parameters, f"search.algorithms = {name!r}", f"search.{label}"
        )
        # If `search` is no generator, its code already runs in this call.
        with system.user_code():
            search = algorithm.search(problem, default_rng(seed))
        requested = []
        try:
            requested.append(next(search))
            while True:
                requested.append(search.send(drive_and_score(system, requested[-1])))
        except StopIteration as end:
            returned = end.value.settings
    return Searched(np.concatenate(requested), returned)
