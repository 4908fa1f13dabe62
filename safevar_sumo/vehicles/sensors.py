"""Sensors and delayed signals: every vehicle reads a common history of samples with a delay of its own."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray, Observation

LONGEST_DELAY = 3600.0
"""Longest delay [s]."""


def start_history(longest_delay: float, step: float, sample: FloatArray) -> FloatArray:
    """A history for delays up to `longest_delay` [s], filled with the first sample, shape (..., N); the newest sample
    comes first.

    Raises
    ------
    InputError
        If the delay is longer than any run.
    """
    if not longest_delay <= LONGEST_DELAY:
        raise InputError("vehicle", f"one of its delays is {longest_delay:g} s", f"up to {LONGEST_DELAY:g} s")
    length = int(longest_delay / step) + 2
    return np.repeat(sample[np.newaxis], length, axis=0)


def extend_history(past: FloatArray, sample: FloatArray) -> FloatArray:
    """The history with a new sample at its front and the oldest one dropped."""
    return np.concatenate([sample[np.newaxis], past[:-1]])


def delay_signal(past: FloatArray, delay: FloatArray, step: float) -> FloatArray:
    """The signal of each vehicle i as it was `delay[i]` seconds ago, interpolated linearly; shape (..., N)."""
    age = delay / step
    whole_steps = np.floor(age)
    share = age - whole_steps
    size = past[0].size
    index = whole_steps.astype(np.intp) * size + np.arange(size).reshape(past.shape[1:])
    newer, older = past.take(index), past.take(index + size)
    with np.errstate(invalid="ignore"):  # a signal is infinite while out of sight, finite a step later
        signal = newer * (1 - share) + older * share
    return np.asarray(np.where(np.isnan(signal), newer, signal))


class Sensors(NamedTuple):
    """Properties of the sensors of N vehicles, each of shape (N,): latency [s], range in clear weather [m], factor on
    distances [-].

    A vehicle's method `sensors(prepared)` returns them; `Vehicle.sense` applies the same sensors to an observation.
    """

    latency: FloatArray
    reach: FloatArray
    scale: FloatArray

    @classmethod
    def perfect(cls, n: int) -> Sensors:
        """Sensors without latency and with unlimited range."""
        return cls(np.zeros(n), np.full(n, np.inf), np.ones(n))


def sensed_observation(
    seen: Observation, past: FloatArray | None, latency: FloatArray, reach: FloatArray, step: float
) -> tuple[Observation, FloatArray]:
    """The observation `latency` [s] ago, without obstacles beyond `reach` [m] times the visibility; also the history
    for the next call.
    """
    obstacle_speed = np.broadcast_to(seen.obstacle_speed, seen.gap.shape)
    sample = np.stack([seen.gap, seen.closing_speed, seen.lateral, seen.lateral_speed, obstacle_speed])
    past = start_history(float(np.max(latency)), step, sample) if past is None else extend_history(past, sample)
    gap, closing_speed, lateral, lateral_speed, obstacle_speed = delay_signal(past, latency, step)
    is_detected = gap <= reach * seen.visibility
    return seen._replace(
        gap=np.where(is_detected, gap, np.inf),
        closing_speed=closing_speed,
        lateral=lateral,
        lateral_speed=lateral_speed,
        obstacle_speed=obstacle_speed,
    ), past
