"""Measures of stops and impacts. The law judges a vehicle by them: UN R13-H, UN R152."""

from __future__ import annotations

import numpy as np

from safevar_sumo.metrics.base import Measure, mask_collisions
from safevar_sumo.metrics.measures import safety_degree
from safevar_sumo.records import (
    LEAST_COLLISION_SPEED,
    STANDSTILL,
    FloatArray,
    SimulationRuns,
)
from safevar_sumo.study import MetricsTable

PEDAL_ROUNDING = 1e-6
"""Changes of the pedal's position up to this one are rounding errors of the brake's delay [-]."""


# Vehicles that do not brake divide by 0.
@np.errstate(all="ignore")
def stopping_distance(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Distance from the first brake force to standstill [m], shape (N,); NaN for a vehicle that
    does not brake or does not stop.

    Samples are a step apart. `pedal[t]` is the position of the brake pedal that acted in the step
    from sample t - 1 to sample t. If the brake's dead time ends inside this step, `pedal[t]` is the
    mean over the step, and brake force acts only in the last part of the step.
    """
    trace = runs.trace
    pedal = np.broadcast_to(trace.pedal, trace.speed.shape)
    vehicles = np.arange(trace.speed.shape[1])
    is_pressed = pedal > pedal[0] + PEDAL_ROUNDING
    # The first step with brake force ends at this sample.
    end = np.argmax(is_pressed, axis=0)
    # The samples at the beginning of this step, at its end, and a step later.
    samples = np.clip([end - 1, end, end + 1], 0, len(pedal) - 1)

    # The share of this step in which brake force acts. The share is 1, unless the pedal has only a
    # part of the first command in this step, and the whole command in the next step: then the share
    # is part / full. Where tyres limit the force, the ratio of the losses of speed is larger than
    # part / full, and says more.
    first_sample = np.argmax(trace.brake > pedal[0] + PEDAL_ROUNDING, axis=0)
    first_command = trace.brake[first_sample, vehicles]
    _, part, full = pedal[samples, vehicles]
    loss, next_loss = -np.diff(trace.speed[samples, vehicles], axis=0)
    is_whole_command = np.abs(full - first_command) <= PEDAL_ROUNDING
    is_part = (part < full) & is_whole_command & (next_loss > 0)
    ratio = np.maximum(part / full, loss / next_loss)
    share = np.where(is_part, np.minimum(ratio, 1.0), 1.0)

    step_begin, step_end, _ = trace.position[samples, vehicles]
    distance = trace.position[-1] - step_end + share * (step_end - step_begin)
    return _mask_unstopped(runs, np.where(is_pressed.any(axis=0), distance, np.nan))


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


def _mask_unstopped(runs: SimulationRuns, values: FloatArray) -> FloatArray:
    """The values of vehicles, shape (N,), with NaN for a vehicle that has not stopped or has
    collided.
    """
    has_stopped = runs.trace.speed[-1] <= STANDSTILL
    return mask_collisions(runs, np.where(has_stopped, values, np.nan))


def stop_from_pedal(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Distance from the first command to brake to standstill [m], shape (N,); NaN for a vehicle
    that does not brake or does not stop.
    """
    trace = runs.trace
    is_commanded = trace.brake > 0
    begin = np.argmax(is_commanded, axis=0)
    distance = trace.position[-1] - trace.position[begin, np.arange(len(begin))]
    return _mask_unstopped(runs, np.where(is_commanded.any(axis=0), distance, np.nan))


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
"""The mean fully developed deceleration is taken between these two shares of the first speed."""


# Vehicles that do not stop divide by 0.
@np.errstate(all="ignore")
def mean_fully_developed_deceleration(
    runs: SimulationRuns, thresholds: MetricsTable
) -> FloatArray:
    """Mean fully developed deceleration of UN R13-H [m/s^2], shape (N,); NaN for a vehicle that
    does not stop.

    The deceleration is (v_b^2 - v_e^2) / (2 (s_e - s_b)). The speed is v_b, 80 % of the first
    speed, at the place s_b, and v_e, 10 % of the first speed, at the place s_e. Both places are
    interpolated in the square of the speed, which is linear over the way while the deceleration is
    constant.
    """
    trace = runs.trace
    squares = trace.speed * trace.speed
    end_squares = np.square(MFDD_SHARES)[:, np.newaxis] * squares[0]
    vehicles = zip(end_squares.T, squares.T, trace.position.T, strict=True)
    # `np.interp` needs ascending values, but the speed falls: hence the minus signs.
    places = [
        np.interp(-ends, -square, position) for ends, square, position in vehicles
    ]
    begin_places, end_places = np.transpose(places)
    first_squares, last_squares = end_squares
    ways = end_places - begin_places
    return _mask_unstopped(runs, (first_squares - last_squares) / (2 * ways))


MFDD = Measure(
    name="mfdd",
    title="MFDD",
    unit="m/s^2",
    function=mean_fully_developed_deceleration,
    needs=("speed", "position"),
    description="Mean fully developed deceleration, between 80 and 10 % of the first speed.",
)


def impact_speed(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Relative speed at contact along the vehicle's lane [m/s], shape (N,), at least
    `LEAST_COLLISION_SPEED`; NaN for a vehicle that does not collide.
    """
    return np.maximum(runs.relative_speed, LEAST_COLLISION_SPEED)


IMPACT_SPEED = Measure(
    name="impact_speed",
    title="impact speed",
    unit="m/s",
    more_is_unsafe=True,
    function=impact_speed,
    description="Relative speed at contact along the vehicle's lane [m/s].",
)


def impact_excess(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """How bad an encounter is, shape (N,): after a contact the relative speed minus the speed that
    the test case allows [m/s]; without a contact the least clearance with a minus sign [m]; NaN if
    nobody was met.
    """
    excess = impact_speed(runs, thresholds) - runs.allowed_impact_speed
    # Some scenarios measure between middles of bodies: a clearance is between their bumpers.
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
