"""Sensors that tell late, and nothing beyond their range."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.records import FloatArray, Observation
from safevar_sumo.vehicles.delay import delayed, history, remembered


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
