"""The conflict with who is in the vehicle's path or comes into it, along that path."""

from __future__ import annotations

import numpy as np

from safevar_sumo.records import FloatArray, SimulationRuns

PATH_TOLERANCE = 1e-6
"""Margin of the vehicle's path [m]: a body that is exactly at its edge is in it."""


def conflict(runs: SimulationRuns) -> tuple[FloatArray, FloatArray]:
    """The closing speed along the vehicle's path [m/s], and the time to collision along it [s];
    shape (T, N) each.

    TTC_p(t) = gap / (v - u), with the speeds v and u of the vehicle and of the other body along the
    path. The other body is in the path, or will be when the vehicle reaches it at these speeds.
    TTC_p is infinite at all other samples, and where the gap does not shrink or TTC(t) does not
    count.

    The speed across the path of somebody who crosses changes neither the gap nor this closing
    speed. Behind a leader, who never leaves the path, TTC_p(t) is TTC(t).
    """
    trace = runs.trace
    reach = (trace.vehicle_width + trace.obstacle_width) / 2 + PATH_TOLERANCE
    is_in_path = np.abs(trace.lateral) <= reach

    # The time until the vehicle reaches the body, and where the body is then.
    closing_speed = trace.speed - trace.obstacle_speed
    is_counted = runs.is_approach & (closing_speed > 0) & (trace.gap >= 0) & np.isfinite(trace.gap)
    ttc = np.divide(trace.gap, closing_speed, out=np.zeros_like(trace.gap), where=is_counted)
    at_arrival = trace.lateral + trace.lateral_speed * ttc
    is_met = is_in_path | (np.abs(at_arrival) <= reach)
    ttc = np.where(is_counted & is_met, ttc, np.inf)

    # Behind a leader, and wherever else the distance is the gap, it is TTC(t).
    is_led = ~(runs.is_approach & ~is_in_path).any(axis=0)
    is_one = is_led | (runs.encounter.distance == trace.gap)
    closing_speed = np.where(is_one, runs.encounter.closing_speed, closing_speed)
    return closing_speed, np.where(is_one, runs.time_to_collision, ttc)
