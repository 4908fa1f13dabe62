"""Runs that go on beyond their scenario's time, as their vehicle still closes on somebody."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np

from safevar_sumo.records import (
    BoolArray,
    Contact,
    Encounter,
    FloatArray,
    IntArray,
    Outcome,
    SimulationRuns,
)
from safevar_sumo.scenarios import Point
from safevar_sumo.sumo.drive import last_sample_of
from safevar_sumo.sumo.system import System

OVERTIME = 30.0
"""How much longer a run may take whose vehicle would touch somebody by then [s]."""
STEADY = 0.05
"""Closing speed up to which a vehicle follows somebody [m/s]."""


def are_closing(on_road: System, runs: SimulationRuns) -> BoolArray:
    """Which runs at K points were ended by their time, shape (K * N,), while the vehicle closed on
    somebody in its way: their clearance would be that of a moment before the encounter has ended.
    """
    # The last sample of a run that is over, or that has stopped early, is none of its time's.
    size = len(runs.outcome) // len(on_road.points)
    ends = [np.zeros(size) + last_sample_of(point, runs.trace.step) for point in on_road.points]
    last = runs.trace.last_active
    is_late = (last == np.round(np.concatenate(ends))) & ~np.isin(
        runs.outcome, (Outcome.COLLISION, Outcome.INVALID_TEST)
    )

    # At its closing speed it would touch within the time that is added.
    sample = last, np.arange(len(last))
    closing_speed = runs.encounter.closing_speed[sample]
    distance = runs.encounter.distance[sample]
    is_met = runs.encounter.in_conflict[sample] & (distance >= 0)
    is_near = (closing_speed > STEADY) & (distance < OVERTIME * closing_speed)
    return is_late & is_met & is_near


def finished(
    system: System,
    settings: FloatArray,
    runs: SimulationRuns,
    drive_again: Callable[[System, FloatArray], SimulationRuns],
    *,
    together: bool,
) -> SimulationRuns:
    """The runs of N settings, shape (N, n), at every point: those that still close are driven again
    with more time; with `together`, among all others at their point.
    """
    closing = are_closing(system.at_encounters(system.cut(settings)[1]), runs)
    n = len(settings)
    for number in np.unique(np.flatnonzero(closing) // n):
        longer = with_overtime(system, system.points[number])
        rows = np.flatnonzero(closing[number * n :][:n])
        if together:
            again = drive_again(longer, settings).of(rows)
        else:
            again = drive_again(longer, settings[rows])
        runs = with_runs(runs, number * n + rows, again)
    return runs


def with_overtime(system: System, point: Point) -> System:
    """The system at one of its points, with more time there."""
    return replace(system, matrix=(point._replace(overtime=OVERTIME),), rater=None)


def with_runs(runs: SimulationRuns, rows: IntArray, others: SimulationRuns) -> SimulationRuns:
    """Runs, with others in place of some; both are of vehicles driven in the same way."""
    longest = max(runs.trace.time, others.trace.time, key=len)

    def put(values: np.ndarray, new: np.ndarray) -> np.ndarray:
        if values.ndim == 2:  # what is written after the end of a run does not count
            values, new = (_padded(column, len(longest)) for column in (values, new))
        if values.ndim:
            values = values.copy()
            values[..., rows] = new
        return values

    def columns(these: Any, those: Any) -> dict[str, Any]:
        pairs = {
            item.name: (getattr(these, item.name), getattr(those, item.name))
            for item in fields(these)
            if item.name != "time"
        }
        return {name: put(*pair) for name, pair in pairs.items() if isinstance(pair[0], np.ndarray)}

    return replace(
        runs,
        **columns(runs, others),
        trace=replace(runs.trace, time=longest, **columns(runs.trace, others.trace)),
        encounter=Encounter._make(map(put, runs.encounter, others.encounter)),
        contact=Contact._make(map(put, runs.contact, others.contact)),
    )


def _padded(column: np.ndarray, samples: int) -> np.ndarray:
    """A column of samples, continued by its last values, or by False."""
    more = ((0, samples - len(column)), (0, 0))
    return np.pad(column, more) if column.dtype == bool else np.pad(column, more, mode="edge")
