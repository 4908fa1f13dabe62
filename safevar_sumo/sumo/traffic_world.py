"""A world in SUMO with bodies on tracks: this module puts each body where its track says, and the
vehicles under test drive among these bodies.

Collisions follow from the geometry of the bodies, and not from SUMO: it misses contacts at the side
between lanes, and reports other contacts too early.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import SimulationError
from safevar_sumo.records import BoolArray, FloatArray, significant
from safevar_sumo.scenarios import VUT, Track
from safevar_sumo.scenarios.roads import Frame
from safevar_sumo.scenarios.tracks import PERSONS, SCREEN
from safevar_sumo.sumo.bodies import BodyPairs, Film, VehicleStates
from safevar_sumo.sumo.engine import open_world
from safevar_sumo.sumo.lane_world import LaneWorld
from safevar_sumo.sumo.moving import Sampled, at_sample
from safevar_sumo.sumo.network import NetworkFiles, copied_network
from safevar_sumo.sumo.traffic import Traffic
from safevar_sumo.sumo.world import SPEED_MODE, Api, SumoWorld, function_of
from safevar_sumo.vehicles import SumoType

PLACE_TOLERANCE = 1e-6
"""Largest distance in SUMO of an actor from its track, and of a vehicle under test from its
position on the lane [m].
"""
ANY_PLACE = 1 + 2 + 4
"""Argument `keepRoute` of `moveToXY`: SUMO looks for the lane on the actor's own route only,
ignores who may use this lane, and allows places beside every road. Without this value SUMO would
look at the lanes of all copies, which are in the same place.
"""
ANY_LANE = -1
"""Argument `laneIndex` of `moveToXY`: SUMO chooses the lane."""
SHAPES = {
    "adult": "pedestrian",
    "child": "pedestrian",
    "cyclist": "bicycle",
    "motorcyclist": "motorcycle",
}
"""Shapes that sumo-gui draws, by kind of actor. All other kinds have the shape of a vehicle whose
corners SUMO does not cut off.
"""
WAIT = 1e6
"""Length of the waiting stage that keeps persons in the simulation [s]: longer than any run."""


@lru_cache(maxsize=100)
def start_frame(network: NetworkFiles, step: float | None) -> Frame:
    """The coordinates of the lane on which the vehicle under test departs, with their origin at its
    front.
    """
    with open_world(copied_network(network, 1), 1, step) as world:
        world.enter(None)
        x, y = world.vehicle_positions(VUT)[0].tolist()
        return Frame((x, y), Frame.of(world.lane_of(VUT)).direction)


class Placed(NamedTuple):
    """An actor in all copies: its track, its ids, whether it is a person, and its position and
    angle in SUMO at every sample.

    `x` and `y` are the position of a vehicle's front or of a person's middle [m], `angle` is in
    degrees clockwise from north; these are columns as in `Moving`.
    """

    track: Track
    ids: list[str]
    is_person: bool
    x: FloatArray
    y: FloatArray
    angle: FloatArray

    @classmethod
    def of(cls, track: Track, ids: list[str], start: Frame) -> Placed:
        """The actor of a track. `start` has the lane's coordinates, in which tracks are, with their
        origin at the first front of the vehicle under test.
        """
        is_person = track.kind in PERSONS
        offset = 0.0 if is_person else track.length.max(axis=0) / 2
        x, y = start.point(
            track.x + track.along * offset, track.y + track.left * offset
        )
        east, north = start._replace(origin=(0.0, 0.0)).point(track.along, track.left)
        angle = np.degrees(np.arctan2(east, north)) % 360
        return cls(track, ids, is_person, np.asarray(x), np.asarray(y), angle)


class TrafficWorld(SumoWorld):
    """N copies of a road in SUMO with bodies on tracks.

    The motion of the vehicles under test is that of a `LaneWorld`, in its coordinates and to the
    last bit. A SimulationError is raised if SUMO has a vehicle at another place.
    """

    def __init__(self, api: Api, n: int, traffic: Traffic, start: Frame) -> None:
        super().__init__(api, n)
        self._traffic = traffic
        self._start = start

        self._sample = 0
        self._lane = LaneWorld(traffic, self.step_length)
        self._actors = [
            Placed.of(track, self.ids(track.name), start)
            for track in traffic.tracks
            if track.kind != SCREEN
        ]

        # These functions run for every copy at every sample: their Python wrappers would double
        # the time.
        self._move_person = function_of(api, "person", "moveToXY")
        self._move_vehicle = function_of(api, "vehicle", "moveToXY")
        self._set_previous_speed = function_of(api, "vehicle", "setPreviousSpeed")
        self._routes = [api.vehicle.getRoute(name) for name in self.ids(VUT)]

    @property
    def frame(self) -> Frame:
        return self._lane.frame

    def enter(
        self, types: SumoType | None, *, keeps_drivers: bool = False
    ) -> VehicleStates:
        super().enter(types, keeps_drivers=keeps_drivers)
        return self._checked(self._lane.enter(types))

    def _depart(self) -> None:
        for actor in self._actors:
            self._add(actor)
        self._put()
        super()._depart()

    def step(self, speeds: FloatArray, is_open: BoolArray) -> VehicleStates:
        self._sample += 1
        self._put()
        super().step(speeds, is_open)
        return self._checked(self._lane.step(speeds, is_open))

    def bodies(self, vehicles: Sequence[int]) -> BodyPairs:
        return self._lane.bodies(vehicles)

    def _hits(self, is_open: BoolArray) -> dict[int, float]:
        return {}

    def film(self, tracks: dict[str, Film], sample: int, length: int) -> None:
        """Write the motion of all actors; see `SumoWorld.film`. An actor without a size is not
        there: its motion is NaN.
        """
        super().film(tracks, sample, length)
        for actor in self._actors:
            size = self._at_copies(actor.track.length + actor.track.width)
            tracks[actor.track.name].motion[sample, size == 0] = np.nan

    def _add(self, actor: Placed) -> None:
        """Add an actor to every copy. `_put` then moves the actor to its place."""
        api = self.api
        types = api.vehicletype
        track = actor.track
        # An actor that appears later has no size yet: SUMO gets the size that the actor will have.
        lengths = self._of_copies(track.length.max(axis=0, keepdims=True))
        widths = self._of_copies(track.width.max(axis=0, keepdims=True))
        default_type = "DEFAULT_PEDTYPE" if actor.is_person else "DEFAULT_VEHTYPE"
        copies = zip(actor.ids, self._routes, lengths, widths, strict=True)
        for id_, route, length, width in copies:
            types.copy(default_type, id_)
            types.setLength(id_, length)
            types.setWidth(id_, width)
            types.setMinGap(id_, 0)
            types.setShapeClass(id_, SHAPES.get(track.kind, "evehicle"))
            if actor.is_person:
                api.person.add(id_, route[0], 0.0, typeID=id_)
                api.person.appendWaitingStage(id_, WAIT)
            else:
                api.route.add(id_, route)
                api.vehicle.add(id_, id_, typeID=id_)
                api.vehicle.setSpeedMode(id_, SPEED_MODE)
                api.vehicle.setLaneChangeMode(id_, 0)

    def _put(self) -> None:
        """Put all actors at their places of the current sample, at which the next step of SUMO
        ends.
        """
        for actor in self._actors:
            places = (
                self._of_copies(values) for values in (actor.x, actor.y, actor.angle)
            )
            placed = zip(actor.ids, self._routes, *places, strict=True)
            if actor.is_person:
                for id_, route, x, y, angle in placed:
                    self._move_person(id_, route[0], x, y, angle, ANY_PLACE)
            else:
                for id_, route, x, y, angle in placed:
                    self._move_vehicle(id_, route[0], ANY_LANE, x, y, angle, ANY_PLACE)
                for id_, speed in zip(
                    actor.ids, self._of_copies(actor.track.speed), strict=True
                ):
                    self._set_previous_speed(id_, speed)

    def _of_copies(self, column: FloatArray) -> list[float]:
        """The values of a column at the current sample, a value for every copy."""
        values: list[float] = self._at_copies(column).tolist()
        return values

    def _at_copies(self, column: Sampled) -> Sampled:
        values = at_sample(column, self._sample, self._traffic.group)
        return np.broadcast_to(values, self.n)

    def _checked(self, motion: VehicleStates) -> VehicleStates:
        """Return the motion on the lane unchanged, after a check. Raises a SimulationError if SUMO
        has a vehicle under test or an actor at another place.
        """
        front = np.stack(self._start.point(motion.fronts[:, 0], 0.0), axis=1)
        driving = list(self.driving.values())
        places = {"vehicle under test": (front[driving], self._fronts[driving])}
        for actor in self._actors:
            get_position = self._get_position
            if actor.is_person:
                get_position = self._get_person_position
            expected = np.stack(
                [self._at_copies(values) for values in (actor.x, actor.y)], axis=1
            )
            actual = np.array([get_position(name) for name in actor.ids])
            places[f"actor {actor.track.name!r}"] = expected, actual
        for name, (expected, actual) in places.items():
            distances = np.abs(actual - expected)
            if not (distances <= PLACE_TOLERANCE).all():
                time = self._sample * self.step_length
                largest = significant(distances.max(), 2)
                raise SimulationError(
                    f"SUMO has the {name} {largest} m beside its track at {time:g} s"
                )
        return motion
