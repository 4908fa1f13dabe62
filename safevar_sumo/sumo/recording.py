"""A scene that SUMO has played once, and the vehicles under test that drive in it without SUMO.

Where nobody reacts to the vehicle under test, everybody else moves alike in every simulation. SUMO plays them once, with a vehicle
under test that stays where it starts; N vehicles then move over its lanes as SUMO's ballistic update moves them and collide where
bodies overlap. Positions are SUMO's to the last bit: the operations are those of `MSVehicle::updateState`,
`MSLane::interpolateLanePosToGeometryPos` and `PositionVector::positionAtOffset`, in their order.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, cast

import numpy as np

from safevar_sumo.errors import SimulationError
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.scenarios import VUT, GuardedScenario, Lane, Scenario
from safevar_sumo.scenarios.base import lane_through
from safevar_sumo.sumo.copies import copied_id, copy_and_name
from safevar_sumo.sumo.engine import Engine, world_on
from safevar_sumo.sumo.network import network_fingerprint
from safevar_sumo.sumo.sources import is_shipped
from safevar_sumo.sumo.staging import staged
from safevar_sumo.sumo.world import Body, SumoWorld, begin, direction_of
from safevar_sumo.vehicles import Sensors, SumoType

SCENES = 256
"""Recorded scenes that a process keeps; one of ten seconds takes some ten kilobytes."""
POSITION_EPS = 0.1
"""Least length of a lane's shape (SUMO, utils/common/StdDefs.h) [m]."""
NUMERICAL_EPS = 0.001
"""SUMO, utils/common/StdDefs.h [m]."""
PARALLEL = 1 - 1e-9
"""Cosine of the angle between two vehicles from which on they are in one direction."""


class UnrecordableError(Exception):
    """A scene cannot be recorded; its text says why."""


class UnknownActorError(Exception):
    """A scenario asks for somebody or a lane that a scene does not have."""


class Track(NamedTuple):
    """Somebody at every step: position [m], shape (T, 2), heading clockwise from north [degrees] and speed [m/s], shape (T,).

    NaN while not on the road; `length` and `width` in m.
    """

    position: FloatArray
    angle: FloatArray
    speed: FloatArray
    is_person: bool
    length: float
    width: float


class Way(NamedTuple):
    """The straight lanes that the vehicle under test drives on, one after the other; shape (L,) or (L, 2) [m].

    `end` is the place on a lane where it ends, `stretch` the length of a lane's shape over the lane's length.
    """

    first: FloatArray
    vector: FloatArray
    end: FloatArray
    stretch: FloatArray
    shape_length: FloatArray

    def positions(self, lane: Any, place: FloatArray) -> FloatArray:
        """Front bumpers, shape (N, 2) [m], at a place on a lane; shapes (N,)."""
        share = place * self.stretch[lane] / self.shape_length[lane]
        return np.asarray(self.first[lane] + self.vector[lane] * share[:, np.newaxis])


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A scene without a vehicle under test that drives: `start` and `speed` are where it departs on its `way` [m, m/s]."""

    step_length: float
    start: float
    speed: float
    length: float
    width: float
    way: Way
    along: FloatArray
    lanes: dict[str, tuple[tuple[float, float], ...]]
    lane_of: dict[str, str]
    tracks: dict[str, Track]


def reason_for_copies(scenario: Scenario, options: Sequence[str]) -> str:
    """Why a scenario is driven in SUMO, each vehicle in a copy of its own; "" if its scene can be recorded."""
    if getattr(scenario, "reactive_actors", True):
        return "somebody in the scenario may react to the vehicle under test"
    if not isinstance(scenario, GuardedScenario) and not is_shipped(scenario.network):  # ours speak for our own networks alone
        return f"the traffic of the network {scenario.network!r} may react to the vehicle under test"
    recording = _recorded(cast(Hashable, scenario), network_fingerprint(staged(scenario)), tuple(options))
    return recording if isinstance(recording, str) else ""


def recording_of(scenario: Scenario, options: Sequence[str]) -> Recording:
    """The scene of a scenario without a `reason_for_copies`, with further options of SUMO; recorded once in a process.

    Raises
    ------
    SimulationError
        If SUMO fails.
    """
    recording = _recorded(cast(Hashable, scenario), network_fingerprint(staged(scenario)), tuple(options))
    assert isinstance(recording, Recording)
    return recording


@lru_cache(maxsize=SCENES)
def _recorded(scenario: Any, fingerprint: str, options: tuple[str, ...]) -> Recording | str:
    """The scene, or why there is none; `fingerprint` stands for the contents of the network's files."""
    with world_on(staged(scenario), 1, Engine.LIBSUMO, options) as world:
        world.let_depart()
        world.depart()
        try:
            return _played(scenario, world)
        except UnrecordableError as error:
            return str(error)


