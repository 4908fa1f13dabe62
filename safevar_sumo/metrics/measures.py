"""The safety metrics of the published study (method section 4; Minderhoud and Bovy 2001), and
metrics of conflicts between the paths of two road users.
"""

from __future__ import annotations

import numpy as np

from safevar_sumo.metrics.base import (
    Measure,
    mask_collisions,
    sampling_stride,
    sum_in_order,
)
from safevar_sumo.records import (
    STANDSTILL,
    TIME_DECIMALS,
    FloatArray,
    Outcome,
    SimulationRuns,
    nans,
)
from safevar_sumo.study import SAFETY_DEGREE, MetricsTable

OF_APPROACH = "speed", "gap", "obstacle_speed"
"""The quantities from which times to collision are computed."""
PATH_TOLERANCE = 1e-6
"""Margin on each side of the vehicle's path [m]: without it, rounding errors decide whether a body
at the edge is in the path.
"""


def safety_degree(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """The least separation during the encounter [m, > 0]. After a collision, minus the closing
    speed of the collision [m/s, < 0].

    Shape (N,); NaN without an encounter and without a collision.
    """
    is_counted = runs.trace.active & runs.encounter.in_conflict
    separation = np.where(is_counted, runs.encounter.separation, np.inf)
    least_separation = np.min(separation, axis=0)
    least_separation[np.isinf(least_separation)] = np.nan
    is_safe = np.isnan(runs.collision_speed)
    return np.where(is_safe, least_separation, -runs.closing_speed)


SAFETY_DEGREE_METRIC = Measure(
    name=SAFETY_DEGREE,
    title="SD",
    unit="m, or -m/s",
    function=safety_degree,
    needs=("separation",),
    description=(
        "Least separation during the encounter [m, > 0], or minus a collision's closing speed [m/s,"
        " < 0]."
    ),
)


def time_exposed(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """TET* = sum of dt over the samples with 0 <= TTC(t) <= TTC* [s].

    Shape (N,); NaN after a collision. TTC* is the study's threshold `ttc_threshold`.
    """
    critical_ttc, interval = _critical_ttc(runs, thresholds)
    n_critical = np.count_nonzero(np.isfinite(critical_ttc), axis=0)
    return mask_collisions(runs, np.round(n_critical * interval, TIME_DECIMALS))


def time_integrated(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """TIT* = sum of (TTC* - TTC(t)) dt over the samples of TET* [s^2].

    Shape (N,); NaN after a collision. TTC* is the study's threshold `ttc_threshold`.
    """
    critical_ttc, interval = _critical_ttc(runs, thresholds)
    # An infinite TTC has no deficit.
    deficit = np.maximum(thresholds.ttc_threshold - critical_ttc, 0.0)
    return mask_collisions(runs, sum_in_order(deficit) * interval)


def _critical_ttc(
    runs: SimulationRuns, thresholds: MetricsTable
) -> tuple[FloatArray, float]:
    """TTC at every sample [s], infinite where TTC exceeds the threshold, and the time between two
    samples [s].
    """
    stride = sampling_stride(runs.trace.step, thresholds.sampling_interval)
    ttc = runs.time_to_collision[::stride]
    critical_ttc = np.where(ttc <= thresholds.ttc_threshold, ttc, np.inf)
    return critical_ttc, stride * runs.trace.step


TET = Measure(
    name="tet",
    title="TET",
    unit="s",
    more_is_unsafe=True,
    over_collisions=False,
    function=time_exposed,
    needs=OF_APPROACH,
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
    needs=OF_APPROACH,
    description=(
        "TIT* = sum of (TTC* - TTC(t)) dt over the same samples [s^2], with the TTC of TET."
    ),
)


def conflict(runs: SimulationRuns) -> tuple[FloatArray, FloatArray]:
    """The closing speed of the vehicle and the other body along the vehicle's path [m/s], and the
    time to collision TTC_p along the path [s]. Both arrays have shape (T, N).

    TTC_p(t) = gap / (v - u). v is the speed of the vehicle, and u the speed of the other body along
    the path. TTC_p is finite only if the gap shrinks, TTC(t) counts, and the other body is in the
    path now or when the vehicle reaches it at these speeds.

    The speed of a crossing body across the path changes neither the gap nor this closing speed.
    Behind a leader, who never leaves the path, TTC_p(t) equals TTC(t).
    """
    trace = runs.trace
    reach = (trace.vehicle_width + trace.obstacle_width) / 2 + PATH_TOLERANCE
    is_in_path = np.abs(trace.lateral) <= reach

    # The time in which the vehicle reaches the body; then the body's place at that time.
    closing_speed = trace.speed - trace.obstacle_speed
    has_gap = (trace.gap >= 0) & np.isfinite(trace.gap)
    is_counted = runs.is_approach & (closing_speed > 0) & has_gap
    ttc = np.divide(
        trace.gap, closing_speed, out=np.zeros_like(trace.gap), where=is_counted
    )
    lateral_at_arrival = trace.lateral + trace.lateral_speed * ttc
    is_met = is_in_path | (np.abs(lateral_at_arrival) <= reach)
    ttc = np.where(is_counted & is_met, ttc, np.inf)

    # If the encounter's distance is the gap, as behind a leader, TTC_p(t) must equal TTC(t) to the
    # bit.
    is_led = ~(runs.is_approach & ~is_in_path).any(axis=0)
    is_ttc = is_led | (runs.encounter.distance == trace.gap)
    closing_speed = np.where(is_ttc, runs.encounter.closing_speed, closing_speed)
    return closing_speed, np.where(is_ttc, runs.time_to_collision, ttc)


def least_time_to_collision(
    runs: SimulationRuns, thresholds: MetricsTable
) -> FloatArray:
    """The least TTC_p(t) [s] (Hayward 1972), shape (N,). NaN after a collision, and if the vehicle
    approaches nobody in its path.
    """
    _, ttc = conflict(runs)
    smallest = np.min(ttc, axis=0, initial=np.inf)
    return mask_collisions(runs, np.where(np.isfinite(smallest), smallest, np.nan))


def largest_deceleration_rate(
    runs: SimulationRuns, thresholds: MetricsTable
) -> FloatArray:
    """The largest DRAC (deceleration rate to avoid the crash) [m/s^2], shape (N,). NaN after a
    collision, and if the vehicle approaches nobody in its path.

    DRAC is the deceleration that just avoids the collision, (v - u)^2 / (2 gap) = (v - u) / (2
    TTC_p) (Cooper and Ferguson 1976), at a sample with a TTC_p.

    Behind a leader, TTC and DRAC equal the values of SUMO's SSM device. For crossing bodies the
    device has other definitions: it predicts when both bodies, at constant speeds, enter and leave
    the place that two lanes share. The device has a TTC only if one body enters before the other
    has left.
    """
    closing_speed, ttc = conflict(runs)
    is_counted = np.isfinite(ttc) & (ttc > 0)
    rate = np.divide(closing_speed, 2 * ttc, out=np.zeros_like(ttc), where=is_counted)
    largest = np.max(rate, axis=0, initial=0.0)
    return mask_collisions(runs, np.where(is_counted.any(axis=0), largest, np.nan))


TTC_MIN = Measure(
    name="ttc_min",
    title="least TTC along the path",
    unit="s",
    over_collisions=False,
    function=least_time_to_collision,
    needs=OF_APPROACH,
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
    needs=OF_APPROACH,
    description=(
        "Largest deceleration rate to avoid the crash, (v - u)^2 / (2 gap) [m/s^2], with the gap "
        "and the speeds of ttc_min; without a collision."
    ),
)


def post_encroachment_time(
    runs: SimulationRuns, thresholds: MetricsTable
) -> FloatArray:
    """The time from the moment at which the first road user leaves the place that both paths share,
    to the moment at which the second road user enters it [s] (Allen, Shin and Cooper 1978).

    Shape (N,); NaN unless the vehicle and a crossing body pass each other without a stop.

    The run ends when the first road user has left the shared place. From then on, the second road
    user is assumed to keep its speed. SUMO's SSM device takes lanes in place of bodies. Its PET is
    shorter, because lanes are wider than bodies.
    """
    trace = runs.trace
    number = np.count_nonzero(trace.active, axis=0)
    last_samples = np.minimum(number, len(trace.time) - 1)
    vehicles = np.arange(len(number))
    columns = np.broadcast_arrays(
        trace.speed,
        trace.gap,
        trace.lateral,
        trace.lateral_speed,
        trace.obstacle_width,
    )
    speed, gap, lateral, lateral_speed, obstacle_width = (
        column[last_samples, vehicles] for column in columns
    )

    # Either the body has left the vehicle's path (`body_is_first`), or the vehicle has passed the
    # body (`vehicle_is_first`). The way is the distance of the second road user from the shared
    # place.
    lateral_gap = np.abs(lateral) - (trace.vehicle_width + obstacle_width) / 2
    body_is_first = (lateral * lateral_speed > 0) & (gap > 0)
    vehicle_is_first = (lateral * lateral_speed < 0) & (gap <= 0)
    way = np.where(body_is_first, gap, lateral_gap)
    rate = np.where(body_is_first, speed, np.abs(lateral_speed))
    passes = (runs.outcome == Outcome.PASSED) & (lateral_gap >= 0)
    passes = passes & (body_is_first | vehicle_is_first)
    times = nans(way.shape)
    np.divide(way, rate, out=times, where=passes & (rate > STANDSTILL))
    return times


def reaction_time(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """The time from the first sample at which nothing hides the body ahead to the first brake
    command at or after this sample [s]. (Olson and Sivak 1986: perception-response time of a
    driver.)

    Shape (N,); NaN if the vehicle sees nobody, or does not brake.
    """
    trace = runs.trace
    visible = trace.active & trace.visible
    first_sight = np.argmax(visible, axis=0)
    has_seen = np.logical_or.accumulate(visible, axis=0)
    brakes = trace.active & has_seen & (trace.brake > 0)
    steps = np.argmax(brakes, axis=0) - first_sight
    times = np.round(steps * trace.step, TIME_DECIMALS)
    return np.where(brakes.any(axis=0), times, np.nan)


PET = Measure(
    name="pet",
    title="PET",
    unit="s",
    over_collisions=False,
    function=post_encroachment_time,
    needs=("speed", "gap"),
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
    needs=("brake",),
    description="Time from the first sight of the body ahead to the first brake command.",
)


def average_deceleration(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """The mean deceleration over the samples at which the brake is commanded and the vehicle moves
    [m/s^2]. A loss of speed is positive.

    Shape (N,); NaN if the vehicle never brakes.
    """
    stride = sampling_stride(runs.trace.step, thresholds.sampling_interval)
    speed = runs.trace.speed[::stride]
    is_braking = runs.trace.active[::stride] & (runs.trace.brake[::stride] > 0)
    is_counted = (is_braking & (np.abs(speed) > STANDSTILL))[1:]
    decelerations = (speed[:-1] - speed[1:]) / (stride * runs.trace.step)
    sample_count = np.count_nonzero(is_counted, axis=0)
    deceleration_sum = sum_in_order(np.where(is_counted, decelerations, 0.0))
    means = nans(deceleration_sum.shape)
    np.divide(deceleration_sum, sample_count, out=means, where=sample_count > 0)
    return means


AVE_DECE = Measure(
    name="ave_dece",
    title="aveDece",
    unit="m/s^2",
    function=average_deceleration,
    needs=("speed", "brake"),
    description=(
        "Mean loss of speed per time over the samples in which the brake is commanded and the"
        " vehicle moves."
    ),
)


UNSAFE_SHARE = Measure(
    name="unsafe_share",
    title="share of unsafe runs",
    unit="-",
    more_is_unsafe=True,
    # A single run has no share. `sumo/simulators.py` computes the share over repeats.
    function=lambda runs, _: nans(len(runs)),
    description="Share of the repeats of a run that are unsafe by the study's own criterion.",
)
