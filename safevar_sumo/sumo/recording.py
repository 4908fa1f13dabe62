"""Recorded scenes: SUMO plays a scene only once if nobody reacts to the vehicle under test, because
then all other actors move in the same way in every simulation.

While SUMO plays a scene, the vehicle under test stays at its start. `recorded_world.py` moves
vehicles in the recorded scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import msgpack, to_builtins

from safevar_sumo.errors import subject
from safevar_sumo.plugins import Modules, user_errors
from safevar_sumo.records import FloatArray, IntArray, Quantity
from safevar_sumo.scenarios import VUT, Lane, Point, Scenario, WorldScenario
from safevar_sumo.scenarios.roads import Coordinates, lane_through
from safevar_sumo.shipped import PACKAGE
from safevar_sumo.sumo.bodies import Film
from safevar_sumo.sumo.copies import copied_id, copy_and_name, ensure_cached
from safevar_sumo.sumo.engine import open_world, step_of
from safevar_sumo.sumo.network import (
    OPTIONS_FILE,
    NetworkFiles,
    copied_network,
    is_shipped,
    network_for,
    open_network,
    options_in,
    road_digests,
    sumo_version,
)
from safevar_sumo.sumo.world import Api, SumoWorld, direction_of

SCENE_FILE = "scene.msgpack"
POSITION_EPS = 0.1
"""Smallest length of a lane's shape (SUMO, utils/common/StdDefs.h) [m]."""
STRAIGHTNESS = 1e-6
"""Largest difference between lanes that form a straight line: between components of their
directions [-], or between the end of a lane and the start of the next lane [m].
"""
NEXT_LANE = 0
"""Position in a link of `getLinks` of the lane to which the link leads."""
INTERNAL_LANE = 4
"""Position in a link of `getLinks` of the lane on the junction, which is "" without such a lane."""
NOT_STRAIGHT = (
    "the vehicle under test does not depart in the middle of a lane and"
    " drive straight on"
)


