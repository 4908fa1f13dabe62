"""Vehicles that drive in a recorded scene, without SUMO.

The vehicles move along the scene's lanes by SUMO's ballistic update, and collide where bodies overlap. Their positions
equal SUMO's to the last bit, because this module repeats the operations of `MSVehicle::updateState`,
`MSLane::interpolateLanePosToGeometryPos` and `PositionVector::positionAtOffset` in the same order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safevar_sumo.errors import SimulationError
from safevar_sumo.records import BoolArray, FloatArray, IntArray
from safevar_sumo.scenarios import VUT, Lane, WorldScenario
from safevar_sumo.scenarios.base import ScenarioMemory
from safevar_sumo.scenarios.roads import Frame
from safevar_sumo.sumo.bodies import Body, Motion, distance_covered
from safevar_sumo.sumo.recording import Recording
from safevar_sumo.vehicles import SumoType

NUMERICAL_EPS = 0.001
"""SUMO's tolerance for positions on lanes [m] (utils/common/StdDefs.h)."""
EXTENT_MARGIN = 0.01
"""Margin of the extents [m]; an actor outside its extent is not checked for a collision."""
PARALLEL_COSINE = 1 - 1e-9
"""Smallest absolute cosine of the angle between two parallel vehicles, which may drive in opposite directions."""


