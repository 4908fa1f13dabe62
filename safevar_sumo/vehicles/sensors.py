"""Sensors and delayed signals: a history of samples that every vehicle reads with its own delay."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray, Observation

LONGEST = 3600.0
"""Longest delay [s]."""


def history(longest: float, step: float, sample: FloatArray) -> FloatArray:
    """A history for delays up to `longest` seconds, filled with a first sample of shape (..., N); newest first.

    Raises
    ------
    InputError
        If the delay is longer than any run.
    """
    if not longest <= LONGEST:
        raise InputError("vehicle", f"one of its delays is {longest:g} s", f"up to {LONGEST:g} s")
    length = int(longest / step) + 2
    return np.repeat(sample[np.newaxis], length, axis=0)


def remembered(past: FloatArray, sample: FloatArray) -> FloatArray:
    """The history with a new sample at its front and the oldest one dropped."""
    return np.concatenate([sample[np.newaxis], past[:-1]])


def delayed(past: FloatArray, delay: FloatArray, step: float) -> FloatArray:
    """The signal of vehicle i `delay[i]` seconds ago, interpolated linearly; shape (..., N)."""
    age = delay / step
    newer = np.floor(age)
    share = age - newer
    signals = past[0].size
    place = newer.astype(np.intp) * signals + np.arange(signals).reshape(past.shape[1:])
    after, before = past.take(place), past.take(place + signals)
    with np.errstate(invalid="ignore"):  # infinite while out of sight, finite a step later
        between = after * (1 - share) + before * share
    return np.asarray(np.where(np.isnan(between), after, between))


class Sensors(NamedTuple):
    """Sensors of N vehicles, each of shape (N,): latency [s], range in clear weather [m], factor on distances [-].

    A vehicle's method `sensors(prepared)` returns them; `Vehicle.sense` applies the same sensors to an observation.
    """

    latency: FloatArray
    reach: FloatArray
    scale: FloatArray

    @classmethod
    def perfect(cls, n: int) -> Sensors:
        """Sensors without latency, with unlimited range."""
        return cls(np.zeros(n), np.full(n, np.inf), np.ones(n))


def late_and_near(seen: Observation, past: FloatArray | None, latency: FloatArray, reach: FloatArray,
                  step: float) -> tuple[Observation, FloatArray]:
    """The observation `latency` [s] ago without obstacles beyond `reach` [m] times the visibility, and the history for the next call."""
    obstacle_speed = np.broadcast_to(seen.obstacle_speed, seen.gap.shape)
    now = np.stack([seen.gap, seen.closing_speed, seen.lateral, seen.lateral_speed, obstacle_speed])
    past = history(float(np.max(latency)), step, now) if past is None else remembered(past, now)
    gap, closing_speed, lateral, lateral_speed, obstacle_speed = delayed(past, latency, step)
    detected = gap <= reach * seen.visibility
    return seen._replace(gap=np.where(detected, gap, np.inf), closing_speed=closing_speed, lateral=lateral,
                         lateral_speed=lateral_speed, obstacle_speed=obstacle_speed), past
