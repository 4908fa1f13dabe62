"""Many vehicles under test beside one copy of a network: for searches that need thousands of vehicles at once.

SUMO simulates everybody else, once, with a vehicle under test that stays where it starts. N vehicles move along its
lane as SUMO's ballistic update moves them and collide where bodies overlap. That is the same as N copies where the lane
is straight and nobody reacts to the vehicle under test; whoever uses it holds it against `simulate`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from safevar_sumo.records import BoolArray, FloatArray, SimulationRuns
from safevar_sumo.scenarios import VUT
from safevar_sumo.sumo.batch import drive, step_options
from safevar_sumo.sumo.copies import copied_id
from safevar_sumo.sumo.engine import Engine, open_world
from safevar_sumo.sumo.network import copied_network
from safevar_sumo.sumo.staging import staged
from safevar_sumo.sumo.system import System
from safevar_sumo.sumo.world import Body, SumoWorld, direction_of
from safevar_sumo.vehicles import SumoType


def simulate_alone(system: System, settings: FloatArray) -> SimulationRuns:
    """`simulate` in the study's one scenario, with one copy of the network for all settings, shape (N, n)."""
    files = copied_network(staged(system.scenario), 1)
    with open_world(files, 1, Engine.LIBSUMO, step_options(system)) as world:
        return drive(system, settings, KinematicWorld(world, len(settings)))


class KinematicWorld(SumoWorld):
    """N vehicles under test in one copy of a network; shapes as in `SumoWorld`."""

    def __init__(self, world: SumoWorld, n: int) -> None:
        super().__init__(world._api, n)
        self._speeds, self._way = np.zeros(n), np.zeros(n)

    def ids(self, name: str) -> list[str]:
        return [copied_id(0, name)]

    def set_types(self, types: SumoType) -> None:
        """The vehicles' SUMO types have no part in how they move."""

    def set_decelerations(self, decel: FloatArray) -> None:
        """Nor have these."""

    def depart(self) -> None:
        super().depart()
        vehicle, vut = self._api.vehicle, self.ids(VUT)[0]
        self._start = np.array(vehicle.getPosition(vut))
        self._along = direction_of(vehicle.getAngle(vut))
        self._body = vehicle.getLength(vut), vehicle.getWidth(vut)
        self._speeds += vehicle.getSpeed(vut)

    def leave(self, copies: Iterable[int]) -> None:
        """There is but one on the road, and the others need it there."""

    def advance(self, speeds: FloatArray) -> None:
        """Ballistic: the way of a step is that of the mean speed."""
        self._way = self._way + (self._speeds + speeds) * (0.5 * self.step_length)
        self._speeds = speeds
        super().advance(np.zeros(1))

    def speeds(self) -> FloatArray:
        return self._speeds

    def _looked_up(self, actor: str, position: Any) -> FloatArray:
        if actor not in self._positions:
            place = self._start + self._way[:, np.newaxis] * self._along if actor == VUT else position(self.ids(actor)[0])
            self._positions[actor] = np.broadcast_to(place, (self.n, 2))
        return self._positions[actor]

    def collisions(self) -> dict[int, float]:
        hit = np.zeros(self.n, dtype=bool)
        for name in self._others():
            hit |= self._overlaps(self._body_of(name))
        return dict(zip(np.flatnonzero(hit).tolist(), self._speeds[hit].tolist(), strict=True))

    def bodies(self, copy: int) -> tuple[Body, Body]:
        own = Body.behind(self.vehicle_positions(VUT)[copy], self._along, *self._body, float(self._speeds[copy]))
        return own, next(body for body in map(self._body_of, self._others()) if self._overlaps(body)[copy])

    def _others(self) -> Iterator[str]:
        """Ids of everybody else."""
        for api in (self._api.vehicle, self._api.person):
            for name in api.getIDList():
                if name != self.ids(VUT)[0]:
                    yield name

    def _overlaps(self, other: Body) -> BoolArray:
        """Whether rectangles overlap: no side of either parts them."""
        (own_length, own_width), (length, width), along = self._body, (other.length, other.width), other.along
        own, across, other_across = self._along, _left(self._along), _left(along)
        to_other = other.middle - (self.vehicle_positions(VUT) - own * (own_length / 2))
        cosine, sine = abs(along @ own), abs(other_across @ own)
        reaches = (
            (own, own_length + length * cosine + width * sine), (across, own_width + length * sine + width * cosine),
            (along, length + own_length * cosine + own_width * sine), (other_across, width + own_length * sine + own_width * cosine))
        overlaps = np.ones(self.n, dtype=bool)
        for axis, reach in reaches:
            overlaps &= np.abs(to_other @ axis) < reach / 2
        return overlaps


def _left(direction: FloatArray) -> FloatArray:
    return np.array([-direction[1], direction[0]])
