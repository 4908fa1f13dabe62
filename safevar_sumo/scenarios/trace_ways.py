"""Speeds and ways in the trace of a user's simulator: the speeds must explain how the position and
the gap change.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from safevar_sumo.records import BoolArray, FloatArray, significant

CREEPS = 1.0
"""Speed up to which a vehicle does not move, or hardly [m/s]."""
SHARE = 0.3
"""Share of a way that speeds may leave unexplained: a gap may be measured beside the path."""
MOST = 0.5
"""Share of the steps in which a mistake shows. In fewer steps, an obstacle may turn away."""
SPEED_ERROR = 0.1
"""Relative error that speeds may have: they may be those of slipping wheels."""
APART = 1.0
"""Way that speeds may leave unexplained in any case [m]; also the largest change of the gap in one
step that cannot be the change to another obstacle.
"""
UNLIKE = 3.0
"""A step with so many times the usual unexplained way is unlike the others: the gap is then that of
another obstacle.
"""
KMH = 3.6
"""A speed in km/h over the same speed in m/s."""
LAGS = (1, -1, 2, -2)
"""Samples by which speeds are tried to be late; early if the number is negative."""
LEAST_LAG = 0.05
"""Smallest sum of unexplained ways that is a reason to look for a lag [m]."""
EXPLAINED = 0.1
"""Share of the unexplained ways that may remain if a lag explains the ways."""
NEARLY_ALL = 0.05
"""Share of the ways that a known mistake may leave unexplained."""
RULES = {
    "position": "a position [m] that changes by the speed [m/s]",
    "gap": "a gap [m] that changes by obstacle_speed - speed [m/s], both along the path",
}
"""What is expected of each distance, in the words of an error."""


class Ways(NamedTuple):
    """How a distance changes between T samples, and the speeds that should explain this change.

    Attributes
    ----------
    name
        The distance, a column of a trace.
    way
        The way in each step, shape (T - 1,) [m]: the change of the position, or by how much the gap
        shrinks. NaN in a step that says nothing.
    speed
        The speed of the vehicle, shape (T,) [m/s].
    obstacle_speed
        The speed of the obstacle, shape (T,) [m/s]; 0 if the distance is the position.
    step
        Time between two samples [s].
    """

    name: str
    way: FloatArray
    speed: FloatArray
    obstacle_speed: FloatArray
    step: float

    def unexplained(self) -> FloatArray:
        """The part of each step's way that no speeds between those at its ends explain [m]."""
        least, most = self._explained()
        return np.asarray(self.way - np.clip(self.way, least, most))

    def scale(self) -> FloatArray:
        """The largest way of each step, from its samples or from its speeds [m]."""
        least, most = self._explained()
        return np.maximum(np.abs(self.way), np.maximum(np.abs(least), np.abs(most)))

    def _explained(self) -> tuple[FloatArray, FloatArray]:
        """The least and the largest way of each step if each body is somewhere between its speeds
        at the ends of the step [m].
        """
        own_least, own_most = _ends(self.speed)
        others_least, others_most = _ends(self.obstacle_speed)
        return (
            (own_least - others_most) * self.step,
            (own_most - others_least) * self.step,
        )

    def compared(self) -> BoolArray:
        """The steps in which the vehicle moves, except those in which another body becomes the
        obstacle, shape (T - 1,).
        """
        moves = np.isfinite(self.way) & (_ends(self.speed)[1] > CREEPS)
        if not moves.any():
            return moves
        unexplained = np.abs(self.unexplained())
        usual = float(np.median(unexplained[moves]))
        return moves & (unexplained <= UNLIKE * usual + APART)

    def left_by(self, lag: int) -> float:
        """The sum of the unexplained ways if the speed is `lag` samples late [m]. Steps near the
        ends, for which some lag has no speeds, are left out.
        """
        reach = max(LAGS)
        inner = self.compared()
        inner[:reach] = False
        inner[-reach:] = False
        shifted = self._replace(speed=np.roll(self.speed, -lag))
        return float(np.abs(shifted.unexplained()[inner]).sum())

    def disagree(self) -> bool:
        """Whether the speeds do not explain the way, in most steps and in their sum."""
        compared = self.compared()
        if np.count_nonzero(compared) < 2:
            return False
        unexplained = self.unexplained()[compared]
        scale = self.scale()[compared]
        in_most = np.mean(np.abs(unexplained) > SHARE * scale) > MOST
        total = abs(float(unexplained.sum()))
        fastest = np.maximum(np.abs(self.speed), np.abs(self.obstacle_speed))[1:]
        driven = float(fastest[compared].sum()) * self.step
        allowed = max(APART, SHARE * float(scale.sum()), SPEED_ERROR * driven)
        return bool(in_most and total > allowed)


