"""Vehicles that drive in recorded scenes, without SUMO.

N vehicles move over the scene's lanes as SUMO's ballistic update moves them and collide where bodies overlap. Positions are SUMO's to
the last bit: the operations are those of `MSVehicle::updateState`, `MSLane::interpolateLanePosToGeometryPos` and
`PositionVector::positionAtOffset`, in their order.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from operator import itemgetter
from typing import Any

import numpy as np

from safevar_sumo.errors import SimulationError
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.scenarios import VUT, Lane
from safevar_sumo.scenarios.base import lane_through
from safevar_sumo.sumo.recording import Recording, Track
from safevar_sumo.sumo.world import Body, direction_of
from safevar_sumo.vehicles import Sensors

NUMERICAL_EPS = 0.001
"""SUMO, utils/common/StdDefs.h [m]."""
NOBODY = np.empty((0, 2), dtype=np.intp)
"""An empty array of (scene, actor) pairs."""
PARALLEL = 1 - 1e-9
"""Cosine of the angle between two vehicles, above which they count as having the same direction."""


class UnknownActorError(Exception):
    """A scenario asks for an actor or a lane that a scene does not have."""


def distance(before: FloatArray, after: FloatArray, step: float) -> FloatArray:
    """Distance covered in a step between two speeds at constant acceleration [m], with SUMO's operations (`MSVehicle::getDeltaPos`)."""
    acceleration = (after - before) / step
    return np.asarray((before + 0.5 * (acceleration * step)) * step)


def not_on_the_road(actor: str, time: float) -> SimulationError:
    """The error for an actor that has not departed, or has arrived, at a time [s]."""
    return SimulationError(f"SUMO failed: {actor!r} is not on the road at {time:g} s")


class Samples:
    """A recorded scene at all of its samples at once, as if each sample were a copy of the network.

    `absent`, shape (T,), is true where the actor last asked for is not on the road; the actor then keeps its last position.
    """

    def __init__(self, tracks: Mapping[str, Track]) -> None:
        self._tracks, self.actor, self.absent = tracks, "", np.zeros(0, dtype=bool)

    def vehicle_positions(self, actor: str) -> FloatArray:
        """Positions of the front; shape (T, 2) [m]."""
        positions = self._tracks[actor].position
        self.actor, self.absent = actor, np.isnan(positions[:, 0])
        return positions[np.maximum.accumulate(np.where(self.absent, 0, np.arange(len(positions))))]

    person_positions = vehicle_positions


class RecordedScene:
    """The vehicles of one scene of a recorded world, with the methods of `SumoWorld` that scenarios call; shapes (N,) and (N, 2).

    All other actors move as recorded, so commands to them have no effect.
    """

    lookup_errors = (UnknownActorError,)

    def __init__(self, world: RecordedWorld, recording: Recording, rows: slice) -> None:
        self._world, self._recording, self._rows = world, recording, rows
        self.n, self.step_length = rows.stop - rows.start, recording.step_length

    def walk(self, *_: object) -> None:
        """Do nothing."""

    drive = turn_back = walk

    def samples(self) -> Samples:
        """The scene at all of its samples."""
        return Samples(self._recording.tracks)

    def speeds(self) -> FloatArray:
        return self._world.speeds()[self._rows]

    def vehicle_positions(self, actor: str) -> FloatArray:
        if actor == VUT:
            return self._world.vehicle_positions(VUT)[self._rows]
        sample, positions = self._world.sample, self._track(actor).position
        position = positions[min(sample, len(positions) - 1)]  # of a batch in which other scenes last longer
        if math.isnan(position[0]):
            raise not_on_the_road(actor, sample * self.step_length)
        result = np.empty((self.n, 2))
        result[:] = position
        return result

    person_positions = vehicle_positions

    def vehicle_length(self, actor: str) -> float:
        return self._recording.length if actor == VUT else self._track(actor).length

    def vehicle_width(self, actor: str) -> float:
        return self._recording.width if actor == VUT else self._track(actor).width

    def person_width(self, actor: str) -> float:
        return self._track(actor).width

    def lane(self, lane: str) -> Lane:
        return lane_through(lane, self._entry(self._recording.lanes, lane))

    def lane_start(self, lane: str) -> tuple[float, float]:
        return self._entry(self._recording.lanes, lane)[0]  # type: ignore[no-any-return]

    def lane_of(self, vehicle: str) -> Lane:
        return self.lane(self._entry(self._recording.lane_of, vehicle))

    def _track(self, actor: str) -> Track:
        track: Track = self._entry(self._recording.tracks, actor)
        return track

    @staticmethod
    def _entry(table: dict[str, Any], name: str) -> Any:
        if name not in table:
            raise UnknownActorError(f"{name!r} is not in the recorded scene")
        return table[name]


