"""Metrics of longitudinal comfort, which a study has only if it names them: jerk, weighted
acceleration, harsh braking.
"""

from __future__ import annotations

import numpy as np

from safevar_sumo.metrics.base import Measure, mask_collisions, sum_in_order
from safevar_sumo.records import BoolArray, FloatArray, SimulationRuns
from safevar_sumo.study import MetricsTable

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
