"""The moments of a drive that tell its story: braking, nearest, end; and when two drives part."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.records import STANDSTILL, Drives

APART = 0.1
"""Two vehicles have parted when their speeds differ by more [m/s]."""


class Moments(NamedTuple):
    """Samples of a drive; None where there is no such moment.

    `brake` is where the brake is first commanded while it moves, `nearest` where the obstacle is nearest (the impact on
    a collision), `end` the drive's last sample.
    """

    brake: int | None
    nearest: int | None
    end: int


def moments(drives: Drives, row: int) -> Moments:
    """The moments of one of N drives."""
    trace = drives.trace
    active = trace.active[:, row]
    end = int(np.flatnonzero(active)[-1])
    moving = np.logical_or.accumulate(trace.speed[:, row] > STANDSTILL)
    braking = np.flatnonzero(active & moving & (trace.brake[:, row] > 0))
    brake = int(braking[0]) if braking.size else None
    if not np.isnan(drives.collision_speed[row]):
        return Moments(brake, end, end)
    near = np.where(active & drives.encounter.in_conflict[:, row], drives.encounter.separation[:, row], np.inf)
    return Moments(brake, int(np.argmin(near)) if np.isfinite(near).any() else None, end)


def divergence(drives: Drives, one: int = 0, other: int = 1) -> int | None:
    """The first sample at which the speeds of two of N drives have parted, None if they never do."""
    trace = drives.trace
    both = trace.active[:, one] & trace.active[:, other]
    apart = np.flatnonzero(both & (np.abs(trace.speed[:, one] - trace.speed[:, other]) > APART))
    return int(apart[0]) if apart.size else None
