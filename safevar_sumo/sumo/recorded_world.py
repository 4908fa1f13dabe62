"""Vehicles that drive in recorded scenes, without SUMO.

The vehicles move along the scenes' lanes by SUMO's ballistic update, and collide where bodies overlap. Their positions
equal SUMO's to the last bit, because this module repeats the operations of `MSVehicle::updateState`,
`MSLane::interpolateLanePosToGeometryPos` and `PositionVector::positionAtOffset` in the same order.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from operator import itemgetter
from typing import Any

import numpy as np

from safevar_sumo.errors import SimulationError
from safevar_sumo.records import BoolArray, FloatArray, IntArray
from safevar_sumo.scenarios import VUT, Lane
from safevar_sumo.scenarios.base import lane_through
from safevar_sumo.sumo.recording import Recording, Track
from safevar_sumo.sumo.world import Body, SumoWorld, direction_of
from safevar_sumo.vehicles import Sensors

NUMERICAL_EPS = 0.001
"""SUMO's tolerance for positions on lanes [m] (utils/common/StdDefs.h)."""
NO_PAIRS = np.empty((0, 2), dtype=np.intp)
"""No (scene, actor) pairs: an empty array."""
PARALLEL_COSINE = 1 - 1e-9
"""Smallest absolute cosine of the angle between two parallel vehicles; vehicles in opposite directions are parallel
too.
"""


class UnknownActorError(Exception):
    """A scenario queries an actor or a lane that the recorded scene does not have."""


def distance_covered(old_speed: FloatArray, new_speed: FloatArray, step: float) -> FloatArray:
    """Distance [m] covered in a time step at constant acceleration, by the operations of SUMO's
    `MSVehicle::getDeltaPos`.
    """
    acceleration = (new_speed - old_speed) / step
    return np.asarray((old_speed + 0.5 * (acceleration * step)) * step)


def absence_error(actor: str, time: float) -> SimulationError:
    """The error for an actor that has not departed yet, or has already arrived, at a time [s]."""
    return SimulationError(f"SUMO failed: {actor!r} is not on the road at {time:g} s")


class SampledRecording:
    """A recorded scene at all of its T samples at once, with the methods of a world of T copies.

    `absence`, shape (T,), is true where `actor`, the actor queried last, is not on the road; its last position is then
    repeated.
    """

    def __init__(self, tracks: Mapping[str, Track]) -> None:
        self._tracks, self.actor, self.absence = tracks, "", np.zeros(0, dtype=bool)

    def vehicle_positions(self, actor: str) -> FloatArray:
        """Positions of the actor's front, shape (T, 2) [m]."""
        positions = self._tracks[actor].position
        self.actor, self.absence = actor, np.isnan(positions[:, 0])
        return positions[np.maximum.accumulate(np.where(self.absence, 0, np.arange(len(positions))))]

    person_positions = vehicle_positions


class RecordedWorldSlice:
    """The N vehicles of a recorded world that drive in the same scene, with the methods of `SumoWorld` that scenarios
    call.

    Arrays have shape (N,) or (N, 2). All other actors move as recorded, so commands to them have no effect.
    """

    lookup_errors = (UnknownActorError,)

    def __init__(self, world: RecordedWorld, recording: Recording, vehicles: slice) -> None:
        self._world, self._recording, self._vehicles = world, recording, vehicles
        self.n, self.step_length = vehicles.stop - vehicles.start, recording.step_length

    def walk(self, *_: object) -> None:
        """Do nothing."""

    drive = turn_back = walk

    def at_all_samples(self) -> SampledRecording:
        return SampledRecording(self._recording.tracks)

    def speeds(self) -> FloatArray:
        return self._world.speeds()[self._vehicles]

    def vehicle_positions(self, actor: str) -> FloatArray:
        if actor == VUT:
            return self._world.vehicle_positions(VUT)[self._vehicles]
        sample, positions = self._world.sample, self._track(actor).position
        position = positions[min(sample, len(positions) - 1)]  # other scenes of the batch may last longer
        if math.isnan(position[0]):
            raise absence_error(actor, sample * self.step_length)
        repeated_positions = np.empty((self.n, 2))
        repeated_positions[:] = position
        return repeated_positions

    person_positions = vehicle_positions

    def vehicle_length(self, actor: str) -> float:
        return self._recording.length if actor == VUT else self._track(actor).length

    def person_width(self, actor: str) -> float:
        return self._track(actor).width

    def lane(self, lane: str) -> Lane:
        return lane_through(lane, self._look_up(self._recording.lanes, lane))

    def lane_of(self, vehicle: str) -> Lane:
        return self.lane(self._look_up(self._recording.lane_of, vehicle))

    def _track(self, actor: str) -> Track:
        return self._look_up(self._recording.tracks, actor)  # type: ignore[no-any-return]

    @staticmethod
    def _look_up(table: dict[str, Any], name: str) -> Any:
        if name not in table:
            raise UnknownActorError(f"{name!r} is not in the recorded scene")
        return table[name]