class RecordedWorld:
    """A recorded scene with `size` vehicles; a `World` in which other actors move as recorded.

    The scene may stand for K scenes with `size` vehicles in each: then its `start`, `speed` and tracks are arrays with
    one value for each (`encounters.py`).
    """

    def __init__(self, recording: Recording, size: int) -> None:
        self._size = size
        self._scene = recording
        self._motion, self._sizes = _joined_tracks(recording)
        self.n = size * self._motion.shape[1]
        self.step_length = self._scene.step_length
        self.sample: Any = 0
        self._speeds = np.repeat(recording.speed, size)
        self._lane_number = np.zeros(self.n, dtype=np.intp)
        self._lane_position = np.repeat(recording.start, size)
        self._lanes = self._scene.way.at(self._lane_number)
        self._fronts: FloatArray | None = None
        self._struck: dict[int, int] = {}
        """The bodies that vehicles strike in this step, by vehicle: numbers among `_others`, all bodies beside them."""
        self._last_fronts = self.vehicle_positions(VUT)
        self._last_speeds = self._speeds
        self._met_persons = self._lanes.meets_persons != 0
        self._last_coordinates = self._last_fronts @ self._scene.along
        self._starts, self._ends = self._extents()

    def enter(self, types: SumoType | None, *, keeps_drivers: bool = False) -> Motion:
        """All vehicles have departed, and their types do not limit the commanded speeds."""
        return self._moved(np.ones(self.n, dtype=bool))

    def step(self, speeds: FloatArray, is_open: BoolArray) -> Motion:
        """Simulate one step, in which the vehicles whose runs are open reach `speeds` [m/s] at a constant acceleration.

        Raises
        ------
        SimulationError
            If a vehicle leaves its last lane.
        """
        self._last_fronts = self.vehicle_positions(VUT)
        self._last_speeds = self._speeds
        self._met_persons = self._lanes.meets_persons != 0
        distances = distance_covered(self._speeds, speeds, self.step_length)
        if np.count_nonzero(is_open) < self.n:
            speeds = np.where(is_open, speeds, self._speeds)
            distances = np.where(is_open, distances, 0.0)
        self._lane_position = self._lane_position + distances
        self._speeds = speeds
        self._fronts = None
        self.sample = self.sample + 1
        while np.count_nonzero(is_beyond := self._lane_position > self._lanes.end):
            if (self._lane_number[is_beyond] == len(self._scene.way.end) - 1).any():
                raise SimulationError("SUMO failed: a vehicle under test drives beyond the end of its route")
            self._lane_position = np.where(is_beyond, self._lane_position - self._lanes.end, self._lane_position)
            self._lane_number = self._lane_number + is_beyond
            self._lanes = self._scene.way.at(self._lane_number)
        return self._moved(is_open)

    def _moved(self, is_open: BoolArray) -> Motion:
        return Motion(self.vehicle_positions(VUT), self._speeds, self._hits(is_open))

    def begin(self, scenario: WorldScenario) -> ScenarioMemory:
        """Start a scenario before the first step, and return its memory."""
        return scenario.begin(self)

    def speeds(self) -> FloatArray:
        return self._speeds

    def vehicle_positions(self, actor: str) -> FloatArray:
        if actor != VUT:
            motion = self._scene.tracks[actor].motion
            places = motion[self.sample, ..., :2]
            return np.full((self.n, 2), places) if motion.ndim == 2 else places.repeat(self._size, axis=0)
        if self._fronts is None:
            self._fronts = self._lanes.positions(self._lane_position)
        return self._fronts

    person_positions = vehicle_positions

    def vehicle_length(self, actor: str) -> float:
        return self._scene.length if actor == VUT else self._scene.tracks[actor].length

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
        """Speeds [m/s] of the vehicles of open runs whose body overlaps another actor's, by vehicle number.

        SUMO checks twice in a step: after persons have moved but before vehicles have, and after vehicles have
        moved (`MSNet::simulationStep`: `STAGE_EVENTS`, `STAGE_MOVEMENTS`). Persons who cross a junction are checked
        against vehicles whose front is on it (`MSLane::detectCollisions`).
        """
        self._struck = {}
        scenes, actors = self._adjacent_pairs(is_open).T
        if not len(scenes):
            return {}
        motion, (length, width, is_person) = self._motion[self.sample, scenes, actors], self._sizes[scenes, actors].T
        self._others = Body.behind(motion[:, :2], motion[:, 2:4], length, width, motion[:, 4])
        is_beside = is_open.reshape(-1, self._size)[scenes]
        persons = (is_person != 0)[:, np.newaxis]
        met, meet = (
            flags.reshape(-1, self._size)[scenes] for flags in (self._met_persons, self._lanes.meets_persons != 0)
        )
        first_hits = self._overlap(self._last_fronts, is_beside & persons & met, scenes, is_person != 0)
        second_hits = self._overlap(self.vehicle_positions(VUT), is_beside & (~persons | meet), scenes, is_person != 0)
        # In the order of the bodies, and for each body of the checks, of which `first` takes a vehicle's first hit:
        bodies, checks, vehicles_in_scene = np.argwhere(np.stack([first_hits, second_hits], axis=1)).T
        vehicles, first = np.unique(scenes[bodies] * self._size + vehicles_in_scene, return_index=True)
        speeds = np.where(checks[first] == 0, self._last_speeds[vehicles], self._speeds[vehicles])
        self._struck = dict(zip(vehicles.tolist(), bodies[first].tolist(), strict=True))
        return dict(zip(vehicles.tolist(), speeds.tolist(), strict=True))

    def _overlap(self, fronts: FloatArray, candidates: BoolArray, scenes: IntArray, is_person: BoolArray) -> BoolArray:
        """Which of the candidates, shape (M, size), overlap the M bodies `_others`, which are in these scenes.

        Two rectangles overlap if no edge of either separates them. Two parallel vehicles must overlap by more than a
        millimetre (SUMO, `MSLane::detectCollisionBetween`).
        """
        if not np.count_nonzero(candidates):
            return candidates
        direction = self._scene.along
        length = self._scene.length
        width = self._scene.width
        others = self._others
        normal = _left_of(direction)
        other_normals = _left_of(others.along)
        cosine = np.abs(others.along @ direction)
        sine = np.abs(other_normals @ direction)
        min_overlap = np.where(is_person | (cosine < PARALLEL_COSINE), 0.0, NUMERICAL_EPS)
        # From a vehicle's front to where it is if the vehicle's middle is the other body's middle.
        to_other = (others.middle + direction * (length / 2))[:, np.newaxis] - fronts.reshape(-1, self._size, 2)[scenes]
        for axis, joint_extent in (
            (direction, length + others.length * cosine + others.width * sine),
            (normal, width + others.length * sine + others.width * cosine),
            (others.along[:, np.newaxis], others.length + length * cosine + width * sine),
            (other_normals[:, np.newaxis], others.width + length * sine + width * cosine),
        ):
            distance = np.abs(to_other[..., 0] * axis[..., 0] + to_other[..., 1] * axis[..., 1])
            candidates = candidates & (distance < (joint_extent / 2 - min_overlap)[:, np.newaxis])
            if not np.count_nonzero(candidates):
                break
        return candidates

    def _extents(self) -> FloatArray:
        """First and last coordinate, along the way, of a vehicle's front while the vehicle is beside an actor, with a
        margin; shape (2, T, K, A) [m].
        """
        x, y, east, north, _ = self._motion.T
        length, width, _ = self._sizes.T[..., np.newaxis]
        along_x, along_y = self._scene.along
        cosine = along_x * east + along_y * north
        sine = along_x * north - along_y * east
        middle = along_x * x + along_y * y - cosine * (length / 2)
        half = (np.abs(cosine) * length + np.abs(sine) * width) / 2 + EXTENT_MARGIN
        return np.array([(middle - half).T, (middle + half + self._scene.length).T])

    def _adjacent_pairs(self, is_open: BoolArray) -> IntArray:
        """Numbers (scene, actor), shape (M, 2), of the actors that vehicles of open runs are beside, now or one step
        ago.
        """
        coordinates = self.vehicle_positions(VUT) @ self._scene.along
        last_coordinates = self._last_coordinates
        self._last_coordinates = coordinates
        sample = min(self.sample, len(self._starts) - 1)
        starts = self._starts[sample]
        ends = self._ends[sample]
        # In most steps no vehicle has come as far as an actor, which is found faster than below.
        if not np.count_nonzero(starts < np.maximum.reduce(coordinates.reshape(-1, self._size), axis=1)[:, np.newaxis]):
            return np.empty((0, 2), dtype=np.intp)
        foremost = np.where(is_open, coordinates, -np.inf).reshape(-1, self._size).max(axis=1)
        rearmost = np.where(is_open, last_coordinates, np.inf).reshape(-1, self._size).min(axis=1)
        return np.argwhere((starts < foremost[:, np.newaxis]) & (ends > rearmost[:, np.newaxis]))

    def bodies(self, vehicles: Sequence[int]) -> tuple[Body, Body]:
        struck = [self._struck[vehicle] for vehicle in vehicles]
        return self._own_bodies(np.asarray(vehicles)), Body._make(column[struck] for column in self._others)

    def bodies_around(self, vehicles: Sequence[int]) -> tuple[IntArray, Body, Body]:
        scenes = np.asarray(vehicles) // self._size
        n_actors = self._motion.shape[2]
        motion = self._motion[self.sample, scenes].reshape(-1, 5)
        sizes = self._sizes[scenes].reshape(-1, 3)
        owners = np.repeat(vehicles, n_actors)
        others = Body.behind(motion[:, :2], motion[:, 2:4], sizes[:, 0], sizes[:, 1], motion[:, 4])
        return owners, self._own_bodies(owners), others

    def _own_bodies(self, vehicles: IntArray) -> Body:
        scene = self._scene
        n = len(vehicles)
        along = np.tile(scene.along, (n, 1))
        length = np.full(n, scene.length)
        width = np.full(n, scene.width)
        return Body.behind(self.vehicle_positions(VUT)[vehicles], along, length, width, self._speeds[vehicles])


def _joined_tracks(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """The motion of A actors in K scenes, shape (T, K, A, 5), NaN after an actor's last sample; and their lengths,
    widths and whether they are persons, shape (K, A, 3).
    """
    tracks = [*recording.tracks.values()]
    n_samples = max((len(track.motion) for track in tracks), default=1)
    n_scenes = np.size(recording.speed)
    motion = np.full((n_samples, n_scenes, len(tracks), 5), np.nan)
    sizes = np.full((n_scenes, len(tracks), 3), np.nan)
    for actor, track in enumerate(tracks):
        motion[: len(track.motion), :, actor] = track.motion.reshape(len(track.motion), -1, 5)
        sizes[:, actor] = track.length, track.width, track.is_person
    return motion, sizes


def _left_of(direction: FloatArray) -> FloatArray:
    """The unit vectors to the left of directions, in the last axis."""
    return np.stack([-direction[..., 1], direction[..., 0]], axis=-1)
