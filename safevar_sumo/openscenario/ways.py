"""Ways: roads that are driven one after another, with their lanes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.openscenario.lines import Line, Piece
from safevar_sumo.openscenario.road import Network, Road

MAX_DETOUR = 6
"""Roads between two waypoints of a route at most."""
STRAY = 0.05
"""How far a straight line is left at most where somebody drives straight on [m]."""
LANE_STEP = 0.5
"""Distance between two places of a lane's line [m]."""
LONGEST_LANE = 30_000.0
"""How far a lane's line is followed [m]."""
MAX_SHIFT = 0.5
"""Largest shift of a lane's middle between two of these places [m]; a lane that goes farther ends.
"""
FloatArray = Any
"""An array of numbers."""
AHEAD = -1e-9
"""Cosine of a direction relative to a road from which on it leads along the road [-]."""


class Crossing(NamedTuple):
    """A place on a road: the road, whether it is driven along its reference line, and s and t there
    [m].
    """

    road: Road
    is_forward: bool
    s: float
    t: float


@dataclass(frozen=True)
class Way(Line):
    """Roads driven one after another, each along its reference line or against it."""

    chain: tuple[tuple[str, bool], ...] = ()
    network: Network | None = None

    @classmethod
    def of(cls, network: Network, chain: tuple[tuple[str, bool], ...]) -> Way:
        """The way along a chain of roads, each with its direction."""
        pieces: list[Piece] = []
        for name, is_forward in chain:
            own = network.road(name).line.pieces
            pieces += own if is_forward else [piece.reversed() for piece in reversed(own)]
        return cls(pieces, chain=chain, network=network)

    @classmethod
    def onward(cls, network: Network, name: str, is_forward: bool) -> Way:
        """The way along a road and straight on along those that follow, as far as there is one such
        road.
        """
        way = cls.of(network, ((name, is_forward),))
        following = [(name, is_forward)]
        while len(following) == 1 and way.stray < STRAY and len(way.chain) <= MAX_DETOUR:
            found = way
            ways = [one for one in network.ways(*way.chain[-1]) if not network.road(one[0]).flaw]
            following = [one for one in ways if cls.of(network, (*found.chain, one)).stray < STRAY]
            if len(following) == 1:
                way = cls.of(network, (*found.chain, *following))
        return way

    def road_at(self, distance: float, left: float = 0.0) -> Crossing:
        """The road at a distance, and the place on it."""
        assert self.network is not None
        road = self.network.road(self.chain[-1][0])
        is_forward = self.chain[-1][1]
        for name, direction in self.chain:
            road = self.network.road(name)
            is_forward = direction
            if distance <= road.length + 1e-9:
                break
            distance -= road.length
        sign = 1 if is_forward else -1
        return Crossing(
            road, is_forward, distance if is_forward else road.length - distance, sign * left
        )

    def distance_to(self, name: str, s: float) -> float | None:
        """The distance at which the way has s on a road, None if it does not lead along that
        road.
        """
        assert self.network is not None
        before = 0.0
        for road, is_forward in self.chain:
            length = self.network.road(road).length
            if road == name:
                return before + (s if is_forward else length - s)
            before += length
        return None

    def lane_left(self, lane: int, distance: float) -> float:
        """How far a lane's middle is to the left at a distance [m]."""
        here = self.road_at(distance)
        return here.road.lane_t(lane, here.s) * (1 if here.is_forward else -1)

    def lane_at(self, distance: float, left: float) -> int:
        """The lane at a place."""
        here = self.road_at(distance, left)
        return here.road.lane_at(here.s, here.t)

    @cached_property
    def has_even_lanes(self) -> bool:
        """Whether no lane changes its place."""
        assert self.network is not None
        return all(self.network.road(name).is_even for name, _ in self.chain)

    @property
    def is_level(self) -> bool:
        """Whether none of its roads has slopes."""
        assert self.network is not None
        return all(self.network.road(name).is_level for name, _ in self.chain)

    def lane_line(self, distance: float, left: float) -> tuple[FloatArray, FloatArray]:
        """Distances, and how far the middle of the lane at a place is to the left there [m].

        Where the lanes of a road have other numbers than before, the lane goes on in the nearest.
        """
        end = min(self.length, distance + LONGEST_LANE) + LANE_STEP
        distances = np.arange(distance, end, LANE_STEP)
        lefts = []
        middle = self.lane_left(self.lane_at(distance, left), distance)
        for at in distances:
            here = self.road_at(float(at), middle)
            sign = 1 if here.is_forward else -1
            # A lane that ends is left straight on.
            if nearest := [here.road.lane_t(lane, here.s) for lane in here.road.lanes_at(here.s)]:
                found = sign * min(nearest, key=lambda t: abs(t - here.t))
                middle = found if abs(found - middle) < MAX_SHIFT else middle
            lefts.append(middle)
        return distances, np.array(lefts)
