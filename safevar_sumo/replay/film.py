"""A simulation seen from above: the position of every actor at every time step, and the road."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from safevar_sumo.records import FloatArray, SimulationRuns
from safevar_sumo.sumo.copies import copy_and_name
from safevar_sumo.sumo.matrix import simulate, system_at_worst_point
from safevar_sumo.sumo.network import Network, built_network, stage_network
from safevar_sumo.sumo.system import System
from safevar_sumo.sumo.world import SumoWorld


class LaneLine(NamedTuple):
    """A lane of SUMO: its middle line of P points, shape (P, 2), and width [m]; an area has its outline as `line` and
    the width 0.

    `kind` is road, path (only for persons), crossing or area (for persons, between paths).
    """

    kind: str
    line: FloatArray
    width: float


class ActorTrack(NamedTuple):
    """The track of one actor: front bumper of a vehicle or middle of a person [m], heading clockwise from north
    [degrees].

    Arrays of shape (T, N) for T samples of N simulations, NaN while the actor was absent; `length` and `width` in m.
    """

    is_person: bool
    length: float
    width: float
    x: FloatArray
    y: FloatArray
    angle: FloatArray


@dataclass(frozen=True, kw_only=True)
class Film:
    """N simulations seen from above.

    `tracks` holds the tracks of actors by name; `last_samples` holds the last sample of every simulation, shape (N,):
    later samples are meaningless, as SUMO continues with the rest of the batch.
    """

    runs: SimulationRuns
    tracks: Mapping[str, ActorTrack]
    road: tuple[LaneLine, ...]

    @property
    def last_samples(self) -> np.ndarray:
        active = self.runs.trace.active
        return np.asarray(len(active) - 1 - np.argmax(active[::-1], axis=0))


def record_film(system: System, settings: FloatArray) -> Film:
    """Simulate N settings of n characteristics, shape (N, n), and record the positions of all actors.

    In a matrix all settings are simulated at the worst point of the last setting.

    Raises
    ------
    SimulationError, InputError
        If `simulate` raises it.
    """
    camera, system = _Camera(len(settings)), system_at_worst_point(system, settings)
    runs = simulate(system, settings, watch=camera.record)
    return Film(runs=runs, tracks=camera.tracks(), road=read_road(stage_network(system.scenario)))


class _Camera:
    """Records the position of every actor in all copies at every sample."""

    def __init__(self, copy_count: int) -> None:
        self._copy_count = copy_count
        self._frames: list[dict[str, tuple[float, float, float]]] = []
        self._sizes: dict[str, tuple[bool, float, float]] = {}

    def record(self, world: SumoWorld) -> None:
        frame = world.actor_poses()
        for name in frame.keys() - self._sizes.keys():
            self._sizes[name] = world.actor_size(name)
        self._frames.append(frame)

    def tracks(self) -> dict[str, ActorTrack]:
        """The recorded tracks, in alphabetical order."""
        by_name: dict[str, ActorTrack] = {}
        for actor in sorted(self._sizes):
            copy, name = copy_and_name(actor)
            if name not in by_name:
                by_name[name] = ActorTrack(
                    *self._sizes[actor], *(np.full((len(self._frames), self._copy_count), np.nan) for _ in range(3))
                )
            for sample, frame in enumerate(self._frames):
                if actor in frame:
                    for array, value in zip(by_name[name][3:], frame[actor], strict=True):
                        array[sample, copy] = value
        return by_name


def read_road(network: Network) -> tuple[LaneLine, ...]:
    """Read the lanes of one copy of a network, as netconvert built it."""
    root = ElementTree.parse(built_network(network)).getroot()
    return tuple(_lane(edge.get("function", ""), lane) for edge in root.iter("edge") for lane in edge.iter("lane"))


def _lane(function: str, lane: ElementTree.Element) -> LaneLine:
    line = np.array([[float(number) for number in point.split(",")[:2]] for point in lane.attrib["shape"].split()])
    if function == "walkingarea":
        return LaneLine("area", line, width=0.0)
    for_persons = lane.get("allow", "").split() == ["pedestrian"]
    kind = "crossing" if function == "crossing" else "path" if for_persons else "road"
    return LaneLine(kind, line, width=float(lane.get("width", 3.2)))  # SUMO's default width
