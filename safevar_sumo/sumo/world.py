"""N copies of a network in a running simulation: queries about their actors, and where bodies touch first."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.records import BoolArray, Contact, FloatArray
from safevar_sumo.scenarios import VUT, Lane, Scenario, Scene
from safevar_sumo.scenarios.base import ScenarioMemory, lane_through
from safevar_sumo.sumo.copies import copied_id, copy_and_name
from safevar_sumo.vehicles import Sensors, SumoType

INSERTION_DECELERATION = 9.0
"""Least deceleration of a vehicle while it is inserted [m/s^2]: SUMO inserts only vehicles that could stop before every
obstacle.
"""
MAX_DEPARTURE_SPEED = 200.0
"""Highest speed at which a vehicle may depart while a scene is recorded [m/s]."""
# TraCI "set speed mode", bit 5: SUMO obeys every speed that is set, and its vehicle yields to nobody on a junction.
SPEED_MODE = 32
# TraCI "set lane change mode": the vehicle never changes lanes.
LANE_CHANGE_MODE = 0

Api = Any
"""The module libsumo or traci, which have the same functions."""


class Body(NamedTuple):
    """A vehicle or person as a rectangle, or M of them in columns [m, m/s]; `along` is its direction, a unit vector."""

    middle: FloatArray
    along: FloatArray
    length: Any
    width: Any
    speed: Any

    @classmethod
    def behind(cls, front: FloatArray, along: FloatArray, length: Any, width: Any, speed: FloatArray | float) -> Body:
        """The body whose front's middle is at `front`, or M such bodies."""
        return cls(front - along * (np.asarray(length)[..., np.newaxis] / 2), along, length, width, speed)

    @classmethod
    def columns(cls, bodies: Sequence[Body]) -> Body:
        """M bodies in columns: `middle` and `along` of shape (M, 2), the other columns of shape (M,)."""
        return cls._make(np.array(column) for column in zip(*bodies, strict=True))


