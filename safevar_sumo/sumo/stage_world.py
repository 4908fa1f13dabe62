"""A stage in SUMO: its bodies are put where their tracks say, and the vehicles under test drive among them.

SUMO's own word on collisions is not taken: it misses contacts at the side between lanes, and calls others too early.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from safevar_sumo.errors import SimulationError
from safevar_sumo.records import BoolArray, FloatArray, IntArray
from safevar_sumo.scenarios import VUT, Track
from safevar_sumo.scenarios.base import Frame
from safevar_sumo.scenarios.tracks import PERSONS, SCREEN
from safevar_sumo.sumo.bodies import Body, Motion
from safevar_sumo.sumo.engine import open_world
from safevar_sumo.sumo.lane_world import LaneWorld
from safevar_sumo.sumo.moving import row
from safevar_sumo.sumo.network import Network, copied_network
from safevar_sumo.sumo.stage import Stage
from safevar_sumo.sumo.world import SPEED_MODE, Api, SumoWorld
from safevar_sumo.vehicles import SumoType

PLACE_TOLERANCE = 1e-6
"""Largest distance in SUMO of an actor from its track, and of a vehicle from where it has driven to [m]."""
ANY_PLACE, ANY_LANE = 2, -1
"""Values of `moveToXY` that allow places beside every road, and leave the lane to SUMO."""
SHAPES = {"adult": "pedestrian", "child": "pedestrian", "cyclist": "bicycle", "motorcyclist": "motorcycle"}
"""Shapes that sumo-gui draws, by kind; of all others the one whose corners SUMO does not cut off."""
WAIT = 1e6
"""How long persons wait to be put somewhere [s]."""


@lru_cache(maxsize=100)
def start_frame(network: Network, options: tuple[str, ...]) -> Frame:
    """The coordinates of the lane on which the vehicle under test departs, with their origin at its front."""
    with open_world(copied_network(network, 1), 1, options) as world:
        world.enter(None)
        x, y = world.vehicle_positions(VUT)[0].tolist()
        return Frame((x, y), Frame.of(world.lane_of(VUT)).direction)


class StageWorld(SumoWorld):
    """N copies of a road in SUMO with the bodies of a stage.

    Vehicles are where they are on `lane`, in its coordinates, to the last bit: SUMO must have them at the same places.
    """

    def __init__(self, api: Api, n: int, stage: Stage, start_speeds: FloatArray, start: Frame) -> None:
        super().__init__(api, n)
        self._stage, self._start, self._sample = stage, start, 0
        self._lane = LaneWorld(stage, start_speeds, self.step_length)
        self._actors = [track for track in stage.cast if track.kind != SCREEN]
        self._edges = [str(api.vehicle.getRoute(id_)[0]) for id_ in self.ids(VUT)]
        """The edges on which the vehicles under test depart."""

    @property
    def frame(self) -> Frame:
        return self._lane.frame

    def enter(self, types: SumoType | None, *, keeps_drivers: bool = False) -> Motion:
        super().enter(types, keeps_drivers=keeps_drivers)
        return self._checked(self._lane.enter(types))

    def _depart(self) -> None:
        for track in self._actors:
            self._add(track)
        self._put()
        super()._depart()

    def step(self, speeds: FloatArray, is_open: BoolArray) -> Motion:
        self._sample += 1
        self._put()
        super().step(speeds, is_open)
        return self._checked(self._lane.step(speeds, is_open))

    def bodies(self, vehicles: Sequence[int]) -> tuple[Body, Body]:
        return self._lane.bodies(vehicles)

    def bodies_around(self, vehicles: Sequence[int]) -> tuple[IntArray, Body, Body]:
        return self._lane.bodies_around(vehicles)

    def _hits(self, is_open: BoolArray) -> dict[int, float]:
        return {}

    def _add(self, actor: Track) -> None:
        """Add an actor to every copy, wherever it may be put."""
        is_person, types = actor.kind in PERSONS, self.api.vehicletype
        lengths, widths = self._of_copies(actor.length), self._of_copies(actor.width)
        for id_, edge, length, width in zip(self.ids(actor.name), self._edges, lengths, widths, strict=True):
            types.copy("DEFAULT_PEDTYPE" if is_person else "DEFAULT_VEHTYPE", id_)
            types.setLength(id_, length)
            types.setWidth(id_, width)
            types.setMinGap(id_, 0)
            types.setShapeClass(id_, SHAPES.get(actor.kind, "evehicle"))
            if is_person:
                self.api.person.add(id_, edge, 0.0, typeID=id_)
                self.api.person.appendWaitingStage(id_, WAIT)
            else:
                self.api.route.add(id_, [edge])
                self.api.vehicle.add(id_, id_, typeID=id_)
                self.api.vehicle.setSpeedMode(id_, SPEED_MODE)
                self.api.vehicle.setLaneChangeMode(id_, 0)

    def _put(self) -> None:
        """Put all actors where they are at the sample that the coming step leads to."""
        for actor in self._actors:
            places, directions = self._fronts_of(actor)
            degrees = np.degrees(np.arctan2(directions[:, 0], directions[:, 1]))
            speeds = self._of_copies(actor.speed)
            domain = self.api.person if actor.kind in PERSONS else self.api.vehicle
            for copy, id_ in enumerate(self.ids(actor.name)):
                x, y = places[copy].tolist()
                edge, angle = self._edges[copy], float(degrees[copy]) % 360
                if domain is self.api.person:
                    domain.moveToXY(id_, edge, x, y, angle, ANY_PLACE)
                else:
                    domain.moveToXY(id_, edge, ANY_LANE, x, y, angle, ANY_PLACE)
                    domain.setPreviousSpeed(id_, speeds[copy])

    def _of_copies(self, column: FloatArray) -> list[float]:
        """A column at this sample, for every copy."""
        values: list[float] = np.broadcast_to(row(column, self._sample, self._stage.group), self.n).tolist()
        return values

    def _fronts_of(self, actor: Track) -> tuple[FloatArray, FloatArray]:
        """Where the front of an actor is in the network, and its direction; shape (N, 2)."""
        x, y, along, left, length = (
            np.array(self._of_copies(column)) for column in (actor.x, actor.y, actor.along, actor.left, actor.length)
        )
        places = self._start.point(x + along * length / 2, y + left * length / 2)
        directions = self._start._replace(origin=(0.0, 0.0)).point(along, left)
        return np.stack(places, axis=1), np.stack(directions, axis=1)

    def _checked(self, motion: Motion) -> Motion:
        """The motion on the lane; refuses a simulation in which SUMO has a vehicle or an actor elsewhere."""
        front = np.stack(self._start.point(motion.fronts[:, 0], 0.0), axis=1)
        driving = [*self.driving.values()]
        wanted = {"vehicle under test": (front[driving], self._fronts[driving])}
        for actor in self._actors:
            domain = self.api.person if actor.kind in PERSONS else self.api.vehicle
            there = np.array([domain.getPosition(id_) for id_ in self.ids(actor.name)])
            wanted[f"actor {actor.name!r}"] = self._fronts_of(actor)[0], there
        for name, (here, there) in wanted.items():
            if not (np.abs(there - here) <= PLACE_TOLERANCE).all():
                off, time = np.abs(there - here).max(), self._sample * self.step_length
                raise SimulationError(f"SUMO has the {name} {off:.2g} m beside its track at {time:g} s")
        return motion
