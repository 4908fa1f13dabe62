"""Scenes that SUMO plays once: if nobody reacts to the vehicle under test, all other actors move identically in every simulation.

Meanwhile the vehicle under test stays at its start; `recorded_world.py` moves vehicles in a recorded scene.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import msgpack, to_builtins

from safevar_sumo.records import FloatArray
from safevar_sumo.scenarios import VUT, GuardedScenario, Scenario
from safevar_sumo.scenarios.target import TargetTest
from safevar_sumo.sumo.cache import cached
from safevar_sumo.sumo.copies import copied_id, copy_and_name
from safevar_sumo.sumo.engine import Engine, open_world
from safevar_sumo.sumo.network import copied_network, netconvert_version
from safevar_sumo.sumo.sources import is_shipped
from safevar_sumo.sumo.staging import all_staged
from safevar_sumo.sumo.world import SumoWorld, begin, direction_of

SCENES = 4000
"""Largest number of recorded scenes that a process keeps; a scene of ten seconds takes some ten kilobytes."""
KEPT = "scenes.msgpack"
LEEWAY = 0.01
"""Margin of the extents [m]; an actor outside its extent is not checked for a collision."""
POSITION_EPS = 0.1
"""Smallest length of a lane's shape (SUMO, utils/common/StdDefs.h) [m]."""


class UnrecordableError(Exception):
    """A scene cannot be recorded; the message is the reason."""


class Track(NamedTuple):
    """An actor at every step: position [m], shape (T, 2), heading clockwise from north [degrees] and speed [m/s], shape (T,).

    Values are NaN while the actor is not on the road; `length` and `width` in m.
    """

    position: FloatArray
    angle: FloatArray
    speed: FloatArray
    is_person: bool
    length: float
    width: float


class Way(NamedTuple):
    """The straight lanes that the vehicle under test follows, in order; shape (L,) or (L, 2) [m].

    `end` is the length of a lane as SUMO counts positions on it, `stretch` the length of a lane's shape over the lane's length.
    """

    first: FloatArray
    vector: FloatArray
    end: FloatArray
    stretch: FloatArray
    shape_length: FloatArray

    def at(self, lane: Any) -> Way:
        """The lanes of N vehicles, given by number; L becomes N."""
        return Way._make(column[lane] for column in self)

    def positions(self, place: FloatArray) -> FloatArray:
        """Front bumpers, shape (N, 2) [m], of vehicles at positions on their lanes, shape (N,)."""
        share = place * self.stretch / self.shape_length
        return np.asarray(self.first + self.vector * share[:, np.newaxis])


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A scene in which the vehicle under test does not drive: `start` and `speed` are those of its departure on its `way` [m, m/s].

    `extents`, shape (2, T, A): the vehicle is beside actor A at step T while its front is between the two positions along the way [m].
    """

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
    extents: FloatArray

    @property
    def road(self) -> tuple[Hashable, ...]:
        """Key of scenes whose vehicles may be in one batch."""
        return self.step_length, self.length, self.width, self.along.tobytes(), *(column.tobytes() for column in self.way)


def recorded_scenes(scenarios: Sequence[Scenario], options: Sequence[str]) -> list[Recording | str]:
    """Recorded scenes of scenarios, with further options of SUMO, or the reason why a scenario needs SUMO and copies.

    SUMO plays a scene once per process; scenes of shipped scenarios are also kept in the user's cache folder.

    Raises
    ------
    SimulationError
        If SUMO fails.
    """
    reasons = [_reason_for_sumo(scenario) for scenario in scenarios]
    recordable = [scenario for scenario, reason in zip(scenarios, reasons, strict=True) if not reason]
    folders = {(scenario, network.fingerprint, tuple(options)): network.folder
               for scenario, network in zip(recordable, all_staged(recordable), strict=True)}
    missing = {key: folder for key, folder in folders.items() if key not in _scenes}
    if missing:
        for old in [key for key in _scenes if key not in folders][:max(len(_scenes) + len(missing) - SCENES, 0)]:
            del _scenes[old]
        _scenes.update(zip(missing, _scenes_of(missing), strict=True))
    scenes = {key[0]: _scenes[key] for key in folders}
    return [reason or scenes[scenario] for scenario, reason in zip(scenarios, reasons, strict=True)]


def _reason_for_sumo(scenario: Scenario) -> str:
    if getattr(scenario, "reactive_actors", True):
        return "somebody in the scenario may react to the vehicle under test"
    if not isinstance(scenario, GuardedScenario) and not is_shipped(scenario.network):  # a shipped scenario claims it for shipped networks
        return f"the traffic of the network {scenario.network!r} may react to the vehicle under test"
    return ""


_Key = tuple[Scenario, str, tuple[str, ...]]
"""A scenario, the fingerprint of its network and traffic, and further options."""
_scenes: dict[_Key, Recording | str] = {}
"""Scenes of this process, or the reason why a scene cannot be recorded."""


def _scenes_of(missing: Mapping[_Key, str]) -> list[Recording | str]:
    """Scenes for keys and network folders, from the cache or played by SUMO."""
    def play() -> list[Recording | str]:
        return [_play(scenario, folder, options) for (scenario, _, options), folder in missing.items()]

    if any(isinstance(scenario, GuardedScenario) for scenario, *_ in missing):
        return play()
    digest = sha256(_code() + repr([(type(scenario).__name__, to_builtins(scenario), *rest) for scenario, *rest in missing]).encode())
    def build(folder: Path) -> None:
        (folder / KEPT).write_bytes(msgpack.encode(play(), enc_hook=_packed_array))

    file = cached(f"scenes-{digest.hexdigest()[:16]}", KEPT, build)
    return msgpack.decode(file.read_bytes(), type=list[Recording | str], dec_hook=_unpacked_array)


@cache
def _code() -> bytes:
    """What determines a scene besides the scenario: SUMO's version, and our code that plays scenes."""
    files = sorted(file for folder in ("sumo", "scenarios") for file in (Path(__file__).parents[1] / folder).glob("*.py"))
    return b"".join([netconvert_version().encode(), *(file.read_bytes() for file in files)])


