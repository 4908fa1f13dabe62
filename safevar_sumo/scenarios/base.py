"""The contract of a scenario: who meets the vehicle under test, and what of it counts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple, Protocol

from msgspec import Meta

from safevar_sumo.records import EVERYWHERE, NOTHING, BoolArray, Encounter, FloatArray, Trace
from safevar_sumo.study import Weather

VUT = "vut"
"""Id of the vehicle under test in every network's traffic."""
STEEPEST = 30.0
"""Of a road [%]."""
Grade = Annotated[float, Meta(ge=-STEEPEST, le=STEEPEST)]
BEND = 0.05
"""So far the middle of a lane that counts as straight may stray [m]."""
Coordinates = tuple[float, float]
Actors = Mapping[str, Mapping[str, str] | None]
"""Changes to a network's traffic file: attributes to set, or None to leave it out, by the XPath of an element below its root."""


class Lane(NamedTuple):
    """First and last point of a lane's middle line [m]."""

    start: Coordinates
    end: Coordinates


class BentLane(Lane):
    """A lane that is not straight: its id, and how far its middle line strays from the straight between its ends [m]."""

    name: str
    bend: float


def lane_through(name: str, points: Sequence[Coordinates]) -> Lane:
    """The lane whose middle line goes through these points [m]."""
    (x, y), (to_x, to_y) = points[0], points[-1]
    length = math.hypot(to_x - x, to_y - y)
    strays = [abs((to_x - x) * (at_y - y) - (to_y - y) * (at_x - x)) / length if length else math.hypot(at_x - x, at_y - y)
              for at_x, at_y in points]
    if max(strays) <= BEND:
        return Lane(points[0], points[-1])
    bent = BentLane(points[0], points[-1])
    bent.name, bent.bend = name, max(strays)
    return bent


class Roads(Protocol):
    """A network without anybody on it."""

    def lane(self, lane: str) -> Lane:
        """A lane by its id."""


class World(Protocol):
    """N copies of a network while SUMO simulates them, as a scenario sees them."""

    def vehicle_positions(self, actor: str) -> FloatArray:
        """Front bumpers of a vehicle in its N copies; shape (N, 2) [m]."""

    def person_positions(self, actor: str) -> FloatArray:
        """Positions of a person in its N copies; shape (N, 2) [m]."""

    def speeds(self) -> FloatArray:
        """Speeds of the vehicles under test; shape (N,) [m/s]."""

    def vehicle_length(self, actor: str) -> float:
        """Length of a vehicle [m]."""

    def lane_start(self, lane: str) -> tuple[float, float]:
        """First point of a lane's middle line, the same in all copies [m]."""

    def lane(self, lane: str) -> Lane:
        """A lane by its id, the same in all copies."""

    def lane_of(self, vehicle: str) -> Lane:
        """The lane that a vehicle is on, the same in all copies."""

    def person_width(self, actor: str) -> float:
        """Width of a person [m]."""

    def walk(self, person: str, speed: float) -> None:
        """Let a person walk on at a speed [m/s], in all copies."""

    def drive(self, vehicle: str, speed: float) -> None:
        """Let a vehicle reach a speed [m/s] within the coming step, in all copies."""

    def turn_back(self, person: str) -> None:
        """Let a person turn round where it is and walk back to the edge that it came from, as fast as before."""


class Scene(NamedTuple):
    """The obstacle relative to N vehicles, each of shape (N,); see `Observation` for the quantities.

    `over` tells where the encounter has ended and cannot come back, `visible` where nothing stands in the sensors' way.
    """

    gap: FloatArray
    lateral: FloatArray
    lateral_speed: FloatArray
    over: BoolArray
    obstacle_speed: FloatArray = NOTHING
    visible: BoolArray = EVERYWHERE


class Scenario(Protocol):
    """A scenario. Its fields are the parameters that a study gives under `scenario.parameters`.

    `network` is a folder of `sumo_nets/`, or the path of a folder with the same files;
    `duration` is the length of a run [s].

    It may have a `grade`, by how much its road rises over the way [%]: SUMO's plane is then that road, and gravity acts in the
    vehicles. It may have a `pre_crash`, what type of NHTSA's it is of. It may have `actors(roads) -> Actors`, what its
    parameters make of the network's traffic, and `remarks() -> list[str]`,
    what a user should know of them. It may have a `test_speed` [m/s]: a robot then holds the vehicle at that speed until the system
    brakes, a run that leaves the tolerance before that is no valid test, and only what the front hits is a collision.
    """

    network: str
    duration: float

    def begin(self, world: World) -> Any:
        """Look at the world once, before the first step; returns what `observe` remembers."""

    def observe(self, world: World, step: float, memory: Any) -> tuple[Scene, Any]:
        """Where the obstacle is now, `step` seconds after the last look; moves it on where SUMO does not."""

    def encounter(self, trace: Trace) -> Encounter:
        """The geometry that the metrics are computed from."""


class Point(NamedTuple):
    """A scenario in a weather; `name` is what a study calls it, `place` what tells it from the study's other points."""

    scenario: Scenario
    weather: Weather
    name: str = ""
    place: tuple[tuple[str, Any], ...] = ()
