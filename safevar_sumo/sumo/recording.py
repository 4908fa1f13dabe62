"""Scenes that SUMO plays once: if nobody reacts to the vehicle under test, all other actors move identically in every
simulation.

While SUMO plays a scene, the vehicle under test stays at its start; `recorded_world.py` moves vehicles in the recorded
scene.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import msgpack, to_builtins

from safevar_sumo.records import FloatArray, IntArray
from safevar_sumo.scenarios import VUT, GuardedScenario, Scenario
from safevar_sumo.scenarios.target import TargetTest
from safevar_sumo.sumo.copies import copied_id, copy_and_name, ensure_cached
from safevar_sumo.sumo.engine import Engine, open_world
from safevar_sumo.sumo.network import Network, copied_network, is_shipped, stage_networks, sumo_version
from safevar_sumo.sumo.world import Api, SumoWorld, begin, direction_of

MAX_RECORDINGS = 4000
"""Largest number of recorded scenes that a process keeps; a scene of ten seconds takes about ten kilobytes."""
SCENES_FILE = "scenes.msgpack"
EXTENT_MARGIN = 0.01
"""Margin of the extents [m]; an actor outside its extent is not checked for a collision."""
POSITION_EPS = 0.1
"""Smallest length of a lane's shape (SUMO, utils/common/StdDefs.h) [m]."""


class UnrecordableError(Exception):
    """A scene cannot be recorded; the message is the reason."""


class Track(NamedTuple):
    """An actor at T steps: `position` [m], shape (T, 2); `angle` clockwise from north [degrees] and `speed` [m/s],
    shape (T,).

    Values are NaN while the actor is not on the road; `length` and `width` are in m.
    """

    position: FloatArray
    angle: FloatArray
    speed: FloatArray
    is_person: bool
    length: float
    width: float


