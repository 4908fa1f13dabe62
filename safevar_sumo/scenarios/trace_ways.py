"""Speeds and ways in the trace of a user's simulator: the speeds must explain how the position and
the gap change.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from safevar_sumo.records import KMH_PER_MS, BoolArray, FloatArray, significant

MOVING_SPEED = 1.0
"""Speed up to which a vehicle does not move, or hardly [m/s]."""
UNEXPLAINED_SHARE = 0.3
"""Share of a way that speeds may leave unexplained: a gap may be measured beside the path."""
WRONG_STEPS = 0.5
"""Share of the steps in which a mistake shows. In fewer steps, an obstacle may turn away."""
SPEED_ERROR = 0.1
"""Relative error that speeds may have: they may be those of slipping wheels."""
ALLOWED_WAY = 1.0
"""Way that speeds may leave unexplained in any case [m]; also the largest change of the gap in one
step that cannot be the change to another obstacle.
"""
UNLIKE = 3.0
"""A step with so many times the usual unexplained way is unlike the others: the gap is then that of
another obstacle.
"""
LEAST_LAG = 0.05
"""Smallest sum of unexplained ways that is a reason to look for a lag [m]."""
EXPLAINED = 0.1
"""Share of the unexplained ways that may remain if a lag explains the ways."""
NEARLY_ALL = 0.05
"""Share of the ways that speeds in km/h may leave unexplained."""
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

    def closing_speeds(self) -> tuple[FloatArray, FloatArray]:
        """The least and the largest closing speed in each step, if each body is somewhere between
        its speeds at the ends of the step [m/s].
        """
        own_least, own_most = _ends(self.speed)
        others_least, others_most = _ends(self.obstacle_speed)
        return own_least - others_most, own_most - others_least

    def unexplained(self) -> FloatArray:
        """The part of each step's way that no speeds between those at its ends explain [m]."""
        least_speed, largest_speed = self.closing_speeds()
        return np.asarray(
            self.way
            - np.clip(self.way, least_speed * self.step, largest_speed * self.step)
        )

    def compared(self) -> BoolArray:
        """The steps in which the vehicle moves, except those in which another body becomes the
        obstacle, shape (T - 1,).
        """
        moves = np.isfinite(self.way) & (_ends(self.speed)[1] > MOVING_SPEED)
        if not moves.any():
            return moves
        unexplained = np.abs(self.unexplained())
        usual = float(np.median(unexplained[moves]))
        return moves & (unexplained <= UNLIKE * usual + ALLOWED_WAY)

    def disagree(self) -> bool:
        """Whether the speeds do not explain the way, in most steps and in their sum."""
        compared = self.compared()
        if np.count_nonzero(compared) < 2:
            return False
        unexplained = self.unexplained()[compared]
        fastest = np.max(np.abs(self.closing_speeds()), axis=0) * self.step
        largest_way = np.maximum(np.abs(self.way), fastest)[compared]
        is_frequent = (
            np.mean(np.abs(unexplained) > UNEXPLAINED_SHARE * largest_way) > WRONG_STEPS
        )
        driven = np.maximum(np.abs(self.speed), np.abs(self.obstacle_speed))[1:]
        allowed = max(
            ALLOWED_WAY,
            UNEXPLAINED_SHARE * float(largest_way.sum()),
            SPEED_ERROR * float(driven[compared].sum()) * self.step,
        )
        return bool(is_frequent and abs(float(unexplained.sum())) > allowed)

    def left_by(self, lag: int) -> float:
        """The sum of the unexplained ways if the speed is `lag` samples late [m]. Steps at the
        ends, for which some lag has no speeds, are left out.
        """
        shifted = self._replace(speed=np.roll(self.speed, -lag))
        unexplained = np.abs(shifted.unexplained())[1:-1]
        return float(unexplained[self.compared()[1:-1]].sum())


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
    """The contradiction between the speeds and the ways of a trace; None if they agree."""
    for ways in ways_of(columns, step):
        if not ways.disagree():
            continue
        expected = RULES[ways.name]
        compared = ways.compared()
        own_converted = ways._replace(speed=ways.speed / KMH_PER_MS)
        both_converted = own_converted._replace(
            obstacle_speed=ways.obstacle_speed / KMH_PER_MS
        )
        for converted_ways in (own_converted, both_converted):
            unexplained = np.abs(converted_ways.unexplained()[compared])
            if unexplained.sum() < NEARLY_ALL * np.abs(ways.way[compared]).sum():
                expected = f"speeds in m/s, not in km/h: {RULES[ways.name]}"
        least_speed, largest_speed = ways.closing_speeds()
        driven = float(((least_speed + largest_speed) / 2)[compared].sum()) * step
        way = float(ways.way[compared].sum())
        return Contradiction(
            f"speed and {ways.name} disagree: {significant(driven, 3)} m and"
            f" {significant(way, 3)} m of way",
            expected,
        )
    return None


def lag_of_speed(columns: Mapping[str, FloatArray], step: float) -> str:
    """The sample to which the speed belongs if it belongs to another sample than the ways do, in
    words; "" if the speeds explain the ways, or if no lag does.
    """
    for ways in ways_of(columns, step):
        unexplained = ways.left_by(0)
        for lag, words in ((1, "late"), (-1, "early")):
            is_explained = ways.left_by(lag) <= EXPLAINED * unexplained
            if unexplained >= LEAST_LAG and is_explained:
                return f"speed that is 1 sample {words} beside its {ways.name}"
    return ""