def _played(scenario: Scenario, world: SumoWorld) -> Recording:
    api, vut, step = world.api, copied_id(0, VUT), world.step_length
    way, along = _way_of(api, vut)
    start, speed = float(api.vehicle.getLanePosition(vut)), float(api.vehicle.getSpeed(vut))
    lane_of = {name: copy_and_name(api.vehicle.getLaneID(one))[1] for one, name in _named(api.vehicle.getIDList())}
    lanes = {name: tuple((float(x), float(y)) for x, y in api.lane.getShape(one)) for one, name in _named(api.lane.getIDList())}
    length = round(scenario.duration / step) + 1
    states, sizes, memory = dict[str, FloatArray](), dict[str, tuple[bool, float, float]](), begin(scenario, world)
    for sample in range(length):
        for kind in (api.vehicle, api.person):
            for one, name in _named(kind.getIDList()):
                if name == VUT:
                    continue
                if name not in states:
                    states[name] = np.full((length, 4), np.nan)
                    sizes[name] = kind is api.person, float(kind.getLength(one)), float(kind.getWidth(one))
                states[name][sample] = *kind.getPosition(one), kind.getAngle(one), kind.getSpeed(one)
        if sample < length - 1:
            _, memory = scenario.observe(world, step, memory)
            world.advance(np.zeros(1))
    return Recording(
        step_length=step, start=start, speed=speed, length=world.vehicle_length(VUT), width=world.vehicle_width(VUT), way=way,
        along=along, lanes=lanes, lane_of=lane_of,
        tracks={name: Track(rows[:, :2].copy(), rows[:, 2], rows[:, 3], *sizes[name]) for name, rows in states.items()})


