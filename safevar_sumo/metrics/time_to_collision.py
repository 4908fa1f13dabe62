"""Time to collision and the metrics derived from it: TET and TIT (method section 4; Minderhoud and Bovy 2001)."""

from __future__ import annotations

import numpy as np

from safevar_sumo.metrics.base import Metric, sampling_stride, total, without_collision
from safevar_sumo.records import STANDSTILL, TIME_DECIMALS, FloatArray, SimulationRuns
from safevar_sumo.study import MetricsTable


def time_to_collision(runs: SimulationRuns) -> FloatArray:
    """TTC(t) = L_s / v_L, distance projected over closing speed [s]; shape (T, N).

    Infinite while the distance does not shrink, outside the encounter, and once the vehicle has stopped after moving.
    """
    moved = np.logical_or.accumulate(runs.trace.speed > STANDSTILL, axis=0)
    stood = np.logical_or.accumulate(moved & (runs.trace.speed <= STANDSTILL), axis=0)
    closing, distance = runs.encounter.closing_speed, runs.encounter.distance
    counts = runs.trace.active & runs.encounter.in_conflict & ~stood & (closing > 0) & (distance >= 0)
    return np.divide(distance, closing, out=np.full_like(distance, np.inf), where=counts)


def time_exposed(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """TET* = sum of dt over the samples with 0 <= TTC(t) <= TTC* [s]; shape (N,), NaN on a collision."""
    critical, interval = _critical(runs, thresholds)
    return without_collision(runs, np.round(np.count_nonzero(np.isfinite(critical), axis=0) * interval, TIME_DECIMALS))


def time_integrated(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """TIT* = sum of (TTC* - TTC(t)) dt over the same samples [s^2]; shape (N,), NaN on a collision."""
    critical, interval = _critical(runs, thresholds)
    deficit = np.where(np.isfinite(critical), thresholds.ttc_threshold - critical, 0.0)
    return without_collision(runs, total(deficit) * interval)


def _critical(runs: SimulationRuns, thresholds: MetricsTable) -> tuple[FloatArray, float]:
    """TTC where it is critical, infinite elsewhere, at the samples; and the time between two samples."""
    stride = sampling_stride(runs.trace.step, thresholds.sampling_interval)
    ttc = time_to_collision(runs)[::stride]
    return np.where(ttc <= thresholds.ttc_threshold, ttc, np.inf), stride * runs.trace.step


TET = Metric(
    name="tet", title="TET", unit="s", more_is_unsafe=True, over_collisions=False, function=time_exposed,
    description="TET* = sum of dt over the samples with 0 <= TTC(t) <= TTC* [s].")
TIT = Metric(
    name="tit", title="TIT", unit="s^2", more_is_unsafe=True, over_collisions=False, function=time_integrated,
    description="TIT* = sum of (TTC* - TTC(t)) dt over the same samples [s^2].")
