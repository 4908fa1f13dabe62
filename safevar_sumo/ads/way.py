"""Whether somebody is, or will be, in the way of a vehicle that keeps its lane."""

from __future__ import annotations

import numpy as np

from safevar_sumo.records import BoolArray, FloatArray, Observation

SLOWEST_CLOSING = 0.1
"""A gap that shrinks more slowly counts as if it shrank so fast [m/s]: everything stays finite."""
FARTHEST = 1e6
"""Nobody is farther away [m]: everything stays finite."""


def time_to_reach(seen: Observation) -> FloatArray:
    """Time to collision, gap over closing speed [s]; very long while the gap does not shrink."""
    gap = np.minimum(np.maximum(seen.gap, 0.0), FARTHEST)
    return np.where(seen.closing_speed > 0, gap / np.maximum(seen.closing_speed, SLOWEST_CLOSING), FARTHEST)


def in_the_way(seen: Observation, corridor: float, reach: float = np.inf) -> BoolArray:
    """Whether somebody detected, not past yet, is within `corridor` of the lane's middle [m], or will be when he is reached.

    Nobody is detected beyond a gap of `reach` times the visibility [m].
    """
    detected = np.isfinite(seen.gap) & (seen.gap <= reach * seen.visibility) & (seen.gap > 0)
    lateral = np.where(detected, seen.lateral, FARTHEST)
    then = lateral + seen.lateral_speed * time_to_reach(seen)
    return np.asarray(detected & ((np.abs(lateral) <= corridor) | (np.abs(then) <= corridor)))


def blocks_the_way(seen: Observation, corridor: float) -> BoolArray:
    """Whether somebody detected, not past yet, is within `corridor` of the lane's middle [m] or on the way into it, and not driving off."""
    ahead = np.isfinite(seen.gap) & (seen.gap > 0) & (seen.closing_speed >= 0)
    return np.asarray(ahead & ((np.abs(seen.lateral) <= corridor) | (np.sign(seen.lateral) * seen.lateral_speed < 0)))
