"""Metrics of longitudinal comfort: jerk, weighted acceleration, harsh braking. A study has these metrics only if it
names them.
"""

from __future__ import annotations

import numpy as np

from safevar_sumo.metrics.base import Metric, mask_collisions, sum_in_order
from safevar_sumo.records import BoolArray, FloatArray, SimulationRuns
from safevar_sumo.study import MetricsTable

JERK_TIME = 1.0
"""Time over which jerk is averaged [s], as in ISO 15622 (adaptive cruise control), which allows 2.5 m/s^3 above 20 m/s.
"""
BRAKING_TIME = 0.5
"""Time over which a deceleration is averaged [s], as for accelerations in UN R79."""
HIGH_PASS, TRANSITION, TRANSITION_QUALITY = 0.4, 2.0, 0.63
"""W_d of ISO 2631-1, annex A: f_1 and f_3 = f_4 [Hz], Q_4 [-]; the high pass is Butterworth's."""


def _filter(
    samples: FloatArray, numerator: tuple[float, float, float], denominator: tuple[float, float, float], step: float
) -> FloatArray:
    """Samples after a second-order filter along the first axis, from rest, sample by sample: no result depends on N.

    The filter is a transfer function in s, with coefficients from the highest power, by Tustin's rule.
    """
    k, (a, b, c) = 2 / step, denominator
    leading = a * k * k + b * k + c
    gains = [
        value / leading
        for a, b, c in (numerator, denominator)
        for value in (a * k * k + b * k + c, 2 * (c - a * k * k), a * k * k - b * k + c)
    ]
    b0, b1, b2, _, a1, a2 = gains
    result = np.zeros_like(samples)
    x1 = x2 = y1 = y2 = np.zeros(samples.shape[1:])
    for i, x in enumerate(samples):
        result[i] = b0 * x + b1 * x1 + b2 * x2 - a1 * y1 - a2 * y2
        x1, x2, y1, y2 = x, x1, result[i], y1
    return result


def weight_acceleration(acceleration: FloatArray, step: float) -> FloatArray:
    """Acceleration along the vehicle, weighted with W_d of ISO 2631-1 [m/s^2], shape (T, N).

    The low pass at 100 Hz is omitted, since the samples of a simulation contain no frequencies above half the sampling
    rate.
    """
    high_pass_rate, transition = 2 * np.pi * HIGH_PASS, 2 * np.pi * TRANSITION
    butterworth = 1.0, float(np.sqrt(2.0)) * high_pass_rate, high_pass_rate * high_pass_rate
    passed = _filter(acceleration, (1.0, 0.0, 0.0), butterworth, step)
    band_limit = 1.0, transition / TRANSITION_QUALITY, transition * transition
    return _filter(passed, (0.0, transition, transition * transition), band_limit, step)


def max_jerk(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Largest magnitude of the jerk over a second [m/s^3]; shape (N,), NaN on a collision."""
    accelerations, is_counted = _accelerations(runs)
    steps = _step_count(JERK_TIME, runs.trace.step, largest_count=len(accelerations) - 1)
    jerk = np.abs(accelerations[steps:] - accelerations[:-steps]) / (steps * runs.trace.step)
    return mask_collisions(runs, np.max(np.where(is_counted[steps:], jerk, 0.0), axis=0, initial=0.0))


def rms_acceleration(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Root mean square of the weighted acceleration over the run [m/s^2]; shape (N,), NaN on a collision."""
    accelerations, is_counted = _accelerations(runs)
    squares = (
        np.where(is_counted, weight_acceleration(np.where(is_counted, accelerations, 0.0), runs.trace.step), 0.0) ** 2
    )
    return mask_collisions(runs, np.sqrt(sum_in_order(squares) / np.maximum(np.count_nonzero(is_counted, axis=0), 1)))


def brake_harshness(runs: SimulationRuns, thresholds: MetricsTable) -> FloatArray:
    """Largest deceleration over half a second [m/s^2]; shape (N,), NaN on a collision."""
    speed, active = runs.trace.speed, runs.trace.active
    steps = _step_count(BRAKING_TIME, runs.trace.step, largest_count=len(speed) - 1)
    decelerations = (speed[:-steps] - speed[steps:]) / (steps * runs.trace.step)
    return mask_collisions(runs, np.max(np.where(active[steps:], decelerations, 0.0), axis=0, initial=0.0))


def _accelerations(runs: SimulationRuns) -> tuple[FloatArray, BoolArray]:
    """Acceleration between two of the T samples [m/s^2], and whether both samples count; shape (T - 1, N) each."""
    return np.diff(runs.trace.speed, axis=0) / runs.trace.step, runs.trace.active[1:]


def _step_count(time: float, step: float, largest_count: int) -> int:
    """Number of steps of `step` [s] in a time [s], from 1 to `largest_count`."""
    return max(1, min(round(time / step), largest_count))


MAX_JERK = Metric(
    name="max_jerk",
    title="jerk",
    unit="m/s^3",
    more_is_unsafe=True,
    over_collisions=False,
    function=max_jerk,
    description="Largest magnitude of the jerk, averaged over a second (ISO 15622); without a collision.",
)
RMS_ACCELERATION = Metric(
    name="rms_acceleration",
    title="RMS a_w",
    unit="m/s^2",
    more_is_unsafe=True,
    over_collisions=False,
    function=rms_acceleration,
    description=(
        "Root mean square of the acceleration along the vehicle, weighted with W_d of ISO 2631-1; without a collision."
    ),
)
BRAKE_HARSHNESS = Metric(
    name="brake_harshness",
    title="harshness",
    unit="m/s^2",
    more_is_unsafe=True,
    over_collisions=False,
    function=brake_harshness,
    description="Largest deceleration, averaged over half a second; without a collision.",
)
