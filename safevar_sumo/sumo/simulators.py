"""Runs of a user's simulator, which simulates one setting after another."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4
from weakref import WeakKeyDictionary

import numpy as np
import portalocker

from safevar_sumo.errors import UserCodeError
from safevar_sumo.metrics import METRICS, OPTIONAL_METRICS, UNSAFE_SHARE, Unsafe
from safevar_sumo.output import ALONE
from safevar_sumo.plugins import UserCode
from safevar_sumo.plugins.process import (
    MARK,
    MAX_DEATHS,
    REPRODUCED_BY,
    note_work,
    temporary_entries,
    this_process,
)
from safevar_sumo.plugins.time_limit import end_if_longer
from safevar_sumo.records import (
    LEAST_COLLISION_SPEED,
    NO_CONTACT,
    QUANTITIES,
    Encounter,
    Evaluations,
    FloatArray,
    NamedValues,
    Outcome,
    SimulationRuns,
    Trace,
    nans,
)
from safevar_sumo.scenarios import Simulator
from safevar_sumo.scenarios.simulated import (
    ALSO_SAMPLED,
    IMPACT_SPEED,
    OUTCOME,
    STRUCK_SPEED,
    TIME,
    StatedRun,
)
from safevar_sumo.study import SAFETY_DEGREE
from safevar_sumo.sumo.encounters import encounter
from safevar_sumo.sumo.kept import KEPT
from safevar_sumo.sumo.system import System

SEVERITY = [
    Outcome.COLLISION,
    Outcome.INVALID_TEST,
    Outcome.TIMEOUT,
    Outcome.NEVER_MOVED,
    Outcome.PASSED,
    Outcome.STOPPED,
]
"""Outcomes that rounds of a setting may have, from the worst to the best."""
COLLISION = Unsafe()
"""The criterion for a single run if the study states none, or a share of unsafe runs: a collision.
"""
_steps = WeakKeyDictionary[type, dict[str, float]]()
"""Time steps [s] of the runs in this process, by class of the simulator and by name of the point.
A class that is loaded again is another class.
"""


def simulate_each(system: System, settings: FloatArray) -> SimulationRuns:
    """Simulate N settings of n characteristics, shape (N, n), one after another, at the system's
    only point. The time limit holds for each simulation.
    """
    (point,) = system.points
    members = system.characteristics
    results = []
    for setting in settings:
        command = f"{system.command} {members.options(setting)}"
        note_work(f"{REPRODUCED_BY}{command}")
        scenario: Any = encounter(point, members.encounter_of(setting)).scenario
        vehicle = members.vehicle.named(setting[members.of_vehicle])
        with (
            temporary_entries(os.environ, {MARK: this_process.mark}),
            system.user_code(),
            _attempt(f"{command} {point.name}", system),
            end_if_longer(system.time_limit),
        ):
            with _end_worker():
                simulator = KEPT.at(scenario)
                KEPT.simulated += 1
                result = simulator.simulate(vehicle)
            if TIME in result:
                _check_step(simulator, result[TIME], point.name)
            else:
                _check_names(scenario, result, system)
        results.append(result)
    return _runs_of(results, system, point.allowed_impact_speed)


class _Setting(dict[str, float]):
    """A setting that notes which of its values a simulator has read; `unread` has all others."""

    def __init__(self, values: NamedValues) -> None:
        super().__init__(values)
        self.unread = {*values}

    def __getitem__(self, name: str) -> float:
        self.unread.discard(name)
        return super().__getitem__(name)

    def get(self, name: str, default: Any = None) -> Any:
        self.unread.discard(name)
        return super().get(name, default)

    # A simulator that iterates over a setting, or copies it, reads all values.
    def __iter__(self) -> Iterator[str]:
        self.unread.clear()
        return super().__iter__()

    def values(self) -> Any:
        self.unread.clear()
        return super().values()

    def items(self) -> Any:
        self.unread.clear()
        return super().items()


class WatchedRun(NamedTuple):
    """A run of a user's simulator, with what the simulator did to its setting.

    Attributes
    ----------
    values, values_after
        The values of the setting before and after the run, by name.
    unread
        The characteristics whose values the simulator did not read.
    result
        What the simulator returned.
    """

    values: NamedValues
    values_after: NamedValues
    unread: set[str]
    result: StatedRun


def watched_runs(system: System, settings: FloatArray) -> Iterator[WatchedRun]:
    """Simulate N settings, shape (N, n), in a user's simulator at the system's first point."""
    members = system.characteristics
    for setting in settings:
        values = members.encounter_of(setting)
        scenario: Any = encounter(system.points[0], values).scenario
        named = members.vehicle.named(setting[members.of_vehicle])
        vehicle = _Setting(named)
        with system.user_code():
            result = KEPT.at(scenario).simulate(vehicle)
        unread = {*vehicle.unread}
        yield WatchedRun(named, dict(vehicle.items()), unread, result)


def simulations_of_setting(system: System) -> int:
    """The number of simulations that a setting takes: one for each point and repetition, and twice
    as many if the original vehicle must be simulated in the same encounter, too.
    """
    has_pairs = system.measuring.scoring.safe_original is not None
    return len(system.points) * system.repeats * (1 + has_pairs)


@contextmanager
def _attempt(command: str, system: System) -> Iterator[None]:
    """Context that notes, for other processes, that this setting is being simulated. It does
    nothing unless the study skips settings on which the simulator fails.

    Raises
    ------
    UserCodeError
        If more than `MAX_DEATHS` workers have died while they simulated this setting.
    """
    if this_process.attempts is None or not system.skips_failed:
        yield
        return
    # An attempt is a file that its process locks before it moves the file to its place: a file
    # that nobody has locked is of a process that has died.
    attempts = this_process.attempts / sha256(command.encode()).hexdigest()
    attempts.mkdir(parents=True, exist_ok=True)
    if sum(map(_has_died, attempts.iterdir())) > MAX_DEATHS:
        problem = "two workers died, or exceeded the time limit, in simulate"
        raise UserCodeError(system.source, f"{problem}{REPRODUCED_BY}{command}")
    attempt = attempts / uuid4().hex
    with this_process.attempts.with_name(attempt.name).open("x") as file:
        # Some disks have no locks.
        with suppress(portalocker.LockException):
            portalocker.lock(file, ALONE)
        os.replace(file.name, attempt)
        try:
            yield
        finally:
            attempt.unlink()


def _has_died(attempt: Path) -> bool:
    """Whether the process of an attempt has died during the attempt: its file still exists, and
    nobody has locked it.
    """
    with (
        suppress(FileNotFoundError, portalocker.LockException),
        attempt.open("r+") as file,
    ):
        # Another process may look at the same time, and must not take this process for the owner.
        portalocker.lock(file, portalocker.LOCK_SH | portalocker.LOCK_NB)
        return attempt.exists()
    return False


@contextmanager
def _end_worker() -> Iterator[None]:
    """Context in which a simulator that ends the program (SystemExit) ends this process, if the
    process is a worker. A new worker then simulates the setting again.
    """
    try:
        yield
    except SystemExit as end:
        if this_process.last_words is not None:
            os._exit(end.code if isinstance(end.code, int) else 1)
        raise


def _check_step(simulator: Simulator, time: FloatArray, point: str) -> None:
    """Refuse a time step that differs from the time step of earlier runs at the same point in this
    process.
    """
    kind = type(simulator)
    step = round(float(time[1] - time[0]), 6)
    earlier_step = _steps.setdefault(kind, {}).setdefault(point, step)
    if step != earlier_step:
        code = UserCode(f"scenario.model = {kind.__name__}", kind)
        shorter, longer = sorted((step, earlier_step))
        steps = f"time steps of {shorter:g} and {longer:g} s"
        raise code.wrong("simulate", steps, "one time step in all runs")


def _check_names(scenario: Simulator, result: StatedRun, system: System) -> None:
    """Refuse a result without a trace that states unknown metrics, or lacks a metric that is an
    objective of the study.
    """
    code = UserCode(f"scenario.model = {type(scenario).__name__}", type(scenario))
    measures = system.measuring.measures
    names = {*OPTIONAL_METRICS, *measures, OUTCOME, IMPACT_SPEED, STRUCK_SPEED}
    for name in result:
        if name not in names:
            raise code.wrong(
                "simulate",
                f"a result without a trace, with {name!r}",
                f"names of metrics: {', '.join(sorted(names))}",
            )
    # The share of unsafe runs follows from all runs of a setting.
    known_names = {UNSAFE_SHARE.name, *result}
    scoring = system.measuring.scoring
    for objective in scoring.objectives:
        if objective in scoring.metrics and objective.name not in known_names:
            raise code.wrong(
                "simulate",
                f"a result without a trace and without {objective.name}",
                "each metric that is an objective of the study",
            )


def _runs_of(
    results: Sequence[StatedRun], system: System, allowed_impact_speed: float
) -> SimulationRuns:
    """The runs of N results. Each run has its own number of samples; 0 for a result without a
    trace.
    """
    # Metrics of a result with a trace follow from the trace; other results state their metrics.
    traces = [result if TIME in result else {} for result in results]
    rigs = [{} if TIME in result else result for result in results]
    times = next((trace[TIME] for trace in traces if trace), np.zeros(2))
    step = float(times[1] - times[0])
    lengths = np.array([len(trace.get(TIME, ())) for trace in traces])
    samples = np.arange(lengths.max())

    def column(name: str) -> FloatArray:
        """A quantity of all runs, shape (T, N). It is NaN in a run that lacks this quantity; after
        the end of a run its last value stays.
        """
        values = nans((len(samples), len(traces)))
        for row, trace in enumerate(traces):
            if name in trace:
                values[:, row] = trace[name][np.minimum(samples, lengths[row] - 1)]
        return values

    def number(name: str, records: Sequence[StatedRun] = results) -> FloatArray:
        """The number that each record states under a name, shape (N,); NaN without it."""
        return np.array([record.get(name, np.nan) for record in records], float)

    outcome = np.array([result[OUTCOME] for result in results], dtype="U16")
    collided = outcome == Outcome.COLLISION
    struck = np.nan_to_num(number(STRUCK_SPEED))
    impact = np.where(
        np.isnan(number(IMPACT_SPEED)), -number(SAFETY_DEGREE), number(IMPACT_SPEED)
    )
    closing_speed = np.maximum(impact - struck, LEAST_COLLISION_SPEED)
    stated_values = {name: number(name, rigs) for name in system.measuring.measures}
    stated_values["impact_speed"] = np.where(collided, closing_speed, np.nan)
    stated_values["impact_excess"] = np.where(
        collided, closing_speed - allowed_impact_speed, number("impact_excess", rigs)
    )

    columns: dict[str, Any] = {name: column(name) for name in ("speed", *ALSO_SAMPLED)}
    closing = columns["speed"] - columns["obstacle_speed"]
    separation = column("separation")
    nothing = np.zeros(closing.shape)
    return SimulationRuns(
        trace=Trace(
            step=step,
            vehicle_length=0.0,
            time=samples * step,
            lateral=nothing,
            lateral_speed=nothing,
            gear=nothing,
            active=samples[:, np.newaxis] < lengths,
            **columns,
        ),
        encounter=Encounter(
            separation, columns["gap"], closing, np.isfinite(separation)
        ),
        outcome=outcome,
        collision_speed=np.where(collided, impact, np.nan),
        contact=NO_CONTACT._replace(speed=struck),
        allowed_impact_speed=np.array(allowed_impact_speed),
        lacks={
            name: np.array([name not in trace for trace in traces])
            for name in QUANTITIES
        },
        stated=stated_values,
    )


def joined(
    evaluations: Evaluations, repeats: int, criterion: Unsafe = COLLISION
) -> Evaluations:
    """Join the evaluations of N settings that were simulated in `repeats` rounds, one round after
    another, into one evaluation for each setting.

    It has the worst outcome of all rounds; the safety degree and the collision speed of the run
    with the least safety degree; the share of runs that are unsafe by `criterion`; and of each
    other metric the mean over the runs that define it. The safety degree and metrics that not every
    study has are also kept for each round (`NAME_1`, `NAME_2`, ...).
    """
    n = len(evaluations) // repeats
    columns = np.arange(n)

    def mean(values: FloatArray) -> FloatArray:
        rounds = values.reshape(repeats, n)
        number = np.count_nonzero(~np.isnan(rounds), axis=0)
        total = np.add.reduce(np.nan_to_num(rounds, nan=0.0), axis=0)
        return np.where(number, total / np.maximum(number, 1), np.nan)

    outcomes = evaluations.outcome.reshape(repeats, n)
    ranks = [SEVERITY.index(outcome) for outcome in evaluations.outcome.tolist()]
    severity = np.reshape(ranks, (repeats, n))
    degrees = evaluations.f_safe.reshape(repeats, n)
    worst = np.argmin(np.where(np.isnan(degrees), np.inf, degrees), axis=0)
    metrics = {name: mean(values) for name, values in evaluations.metrics.items()}
    metrics[SAFETY_DEGREE] = degrees[worst, columns]

    # The share of unsafe runs is no criterion for one run.
    is_of_shares = criterion.measure == UNSAFE_SHARE.name
    is_unsafe = (COLLISION if is_of_shares else criterion).of(evaluations)
    metrics[UNSAFE_SHARE.name] = mean(is_unsafe.astype(float))
    means_alone = {*METRICS, UNSAFE_SHARE.name} - {SAFETY_DEGREE}
    rounds = {}
    for name, values in evaluations.metrics.items():
        if name not in means_alone:
            for number, row in enumerate(values.reshape(repeats, n), 1):
                rounds[f"{name}_{number}"] = row
    return replace(
        evaluations.take(worst * n + columns),
        outcome=outcomes[np.argmin(severity, axis=0), columns],
        metrics={**metrics, **rounds},
    )
