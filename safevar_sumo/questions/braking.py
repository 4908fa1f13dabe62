"""When a vehicle begins to brake for an obstacle."""

from __future__ import annotations

import numpy as np

from safevar_sumo.records import STANDSTILL, SimulationRuns

CRUISE_SHARE = 0.9
"""A vehicle cruises at this share of its highest speed or more [-]."""
REGULATION_SHARE = 0.05
"""With less than this share of its largest brake command, a vehicle only regulates its speed [-].
"""


def brake_onset(runs: SimulationRuns, column: int) -> int | None:
    """The sample at which vehicle `column` begins to brake for the obstacle, before the obstacle is
    nearest; None if it does not brake, or if its simulator does not say.

    A braking manoeuvre has brake commands of at least `REGULATION_SHARE` times the largest one. It
    begins where the command starts to rise towards that, and ends where the throttle or a smaller
    brake command regulates the speed again. The manoeuvre that counts is

    1. the one in which the speed falls below `CRUISE_SHARE` of the highest speed for the last time,
       as earlier manoeuvres, such as those of a cruise control after an overshoot, did not slow the
       vehicle down;
    2. otherwise the first one after that;
    3. otherwise none if the vehicle collides, and its last one if it does not.
    """
    # Speed and brake until the obstacle is nearest.
    if runs.lacking("brake")[column]:
        return None
    trace = runs.trace
    nearest_sample = runs.nearest(column)
    active = trace.active[
        : None if nearest_sample is None else nearest_sample + 1, column
    ]
    speed = np.where(active, trace.speed[: len(active), column], 0.0)
    brake = np.where(speed > STANDSTILL, trace.brake[: len(active), column], 0.0)

    # Braking that belongs to the manoeuvre, after the last cruise.
    is_braking = (brake > 0) & (brake >= REGULATION_SHARE * brake.max())
    braking_samples = np.flatnonzero(is_braking)
    last_cruise = np.flatnonzero(speed >= CRUISE_SHARE * speed.max())[-1]
    later_samples = braking_samples[braking_samples >= last_cruise]
    if not braking_samples.size or (
        not later_samples.size and np.isfinite(runs.collision_speed[column])
    ):
        return None
    # A sample of the manoeuvre that counts.
    sample = later_samples[0] if later_samples.size else braking_samples[-1]

    # Where the pedals no longer regulate the speed, the brake begins to rise.
    regulation = np.flatnonzero(
        ((trace.throttle[:sample, column] > 0) | (brake[:sample] > 0))
        & ~is_braking[:sample]
    )
    end = regulation[-1] if regulation.size else 0
    onset = int(braking_samples[braking_samples >= end][0])
    # The command already rises.
    while onset > 0 and brake[onset - 1] > (brake[onset - 2] if onset > 1 else 0):
        onset -= 1
    return onset