class SumoWorld:
    """N copies of a network in a running simulation, created by `open_world`. Arrays have shape (N,) or (N, 2)."""

    def __init__(self, api: Api, n: int) -> None:
        self.api, self.n = api, n
        self.step_length: float = api.simulation.getDeltaT()
        self._set_speed, self._get_speed, self._get_position = (
            _vehicle_function(api, name) for name in ("setSpeed", "getSpeed", "getPosition")
        )
        self._copy_of = {id_: copy for copy, id_ in enumerate(self.ids(VUT))}
        self.driving = dict(self._copy_of)
        """Copies whose vehicle under test is on the road, by the vehicle's id."""
        self._speeds, self._fronts = np.zeros(n), np.zeros((n, 2))
        """Speeds and fronts of the vehicles under test; the last ones of those that have left the road."""
        self._commanded_speeds = np.full(n, np.nan)
        self._struck_ids: dict[int, str] = {}
        """Ids of the actors that the vehicles under test collided with last, by copy."""
        self.sensors = Sensors.perfect(n)
        """The vehicles' sensors in their weather, for ADSs that read the world instead of getting observations."""

    def ids(self, name: str) -> list[str]:
        """The ids of an actor in its copies."""
        return _copied_ids(name, self.n)

    def _set_types(self, types: SumoType) -> None:
        """Set the attributes of the vehicles under test, except their decelerations."""
        vehicletype = self.api.vehicletype
        self._set(vehicletype.setMass, types.mass)
        self._set(vehicletype.setAccel, types.accel)
        self._set(vehicletype.setMaxSpeed, types.max_speed)
        if types.tau is not None:
            self._set(vehicletype.setTau, types.tau)

    def _set_decelerations(self, decel: FloatArray, emergency_decel: FloatArray | None = None) -> None:
        """Set the largest decelerations of the vehicles under test, by default the same in emergencies [m/s^2]."""
        self._set(self.api.vehicletype.setDecel, decel)
        self._set(self.api.vehicletype.setEmergencyDecel, decel if emergency_decel is None else emergency_decel)

    def _set(self, set_value: Callable[[str, float], None], values: FloatArray) -> None:
        for id_, value in zip(self.ids(VUT), values.tolist(), strict=True):
            set_value(id_, value)

    def insert(self, types: SumoType) -> None:
        """Insert all actors, the vehicles under test with these types; raises the errors of `depart`."""
        self._set_types(types)
        self._set_decelerations(np.maximum(types.decel, INSERTION_DECELERATION))
        self.depart()
        self._set_decelerations(types.decel)

    def insert_with_drivers(self, types: SumoType) -> None:
        """Insert all actors, the vehicles under test with these types, but with the decelerations that the traffic file
        gives SUMO's drivers; raises the errors of `depart`.
        """
        vehicletype = self.api.vehicletype
        planned = [(vehicletype.getDecel(id_), vehicletype.getEmergencyDecel(id_)) for id_ in self.ids(VUT)]
        self._set_types(types)
        self._set_decelerations(np.full(self.n, INSERTION_DECELERATION))
        self.depart()
        self._set_decelerations(*np.array(planned).T)
        for id_ in self.ids(VUT):  # SUMO drew a factor for each vehicle
            self.api.vehicle.setSpeedFactor(id_, vehicletype.getSpeedFactor(id_))

    def insert_at_any_speed(self) -> None:
        """Insert all actors; the types of the vehicles under test change."""
        self._set(self.api.vehicletype.setMaxSpeed, np.full(self.n, MAX_DEPARTURE_SPEED))
        self._set_decelerations(np.full(self.n, INSERTION_DECELERATION))
        self.depart()

    def depart(self) -> None:
        """Insert all actors, and take control of the vehicles under test.

        Raises
        ------
        SimulationError
            If SUMO cannot insert a vehicle under test.
        """
        global _current_world
        _current_world = self
        self.api.simulationStep()
        departed = set(self.api.vehicle.getIDList())
        for id_ in self.ids(VUT):
            if id_ not in departed:
                raise SimulationError(f"SUMO could not insert vehicle {id_!r}; check the network's traffic file")
            self.api.vehicle.setSpeedMode(id_, SPEED_MODE)
            self.api.vehicle.setLaneChangeMode(id_, LANE_CHANGE_MODE)
        self._read()

    def begin(self, scenario: Scenario) -> ScenarioMemory:
        """Start a scenario before the first step, and return its memory.

        Raises
        ------
        InputError
            If the network lacks an actor or lane of the scenario.
        """
        try:
            return scenario.begin(self)
        except self.api.TraCIException as error:
            raise InputError(
                "scenario.parameters.network",
                f"the network lacks an element of the scenario: {str(error).strip()}",
                "a network and traffic with the ids that the scenario names",
            ) from None

    def advance(self, speeds: FloatArray) -> None:
        """Simulate one step, in which the vehicles under test reach `speeds` [m/s]."""
        for id_, copy in self.driving.items():
            if speeds[copy] != self._commanded_speeds[copy]:
                self._set_speed(id_, float(speeds[copy]))
        self._commanded_speeds = speeds
        self.api.simulationStep()
        self._read()

    def _read(self) -> None:
        self._speeds, self._fronts = self._speeds.copy(), self._fronts.copy()
        copies = [*self.driving.values()]
        self._speeds[copies] = [*map(self._get_speed, self.driving)]
        self._fronts[copies] = [*map(self._get_position, self.driving)]

    def end_runs(self, copies: Sequence[int]) -> None:
        """Remove vehicles whose runs end from SUMO's simulation, and keep their last positions and speeds."""
        for copy in copies:
            self.api.vehicle.remove(self.ids(VUT)[copy])
            del self.driving[self.ids(VUT)[copy]]

    def collisions(self, is_open: BoolArray) -> dict[int, float]:
        """Speeds [m/s] of the vehicles under test of open runs that collide in this step, by copy.

        On a junction SUMO's collider is the vehicle that must yield (`MSLane::detectCollisions`): the vehicle under
        test may be either.
        """
        self._struck_ids, speeds = {}, dict[int, float]()
        for collision in self.api.simulation.getCollisions():
            pairs = [(collision.collider, collision.colliderSpeed, collision.victim)]
            if collision.type == "junction":
                pairs.append((collision.victim, collision.victimSpeed, collision.collider))
            for id_, speed, other_id in pairs:
                if (copy := self._copy_of.get(id_)) is not None and is_open[copy]:
                    speeds[copy], self._struck_ids[copy] = speed, other_id
        return speeds

    def bodies(self, copies: Sequence[int]) -> tuple[Body, Body]:
        """The bodies of vehicles that collide in this step, and of the actors that they collide with, both in
        columns.
        """
        return (
            Body.columns([self._body_of(self.ids(VUT)[copy]) for copy in copies]),
            Body.columns([self._body_of(self._struck_ids[copy]) for copy in copies]),
        )

    def _body_of(self, id_: str) -> Body:
        domain, (_, length, width) = self._domain_of(id_), self.actor_size(id_)
        front, along = np.array(domain.getPosition(id_)), direction_of(domain.getAngle(id_))
        return Body.behind(front, along, length, width, domain.getSpeed(id_))

    def _domain_of(self, id_: str) -> Api:
        return self.api.person if id_ in self.api.person.getIDList() else self.api.vehicle

    def speeds(self) -> FloatArray:
        """Speeds of the vehicles under test in this step [m/s]."""
        return self._speeds

    def vehicle_positions(self, actor: str) -> FloatArray:
        if actor == VUT:
            return self._fronts
        return np.array([self._get_position(id_) for id_ in self.ids(actor)])

    def person_positions(self, actor: str) -> FloatArray:
        return np.array([self.api.person.getPosition(id_) for id_ in self.ids(actor)])

    def actor_poses(self) -> dict[str, tuple[float, float, float]]:
        """All actors on the road, by id: x and y of front or person [m], heading clockwise from north [degrees]."""
        domains = (self.api.vehicle, self.api.person)
        return {
            id_: (*domain.getPosition(id_), domain.getAngle(id_)) for domain in domains for id_ in domain.getIDList()
        }

    def actor_size(self, id_: str) -> tuple[bool, float, float]:
        """Whether an actor is a person, and its length and width [m]."""
        domain = self._domain_of(id_)
        return domain is self.api.person, domain.getLength(id_), domain.getWidth(id_)

    def actor_speed(self, id_: str) -> float:
        return float(self._domain_of(id_).getSpeed(id_))

    def vehicle_length(self, actor: str) -> float:
        return float(self.api.vehicle.getLength(self.ids(actor)[0]))

    def lane(self, lane: str) -> Lane:
        return lane_through(lane, self.api.lane.getShape(copied_id(0, lane)))

    def lane_of(self, vehicle: str) -> Lane:
        return self.lane(copy_and_name(self.api.vehicle.getLaneID(self.ids(vehicle)[0]))[1])

    def person_width(self, actor: str) -> float:
        return float(self.api.person.getWidth(self.ids(actor)[0]))

    def walk(self, person: str, speed: float) -> None:
        for id_ in self.ids(person):
            self.api.person.setSpeed(id_, speed)

    def drive(self, vehicle: str, speed: float) -> None:
        for id_ in self.ids(vehicle):
            self.api.vehicle.setSpeedMode(id_, SPEED_MODE)
            self.api.vehicle.setSpeed(id_, speed)

    def turn_back(self, person: str) -> None:
        api = self.api.person
        for id_ in self.ids(person):
            back = [api.getRoadID(id_), api.getEdges(id_)[0]]
            api.appendWalkingStage(id_, back, 0.0, speed=api.getSpeed(id_))
            api.removeStage(id_, 0)


