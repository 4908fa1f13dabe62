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
from safevar_sumo.vehicles import Sensors, SumoType

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


class RecordedWorld:
    """N vehicles in each of several recorded scenes of one network, with the methods of `SumoWorld`; shapes (N,) and (N, 2)."""

    lookup_errors = (UnknownActorError,)

    def __init__(self, recordings: Sequence[Recording], n: int, whole: RecordedWorld | None = None, first: int = 0) -> None:
        self._recordings, self._size, self._whole, self._first = recordings, n, whole, first
        self.n, self.step_length = n * len(recordings), recordings[0].step_length
        self._sample = 0
        self._speeds = np.repeat([one.speed for one in recordings], n)
        self._lane, self._place = np.zeros(self.n, dtype=np.intp), np.repeat([one.start for one in recordings], n)
        self._lanes, self._left = recordings[0].way.at(self._lane), np.zeros(self.n, dtype=bool)
        self._front: FloatArray | None = None
        self._struck: dict[int, Body] = {}
        self.sensors = Sensors.perfect(self.n)
        if whole is None:
            self._front_before, self._speeds_before = self.vehicle_positions(VUT), self._speeds
            self._ahead_before = self._front_before @ recordings[0].along
            self._extents, self._others = _joined_extents(recordings), [[*one.tracks.values()] for one in recordings]

    def set_types(self, types: SumoType) -> None:
        """Do nothing: SUMO obeys every speed that is set, so types do not affect how vehicles move."""

    def set_decelerations(self, decel: FloatArray) -> None:
        """Do nothing: decelerations do not affect how vehicles move either."""

    def depart(self) -> None:
        """Do nothing: everybody has departed."""

    def leave(self, copies: Sequence[int]) -> None:
        """Freeze position and speed of vehicles whose runs are over."""
        self._left[copies] = True

    def walk(self, person: str, speed: float) -> None:
        """Do nothing: all other actors move as recorded."""

    def drive(self, vehicle: str, speed: float) -> None:
        """Do nothing: as recorded."""

    def turn_back(self, person: str) -> None:
        """Do nothing: as recorded."""

    def part(self, first: int, n: int) -> RecordedWorld:
        """The world of `n` vehicles of one scene, from row `first` on."""
        return RecordedWorld([self._recordings[first // self._size]], n, self, first)

    def samples(self) -> Samples:
        """The only scene, at all of its samples."""
        return Samples(self._recordings[0].tracks)

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
        self._speeds, self._front, self._sample = speeds, None, self._sample + 1
        while np.count_nonzero(beyond := self._place > self._lanes.end):
            way_ahead = self._recordings[0].way
            if (self._lane[beyond] == len(way_ahead.end) - 1).any():
                raise SimulationError("SUMO failed: a vehicle under test drives beyond the end of its route")
            self._place = np.where(beyond, self._place - self._lanes.end, self._place)
            self._lane = self._lane + beyond
            self._lanes = way_ahead.at(self._lane)

    def speeds(self) -> FloatArray:
        return self._speeds if self._whole is None else self._whole.speeds()[self._rows]

    def vehicle_positions(self, actor: str) -> FloatArray:
        if actor != VUT:
            return self._recorded(actor)
        if self._whole is not None:
            return self._whole.vehicle_positions(VUT)[self._rows]
        if self._front is None:
            self._front = self._lanes.positions(self._place)
        return self._front

    person_positions = vehicle_positions

    def _recorded(self, actor: str) -> FloatArray:
        """Position of a recorded actor, repeated for all vehicles; there must be one scene only."""
        positions = self._track(actor).position
        position = positions[min(self._now, len(positions) - 1)]  # of a batch in which other scenes last longer
        if math.isnan(position[0]):
            raise not_on_the_road(actor, self._now * self.step_length)
        result = np.empty((self.n, 2))
        result[:] = position
        return result

    def _track(self, actor: str) -> Track:
        track: Track = self._known(self._recordings[0].tracks, actor)
        return track

    @staticmethod
    def _known(table: dict[str, Any], name: str) -> Any:
        if name not in table:
            raise UnknownActorError(f"{name!r} is not known")
        return table[name]

    @property
    def _rows(self) -> slice:
        return slice(self._first, self._first + self.n)

    @property
    def _now(self) -> int:
        return self._sample if self._whole is None else self._whole._sample

    def vehicle_length(self, actor: str) -> float:
        return self._recordings[0].length if actor == VUT else self._track(actor).length

    def vehicle_width(self, actor: str) -> float:
        return self._recordings[0].width if actor == VUT else self._track(actor).width

    def person_width(self, actor: str) -> float:
        return self._track(actor).width

    def lane(self, lane: str) -> Lane:
        return lane_through(lane, self._known(self._recordings[0].lanes, lane))

    def lane_start(self, lane: str) -> tuple[float, float]:
        return self._known(self._recordings[0].lanes, lane)[0]  # type: ignore[no-any-return]

    def lane_of(self, vehicle: str) -> Lane:
        return self.lane(self._known(self._recordings[0].lane_of, vehicle))

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
        others = Body.columns([_body(track, self._sample) for track in tracks])
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
        if self._sample >= self._extents.shape[1]:
            return NOBODY
        rears, fronts = self._extents[:, self._sample]
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
    _, length, most = np.max([one.extents.shape for one in recordings], axis=0)
    joined = np.full((2, length, len(recordings), most), np.nan)
    for k, one in enumerate(recordings):
        joined[:, :one.extents.shape[1], k, :one.extents.shape[2]] = one.extents
    return joined


def _body(track: Track, sample: int) -> Body:
    return Body.behind(track.position[sample], direction_of(float(track.angle[sample])), track.length, track.width,
                       float(track.speed[sample]))


def _left(direction: FloatArray) -> FloatArray:
    return np.array([-direction[1], direction[0]])
