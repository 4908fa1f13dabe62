"""Time to collision and the metrics derived from it: TET and TIT (method section 4; Minderhoud and Bovy 2001)."""

from __future__ import annotations

import numpy as np

from safevar_sumo.metrics.base import Metric, mask_collisions, sampling_stride, sum_in_order
from safevar_sumo.records import STANDSTILL, TIME_DECIMALS, FloatArray, SimulationRuns
from safevar_sumo.study import MetricsTable


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