_current_world: SumoWorld | None = None
"""The world that this process simulates; SUMO, too, allows only one per process."""


def current_world() -> SumoWorld:
    assert _current_world is not None
    return _current_world


@lru_cache
def _copied_ids(name: str, n: int) -> list[str]:
    return [copied_id(copy, name) for copy in range(n)]


def direction_of(angle: float) -> FloatArray:
    """Unit vector of a SUMO angle [degrees clockwise from north]."""
    return np.array([math.sin(math.radians(angle)), math.cos(math.radians(angle))])


def _vehicle_function(api: Api, name: str) -> Callable[..., Any]:
    """A function of traci, or one of libsumo without its Python wrapper, which takes as long as the function itself."""
    compiled = getattr(api, "_libsumo", None)
    function: Callable[..., Any] = getattr(compiled or api.vehicle, f"vehicle_{name}" if compiled else name)
    return function


FRONT, LEFT, RIGHT, REAR = "front", "left", "right", "rear"


class Contacts:
    """First contacts of N vehicles, `first`.

    In a Euro NCAP test, where `is_tested`, only contacts of the vehicle's front are collisions.
    """

    def __init__(self, n: int, is_tested: BoolArray) -> None:
        self._is_tested, self.first = is_tested, Contact(np.full(n, "", dtype="U5"), np.full(n, np.nan))

    def record_collisions(self, world: Any, is_open: BoolArray, scene: Scene) -> dict[int, float]:
        """Process one sample; returns the speeds [m/s] of the vehicles of open runs that collide, by vehicle number."""
        speeds = world.collisions(is_open)
        new_copies = [copy for copy in speeds if not self.first.side[copy]]
        if new_copies:
            own, other = world.bodies(new_copies)
            self._locate(new_copies, own, other, scene)
        side = self.first.side
        return {copy: speed for copy, speed in speeds.items() if not self._is_tested[copy] or side[copy] == FRONT}

    def _locate(self, copies: Sequence[int], own: Body, other: Body, scene: Scene) -> None:
        side, age, distance_behind_front = find_touches(own, other)
        lateral = scene.lateral[copies] - np.broadcast_to(scene.lateral_speed, scene.lateral.shape)[copies] * age
        is_at_end = (side == FRONT) | (side == REAR)
        share = np.where(is_at_end, lateral / own.width + 0.5, distance_behind_front / own.length)
        self.first.side[copies] = side
        self.first.place[copies] = 100 * np.minimum(np.maximum(share, 0.0), 1.0)