class LaneSequence(NamedTuple):
    """The L lanes that the vehicle under test follows, in order, which form a straight line; columns of shape (L,) or
    (L, 2) [m].

    A lane leads from `first` along `vector`. SUMO counts positions on a lane from 0 to `end`; `stretch` is
    `shape_length` / `end`.
    """

    first: FloatArray
    vector: FloatArray
    end: FloatArray
    stretch: FloatArray
    shape_length: FloatArray

    def at(self, lane: IntArray) -> LaneSequence:
        """The current lanes of N vehicles, given by lane number; columns of length N."""
        return LaneSequence._make(column[lane] for column in self)

    def positions(self, lane_position: FloatArray) -> FloatArray:
        """Coordinates of the front bumpers, shape (N, 2) [m], of vehicles at positions on their lanes, shape (N,)
        [m].
        """
        share = lane_position * self.stretch / self.shape_length
        return np.asarray(self.first + self.vector * share[:, np.newaxis])


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A recorded scene, in which the vehicle under test departs at position `start` on the first lane of its `way` [m],
    at `speed` [m/s].

    `length` and `width` are the vehicle's [m], `lanes` the shapes of all lanes, `lane_of` each vehicle's first lane.
    `extents`, shape (2, T, A): at step t, the vehicle is beside actor a while its front is between these coordinates
    `along` the lanes [m].
    """

    step_length: float
    start: float
    speed: float
    length: float
    width: float
    way: LaneSequence
    along: FloatArray
    lanes: dict[str, tuple[tuple[float, float], ...]]
    lane_of: dict[str, str]
    tracks: dict[str, Track]
    extents: FloatArray

    @property
    def batch_key(self) -> tuple[Hashable, ...]:
        """Vehicles in scenes with the same key may share a batch."""
        return (
            self.step_length,
            self.length,
            self.width,
            self.along.tobytes(),
            *(column.tobytes() for column in self.way),
        )


def record_scenes(scenarios: Sequence[Scenario], options: Sequence[str]) -> list[Recording | str]:
    """Each scenario's scene, played with additional options of SUMO and recorded, or the reason why SUMO must simulate
    the scenario.

    SUMO plays a scene once per process; scenes of shipped scenarios are also kept in the user's cache folder.

    Raises
    ------
    SimulationError
        If SUMO fails.
    """
    reasons = [_reason_against_recording(scenario) for scenario in scenarios]
    recordable = [scenario for scenario, reason in zip(scenarios, reasons, strict=True) if not reason]
    keys = [
        (scenario, network, tuple(options))
        for scenario, network in zip(recordable, stage_networks(recordable), strict=True)
    ]
    new_keys = [key for key in dict.fromkeys(keys) if key not in _recordings]
    if new_keys:
        for old_key in [key for key in _recordings if key not in keys][
            : max(len(_recordings) + len(new_keys) - MAX_RECORDINGS, 0)
        ]:
            del _recordings[old_key]
        _recordings.update(zip(new_keys, _recordings_of(new_keys), strict=True))
    scenes = {scenario: _recordings[scenario, network, step] for scenario, network, step in keys}
    return [reason or scenes[scenario] for scenario, reason in zip(scenarios, reasons, strict=True)]


def _reason_against_recording(scenario: Scenario) -> str:
    if scenario.reactive_actors:
        return "an actor of the scenario may react to the vehicle under test"
    if not isinstance(scenario, GuardedScenario) and not is_shipped(
        scenario.network
    ):  # shipped scenarios know only shipped networks
        return f"the traffic of the network {scenario.network!r} may react to the vehicle under test"
    return ""


_Key = tuple[Scenario, Network, tuple[str, ...]]
"""A scenario, its network, and additional options of SUMO."""
_recordings: dict[_Key, Recording | str] = {}
"""The scenes that this process keeps, or the reasons why scenes cannot be recorded."""


def _recordings_of(keys: Sequence[_Key]) -> list[Recording | str]:
    """The scenes, read from the cache or played by SUMO."""

    def play() -> list[Recording | str]:
        return [_play(*key) for key in keys]

    if any(isinstance(scenario, GuardedScenario) for scenario, _, _ in keys):
        return play()
    inputs = [
        (type(scenario).__name__, to_builtins(scenario), network.digests, options)
        for scenario, network, options in keys
    ]
    digest = sha256(_code_bytes() + repr(inputs).encode())

    def build(folder: Path) -> None:
        (folder / SCENES_FILE).write_bytes(msgpack.encode(play(), enc_hook=_packed_array))

    file = ensure_cached(f"scenes-{digest.hexdigest()[:16]}", SCENES_FILE, build)
    return msgpack.decode(file.read_bytes(), type=list[Recording | str], dec_hook=_unpacked_array)


@cache
def _code_bytes() -> bytes:
    """SUMO's version and the code that plays scenes: a scene depends on them and on its scenario."""
    files = sorted(
        file for folder in ("sumo", "scenarios") for file in (Path(__file__).parents[1] / folder).glob("*.py")
    )
    return b"".join([sumo_version().encode(), *(file.read_bytes() for file in files)])


def _packed_array(array: FloatArray) -> tuple[tuple[int, ...], bytes]:
    return array.shape, array.tobytes()


def _unpacked_array(_: Any, packed: Any) -> FloatArray:
    shape, content = packed
    return np.frombuffer(content).reshape(shape)


def _play(scenario: Scenario, network: Network, options: tuple[str, ...]) -> Recording | str:
    """The scene, or the reason why it cannot be recorded."""
    with open_world(copied_network(network, 1), 1, Engine.LIBSUMO, options) as world:
        world.depart(at_any_speed=True)
        try:
            return _record(scenario, world)
        except UnrecordableError as error:
            return str(error)


