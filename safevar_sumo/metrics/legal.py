"""Measures of stops and impacts, by which the law judges a vehicle: UN R13-H, UN R152."""

from __future__ import annotations

import numpy as np

from safevar_sumo.metrics.base import Measure, mask_collisions
from safevar_sumo.metrics.measures import safety_degree
from safevar_sumo.records import (
    LEAST_CLOSING_SPEED,
    STANDSTILL,
    FloatArray,
    SimulationRuns,
)
from safevar_sumo.study import MetricsTable

PEDAL_ROUNDING = 1e-6
"""Change of the brake pedal that is a rounding error of its delay [-]."""


# Vehicles that do not brake divide by 0.
@np.errstate(all="ignore")
def stopping_distance(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Distance from the first brake force to standstill [m]; shape (N,), NaN for a vehicle that
    does not brake or stop.

    A sample's pedal acts in the step before it. A dead time of the brake may end inside that step.
    """
    trace = runs.trace
    pedal = np.broadcast_to(trace.pedal, trace.speed.shape)
    vehicles = np.arange(trace.speed.shape[1])
    is_pressed = pedal > pedal[0] + PEDAL_ROUNDING
    end = np.argmax(is_pressed, axis=0)
    samples = np.clip([end - 1, end, end + 1], 0, len(pedal) - 1)

    # The share of this step with brake force is 1 unless the pedal has a part of the first command
    # there and all of it a step later. The loss of speed says more where tyres limit the force.
    first_command = trace.brake[
        np.argmax(trace.brake > pedal[0] + PEDAL_ROUNDING, axis=0), vehicles
    ]
    _, part, full = pedal[samples, vehicles]
    loss, later_loss = -np.diff(trace.speed[samples, vehicles], axis=0)
    is_part = (
        (part < full)
        & (np.abs(full - first_command) <= PEDAL_ROUNDING)
        & (later_loss > 0)
    )
    shares = np.maximum(part / full, loss / later_loss)
    share = np.where(is_part, np.minimum(shares, 1.0), 1.0)

    step_begin, step_end, _ = trace.position[samples, vehicles]
    distance = trace.position[-1] - step_end + share * (step_end - step_begin)
    return _of_stops(runs, np.where(is_pressed.any(axis=0), distance, np.nan))


STOPPING_DISTANCE = Measure(
    name="stopping_distance",
    title="stop",
    unit="m",
    more_is_unsafe=True,
    function=stopping_distance,
    needs=("speed", "position", "brake", "pedal"),
    description=(
        "Distance from the first brake force to standstill (in every study of the scenario stop)."
    ),
)


def _of_stops(runs: SimulationRuns, values: FloatArray) -> FloatArray:
    """Values of vehicles that have stopped, shape (N,), NaN for others."""
    return mask_collisions(
        runs, np.where(runs.trace.speed[-1] <= STANDSTILL, values, np.nan)
    )


def stop_from_pedal(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Distance from the first command to brake to standstill [m]; shape (N,), NaN for a vehicle
    that does not brake or stop.
    """
    trace = runs.trace
    is_commanded = trace.brake > 0
    begin = np.argmax(is_commanded, axis=0)
    distance = trace.position[-1] - trace.position[begin, np.arange(len(begin))]
    return _of_stops(runs, np.where(is_commanded.any(axis=0), distance, np.nan))


STOP_FROM_PEDAL = Measure(
    name="stop_from_pedal",
    title="stop from pedal",
    unit="m",
    more_is_unsafe=True,
    function=stop_from_pedal,
    needs=("speed", "position", "brake"),
    description="Distance from the first command to brake to standstill, with the brake's delay.",
)


MFDD_SHARES = 0.8, 0.1
"""Shares of the first speed between which the mean fully developed deceleration counts."""


# Vehicles that do not stop divide by 0.
@np.errstate(all="ignore")
def mean_fully_developed_deceleration(
    runs: SimulationRuns, thresholds: MetricsTable
) -> FloatArray:
    """Mean fully developed deceleration of UN R13-H, (v_b^2 - v_e^2) / (2 (s_e - s_b)) [m/s^2],
    with the places s_b and s_e where the speed is 80 and 10 % of the first one; shape (N,), NaN for
    a vehicle that does not stop.

    With a constant deceleration in a step, squares of speeds are linear over the way.
    """
    trace = runs.trace
    squares = trace.speed * trace.speed
    end_squares = np.square(MFDD_SHARES)[:, None] * squares[0]
    columns = zip(end_squares.T, squares.T, trace.position.T, strict=True)
    places = np.array(
        [np.interp(-levels, -square, way) for levels, square, way in columns]
    )
    ways = 2 * (places[:, 1] - places[:, 0])
    return _of_stops(runs, (end_squares[0] - end_squares[1]) / ways)


MFDD = Measure(
    name="mfdd",
    title="MFDD",
    unit="m/s^2",
    function=mean_fully_developed_deceleration,
    needs=("speed", "position"),
    description="Mean fully developed deceleration, between 80 and 10 % of the first speed.",
)


def impact_speed(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Relative speed at contact along the vehicle's lane [m/s], at least `LEAST_CLOSING_SPEED`;
    shape (N,), NaN without a collision.
    """
    return np.maximum(runs.relative_speed, LEAST_CLOSING_SPEED)


IMPACT_SPEED = Measure(
    name="impact_speed",
    title="impact speed",
    unit="m/s",
    more_is_unsafe=True,
    function=impact_speed,
    description="Relative speed at contact along the vehicle's lane [m/s].",
)


def impact_excess(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Relative speed at contact above the one that the test case allows [m/s]; without a contact
    minus the least clearance [m]. Shape (N,), NaN where there was no encounter.
    """
    excess = impact_speed(runs, thresholds) - runs.allowed_impact_speed
    clearance = safety_degree(runs, thresholds) - runs.middles_apart
    return np.where(np.isnan(runs.collision_speed), -clearance, excess)


IMPACT_EXCESS = Measure(
    name="impact_excess",
    title="impact excess",
    unit="m/s, m",
    more_is_unsafe=True,
    function=impact_excess,
    description=(
        "Relative speed at contact above the allowed speed of the test case [m/s], or minus the"
        " clearance [m] without a contact."
    ),
)