def find_touches(own: Body, other: Body) -> tuple[npt.NDArray[np.str_], FloatArray, FloatArray]:
    """The first touches of M overlapping pairs, a vehicle's own body and another, if their velocities were constant.

    Returns the touched side of the own body, the time since the touch [s], and how far the other body's middle was then
    behind the own front [m].

    Two bodies of length l, l' and width w, w' at an angle a have the joint half extent r = (l + l' |cos a| + w' |sin
    a|) / 2 along the own body and (w + l' |sin a| + w' |cos a|) / 2 across it. If their middles are x apart in such a
    direction and approach each other at v, the overlap in it began (r - |x|) / v ago. The bodies touched in the
    direction in which the overlap began last, or, if they approach each other in neither direction, in the one with the
    smaller overlap.
    """
    axes = np.stack([own.along, np.stack([-own.along[:, 1], own.along[:, 0]], axis=1)])
    cosine, sine = np.abs(_dot(other.along, axes))
    extent = np.stack(
        [
            (own.length + other.length * cosine + other.width * sine) / 2,
            (own.width + other.length * sine + other.width * cosine) / 2,
        ]
    )
    distance = _dot(other.middle - own.middle, axes)
    speed = _dot(own.along * own.speed[:, np.newaxis] - other.along * other.speed[:, np.newaxis], axes)
    overlap, closing_speed = extent - np.abs(distance), np.copysign(1.0, distance) * speed
    is_closing = closing_speed > 0
    ages = np.where(is_closing, np.maximum(overlap, 0.0) / np.where(is_closing, closing_speed, 1.0), np.inf)
    approaches = is_closing.any(axis=0)
    is_lengthwise = np.where(approaches, ages[0] < ages[1], overlap[0] < overlap[1])
    age = np.where(approaches, np.min(ages, axis=0), 0.0)
    ahead, left = distance > 0
    side = np.where(is_lengthwise, np.where(ahead, FRONT, REAR), np.where(left, LEFT, RIGHT))
    return side, age, own.length / 2 - (distance[0] + age * speed[0])


def _dot(vectors: FloatArray, axes: FloatArray) -> FloatArray:
    """Components of M vectors along their two axes, shape (2, M)."""
    return vectors[:, 0] * axes[..., 0] + vectors[:, 1] * axes[..., 1]