def _packed_array(array: Any) -> tuple[tuple[int, ...], bytes]:
    return array.shape, array.tobytes()


def _unpacked_array(kind: Any, packed: Any) -> FloatArray:
    shape, content = packed
    return np.frombuffer(content).reshape(shape)


def _play(scenario: Any, folder: str, options: tuple[str, ...]) -> Recording | str:
    """The scene, or the reason why it cannot be recorded."""
    with open_world(copied_network(folder, 1), 1, Engine.LIBSUMO, options) as world:
        world.allow_departure()
        world.depart()
        try:
            return _record(scenario, world)
        except UnrecordableError as error:
            return str(error)


def _record(scenario: Scenario, world: SumoWorld) -> Recording:
    api, vut, step = world.api, copied_id(0, VUT), world.step_length
    way, along = _way_of(api, vut)
    start, speed = float(api.vehicle.getLanePosition(vut)), float(api.vehicle.getSpeed(vut))
    lane_of = {name: copy_and_name(api.vehicle.getLaneID(id_))[1] for id_, name in _named(api.vehicle.getIDList())}
    lanes = {name: tuple((float(x), float(y)) for x, y in api.lane.getShape(id_)) for id_, name in _named(api.lane.getIDList())}
    length = round(scenario.duration / step) + 1
    states, sizes, memory = dict[str, FloatArray](), dict[str, tuple[bool, float, float]](), begin(scenario, world)
    for sample in range(length):
        for kind in (api.vehicle, api.person):
            for id_, name in _named(kind.getIDList()):
                if name == VUT:
                    continue
                if name not in states:
                    states[name] = np.full((length, 4), np.nan)
                    sizes[name] = kind is api.person, float(kind.getLength(id_)), float(kind.getWidth(id_))
                states[name][sample] = *kind.getPosition(id_), kind.getAngle(id_), kind.getSpeed(id_)
        if sample < length - 1:
            memory = scenario.move(world, step, memory) if isinstance(scenario, TargetTest) else scenario.observe(world, step, memory)[1]
            world.advance(np.zeros(1))
    tracks = {name: Track(rows[:, :2].copy(), rows[:, 2].copy(), rows[:, 3].copy(), *sizes[name]) for name, rows in states.items()}
    own_length = world.vehicle_length(VUT)
    extents = np.full((2, length, len(tracks)), np.nan)
    for number, track in enumerate(tracks.values()):
        extents[:, :, number] = _extent(track, along, own_length)
    return Recording(
        step_length=step, start=start, speed=speed, length=own_length, width=world.vehicle_width(VUT), way=way,
        along=along, lanes=lanes, lane_of=lane_of, tracks=tracks, extents=extents)


def _extent(track: Track, along: FloatArray, own_length: float) -> FloatArray:
    """Least and largest position of a vehicle's front beside an actor at every step, with a margin; shape (2, T) [m]."""
    angle = np.radians(track.angle)  # clockwise from north
    cosine, sine = along @ np.array([np.sin(angle), np.cos(angle)]), along @ np.array([np.cos(angle), -np.sin(angle)])
    middle = track.position @ along - cosine * (track.length / 2)
    half_extent = (np.abs(cosine) * track.length + np.abs(sine) * track.width) / 2 + LEEWAY
    return np.array([middle - half_extent, middle + half_extent + own_length])


def _named(ids: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Ids of the first copy, and their names in the original."""
    for id_ in ids:
        copy, name = copy_and_name(id_)
        if copy == 0:
            yield id_, name


def _way_of(api: Any, vut: str) -> tuple[Way, FloatArray]:
    """The lanes ahead of a vehicle that has departed, and their direction.

    Raises
    ------
    UnrecordableError
        If the lanes do not form a straight line.
    """
    if api.vehicle.getLateralLanePosition(vut):
        raise UnrecordableError("the vehicle under test does not depart in the middle of its lane")
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
        raise UnrecordableError("the lanes of the vehicle under test do not form a straight line")
    return Way(first, vector, end, np.maximum(shape_length, POSITION_EPS) / end, shape_length), direction_of(api.vehicle.getAngle(vut))