def _named(ids: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Those of the first copy, and what they are called in the original."""
    for one in ids:
        copy, name = copy_and_name(one)
        if copy == 0:
            yield one, name


def _way_of(api: Any, vut: str) -> tuple[Way, FloatArray]:
    """The lanes ahead of a vehicle that has departed, and their direction.

    Raises
    ------
    UnrecordableError
        If they are not one straight.
    """
    if api.vehicle.getLateralLanePosition(vut):
        raise UnrecordableError("the vehicle under test departs beside the middle of its lane")
    lanes = [api.vehicle.getLaneID(vut)]
    for edge in api.vehicle.getRoute(vut)[api.vehicle.getRouteIndex(vut) + 1:]:
        links = [link for link in api.lane.getLinks(lanes[-1]) if api.lane.getEdgeID(link[0]) == edge]
        if len(links) != 1:
            raise UnrecordableError(f"there are {len(links)} lanes from {lanes[-1]!r} to {edge!r}")
        ahead, inside = links[0][0], links[0][4]
        while inside:
            lanes.append(inside)
            inside = next(iter(api.lane.getLinks(inside)), ("", "", "", "", ""))[4]
        lanes.append(ahead)
    shapes = [api.lane.getShape(lane) for lane in lanes]
    for lane, shape in zip(lanes, shapes, strict=True):
        if len(shape) != 2:
            raise UnrecordableError(f"lane {copy_and_name(lane)[1]!r} of the vehicle under test is not straight")
    first, last = (np.array([shape[k] for shape in shapes], dtype=float) for k in (0, 1))
    vector, end = last - first, np.array([api.lane.getLength(lane) for lane in lanes], dtype=float)
    shape_length = np.sqrt((vector * vector).sum(axis=1))
    direction = vector / shape_length[:, np.newaxis]
    if np.abs(direction - direction[0]).max() > 1e-6 or np.abs(first[1:] - last[:-1]).max(initial=0.0) > 1e-6:
        raise UnrecordableError("the lanes of the vehicle under test are not one straight")
    return Way(first, vector, end, np.maximum(shape_length, POSITION_EPS) / end, shape_length), direction_of(api.vehicle.getAngle(vut))


def distance(before: FloatArray, after: FloatArray, step: float) -> FloatArray:
    """Way in a step from one speed to another at a constant acceleration [m], in SUMO's operations (`MSVehicle::getDeltaPos`)."""
    acceleration = (after - before) / step
    return np.asarray((before + 0.5 * (acceleration * step)) * step)


class RecordedWorld:
    """N vehicles in each of several recorded scenes of one network; for a drive what `SumoWorld` is, of shapes (N,) and (N, 2)."""

    lookup_errors = (UnknownActorError,)

    def __init__(self, recordings: Sequence[Recording], n: int, whole: RecordedWorld | None = None, first: int = 0) -> None:
        self._recordings, self._size, self._whole, self._first = recordings, n, whole, first
        self.n, self.step_length = n * len(recordings), recordings[0].step_length
        self._way, self._sample = recordings[0].way, 0
        self._speeds = np.repeat([one.speed for one in recordings], n)
        self._lane, self._place = np.zeros(self.n, dtype=np.intp), np.repeat([one.start for one in recordings], n)
        self._left = np.zeros(self.n, dtype=bool)
        self._front: FloatArray | None = None
        self._front_before, self._speeds_before = np.full((self.n, 2), np.inf), self._speeds
        self._struck: dict[int, Body] = {}
        self.sensors = Sensors.perfect(self.n)

    def set_types(self, types: SumoType) -> None:
        """SUMO obeys every speed that it is given: types have no part in how vehicles move."""

    def set_decelerations(self, decel: FloatArray) -> None:
        """Nor have these."""

    def depart(self) -> None:
        """Everybody has departed."""

    def leave(self, copies: Sequence[int]) -> None:
        """Vehicles whose runs are over are told to be where and as fast as they were."""
        self._left[copies] = True

    def walk(self, person: str, speed: float) -> None:
        """Everybody else moves as recorded."""

    def drive(self, vehicle: str, speed: float) -> None:
        """As recorded."""

    def turn_back(self, person: str) -> None:
        """As recorded."""

    def part(self, first: int, n: int) -> RecordedWorld:
        """The world of the `n` vehicles from the `first`, in one of the scenes."""
        return RecordedWorld([self._recordings[first // self._size]], n, self, first)

    def advance(self, speeds: FloatArray) -> None:
        """One step in which the vehicles reach `speeds` [m/s], at a constant acceleration.

        Raises
        ------
        SimulationError
            If a vehicle leaves its last lane.
        """
        self._front_before, self._speeds_before = self.vehicle_positions(VUT), self._speeds
        way = distance(self._speeds, speeds, self.step_length)
        if self._left.any():
            speeds, way = np.where(self._left, self._speeds, speeds), np.where(self._left, 0.0, way)
        self._place = self._place + way
        self._speeds, self._front, self._sample = speeds, None, self._sample + 1
        end = self._way.end
        while (beyond := self._place > end[self._lane]).any():
            if (self._lane[beyond] == len(end) - 1).any():
                raise SimulationError("SUMO failed: a vehicle under test drives beyond the end of its route")
            self._place = np.where(beyond, self._place - end[self._lane], self._place)
            self._lane = self._lane + beyond

    def speeds(self) -> FloatArray:
        return self._speeds if self._whole is None else self._whole.speeds()[self._rows]

    def vehicle_positions(self, actor: str) -> FloatArray:
        if actor != VUT:
            return self._recorded(actor)
        if self._whole is not None:
            return self._whole.vehicle_positions(VUT)[self._rows]
        if self._front is None:
            self._front = self._way.positions(self._lane, self._place)
        return self._front

    person_positions = vehicle_positions

    def _recorded(self, actor: str) -> FloatArray:
        """Where one is whom a scene has, for all vehicles in it; there is one scene."""
        positions = self._track(actor).position
        position = positions[min(self._now, len(positions) - 1)]  # of a batch in which other scenes last longer
        if np.isnan(position[0]):
            raise SimulationError(f"SUMO failed: {actor!r} is not on the road at {self._now * self.step_length:g} s")
        return np.broadcast_to(position, (self.n, 2))

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

        SUMO looks twice in a step: when persons have moved, while vehicles are where and as fast as they were, and when vehicles have
        moved too (`MSNet::simulationStep`: `STAGE_EVENTS`, `STAGE_MOVEMENTS`).
        """
        self._struck, found = {}, dict[int, float]()
        for k, recording in enumerate(self._recordings):
            rows = slice(k * self._size, (k + 1) * self._size)
            of_open = open_[rows]
            moved, still = (self.vehicle_positions(VUT), self._speeds), (self._front_before, self._speeds_before)
            for track in recording.tracks.values():
                if self._sample < len(track.angle) and not np.isnan(track.angle[self._sample]):
                    other = _body(track, self._sample)
                    for fronts, speeds in (still, moved) if track.is_person else (moved,):
                        for row in (rows.start + _overlaps(fronts[rows], of_open, recording, other, track.is_person)).tolist():
                            if row not in found:
                                found[row], self._struck[row] = float(speeds[row]), other
        return dict(sorted(found.items()))

    def bodies(self, copy: int) -> tuple[Body, Body]:
        """A vehicle under test that collides in this step, and whom it collides with."""
        recording = self._recordings[copy // self._size]
        own = Body.behind(self.vehicle_positions(VUT)[copy], recording.along, recording.length, recording.width,
                          float(self._speeds[copy]))
        return own, self._struck[copy]


def _body(track: Track, sample: int) -> Body:
    return Body.behind(track.position[sample], direction_of(float(track.angle[sample])), track.length, track.width,
                       float(track.speed[sample]))


def _overlaps(front: FloatArray, of_open: BoolArray, recording: Recording, other: Body, is_person: bool) -> Any:
    """Rows of vehicles whose rectangles overlap another: no side of either parts them.

    Two vehicles in one direction overlap by more than a millimetre (SUMO, `MSLane::detectCollisionBetween`).
    """
    own, along = recording.along, other.along
    across, other_across = _left(own), _left(along)
    cosine, sine = abs(along @ own), abs(other_across @ own)
    least = 0.0 if is_person or cosine < PARALLEL else NUMERICAL_EPS
    axes = (
        (own, recording.length + other.length * cosine + other.width * sine),
        (across, recording.width + other.length * sine + other.width * cosine),
        (along, other.length + recording.length * cosine + recording.width * sine),
        (other_across, other.width + recording.length * sine + recording.width * cosine))
    offset = other.middle + own * (recording.length / 2)
    rows = np.flatnonzero(of_open & (np.abs((offset - front) @ own) < axes[0][1] / 2 - least))
    if len(rows):
        to_other = offset - front[rows]
        apart = [np.abs(to_other @ axis) >= reach / 2 - least for axis, reach in axes[1:]]
        rows = rows[~np.logical_or.reduce(apart)]
    return rows


def _left(direction: FloatArray) -> FloatArray:
    return np.array([-direction[1], direction[0]])
