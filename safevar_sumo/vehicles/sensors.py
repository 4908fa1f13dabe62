"""Signals that arrive late: a history of samples, read back by every vehicle at its own age."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray, Observation

LONGEST = 3600.0
"""[s]"""


def history(longest: float, step: float, sample: FloatArray) -> FloatArray:
    """Room for delays up to `longest` seconds, filled with a first sample of shape (..., N); newest first.

    Raises
    ------
    InputError
        If nobody simulates that long.
    """
    if not longest <= LONGEST:
        raise InputError("vehicle", f"one of its delays is {longest:g} s", f"up to {LONGEST:g} s")
    length = int(longest / step) + 2
    return np.repeat(sample[np.newaxis], length, axis=0)


def remembered(past: FloatArray, sample: FloatArray) -> FloatArray:
    """The history with a new sample in front and the oldest forgotten."""
    return np.concatenate([sample[np.newaxis], past[:-1]])


def delayed(past: FloatArray, delay: FloatArray, step: float) -> FloatArray:
    """What vehicle i's signal was `delay[i]` seconds ago, linear between two samples; shape (..., N)."""
    age = delay / step
    newer = np.floor(age)
    share = age - newer
    row, column = newer.astype(np.intp), np.arange(len(delay))
    after, before = np.moveaxis(past[row, ..., column], 0, -1), np.moveaxis(past[row + 1, ..., column], 0, -1)
    with np.errstate(invalid="ignore"):  # infinitely far a whole number of steps ago, and now in sight
        between = after * (1 - share) + before * share
    return np.where(np.isnan(between), after, between)


class Sensors(NamedTuple):
    """What lies between the world and the ADSs of N vehicles, each of shape (N,): s, m, -.

    They tell of others `latency` late, of nobody beyond `reach` in clear weather, and `scale` times as far away as they are.
    A vehicle's method `sensors(prepared)` returns them; `Vehicle.sense` does the same to an observation.
    """

    latency: FloatArray
    reach: FloatArray
    scale: FloatArray

    @classmethod
    def perfect(cls, n: int) -> Sensors:
        """At once, however far."""
        return cls(np.zeros(n), np.full(n, np.inf), np.ones(n))


def late_and_near(seen: Observation, past: FloatArray | None, latency: FloatArray, reach: FloatArray,
                  step: float) -> tuple[Observation, FloatArray]:
    """What was there `latency` [s] ago, and nothing beyond `reach` [m] times the visibility; and what is to be remembered for that."""
    obstacle_speed = np.broadcast_to(seen.obstacle_speed, seen.gap.shape)
    now = np.stack([seen.gap, seen.closing_speed, seen.lateral, seen.lateral_speed, obstacle_speed])
    past = history(float(np.max(latency)), step, now) if past is None else remembered(past, now)
    gap, closing_speed, lateral, lateral_speed, obstacle_speed = delayed(past, latency, step)
    detected = gap <= reach * seen.visibility
    return seen._replace(gap=np.where(detected, gap, np.inf), closing_speed=closing_speed, lateral=lateral,
                         lateral_speed=lateral_speed, obstacle_speed=obstacle_speed), past
