"""A world in which vehicles drive in a recorded scene, without SUMO.

The vehicles move along the scene's lanes by SUMO's ballistic update, and collide when bodies
overlap. Their positions equal SUMO's to the last bit, because this module repeats the operations of
`MSVehicle::updateState`, `MSLane::interpolateLanePosToGeometryPos` and
`PositionVector::positionAtOffset` in the same order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import SimulationError
from safevar_sumo.records import BoolArray, FloatArray, IntArray, nans
from safevar_sumo.scenarios import VUT, Lane, WorldScenario
from safevar_sumo.scenarios.base import ScenarioMemory
from safevar_sumo.scenarios.roads import Frame
from safevar_sumo.sumo.bodies import (
    Body,
    BodyPairs,
    VehicleStates,
    distance_covered,
    find_overlaps,
)
from safevar_sumo.sumo.recording import Recording
from safevar_sumo.vehicles import SumoType

NUMERICAL_EPS = 0.001
"""SUMO's tolerance for positions on lanes [m] (utils/common/StdDefs.h)."""
PARALLEL_COSINE = 1 - 1e-9
"""Smallest absolute cosine of the angle between two vehicles that count as parallel; they may drive
in opposite directions.
"""


class _Moment(NamedTuple):
    """The motion of N vehicles at one time: their fronts, shape (N, 2) [m], their speeds, shape
    (N,) [m/s], and whether SUMO looks for collisions with persons on their lanes, shape (N,).
    """

    fronts: FloatArray
    speeds: FloatArray
    meets_persons: BoolArray


