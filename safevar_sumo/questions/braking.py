"""Finds the moment at which a vehicle begins to brake for an obstacle."""

from __future__ import annotations

import numpy as np

from safevar_sumo.records import STANDSTILL, BoolArray, FloatArray, SimulationRuns

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
    if runs.lacking("brake")[column]:
        return None
    # Only samples until the obstacle is nearest count.
    nearest_sample = runs.nearest(column)
    samples = slice(None if nearest_sample is None else nearest_sample + 1)
    place = samples, column
    trace = runs.trace
    is_active = trace.active[place]
    speed = np.where(is_active, trace.speed[place], 0.0)
    brake = np.where(speed > STANDSTILL, trace.brake[place], 0.0)
    is_braking = (brake > 0) & (brake >= REGULATION_SHARE * brake.max())
    has_collided = bool(np.isfinite(runs.collision_speed[column]))
    sample = find_manoeuvre(speed, is_braking, has_collided)
    if sample is None:
        return None

    # The manoeuvre begins after the last sample in which pedals only regulate the speed.
    is_pressed = (brake > 0) | (trace.throttle[place] > 0)
    (regulation,) = np.nonzero((is_pressed & ~is_braking)[:sample])
    end = int(regulation[-1]) if regulation.size else 0
    onset = end + int(is_braking[end:].argmax())
    # The command may have begun to rise while it was still small: go back to this beginning.
    is_rising = np.diff(brake, prepend=0.0) > 0
    while onset > 0 and is_rising[onset - 1]:
        onset -= 1
    return onset


def find_manoeuvre(
    speed: FloatArray, is_braking: BoolArray, has_collided: bool
) -> int | None:
    """A sample of the braking manoeuvre that counts, as `brake_onset` defines it; None without."""
    braking_samples = np.flatnonzero(is_braking)
    last_cruise = np.flatnonzero(speed >= CRUISE_SHARE * speed.max())[-1]
    later_samples = braking_samples[braking_samples >= last_cruise]
    if later_samples.size:
        return int(later_samples[0])
    if has_collided or not braking_samples.size:
        return None
    return int(braking_samples[-1])