class RecordedWorld:
    """K recorded scenes of one network with `size` vehicles in each, and the methods of `SumoWorld` for these K * size
    vehicles.
    """

    def __init__(self, recordings: Sequence[Recording], size: int) -> None:
        self._recordings, self._size, first_recording = recordings, size, recordings[0]
        self.n, self.step_length, self.sample = size * len(recordings), first_recording.step_length, 0
        self.slices = [
            RecordedWorldSlice(self, recording, slice(k * size, (k + 1) * size))
            for k, recording in enumerate(recordings)
        ]
        self.vehicle_length, self.lane_of = self.slices[0].vehicle_length, self.slices[0].lane_of
        self._speeds = np.repeat([recording.speed for recording in recordings], size)
        self._lane_number = np.zeros(self.n, dtype=np.intp)
        self._lane_position = np.repeat([recording.start for recording in recordings], size)
        self._lanes, self._is_frozen = first_recording.way.at(self._lane_number), np.zeros(self.n, dtype=bool)
        self._fronts: FloatArray | None = None
        self._struck_bodies: dict[int, Body] = {}
        self.sensors = Sensors.perfect(self.n)
        self._last_fronts, self._last_speeds = self.vehicle_positions(VUT), self._speeds
        self._last_coordinates = self._last_fronts @ first_recording.along
        self._extents, self._tracks = (
            _joined_extents(recordings),
            [[*recording.tracks.values()] for recording in recordings],
        )

    def set_types(self, *_: object) -> None:
        """Do nothing: all vehicles have departed, and their types and decelerations do not limit the commanded
        speeds.
        """

    depart = set_decelerations = set_types

    def end_runs(self, copies: Sequence[int]) -> None:
        """Freeze the positions and speeds of vehicles whose runs end."""
        self._is_frozen[copies] = True

    def advance(self, speeds: FloatArray) -> None:
        """Simulate one step, in which the vehicles reach `speeds` [m/s] at a constant acceleration.

        Raises
        ------
        SimulationError
            If a vehicle leaves its last lane.
        """
        self._last_fronts, self._last_speeds = self.vehicle_positions(VUT), self._speeds
        distances = distance_covered(self._speeds, speeds, self.step_length)
        if np.count_nonzero(self._is_frozen):
            speeds, distances = (
                np.where(self._is_frozen, self._speeds, speeds),
                np.where(self._is_frozen, 0.0, distances),
            )
        self._lane_position = self._lane_position + distances
        self._speeds, self._fronts, self.sample = speeds, None, self.sample + 1
        while np.count_nonzero(is_beyond := self._lane_position > self._lanes.end):
            lane_sequence = self._recordings[0].way
            if (self._lane_number[is_beyond] == len(lane_sequence.end) - 1).any():
                raise SimulationError("SUMO failed: a vehicle under test drives beyond the end of its route")
            self._lane_position = np.where(is_beyond, self._lane_position - self._lanes.end, self._lane_position)
            self._lane_number = self._lane_number + is_beyond
            self._lanes = lane_sequence.at(self._lane_number)

    def speeds(self) -> FloatArray:
        return self._speeds

    def vehicle_positions(self, _: str) -> FloatArray:
        """Positions of the vehicles under test."""
        if self._fronts is None:
            self._fronts = self._lanes.positions(self._lane_position)
        return self._fronts

    def collisions(self, is_open: BoolArray) -> dict[int, float]:
        """Speeds [m/s] of the vehicles of open runs whose body overlaps another actor's, by vehicle number.

        SUMO checks twice in a step: after persons have moved but before vehicles have, and after vehicles have
        moved (`MSNet::simulationStep`: `STAGE_EVENTS`, `STAGE_MOVEMENTS`).
        """
        self._struck_bodies, collision_speeds = {}, dict[int, float]()
        pairs = self._adjacent_pairs(is_open)
        if not len(pairs):
            return collision_speeds
        tracks = [self._tracks[scene][actor] for scene, actor in pairs.tolist()]
        others = Body.columns([_body_at(track, self.sample) for track in tracks])
        persons = np.array([track.is_person for track in tracks])
        fronts_at_checks, speeds_at_checks = (
            (self._last_fronts, self.vehicle_positions(VUT)),
            (self._last_speeds, self._speeds),
        )
        hits = [
            (body, vehicle, check)
            for check, fronts in enumerate(fronts_at_checks)
            if check or persons.any()
            for body, vehicle in self._overlaps(fronts, is_open, pairs[:, 0], others, persons, only_persons=not check)
        ]
        for body, vehicle, check in sorted(hits, key=itemgetter(0, 2)):
            if vehicle not in collision_speeds:
                collision_speeds[vehicle] = float(speeds_at_checks[check][vehicle])
                self._struck_bodies[vehicle] = Body._make(column[body] for column in others)
        return dict(sorted(collision_speeds.items()))

    def _overlaps(
        self,
        fronts: FloatArray,
        is_open: BoolArray,
        scene_numbers: IntArray,
        others: Body,
        persons: BoolArray,
        *,
        only_persons: bool,
    ) -> Iterator[tuple[int, int]]:
        """Yield the numbers of a body of `others` and of a vehicle that overlap: no edge of either rectangle separates
        them.

        Two parallel vehicles must overlap by more than a millimetre (SUMO, `MSLane::detectCollisionBetween`).
        """
        direction, length, width = self._recordings[0].along, self._recordings[0].length, self._recordings[0].width
        normal, other_normals = (
            np.array([-direction[1], direction[0]]),
            np.stack([-others.along[:, 1], others.along[:, 0]], axis=1),
        )
        cosine, sine = np.abs(others.along @ direction), np.abs(other_normals @ direction)
        min_overlap = np.where(persons | (cosine < PARALLEL_COSINE), 0.0, NUMERICAL_EPS)
        max_distance = (length + others.length * cosine + others.width * sine) / 2 - min_overlap
        # Where a vehicle's front is if its middle is the other body's middle.
        front_targets = others.middle + direction * (length / 2)
        candidates = is_open.reshape(-1, self._size)[scene_numbers]
        if only_persons:
            candidates = candidates & persons[:, np.newaxis]
        distance = np.abs((front_targets[:, np.newaxis] - fronts.reshape(-1, self._size, 2)[scene_numbers]) @ direction)
        body, vehicle_in_scene = np.nonzero(candidates & (distance < max_distance[:, np.newaxis]))
        if not len(body):
            return
        vehicle = scene_numbers[body] * self._size + vehicle_in_scene
        to_other, cosine, sine, min_overlap = (
            front_targets[body] - fronts[vehicle],
            cosine[body],
            sine[body],
            min_overlap[body],
        )
        other_length, other_width = others.length[body], others.width[body]
        is_separated = (
            np.abs(to_other @ normal) >= (width + other_length * sine + other_width * cosine) / 2 - min_overlap
        )
        for axis, joint_extent in (
            (others.along, other_length + length * cosine + width * sine),
            (other_normals, other_width + length * sine + width * cosine),
        ):
            is_separated |= np.abs((to_other * axis[body]).sum(axis=1)) >= joint_extent / 2 - min_overlap
        yield from zip(body[~is_separated].tolist(), vehicle[~is_separated].tolist(), strict=True)

    def _adjacent_pairs(self, is_open: BoolArray) -> IntArray:
        """Numbers (scene, actor) of the M actors that vehicles of open runs are beside, now or one step ago; shape (M,
        2).
        """
        coordinates, last_coordinates = self.vehicle_positions(VUT) @ self._recordings[0].along, self._last_coordinates
        self._last_coordinates = coordinates
        if self.sample >= self._extents.shape[1]:
            return NO_PAIRS
        starts, ends = self._extents[:, self.sample]
        if not np.count_nonzero(starts < np.maximum.reduce(coordinates.reshape(-1, self._size), axis=1)[:, np.newaxis]):
            return NO_PAIRS
        foremost = np.where(is_open, coordinates, -np.inf).reshape(-1, self._size).max(axis=1)
        rearmost = np.where(is_open, last_coordinates, np.inf).reshape(-1, self._size).min(axis=1)
        return np.argwhere((starts < foremost[:, np.newaxis]) & (ends > rearmost[:, np.newaxis]))

    def bodies(self, copies: Sequence[int]) -> tuple[Body, Body]:
        """The bodies of vehicles that collide in this step, and of the actors that they collide with, both in
        columns.
        """
        vut, n = self._recordings[0], len(copies)
        own = Body.behind(self.vehicle_positions(VUT)[copies], vut.along, vut.length, vut.width, self._speeds[copies])
        return (
            own._replace(along=np.tile(vut.along, (n, 1)), length=np.full(n, vut.length), width=np.full(n, vut.width)),
            Body.columns([self._struck_bodies[copy] for copy in copies]),
        )


def _joined_extents(recordings: Sequence[Recording]) -> FloatArray:
    """The extents of K scenes in one array, shape (2, T, K, A); NaN where a scene has no actor."""
    _, n_samples, n_actors = np.max([recording.extents.shape for recording in recordings], axis=0)
    joined = np.full((2, n_samples, len(recordings), n_actors), np.nan)
    for k, recording in enumerate(recordings):
        joined[:, : recording.extents.shape[1], k, : recording.extents.shape[2]] = recording.extents
    return joined


def _body_at(track: Track, sample: int) -> Body:
    along = direction_of(float(track.angle[sample]))
    return Body.behind(track.position[sample], along, track.length, track.width, float(track.speed[sample]))


DrivenWorld = SumoWorld | RecordedWorld
"""A world in which vehicles under test drive."""