class RecordedWorld:
    """A `SceneWorld` with `size` vehicles in a recorded scene: all other actors move as recorded.

    A recording may stand for K scenes with `size` vehicles in each. Then its `start`, `speed` and
    tracks are arrays with a value for each scene (see `encounters.py`).
    """

    def __init__(self, recording: Recording, size: int) -> None:
        films = list(recording.tracks.values())
        n_samples = max((len(film.motion) for film in films), default=1)
        n_scenes = np.size(recording.speed)
        self._size = size
        self._scene = recording
        self._is_person = np.array([film.is_person for film in films], bool)
        sizes = [(film.length, film.width) for film in films]
        self._sizes = np.reshape(sizes, (-1, 2))
        self._motion = nans((n_samples, n_scenes, len(films), 5))
        for actor, film in enumerate(films):
            length = len(film.motion)
            self._motion[:length, :, actor] = film.motion.reshape(length, -1, 5)

        fronts = self._motion[..., :2]
        directions = self._motion[..., 2:4]
        self._middles = fronts - directions * (self._sizes[:, :1] / 2)
        diagonals = np.hypot(*self._sizes.T)
        vehicle_size = recording.length, recording.width
        self._reach = np.add.outer(vehicle_size, diagonals) / 2
        """Largest distances between the middles of a vehicle and an actor that touch, along and
        across the way, shape (2, A) [m].
        """
        begins = self._middles @ recording.along - self._reach[0]
        first_begins = np.fmin.reduce(begins, axis=(1, 2), initial=np.inf)
        self._begins = first_begins + recording.length / 2
        """Position along the way that a front must have reached to touch somebody, at every sample
        [m]; infinite without actors.
        """
        self.n = size * n_scenes
        self.step_length = recording.step_length
        self.sample = 0
        self._lane_number = np.zeros(self.n, np.intp)
        self._lane_position = np.repeat(recording.start, size)
        self._lanes = recording.way.at(self._lane_number)
        self._now = self._moment(np.repeat(recording.speed, size))
        self._before = self._now
        self._struck: dict[int, int] = {}
        """The numbers of the actors that vehicles hit in this step, by vehicle number."""

    def enter(
        self, types: SumoType | None, *, keeps_drivers: bool = False
    ) -> VehicleStates:
        """Return the first motion. The recording starts with vehicles that have departed, and types
        do not limit the speeds that `step` gets.
        """
        return self._moved(np.ones(self.n, bool))

    def step(self, speeds: FloatArray, is_open: BoolArray) -> VehicleStates:
        """Simulate one step, in which vehicles with `is_open` (their runs have not ended) reach
        `speeds` [m/s] at a constant acceleration.

        Raises
        ------
        SimulationError
            If a vehicle leaves its last lane.
        """
        self._before = self._now
        distances = distance_covered(self._before.speeds, speeds, self.step_length)
        speeds = np.where(is_open, speeds, self._before.speeds)
        distances = np.where(is_open, distances, 0.0)
        self._lane_position = self._lane_position + distances
        self.sample += 1

        # A fast vehicle may pass several lanes in a step.
        last_lane = len(self._scene.way.end) - 1
        while True:
            is_past = self._lane_position > self._lanes.end
            if not is_past.any():
                break
            if (self._lane_number[is_past] == last_lane).any():
                raise SimulationError(
                    "SUMO failed: a vehicle under test drives beyond the end of its route"
                )
            rest_of_way = self._lane_position - self._lanes.end
            self._lane_position = np.where(is_past, rest_of_way, self._lane_position)
            self._lane_number = self._lane_number + is_past
            self._lanes = self._scene.way.at(self._lane_number)
        self._now = self._moment(speeds)
        return self._moved(is_open)

    def _moment(self, speeds: FloatArray) -> _Moment:
        fronts = self._lanes.positions(self._lane_position)
        return _Moment(fronts, speeds, self._lanes.meets_persons != 0)

    def _moved(self, is_open: BoolArray) -> VehicleStates:
        return VehicleStates(self._now.fronts, self._now.speeds, self._hits(is_open))

    def begin(self, scenario: WorldScenario) -> ScenarioMemory:
        """Start a scenario before the first step, and return its memory."""
        return scenario.begin(self)

    def speeds(self) -> FloatArray:
        return self._now.speeds

    def vehicle_positions(self, actor: str) -> FloatArray:
        if actor == VUT:
            return self._now.fronts
        # One place for all scenes, or a place for each.
        places = np.atleast_2d(self._scene.tracks[actor].motion[self.sample, ..., :2])
        return places.repeat(self.n // len(places), axis=0)

    person_positions = vehicle_positions

    def vehicle_length(self, actor: str) -> float:
        if actor == VUT:
            return self._scene.length
        return self._scene.tracks[actor].length

    @property
    def vehicle_width(self) -> float:
        return self._scene.width

    def person_width(self, actor: str) -> float:
        return self._scene.tracks[actor].width

    def lane(self, lane: str) -> Lane:
        return self._scene.lane(lane)

    @property
    def frame(self) -> Frame:
        return Frame.through_origin(self.lane_of(VUT))

    def lane_of(self, vehicle: str) -> Lane:
        return self.lane(self._scene.first_lanes[vehicle])

    def walk(self, *_: object) -> None:
        """Do nothing: actors move as recorded."""

    turn_back = walk

    def _hits(self, is_open: BoolArray) -> dict[int, float]:
        """Speeds [m/s] of the vehicles whose body overlaps the body of an actor, by vehicle number.
        Vehicles whose runs have ended (not `is_open`) are left out.

        As in SUMO, overlaps count at two times of a step: after persons have moved but before
        vehicles have, and after vehicles have moved (`MSNet::simulationStep`: `STAGE_EVENTS`,
        `STAGE_MOVEMENTS`). Persons who cross a junction are only hit by vehicles whose front is on
        this junction (`MSLane::detectCollisions`).
        """
        # In most steps nobody is near any vehicle: this test saves the computation of overlaps.
        self._struck = {}
        if (self._now.fronts @ self._scene.along).max() < self._at_sample(self._begins):
            return {}
        vehicles, actors = np.nonzero(self._is_near() & is_open[:, np.newaxis])
        if not len(vehicles):
            return {}

        # `early` is before vehicles move, `late` is after; other vehicles are hit only late.
        is_person = self._is_person[actors]
        early = is_person & self._before.meets_persons[vehicles]
        early &= self._overlaps(self._before, vehicles, actors)
        late = ~is_person | self._now.meets_persons[vehicles]
        late &= self._overlaps(self._now, vehicles, actors)

        speeds = {}
        for pair in np.flatnonzero(early | late):
            vehicle = int(vehicles[pair])
            # Of several actors, the first counts.
            if vehicle not in speeds:
                moment = self._before if early[pair] else self._now
                speeds[vehicle] = float(moment.speeds[vehicle])
                self._struck[vehicle] = int(actors[pair])
        return speeds

    def _is_near(self) -> BoolArray:
        """Whether each vehicle may have touched each of the A actors since the last step, shape
        (N, A).
        """
        middles = self._now.fronts - self._scene.along * (self._scene.length / 2)
        middles_of_scenes = middles.reshape(-1, self._size, 1, 2)
        offsets = middles_of_scenes - self._at_sample(self._middles)[:, np.newaxis]
        dx, dy = offsets.reshape(self.n, -1, 2).transpose(2, 0, 1)
        east, north = self._scene.along
        along = np.abs(dx * east + dy * north)
        across = np.abs(dy * east - dx * north)
        largest_way = (
            np.maximum(self._before.speeds, self._now.speeds) * self.step_length
        )
        is_near_along = along < self._reach[0] + largest_way[:, np.newaxis]
        return np.asarray(is_near_along & (across < self._reach[1]))

    def _overlaps(
        self,
        moment: _Moment,
        vehicles: IntArray,
        actors: IntArray,
    ) -> BoolArray:
        """Whether vehicle and actor overlap in each pair of `vehicles` and `actors`. Two parallel
        vehicles must overlap by more than a millimetre (SUMO, `MSLane::detectCollisionBetween`).
        """
        bodies = self._vehicle_body(moment, vehicles)
        obstacles = self._actors(vehicles, actors)
        is_parallel = np.abs(obstacles.along @ self._scene.along) >= PARALLEL_COSINE
        has_tolerance = is_parallel & ~self._is_person[actors]
        tolerance = np.where(has_tolerance, NUMERICAL_EPS, 0.0)
        return np.asarray(find_overlaps(bodies, obstacles) > tolerance)

    def bodies(self, vehicles: Sequence[int]) -> BodyPairs:
        struck = np.array([self._struck[vehicle] for vehicle in vehicles])
        return self._pairs(np.asarray(vehicles), struck)

    def bodies_around(self, vehicles: Sequence[int]) -> BodyPairs:
        n_actors = len(self._sizes)
        actors = np.tile(np.arange(n_actors), len(vehicles))
        return self._pairs(np.repeat(vehicles, n_actors), actors)

    def _pairs(self, vehicles: IntArray, actors: IntArray) -> BodyPairs:
        """Vehicles, shape (M,), each with an actor at this sample."""
        body = self._vehicle_body(self._now, vehicles)
        return BodyPairs(vehicles, body, self._actors(vehicles, actors))

    def _at_sample(self, motion: FloatArray) -> FloatArray:
        """The row of `motion` at the current sample; without actors there is only one row."""
        row: FloatArray = motion[min(self.sample, len(motion) - 1)]
        return row

    def _actors(self, vehicles: IntArray, actors: IntArray) -> Body:
        """The bodies of actors at the current sample, each in the scene of its vehicle."""
        motion = self._at_sample(self._motion)[vehicles // self._size, actors]
        front, along, speed = np.split(motion, (2, 4), axis=1)
        length, width = self._sizes[actors].T
        return Body.behind(front, along, length, width, speed[:, 0])

    def _vehicle_body(self, moment: _Moment, vehicles: IntArray) -> Body:
        scene = self._scene
        along = np.tile(scene.along, (len(vehicles), 1))
        return Body.behind(
            moment.fronts[vehicles],
            along,
            scene.length,
            scene.width,
            moment.speeds[vehicles],
        )