def _ends(speed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The smaller and the larger one of the speeds at the ends of each step."""
    return np.minimum(speed[:-1], speed[1:]), np.maximum(speed[:-1], speed[1:])


def ways_of(columns: Mapping[str, FloatArray], step: float) -> Iterator[Ways]:
    """The ways that the columns of a trace state, with `step` seconds between its samples."""
    speed = columns["speed"]
    if "position" in columns:
        standing = np.zeros(len(speed))
        yield Ways("position", np.diff(columns["position"]), speed, standing, step)
    if "gap" in columns and "obstacle_speed" in columns:
        # A gap may end at 0 whatever way is left, and is infinite without an obstacle.
        gap = columns["gap"]
        gap = np.where(np.isfinite(gap) & (gap > 0), gap, np.nan)
        yield Ways("gap", -np.diff(gap), speed, columns["obstacle_speed"], step)


class Contradiction(NamedTuple):
    """A contradiction within a trace, and what is expected instead, in words."""

    problem: str
    expected: str


def contradiction_of_speeds(
    columns: Mapping[str, FloatArray], step: float
) -> Contradiction | None:
    """The contradiction between the speeds and the ways of a trace, such as a speed in km/h; None
    if they agree.
    """
    for ways in ways_of(columns, step):
        if not ways.disagree():
            continue
        compared = ways.compared()
        closing = ways.speed - ways.obstacle_speed
        driven = (closing[1:] + closing[:-1]) / 2 * step
        names = "speed - obstacle_speed" if ways.obstacle_speed.any() else "speed"
        expected = RULES[ways.name]
        if mistake := _mistake(ways):
            expected += f" ({mistake} would explain the difference)"
        return Contradiction(
            f"{names} and {ways.name} disagree: {significant(driven[compared].sum(), 3)} m and"
            f" {significant(ways.way[compared].sum(), 3)} m of way",
            expected,
        )
    return None


def _mistake(ways: Ways) -> str:
    """The mistake that explains the way best, in words; "" if no known mistake explains it."""
    speed = ways.speed
    obstacle_speed = ways.obstacle_speed
    standing = np.zeros(len(speed))
    true_speeds = {
        "a speed in km/h": (speed / KMH, obstacle_speed),
        "a speed that was divided by 3.6 twice": (speed * KMH, obstacle_speed),
        "speeds in km/h": (speed / KMH, obstacle_speed / KMH),
        "an obstacle_speed in km/h": (speed, obstacle_speed / KMH),
        "an obstacle_speed with the wrong sign": (speed, -obstacle_speed),
        "an obstacle_speed relative to the vehicle": (-obstacle_speed, standing),
        "an obstacle_speed that is the closing speed": (obstacle_speed, standing),
    }
    compared = ways.compared()
    unexplained = {}
    for mistake, (own, others) in true_speeds.items():
        corrected = ways._replace(speed=own, obstacle_speed=others)
        left = float(np.abs(corrected.unexplained()[compared]).sum())
        unexplained[mistake] = left / float(ways.scale()[compared].sum())
    best = min(unexplained, key=unexplained.__getitem__)
    return best if unexplained[best] < NEARLY_ALL else ""


def lag_of_speed(columns: Mapping[str, FloatArray], step: float) -> str:
    """The number of samples by which the speed is late or early, in words; "" if the speeds explain
    the ways, or if no lag does.
    """
    for ways in ways_of(columns, step):
        unexplained = {lag: ways.left_by(lag) for lag in (0, *LAGS)}
        lag = min(unexplained, key=unexplained.__getitem__)
        if (
            unexplained[0] >= LEAST_LAG
            and unexplained[lag] <= EXPLAINED * unexplained[0]
        ):
            number = "1 sample" if abs(lag) == 1 else f"{abs(lag)} samples"
            return f"speed that is {number} {'late' if lag > 0 else 'early'} beside its {ways.name}"
    return ""