class RecordedWorld:
    """N vehicles in each of several recorded scenes of one network, with the methods of `SumoWorld` for vehicles under test."""

    def __init__(self, recordings: Sequence[Recording], n: int) -> None:
        self._recordings, self._size, road = recordings, n, recordings[0]
        self.n, self.step_length, self.sample = n * len(recordings), road.step_length, 0
        self.scenes = [RecordedScene(self, recording, slice(k * n, (k + 1) * n)) for k, recording in enumerate(recordings)]
        self.vehicle_length, self.lane_of = self.scenes[0].vehicle_length, self.scenes[0].lane_of
        self._speeds = np.repeat([recording.speed for recording in recordings], n)
        self._lane, self._place = np.zeros(self.n, dtype=np.intp), np.repeat([recording.start for recording in recordings], n)
        self._lanes, self._left = road.way.at(self._lane), np.zeros(self.n, dtype=bool)
        self._front: FloatArray | None = None
        self._struck: dict[int, Body] = {}
        self.sensors = Sensors.perfect(self.n)
        self._front_before, self._speeds_before = self.vehicle_positions(VUT), self._speeds
        self._ahead_before = self._front_before @ road.along
        self._extents, self._others = _joined_extents(recordings), [[*recording.tracks.values()] for recording in recordings]

    def set_types(self, *_: object) -> None:
        """Do nothing: everybody has departed, and SUMO obeys every speed that is set, whatever a vehicle's type and decelerations."""

    depart = set_decelerations = set_types

    def leave(self, copies: Sequence[int]) -> None:
        """Freeze position and speed of vehicles whose runs are over."""
        self._left[copies] = True

    def advance(self, speeds: FloatArray) -> None:
        """One step in which the vehicles reach `speeds` [m/s], at a constant acceleration.

        Raises
        ------
        SimulationError
            If a vehicle leaves its last lane.
        """
        self._front_before, self._speeds_before = self.vehicle_positions(VUT), self._speeds
        way = distance(self._speeds, speeds, self.step_length)
        if np.count_nonzero(self._left):
            speeds, way = np.where(self._left, self._speeds, speeds), np.where(self._left, 0.0, way)
        self._place = self._place + way
        self._speeds, self._front, self.sample = speeds, None, self.sample + 1
        while np.count_nonzero(beyond := self._place > self._lanes.end):
            way_ahead = self._recordings[0].way
            if (self._lane[beyond] == len(way_ahead.end) - 1).any():
                raise SimulationError("SUMO failed: a vehicle under test drives beyond the end of its route")
            self._place = np.where(beyond, self._place - self._lanes.end, self._place)
            self._lane = self._lane + beyond
            self._lanes = way_ahead.at(self._lane)

    def speeds(self) -> FloatArray:
        return self._speeds

    def vehicle_positions(self, _: str) -> FloatArray:
        """Positions of the vehicles under test."""
        if self._front is None:
            self._front = self._lanes.positions(self._place)
        return self._front

    def collisions(self, open_: BoolArray) -> dict[int, float]:
        """Vehicles of open runs whose body overlaps another, and their speeds [m/s].

        SUMO checks twice in a step: after persons have moved but before vehicles have, and after vehicles have
        moved (`MSNet::simulationStep`: `STAGE_EVENTS`, `STAGE_MOVEMENTS`).
        """
        self._struck, result = {}, dict[int, float]()
        near = self._near(open_)
        if not len(near):
            return result
        tracks = [self._others[k][number] for k, number in near.tolist()]
        others = Body.columns([_body(track, self.sample) for track in tracks])
        persons = np.array([track.is_person for track in tracks])
        moved, still = (self.vehicle_positions(VUT), self._speeds), (self._front_before, self._speeds_before)
        hits = [(pair, row, phase) for phase, (fronts, _) in enumerate((still, moved)) if phase or persons.any()
                for pair, row in self._overlaps(fronts, open_, near[:, 0], others, persons, still=not phase)]
        for pair, row, phase in sorted(hits, key=itemgetter(0, 2)):
            if row not in result:
                result[row] = float((moved if phase else still)[1][row])
                self._struck[row] = Body._make(column[pair] for column in others)
        return dict(sorted(result.items()))

    def _overlaps(self, fronts: FloatArray, open_: BoolArray, scenes: Any, others: Body, persons: BoolArray, *,
                  still: bool) -> Iterator[tuple[int, int]]:
        """Pairs of a body, by its number, and a vehicle, by its row, whose rectangles overlap: no side of either separates them.

        Two vehicles with the same direction must overlap by more than a millimetre (SUMO, `MSLane::detectCollisionBetween`).
        """
        own, length, width = self._recordings[0].along, self._recordings[0].length, self._recordings[0].width
        across, other_across = _left(own), np.stack([-others.along[:, 1], others.along[:, 0]], axis=1)
        cosine, sine = np.abs(others.along @ own), np.abs(other_across @ own)
        least = np.where(persons | (cosine < PARALLEL), 0.0, NUMERICAL_EPS)
        reach = (length + others.length * cosine + others.width * sine) / 2 - least
        offset = others.middle + own * (length / 2)
        candidates = open_.reshape(-1, self._size)[scenes]
        if still:
            candidates = candidates & persons[:, np.newaxis]
        ahead = np.abs((offset[:, np.newaxis] - fronts.reshape(-1, self._size, 2)[scenes]) @ own)
        pair, place = np.nonzero(candidates & (ahead < reach[:, np.newaxis]))
        if not len(pair):
            return
        row = scenes[pair] * self._size + place
        to_other, cosine, sine, least = offset[pair] - fronts[row], cosine[pair], sine[pair], least[pair]
        other_length, other_width = others.length[pair], others.width[pair]
        apart = np.abs(to_other @ across) >= (width + other_length * sine + other_width * cosine) / 2 - least
        for axis, reach in ((others.along, other_length + length * cosine + width * sine),
                            (other_across, other_width + length * sine + width * cosine)):
            apart |= np.abs((to_other * axis[pair]).sum(axis=1)) >= reach / 2 - least
        yield from zip(pair[~apart].tolist(), row[~apart].tolist(), strict=True)

    def _near(self, open_: BoolArray) -> Any:
        """Pairs (scene, actor), by number, with a vehicle of an open run beside the actor now or a step ago; shape (M, 2)."""
        ahead, before = self.vehicle_positions(VUT) @ self._recordings[0].along, self._ahead_before
        self._ahead_before = ahead
        if self.sample >= self._extents.shape[1]:
            return NOBODY
        rears, fronts = self._extents[:, self.sample]
        if not np.count_nonzero(rears < np.maximum.reduce(ahead.reshape(-1, self._size), axis=1)[:, np.newaxis]):
            return NOBODY
        foremost = np.where(open_, ahead, -np.inf).reshape(-1, self._size).max(axis=1)
        rearmost = np.where(open_, before, np.inf).reshape(-1, self._size).min(axis=1)
        return np.argwhere((rears < foremost[:, np.newaxis]) & (fronts > rearmost[:, np.newaxis]))

    def bodies(self, copies: Sequence[int]) -> tuple[Body, Body]:
        """Vehicles under test that collide in this step, and the bodies that they collide with; in columns."""
        road, n = self._recordings[0], len(copies)
        own = Body.behind(self.vehicle_positions(VUT)[copies], road.along, road.length, road.width, self._speeds[copies])
        return (own._replace(along=np.tile(road.along, (n, 1)), length=np.full(n, road.length), width=np.full(n, road.width)),
                Body.columns([self._struck[copy] for copy in copies]))


def _joined_extents(recordings: Sequence[Recording]) -> FloatArray:
    """Extents of several scenes in one array, shape (2, T, K, A); NaN where nobody is."""
    _, length, most = np.max([recording.extents.shape for recording in recordings], axis=0)
    joined = np.full((2, length, len(recordings), most), np.nan)
    for k, recording in enumerate(recordings):
        joined[:, :recording.extents.shape[1], k, :recording.extents.shape[2]] = recording.extents
    return joined


def _body(track: Track, sample: int) -> Body:
    return Body.behind(track.position[sample], direction_of(float(track.angle[sample])), track.length, track.width,
                       float(track.speed[sample]))


def _left(direction: FloatArray) -> FloatArray:
    return np.array([-direction[1], direction[0]])