class LaneSequence(NamedTuple):
    """The L lanes that the vehicle under test follows, in order; they form a straight line. Columns
    have the shape (L,) or (L, 2) [m].

    A lane's shape leads from `origin` along `vector`, whose length is `shape_length`. SUMO counts
    positions on the lane from 0 to `end`; `stretch` is `shape_length` / `end`, with at least
    `POSITION_EPS` as length. `meets_persons` is 1 on lanes on which SUMO looks for collisions with
    persons, else 0: on lanes of junctions, which persons cross, or on all lanes if there is no
    junction.
    """

    origin: FloatArray
    vector: FloatArray
    end: FloatArray
    stretch: FloatArray
    shape_length: FloatArray
    meets_persons: FloatArray

    def at(self, lane: IntArray) -> LaneSequence:
        """The current lanes of N vehicles, from their lane numbers, shape (N,); the columns of the
        result have the length N.
        """
        return LaneSequence._make(column[lane] for column in self)

    def positions(self, lane_position: FloatArray) -> FloatArray:
        """Coordinates of the front bumpers, shape (N, 2) [m], of vehicles at positions on their
        lanes, shape (N,) [m].
        """
        share = lane_position * self.stretch / self.shape_length
        return self.origin + self.vector * share[:, np.newaxis]


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A recorded scene of T samples.

    The vehicle under test departs at the position `start` on the first lane of its `way` [m], at
    `speed` [m/s]. `length` and `width` are its size [m], `along` is the direction of its way, a
    unit vector. `lanes` has the shape of each lane of the network, `first_lanes` the first lane of
    each vehicle, and `tracks` the motion of all other actors.
    """

    step_length: float
    start: Quantity
    speed: Quantity
    length: float
    width: float
    way: LaneSequence
    along: FloatArray
    lanes: dict[str, tuple[Coordinates, ...]]
    first_lanes: dict[str, str]
    tracks: dict[str, Film]

    def lane(self, lane: str) -> Lane:
        """A lane by its id."""
        return lane_through(lane, self.lanes[lane])


class Scenes:
    """The scenes of a study. Each scene is recorded when it is first needed, with the study's time
    step [s] (None: the time step of the network). `modules` are those of the study's user code.
    """

    def __init__(
        self, step_length: float | None = None, modules: Modules | None = None
    ) -> None:
        self.step = step_length
        self._modules = modules or Modules(())
        self._source = subject()
        self._recorded: dict[WorldScenario, Recording | str] = {}

    def step_of(self, scenario: Scenario) -> float:
        """Time step of a scenario [s]."""
        return self.step or step_of(
            options_in(open_network(scenario.network).path(OPTIONS_FILE))
        )

    def of(self, scenario: WorldScenario) -> Recording | str:
        """The recorded scene of a scenario, or the reason why SUMO must simulate the scenario.

        SUMO plays a scene once. Scenes of shipped scenarios are also kept in the user's cache
        folder, for later processes.

        Raises
        ------
        SimulationError
            If SUMO fails.
        UserCodeError
            If a user's scenario fails.
        """
        if scenario not in self._recorded:
            with self._modules.active(), user_errors(self._source):
                self._recorded[scenario] = _scene_of(scenario, self.step)
        return self._recorded[scenario]

    def reason_against_scenes(self, points: Sequence[Point]) -> str:
        """The reason why SUMO must simulate one of the points, in a copy of the network for each
        vehicle; "" if recorded scenes suffice for all points.
        """
        for point in points:
            if isinstance(point.scenario, WorldScenario):
                scene = self.of(point.scenario)
                if isinstance(scene, str):
                    return scene
        return ""


def _scene_of(scenario: WorldScenario, step: float | None) -> Recording | str:
    """The scene of a scenario, from the cache or played by SUMO with this time step [s]; or the
    reason why it cannot be recorded.
    """
    if scenario.reactive_actors:
        return "an actor of the scenario may react to the vehicle under test"
    # Shipped scenarios know that nobody reacts in shipped networks; a user's scenario declares it.
    if not scenario.is_user_code and not is_shipped(scenario.network):
        return (
            f"the traffic of the network {scenario.network!r} may react to the"
            " vehicle under test"
        )
    network = network_for(scenario)
    if scenario.is_user_code:
        return _play(scenario, network, step)
    inputs = (
        type(scenario).__name__,
        to_builtins(scenario),
        (network.digests, road_digests(network)),
        step,
    )
    digest = sha256(_code_bytes() + repr(inputs).encode())

    def build(folder: Path) -> None:
        (folder / SCENE_FILE).write_bytes(
            msgpack.encode(_play(scenario, network, step), enc_hook=_packed_array)
        )

    file = ensure_cached(f"scene-{digest.hexdigest()[:16]}", SCENE_FILE, build)
    return msgpack.decode(
        file.read_bytes(), type=Recording | str, dec_hook=_unpacked_array
    )


@cache
def _code_bytes() -> bytes:
    """SUMO's version and the code that plays scenes, as bytes: a cached scene is valid only for the
    same version and code.
    """
    files = sorted(
        [*(PACKAGE / "sumo").glob("*.*"), *(PACKAGE / "scenarios").glob("*.*")]
    )
    return sumo_version().encode() + b"".join(file.read_bytes() for file in files)


def _packed_array(array: FloatArray) -> tuple[tuple[int, ...], bytes]:
    return array.shape, array.tobytes()


def _unpacked_array(_: Any, packed: Any) -> FloatArray:
    shape, content = packed
    return np.frombuffer(content).reshape(shape)


def _play(
    scenario: WorldScenario, network: NetworkFiles, step: float | None
) -> Recording | str:
    """Let SUMO play a scene. Returns the recording, or the reason why it cannot be recorded."""
    with open_world(copied_network(network, 1), 1, step) as world:
        world.enter(None)
        api = world.api
        vehicle = api.vehicle
        vut = copied_id(0, VUT)
        way = _way_of(api, vut)
        if way is None:
            return NOT_STRAIGHT
        # `_tracks` must come last: it advances the world, and the other values are of the start.
        return Recording(
            step_length=world.step_length,
            start=vehicle.getLanePosition(vut),
            speed=vehicle.getSpeed(vut),
            length=world.vehicle_length(VUT),
            width=world.vehicle_width,
            way=way,
            along=direction_of(vehicle.getAngle(vut)),
            lanes={
                copy_and_name(id_)[1]: tuple(api.lane.getShape(id_))
                for id_ in api.lane.getIDList()
            },
            first_lanes={
                copy_and_name(id_)[1]: copy_and_name(vehicle.getLaneID(id_))[1]
                for id_ in vehicle.getIDList()
            },
            tracks=_tracks(scenario, world),
        )


def _tracks(scenario: WorldScenario, world: SumoWorld) -> dict[str, Film]:
    """The motion of all actors except the vehicle under test, until the end of the scenario."""
    length = round(scenario.duration / world.step_length) + 1

    tracks = dict[str, Film]()
    memory = world.begin(scenario)
    for sample in range(length):
        world.film(tracks, sample, length)
        _, memory = scenario.observe(world, world.step_length, memory)
        if sample < length - 1:
            world.step(np.zeros(1), np.ones(1, bool))
    return {
        name: track._replace(motion=track.motion[:, 0])
        for name, track in tracks.items()
        if name != VUT
    }


def _way_of(api: Api, vut: str) -> LaneSequence | None:
    """The lanes that a vehicle follows on its route. None if the vehicle does not depart in the
    middle of a lane, if a choice of lanes is open, or if the lanes form no straight line.
    """
    # A route has no lanes of junctions: they follow from the links between lanes.
    lanes = [api.vehicle.getLaneID(vut)]
    for edge in api.vehicle.getRoute(vut)[api.vehicle.getRouteIndex(vut) + 1 :]:
        links = [
            link
            for link in api.lane.getLinks(lanes[-1])
            if api.lane.getEdgeID(link[NEXT_LANE]) == edge
        ]
        if len(links) != 1:
            return None
        next_lane = links[0][NEXT_LANE]
        while links and links[0][INTERNAL_LANE]:
            lanes.append(links[0][INTERNAL_LANE])
            links = api.lane.getLinks(lanes[-1])
        lanes.append(next_lane)

    shapes = [api.lane.getShape(lane) for lane in lanes]
    # A straight lane has a shape of two points.
    if api.vehicle.getLateralLanePosition(vut) or any(
        len(shape) != 2 for shape in shapes
    ):
        return None
    starts, ends = np.array(shapes, float).transpose(1, 0, 2)
    vector = ends - starts
    lengths = np.array([api.lane.getLength(lane) for lane in lanes])
    shape_length = np.sqrt((vector * vector).sum(axis=1))
    direction = vector / shape_length[:, np.newaxis]
    largest_turn = np.abs(direction - direction[0]).max()
    largest_gap = np.abs(starts[1:] - ends[:-1]).max(initial=0.0)
    if largest_turn > STRAIGHTNESS or largest_gap > STRAIGHTNESS:
        return None

    is_junction = np.array(
        [float(copy_and_name(lane)[1].startswith(":")) for lane in lanes]
    )
    meets_persons = is_junction if is_junction.any() else np.ones(len(lanes))
    stretch = np.maximum(shape_length, POSITION_EPS) / lengths
    return LaneSequence(starts, vector, lengths, stretch, shape_length, meets_persons)
