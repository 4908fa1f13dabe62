"""The safety metrics of the published study (method section 4; Minderhoud and Bovy 2001), and a rating's points."""

from __future__ import annotations

import numpy as np

from safevar_sumo.metrics.base import Metric, mask_collisions, sampling_stride, sum_in_order
from safevar_sumo.records import STANDSTILL, TIME_DECIMALS, FloatArray, SimulationRuns
from safevar_sumo.study import SAFETY_DEGREE, MetricsTable


def safety_degree(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Least separation during the encounter [m, > 0], or minus the speed of the collision [m/s, <= 0].

    Shape (N,); NaN where there was neither an encounter nor a collision.
    """
    is_counted = runs.trace.active & runs.encounter.in_conflict
    least_separation = np.min(np.where(is_counted, runs.encounter.separation, np.inf), axis=0)
    least_separation = np.where(np.isfinite(least_separation), least_separation, np.nan)
    return np.where(np.isnan(runs.collision_speed), least_separation, -runs.collision_speed)


SAFETY_DEGREE_METRIC = Metric(
    name=SAFETY_DEGREE,
    title="SD",
    unit="m, or -m/s",
    head="SD",
    more_is_unsafe=False,
    function=safety_degree,
    description="Least separation during the encounter [m, > 0], or minus the speed of the collision [m/s, <= 0].",
)


def time_to_collision(runs: SimulationRuns) -> FloatArray:
    """TTC(t) = L_s / v_L, the projected distance divided by the closing speed [s]; shape (T, N).

    Infinite while the distance does not shrink, outside the encounter, and once the vehicle has stopped after moving.
    """
    has_moved = np.logical_or.accumulate(runs.trace.speed > STANDSTILL, axis=0)
    has_stopped = np.logical_or.accumulate(has_moved & (runs.trace.speed <= STANDSTILL), axis=0)
    closing_speed, distance = runs.encounter.closing_speed, runs.encounter.distance
    is_counted = runs.trace.active & runs.encounter.in_conflict & ~has_stopped & (closing_speed > 0) & (distance >= 0)
    return np.divide(distance, closing_speed, out=np.full_like(distance, np.inf), where=is_counted)


def time_exposed(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """TET* = sum of dt over the samples with 0 <= TTC(t) <= TTC* [s]; shape (N,), NaN on a collision."""
    critical_ttc, interval = _critical_ttc(runs, thresholds)
    return mask_collisions(
        runs, np.round(np.count_nonzero(np.isfinite(critical_ttc), axis=0) * interval, TIME_DECIMALS)
    )


def time_integrated(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """TIT* = sum of (TTC* - TTC(t)) dt over the samples of TET* [s^2]; shape (N,), NaN on a collision."""
    critical_ttc, interval = _critical_ttc(runs, thresholds)
    deficit = np.where(np.isfinite(critical_ttc), thresholds.ttc_threshold - critical_ttc, 0.0)
    return mask_collisions(runs, sum_in_order(deficit) * interval)


def _critical_ttc(runs: SimulationRuns, thresholds: MetricsTable) -> tuple[FloatArray, float]:
    """TTC at every sample, infinite where it is not critical; and the time between two samples [s]."""
    stride = sampling_stride(runs.trace.step, thresholds.sampling_interval)
    ttc = time_to_collision(runs)[::stride]
    return np.where(ttc <= thresholds.ttc_threshold, ttc, np.inf), stride * runs.trace.step


TET = Metric(
    name="tet",
    title="TET",
    unit="s",
    more_is_unsafe=True,
    over_collisions=False,
    function=time_exposed,
    description="TET* = sum of dt over the samples with 0 <= TTC(t) <= TTC* [s].",
)
TIT = Metric(
    name="tit",
    title="TIT",
    unit="s^2",
    more_is_unsafe=True,
    over_collisions=False,
    function=time_integrated,
    description="TIT* = sum of (TTC* - TTC(t)) dt over the same samples [s^2].",
)


def average_deceleration(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Mean deceleration over the samples in which the brake is commanded and the vehicle moves [m/s^2].

    Positive for a loss of speed; shape (N,); NaN for a vehicle that never braked.
    """
    stride = sampling_stride(runs.trace.step, thresholds.sampling_interval)
    interval = stride * runs.trace.step
    speed, active = runs.trace.speed[::stride], runs.trace.active[::stride]
    is_braking = active & (runs.trace.brake[::stride] > 0) & (np.abs(speed) > STANDSTILL)
    decelerations = (speed[:-1] - speed[1:]) / interval
    is_counted = is_braking[1:]
    sample_count = np.count_nonzero(is_counted, axis=0)
    deceleration_sum = sum_in_order(np.where(is_counted, decelerations, 0.0))
    return np.asarray(
        np.divide(deceleration_sum, sample_count, out=np.full_like(deceleration_sum, np.nan), where=sample_count > 0)
    )


AVE_DECE = Metric(
    name="ave_dece",
    title="aveDece",
    unit="m/s^2",
    more_is_unsafe=False,
    function=average_deceleration,
    description="Mean loss of speed per time over the samples in which the brake is commanded and the vehicle moves.",
)


def _undefined_points(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """NaN, shape (N,): a single cell has no points; the rater computes them from all cells of the matrix."""
    return np.full(len(runs.outcome), np.nan)


RATING_POINTS = Metric(
    name="rating_points",
    title="points kept",
    unit="points",
    more_is_unsafe=False,
    function=_undefined_points,
    description="Points of Euro NCAP's crash avoidance rating, frontal collisions, in all tests that are simulated.",
)
