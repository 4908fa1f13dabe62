"""Average deceleration of the braking cycle (method section 4)."""

from __future__ import annotations

import numpy as np

from safevar_sumo.metrics.base import Metric, sampling_stride, sum_in_order
from safevar_sumo.records import STANDSTILL, FloatArray, SimulationRuns
from safevar_sumo.study import MetricsTable


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
