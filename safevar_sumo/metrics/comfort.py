"""Metrics of longitudinal comfort: jerk, weighted acceleration, harsh braking. A study has these metrics only if it
names them.
"""

from __future__ import annotations

from typing import NamedTuple

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


class _BiquadFilter(NamedTuple):
    """A second-order filter; coefficients from the latest sample to the oldest; the output's first coefficient is 1 and
    not stored.
    """

    input_coefficients: tuple[float, float, float]
    output_coefficients: tuple[float, float]

    @classmethod
    def bilinear(
        cls, numerator: tuple[float, float, float], denominator: tuple[float, float, float], step: float
    ) -> _BiquadFilter:
        """The filter with a transfer function in s, by Tustin's rule; coefficients of polynomials from the highest
        power.
        """
        k = 2 / step

        def in_z(polynomial: tuple[float, float, float]) -> tuple[float, float, float]:
            a, b, c = polynomial
            return a * k * k + b * k + c, 2 * (c - a * k * k), a * k * k - b * k + c

        leading, *outputs = in_z(denominator)
        inputs = in_z(numerator)
        return cls(
            (inputs[0] / leading, inputs[1] / leading, inputs[2] / leading),
            (outputs[0] / leading, outputs[1] / leading),
        )

    def apply(self, samples: FloatArray) -> FloatArray:
        """Filter samples along the first axis, from rest, sample by sample, so that results do not depend on N."""
        (b0, b1, b2), (a1, a2) = self
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
    high_pass = _BiquadFilter.bilinear(
        (1.0, 0.0, 0.0), (1.0, float(np.sqrt(2.0)) * high_pass_rate, high_pass_rate * high_pass_rate), step
    )
    weighting = _BiquadFilter.bilinear(
        (0.0, transition, transition * transition),
        (1.0, transition / TRANSITION_QUALITY, transition * transition),
        step,
    )
    return weighting.apply(high_pass.apply(acceleration))


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
