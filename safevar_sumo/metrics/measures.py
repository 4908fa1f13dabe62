"""The safety metrics of the published study (method section 4; Minderhoud and Bovy 2001), and a
rating's points.

Metrics of longitudinal comfort follow, which a study has only if it names them: jerk, weighted
acceleration, harsh braking.
"""

from __future__ import annotations

import numpy as np

from safevar_sumo.metrics.base import Measure, mask_collisions, sampling_stride, sum_in_order
from safevar_sumo.metrics.conflicts import conflict
from safevar_sumo.records import (
    LEAST_CLOSING_SPEED,
    STANDSTILL,
    TIME_DECIMALS,
    BoolArray,
    FloatArray,
    Outcome,
    SimulationRuns,
)
from safevar_sumo.study import SAFETY_DEGREE, MetricsTable


def safety_degree(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Least separation during the encounter [m, > 0], or minus the closing speed of the collision
    [m/s, < 0].

    Shape (N,); NaN where there was neither an encounter nor a collision.
    """
    is_counted = runs.trace.active & runs.encounter.in_conflict
    least_separation = np.min(np.where(is_counted, runs.encounter.separation, np.inf), axis=0)
    least_separation = np.where(np.isfinite(least_separation), least_separation, np.nan)
    return np.where(np.isnan(runs.collision_speed), least_separation, -runs.closing_speed)


SAFETY_DEGREE_METRIC = Measure(
    name=SAFETY_DEGREE,
    title="SD",
    unit="m, or -m/s",
    function=safety_degree,
    description=(
        "Least separation during the encounter [m, > 0], or minus a collision's closing speed [m/s,"
        " < 0]."
    ),
)


def time_to_collision(runs: SimulationRuns) -> FloatArray:
    """TTC(t) = L_s / v_L, the distance between both over the speed at which it shrinks [s]; shape
    (T, N).

    Infinite while the distance does not shrink, outside the encounter, and once the vehicle has
    stopped after moving. The distance is that of the published data (method section 4): it also
    shrinks by the speed of who crosses the path. `conflicts.conflict` is along the path alone.
    """
    return runs.time_to_collision


def time_exposed(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """TET* = sum of dt over the samples with 0 <= TTC(t) <= TTC* [s]; shape (N,), NaN on a
    collision.
    """
    critical_ttc, interval = _critical_ttc(runs, thresholds)
    return mask_collisions(
        runs,
        np.round(np.count_nonzero(np.isfinite(critical_ttc), axis=0) * interval, TIME_DECIMALS),
    )


def time_integrated(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """TIT* = sum of (TTC* - TTC(t)) dt over the samples of TET* [s^2]; shape (N,), NaN on a
    collision.
    """
    critical_ttc, interval = _critical_ttc(runs, thresholds)
    deficit = np.where(np.isfinite(critical_ttc), thresholds.ttc_threshold - critical_ttc, 0.0)
    return mask_collisions(runs, sum_in_order(deficit) * interval)


def _critical_ttc(runs: SimulationRuns, thresholds: MetricsTable) -> tuple[FloatArray, float]:
    """TTC at every sample, infinite where it is not critical; and the time between two samples
    [s].
    """
    stride = sampling_stride(runs.trace.step, thresholds.sampling_interval)
    ttc = time_to_collision(runs)[::stride]
    return np.where(ttc <= thresholds.ttc_threshold, ttc, np.inf), stride * runs.trace.step


TET = Measure(
    name="tet",
    title="TET",
    unit="s",
    more_is_unsafe=True,
    over_collisions=False,
    function=time_exposed,
    description=(
        "TET* = sum of dt over the samples with 0 <= TTC(t) <= TTC* [s]; TTC(t) = L_s / v_L, "
        "the distance between both over the speed at which it shrinks; another TTC than that of "
        "ttc_min and drac."
    ),
)
TIT = Measure(
    name="tit",
    title="TIT",
    unit="s^2",
    more_is_unsafe=True,
    over_collisions=False,
    function=time_integrated,
    description=(
        "TIT* = sum of (TTC* - TTC(t)) dt over the same samples [s^2], with the TTC of TET."
    ),
)


def least_time_to_collision(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """The least TTC_p(t) [s] (Hayward 1972); shape (N,), NaN on a collision, and for a vehicle that
    approaches nobody in its path.
    """
    _, ttc = conflict(runs)
    least = np.min(ttc, axis=0, initial=np.inf)
    return mask_collisions(runs, np.where(np.isfinite(least), least, np.nan))


def largest_deceleration_rate(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """The largest deceleration that would just avoid the collision, (v - u)^2 / (2 gap), which is
    (v - u) / (2 TTC_p) [m/s^2] (Cooper and Ferguson 1976; DRAC of SUMO's SSM device), over the
    samples with a TTC_p; shape (N,), NaN as for the least TTC_p.

    Behind a leader, TTC and DRAC are the device's. With who crosses they are other quantities, and
    not compared: the device predicts at which constant speeds both enter and leave the place that
    two lanes share, and has a TTC only where one enters before the other has left.
    """
    closing_speed, ttc = conflict(runs)
    is_counted = np.isfinite(ttc) & (ttc > 0)
    rate = np.divide(closing_speed, 2 * ttc, out=np.full_like(ttc, np.nan), where=is_counted)
    largest = np.max(np.where(is_counted, rate, 0.0), axis=0, initial=0.0)
    return mask_collisions(runs, np.where(is_counted.any(axis=0), largest, np.nan))


TTC_MIN = Measure(
    name="ttc_min",
    title="least TTC along the path",
    unit="s",
    more_is_unsafe=False,
    over_collisions=False,
    function=least_time_to_collision,
    description=(
        "Least TTC_p(t) = gap / (v - u) [s], both along the vehicle's path, to a body that is in "
        "it or comes into it; another TTC than that of TET and TIT; without a collision."
    ),
)
DRAC = Measure(
    name="drac",
    title="DRAC",
    unit="m/s^2",
    more_is_unsafe=True,
    over_collisions=False,
    function=largest_deceleration_rate,
    description=(
        "Largest deceleration rate to avoid the crash, (v - u)^2 / (2 gap) [m/s^2], with the gap "
        "and the speeds of ttc_min; without a collision."
    ),
)


def post_encroachment_time(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Time from the first one's leaving the place that both paths share to the second one's
    entering it [s] (Allen, Shin and Cooper 1978); shape (N,), NaN unless the vehicle and a body
    that crosses pass without a stop.

    The run ends when the first one has left: the body the vehicle's path, or the vehicle's rear the
    body's. The second one arrives at its speed then. PET of SUMO's SSM device takes lanes for
    bodies: it is shorter by the share of both widths that lanes are wider.
    """
    trace = runs.trace

    # Where both are in the last sample of the run.
    number = np.count_nonzero(trace.active, axis=0)
    at_end = np.minimum(number, len(trace.time) - 1), np.arange(len(number))
    speed, gap, lateral, lateral_speed, obstacle_width = (
        np.broadcast_to(column, trace.speed.shape)[at_end]
        for column in (
            trace.speed,
            trace.gap,
            trace.lateral,
            trace.lateral_speed,
            trace.obstacle_width,
        )
    )

    # Who leaves the shared place last, and how far the other one is from it.
    apart = np.abs(lateral) - (trace.vehicle_width + obstacle_width) / 2
    crossing = np.abs(lateral_speed)
    leaves = (lateral * lateral_speed > 0) & (gap > 0)
    comes = (lateral * lateral_speed < 0) & (gap <= 0)
    way = np.where(leaves, gap, apart)
    rate = np.where(leaves, speed, crossing)
    is_defined = (
        (runs.outcome == Outcome.PASSED) & (apart >= 0) & (leaves | comes) & (rate > STANDSTILL)
    )
    return np.asarray(np.divide(way, rate, out=np.full_like(way, np.nan), where=is_defined))


def reaction_time(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Time from the first sample at which nothing hides the body ahead to the first brake command
    from then on [s], as of a driver (Olson and Sivak 1986: perception-response time); shape (N,),
    NaN for a vehicle that sees nobody, or does not brake.
    """
    trace = runs.trace
    visible = trace.active & trace.visible
    first = np.argmax(visible, axis=0)
    has_seen = np.logical_or.accumulate(visible, axis=0)
    brakes = trace.active & has_seen & (trace.brake > 0)
    steps = np.argmax(brakes, axis=0) - first
    return np.where(brakes.any(axis=0), np.round(steps * trace.step, TIME_DECIMALS), np.nan)


PET = Measure(
    name="pet",
    title="PET",
    unit="s",
    over_collisions=False,
    function=post_encroachment_time,
    description=(
        "Post-encroachment time of a vehicle that passes who crosses; without a collision or a"
        " stop."
    ),
)
REACTION_TIME = Measure(
    name="reaction_time",
    title="reaction",
    unit="s",
    more_is_unsafe=True,
    function=reaction_time,
    description="Time from the first sight of the body ahead to the first brake command.",
)


def average_deceleration(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Mean deceleration over the samples in which the brake is commanded and the vehicle moves
    [m/s^2].

    Positive for a loss of speed; shape (N,); NaN for a vehicle that never braked.
    """
    stride = sampling_stride(runs.trace.step, thresholds.sampling_interval)
    speed = runs.trace.speed[::stride]
    active = runs.trace.active[::stride]
    is_braking = active & (runs.trace.brake[::stride] > 0) & (np.abs(speed) > STANDSTILL)
    decelerations = (speed[:-1] - speed[1:]) / (stride * runs.trace.step)
    is_counted = is_braking[1:]
    sample_count = np.count_nonzero(is_counted, axis=0)
    deceleration_sum = sum_in_order(np.where(is_counted, decelerations, 0.0))
    undefined = np.full_like(deceleration_sum, np.nan)
    return np.asarray(
        np.divide(deceleration_sum, sample_count, out=undefined, where=sample_count > 0)
    )


AVE_DECE = Measure(
    name="ave_dece",
    title="aveDece",
    unit="m/s^2",
    function=average_deceleration,
    description=(
        "Mean loss of speed per time over the samples in which the brake is commanded and the"
        " vehicle moves."
    ),
)


PEDAL_ROUNDING = 1e-6
"""Change of the brake pedal that is a rounding error of its delay [-]."""


def stopping_distance(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Distance from the first brake force to standstill [m]; shape (N,), NaN for a vehicle that
    does not brake or stop.

    A sample's pedal acts in the step before it.
    """
    trace = runs.trace
    pedal = np.broadcast_to(trace.pedal, trace.speed.shape)
    vehicles = np.arange(trace.speed.shape[1])
    is_pressed = pedal > pedal[0] + PEDAL_ROUNDING
    begin = np.maximum(np.argmax(is_pressed, axis=0) - 1, 0)
    distance = trace.position[-1] - trace.position[begin, vehicles]
    return _of_stops(runs, np.where(is_pressed.any(axis=0), distance, np.nan))


def _of_stops(runs: SimulationRuns, values: FloatArray) -> FloatArray:
    """Values of vehicles that have stopped, shape (N,), NaN for others."""
    return mask_collisions(runs, np.where(runs.trace.speed[-1] <= STANDSTILL, values, np.nan))


def stop_from_pedal(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Distance from the first command to brake to standstill [m]; shape (N,), NaN for a vehicle
    that does not brake or stop.
    """
    trace = runs.trace
    is_commanded = trace.brake > 0
    begin = np.argmax(is_commanded, axis=0)
    distance = trace.position[-1] - trace.position[begin, np.arange(len(begin))]
    return _of_stops(runs, np.where(is_commanded.any(axis=0), distance, np.nan))


MFDD_SHARES = 0.8, 0.1
"""Shares of the first speed between which the mean fully developed deceleration counts."""


@np.errstate(all="ignore")  # of vehicles that do not stop
def mean_fully_developed_deceleration(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Mean fully developed deceleration of UN R13-H, (v_b^2 - v_e^2) / (2 (s_e - s_b)) [m/s^2],
    with the places s_b and s_e where the speed is 80 and 10 % of the first one; shape (N,), NaN for
    a vehicle that does not stop.

    With a constant deceleration in a step, squares of speeds are linear over the way.
    """
    trace = runs.trace
    squares = trace.speed * trace.speed
    wanted = np.square(MFDD_SHARES)[:, np.newaxis] * squares[0]
    columns = zip(wanted.T, squares.T, trace.position.T, strict=True)
    places = np.array([np.interp(-levels, -square, way) for levels, square, way in columns])
    ways = 2 * (places[:, 1] - places[:, 0])
    return _of_stops(runs, (wanted[0] - wanted[1]) / ways)


STOP_FROM_PEDAL = Measure(
    name="stop_from_pedal",
    title="stop from pedal",
    unit="m",
    more_is_unsafe=True,
    function=stop_from_pedal,
    description="Distance from the first command to brake to standstill, with the brake's delay.",
)
MFDD = Measure(
    name="mfdd",
    title="MFDD",
    unit="m/s^2",
    function=mean_fully_developed_deceleration,
    description="Mean fully developed deceleration, between 80 and 10 % of the first speed.",
)
STOPPING_DISTANCE = Measure(
    name="stopping_distance",
    title="stop",
    unit="m",
    more_is_unsafe=True,
    function=stopping_distance,
    description=(
        "Distance from the first brake force to standstill; every study of the scenario stop"
        " has it."
    ),
)


def impact_speed(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Relative speed at contact along the vehicle's lane [m/s], at least `LEAST_CLOSING_SPEED`;
    shape (N,), NaN without a collision.
    """
    return np.asarray(np.maximum(runs.relative_speed, LEAST_CLOSING_SPEED))


def impact_excess(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Relative speed at contact above the one that the test case allows [m/s]; without a contact
    minus the least clearance [m]. Shape (N,), NaN where there was no encounter.
    """
    excess = impact_speed(runs, thresholds) - runs.allowed_impact_speed
    clearance = safety_degree(runs, thresholds) - runs.middles_apart
    return np.where(np.isnan(runs.collision_speed), -clearance, excess)


IMPACT_SPEED = Measure(
    name="impact_speed",
    title="impact speed",
    unit="m/s",
    more_is_unsafe=True,
    function=impact_speed,
    description="Relative speed at contact along the vehicle's lane [m/s].",
)
IMPACT_EXCESS = Measure(
    name="impact_excess",
    title="impact excess",
    unit="m/s, m",
    more_is_unsafe=True,
    function=impact_excess,
    description=(
        "Relative speed at contact above the allowed_impact_speed of the test case [m/s], or"
        " without a contact minus the clearance [m]; every study with it has impact_speed, too."
    ),
)


def _undefined_points(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """NaN, shape (N,): a single cell has no points; the rater computes them from all cells of the
    matrix.
    """
    return np.full(len(runs.outcome), np.nan)


RATING_POINTS = Measure(
    name="rating_points",
    title="points kept",
    unit="points",
    function=_undefined_points,
    description=(
        "Points of Euro NCAP's crash avoidance rating, frontal collisions, in all tests that are"
        " simulated."
    ),
)


JERK_TIME = 1.0
"""Time over which jerk is averaged [s], as in ISO 15622 (adaptive cruise control), which allows 2.5
m/s^3 above 20 m/s; cited from memory, not read.
"""
BRAKING_TIME = 0.5
"""Time over which a deceleration is averaged [s], as for accelerations in UN R79; cited from
memory, not read.
"""
HIGH_PASS, TRANSITION, TRANSITION_QUALITY = 0.4, 2.0, 0.63
"""W_d of ISO 2631-1, annex A: f_1 and f_3 = f_4 [Hz], Q_4 [-]; the high pass is Butterworth's."""


def _filter(
    samples: FloatArray,
    numerator: tuple[float, float, float],
    denominator: tuple[float, float, float],
    step: float,
) -> FloatArray:
    """Samples after a second-order filter along the first axis, from rest, sample by sample: no
    result depends on N.

    The filter is a transfer function in s, with coefficients from the highest power; Tustin's rule
    makes it discrete.
    """
    k = 2 / step
    (b0, b1, b2), (a0, a1, a2) = (
        (c2 * k * k + c1 * k + c0, 2 * (c0 - c2 * k * k), c2 * k * k - c1 * k + c0)
        for c2, c1, c0 in (numerator, denominator)
    )
    b0, b1, b2, a1, a2 = (gain / a0 for gain in (b0, b1, b2, a1, a2))
    result = np.zeros_like(samples)
    x1 = x2 = y1 = y2 = np.zeros(samples.shape[1:])  # none is changed in place
    for i, x in enumerate(samples):
        result[i] = b0 * x + b1 * x1 + b2 * x2 - a1 * y1 - a2 * y2
        x1, x2, y1, y2 = x, x1, result[i], y1
    return result


def weight_acceleration(acceleration: FloatArray, step: float) -> FloatArray:
    """Acceleration along the vehicle, weighted with W_d of ISO 2631-1 [m/s^2], shape (T, N).

    The low pass at 100 Hz is omitted, since the samples of a simulation contain no frequencies
    above half the sampling rate.
    """
    high_pass_rate = 2 * np.pi * HIGH_PASS
    transition = 2 * np.pi * TRANSITION
    butterworth = 1.0, float(np.sqrt(2.0)) * high_pass_rate, high_pass_rate * high_pass_rate
    passed = _filter(acceleration, (1.0, 0.0, 0.0), butterworth, step)
    band_limit = 1.0, transition / TRANSITION_QUALITY, transition * transition
    return _filter(passed, (0.0, transition, transition * transition), band_limit, step)


def max_jerk(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Largest magnitude of the jerk over a second [m/s^3]; shape (N,), NaN on a collision."""
    accelerations, is_counted = _accelerations(runs)
    steps = _step_count(JERK_TIME, runs.trace.step, largest_count=len(accelerations) - 1)
    jerk = np.abs(accelerations[steps:] - accelerations[:-steps]) / (steps * runs.trace.step)
    return mask_collisions(
        runs, np.max(np.where(is_counted[steps:], jerk, 0.0), axis=0, initial=0.0)
    )


def rms_acceleration(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Root mean square of the weighted acceleration over the run [m/s^2]; shape (N,), NaN on a
    collision.
    """
    accelerations, is_counted = _accelerations(runs)
    weighted = weight_acceleration(np.where(is_counted, accelerations, 0.0), runs.trace.step)
    squares = np.where(is_counted, weighted, 0.0) ** 2
    return mask_collisions(
        runs, np.sqrt(sum_in_order(squares) / np.maximum(np.count_nonzero(is_counted, axis=0), 1))
    )


def brake_harshness(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Largest deceleration over half a second [m/s^2]; shape (N,), NaN on a collision."""
    speed = runs.trace.speed
    active = runs.trace.active
    steps = _step_count(BRAKING_TIME, runs.trace.step, largest_count=len(speed) - 1)
    decelerations = (speed[:-steps] - speed[steps:]) / (steps * runs.trace.step)
    return mask_collisions(
        runs, np.max(np.where(active[steps:], decelerations, 0.0), axis=0, initial=0.0)
    )


def _accelerations(runs: SimulationRuns) -> tuple[FloatArray, BoolArray]:
    """Acceleration between two of the T samples [m/s^2], and whether both samples count; shape (T -
    1, N) each.
    """
    return np.diff(runs.trace.speed, axis=0) / runs.trace.step, runs.trace.active[1:]


def _step_count(time: float, step: float, largest_count: int) -> int:
    """Number of steps of `step` [s] in a time [s], from 1 to `largest_count`."""
    return max(1, min(round(time / step), largest_count))


MAX_JERK = Measure(
    name="max_jerk",
    title="jerk",
    unit="m/s^3",
    more_is_unsafe=True,
    over_collisions=False,
    function=max_jerk,
    description=(
        "Largest magnitude of the jerk, averaged over a second (ISO 15622); without a collision."
    ),
)
RMS_ACCELERATION = Measure(
    name="rms_acceleration",
    title="RMS a_w",
    unit="m/s^2",
    more_is_unsafe=True,
    over_collisions=False,
    function=rms_acceleration,
    description=(
        "Root mean square of the acceleration along the vehicle, weighted with W_d of ISO 2631-1;"
        " without a collision."
    ),
)
BRAKE_HARSHNESS = Measure(
    name="brake_harshness",
    title="harshness",
    unit="m/s^2",
    more_is_unsafe=True,
    over_collisions=False,
    function=brake_harshness,
    description="Largest deceleration, averaged over half a second; without a collision.",
)
