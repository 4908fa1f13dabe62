"""Finds the moment at which a vehicle begins to brake for an obstacle."""

from __future__ import annotations

import numpy as np

from safevar_sumo.records import STANDSTILL, SimulationRuns

CRUISE_SHARE = 0.9
"""A vehicle cruises at this share of its highest speed or more [-]."""
REGULATION_SHARE = 0.05
"""With less than this share of its largest brake command, a vehicle only regulates its speed [-].
"""


def brake_onset(runs: SimulationRuns, column: int) -> int | None:
    """The number of the sample at which vehicle `column` begins to brake for the obstacle, before
    the obstacle is nearest; None if the vehicle does not brake, or if its simulator states no brake
    commands.

    A braking manoeuvre has brake commands of at least `REGULATION_SHARE` times the largest command.
    It begins where the command starts to rise to this size, and ends where the throttle or a
    smaller brake command regulates the speed again. The manoeuvre that counts is

    1. the manoeuvre in which the speed falls below `CRUISE_SHARE` of the highest speed for the last
       time: earlier manoeuvres, such as those of a cruise control after an overshoot, did not slow
       the vehicle down;
    2. otherwise the first manoeuvre after that; 3. otherwise no manoeuvre if the vehicle collides,
    and its last manoeuvre if it does not.
    """
    # Only samples until the obstacle is nearest count.
    if runs.lacking("brake")[column]:
        return None
    trace = runs.trace
    nearest_sample = runs.nearest(column)
    active = trace.active[
        : None if nearest_sample is None else nearest_sample + 1, column
    ]
    speed = np.where(active, trace.speed[: len(active), column], 0.0)
    brake = np.where(speed > STANDSTILL, trace.brake[: len(active), column], 0.0)

    is_braking = (brake > 0) & (brake >= REGULATION_SHARE * brake.max())
    braking_samples = np.flatnonzero(is_braking)
    last_cruise = np.flatnonzero(speed >= CRUISE_SHARE * speed.max())[-1]
    later_samples = braking_samples[braking_samples >= last_cruise]
    if not braking_samples.size or (
        not later_samples.size and np.isfinite(runs.collision_speed[column])
    ):
        return None
    # This sample lies in the manoeuvre that counts.
    sample = later_samples[0] if later_samples.size else braking_samples[-1]

    # The manoeuvre begins after the last sample in which pedals only regulate the speed.
    regulation = np.flatnonzero(
        ((trace.throttle[:sample, column] > 0) | (brake[:sample] > 0))
        & ~is_braking[:sample]
    )
    end = regulation[-1] if regulation.size else 0
    onset = int(braking_samples[braking_samples >= end][0])
    # The command may have begun to rise while it was still small: go back to this beginning.
    while onset > 0 and brake[onset - 1] > (brake[onset - 2] if onset > 1 else 0):
        onset -= 1
    return onset