def _record(scenario: Scenario, world: SumoWorld) -> Recording:
    api, vut, step = world.api, copied_id(0, VUT), world.step_length
    lane_sequence, along = _lane_sequence_of(api, vut)
    start, speed = float(api.vehicle.getLanePosition(vut)), float(api.vehicle.getSpeed(vut))
    lane_of = {
        name: copy_and_name(api.vehicle.getLaneID(id_))[1] for id_, name in _ids_in_first_copy(api.vehicle.getIDList())
    }
    lanes = {
        name: tuple((float(x), float(y)) for x, y in api.lane.getShape(id_))
        for id_, name in _ids_in_first_copy(api.lane.getIDList())
    }
    length = round(scenario.duration / step) + 1
    samples, sizes, memory = dict[str, FloatArray](), dict[str, tuple[bool, float, float]](), begin(scenario, world)
    for sample in range(length):
        for domain in (api.vehicle, api.person):
            for id_, name in _ids_in_first_copy(domain.getIDList()):
                if name == VUT:
                    continue
                if name not in samples:
                    samples[name] = np.full((length, 4), np.nan)
                    sizes[name] = domain is api.person, float(domain.getLength(id_)), float(domain.getWidth(id_))
                samples[name][sample] = *domain.getPosition(id_), domain.getAngle(id_), domain.getSpeed(id_)
        if sample < length - 1:
            memory = (
                scenario.move(world, step, memory)
                if isinstance(scenario, TargetTest)
                else scenario.observe(world, step, memory)[1]
            )
            world.advance(np.zeros(1))
    tracks = {
        name: Track(rows[:, :2].copy(), rows[:, 2].copy(), rows[:, 3].copy(), *sizes[name])
        for name, rows in samples.items()
    }
    vut_length = world.vehicle_length(VUT)
    extents = np.full((2, length, len(tracks)), np.nan)
    for actor, track in enumerate(tracks.values()):
        extents[:, :, actor] = _extent_beside(track, along, vut_length)
    return Recording(
        step_length=step,
        start=start,
        speed=speed,
        length=vut_length,
        width=float(api.vehicle.getWidth(vut)),
        way=lane_sequence,
        along=along,
        lanes=lanes,
        lane_of=lane_of,
        tracks=tracks,
        extents=extents,
    )


def _extent_beside(track: Track, along: FloatArray, vut_length: float) -> FloatArray:
    """First and last coordinate of a vehicle's front while the vehicle is beside an actor, with a margin; shape (2, T)
    [m].
    """
    angle = np.radians(track.angle)  # clockwise from north
    cosine, sine = along @ np.array([np.sin(angle), np.cos(angle)]), along @ np.array([np.cos(angle), -np.sin(angle)])
    middle = track.position @ along - cosine * (track.length / 2)
    half_extent = (np.abs(cosine) * track.length + np.abs(sine) * track.width) / 2 + EXTENT_MARGIN
    return np.array([middle - half_extent, middle + half_extent + vut_length])


def _ids_in_first_copy(ids: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield the ids that belong to the first copy, each with its name in the original network."""
    for id_ in ids:
        copy, name = copy_and_name(id_)
        if copy == 0:
            yield id_, name


def _lane_sequence_of(api: Api, vut: str) -> tuple[LaneSequence, FloatArray]:
    """The lanes of the rest of a vehicle's route, and their common direction.

    Raises
    ------
    UnrecordableError
        If the lanes do not form a straight line.
    """
    if api.vehicle.getLateralLanePosition(vut):
        raise UnrecordableError("the vehicle under test does not depart in the middle of its lane")
    lanes = [api.vehicle.getLaneID(vut)]
    for edge in api.vehicle.getRoute(vut)[api.vehicle.getRouteIndex(vut) + 1 :]:
        links = [link for link in api.lane.getLinks(lanes[-1]) if api.lane.getEdgeID(link[0]) == edge]
        if len(links) != 1:
            raise UnrecordableError(f"there are {len(links)} lanes from {lanes[-1]!r} to {edge!r}")
        next_lane, internal_lane = links[0][0], links[0][4]
        while internal_lane:
            lanes.append(internal_lane)
            internal_lane = next(iter(api.lane.getLinks(internal_lane)), ("", "", "", "", ""))[4]
        lanes.append(next_lane)
    shapes = [api.lane.getShape(lane) for lane in lanes]
    for lane, shape in zip(lanes, shapes, strict=True):
        if len(shape) != 2:
            raise UnrecordableError(f"lane {copy_and_name(lane)[1]!r} of the vehicle under test is not straight")
    starts, ends = (np.array([shape[k] for shape in shapes], dtype=float) for k in (0, 1))
    vector, lengths = ends - starts, np.array([api.lane.getLength(lane) for lane in lanes], dtype=float)
    shape_length = np.sqrt((vector * vector).sum(axis=1))
    direction = vector / shape_length[:, np.newaxis]
    if np.abs(direction - direction[0]).max() > 1e-6 or np.abs(starts[1:] - ends[:-1]).max(initial=0.0) > 1e-6:
        raise UnrecordableError("the lanes of the vehicle under test do not form a straight line")
    stretch = np.maximum(shape_length, POSITION_EPS) / lengths
    return LaneSequence(starts, vector, lengths, stretch, shape_length), direction_of(api.vehicle.getAngle(vut))
