"""N copies of a network in a running simulation: queries about their actors, and where bodies touch first."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import chain
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
    """A vehicle or person as a rectangle, or M of them in columns [m, m/s]; `along`, the direction, is a unit
    vector.
    """

    middle: FloatArray
    along: FloatArray
    length: Any
    width: Any
    speed: Any

    @classmethod
    def behind(
        cls, front: FloatArray, along: FloatArray, length: float, width: float, speed: FloatArray | float
    ) -> Body:
        """The body whose front has its middle at `front`."""
        return cls(front - along * (length / 2), along, length, width, speed)

    @classmethod
    def columns(cls, bodies: Sequence[Body]) -> Body:
        """M bodies in columns: `middle` and `along` of shape (M, 2), the other columns of shape (M,)."""
        return cls._make(np.array(column) for column in zip(*bodies, strict=True))


class SumoWorld:
    """N copies of a network in a running simulation, created by `open_world`. Arrays have shape (N,) or (N, 2)."""

    def __init__(self, api: Api, n: int) -> None:
        self.api, self.n = api, n
        self._set_speed, self._get_speed = (
            _api_function(api, "vehicle", "setSpeed"),
            _api_function(api, "vehicle", "getSpeed"),
        )
        self._vehicle_position, self._person_position = (
            _api_function(api, domain, "getPosition") for domain in ("vehicle", "person")
        )
        self._last_speeds, self._last_positions = np.zeros(n), np.zeros((n, 2))
        """Speeds and positions of vehicles under test that have left the road."""
        self._speeds_now: FloatArray | None = None
        self._struck_ids: dict[int, str] = {}
        """Ids of the actors that the vehicles under test collided with last, by copy."""
        self._ids: dict[str, list[str]] = {}
        self._positions: dict[str, FloatArray] = {}
        self._copy_of = {id_: copy for copy, id_ in enumerate(self.ids(VUT))}
        self._driving_copies, self._driving_numbers = dict(self._copy_of), np.arange(len(self._copy_of))
        """Numbers of the copies whose vehicle under test is on the road: by the vehicle's id, and as an array."""
        self._commanded_speeds = np.full(len(self._driving_numbers), np.nan)
        """Last speeds commanded to the vehicles under test [m/s]."""
        self.step_length: float = api.simulation.getDeltaT()
        self.sensors = Sensors.perfect(n)
        """The vehicles' sensors in their weather, for ADSs that read the world instead of getting observations."""

    def ids(self, name: str) -> list[str]:
        """The ids of an actor in its copies."""
        if name not in self._ids:
            self._ids[name] = [copied_id(copy, name) for copy in range(self.n)]
        return self._ids[name]

    def set_types(self, types: SumoType) -> None:
        vehicletype = self.api.vehicletype
        columns = (values.tolist() for values in (types.mass, types.accel, types.max_speed, types.tau))
        for id_, mass, accel, max_speed, tau in zip(self.ids(VUT), *columns, strict=True):
            vehicletype.setMass(id_, mass)
            vehicletype.setAccel(id_, accel)
            vehicletype.setMaxSpeed(id_, max_speed)
            vehicletype.setTau(id_, tau)
        self.set_decelerations(types.decel)

    def set_decelerations(self, decel: FloatArray) -> None:
        """Set the largest decelerations of the vehicles under test, also in emergencies [m/s^2]."""
        for id_, value in zip(self.ids(VUT), decel.tolist(), strict=True):
            self.api.vehicletype.setDecel(id_, value)
            self.api.vehicletype.setEmergencyDecel(id_, value)

    def depart(self, *, at_any_speed: bool = False) -> None:
        """Insert all actors, and take control of the vehicles under test; `at_any_speed` changes their types for that.

        Raises
        ------
        SimulationError
            If SUMO cannot insert a vehicle under test.
        """
        global _current_world
        _current_world = self
        if at_any_speed:
            for id_ in self.ids(VUT):
                self.api.vehicletype.setMaxSpeed(id_, MAX_DEPARTURE_SPEED)
            self.set_decelerations(np.full(self.n, INSERTION_DECELERATION))
        self.api.simulationStep()
        departed = set(self.api.vehicle.getIDList())
        for id_ in self.ids(VUT):
            if id_ not in departed:
                raise SimulationError(f"SUMO could not insert vehicle {id_!r}; check the network's traffic file")
            self.api.vehicle.setSpeedMode(id_, SPEED_MODE)
            self.api.vehicle.setLaneChangeMode(id_, LANE_CHANGE_MODE)

    def advance(self, speeds: FloatArray) -> None:
        """Simulate one step, in which the vehicles under test reach `speeds` [m/s]."""
        set_speed, ids = self._set_speed, self.ids(VUT)
        changed_copies = self._driving_numbers[(speeds != self._commanded_speeds)[self._driving_numbers]]
        for copy, speed in zip(changed_copies.tolist(), speeds[changed_copies].tolist(), strict=True):
            set_speed(ids[copy], speed)
        self._commanded_speeds = speeds
        self.api.simulationStep()
        self._positions.clear()
        self._speeds_now = None

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

    def end_runs(self, copies: Sequence[int]) -> None:
        """Remove vehicles whose runs end from SUMO's simulation, and keep their last positions and speeds."""
        if not copies:
            return
        self._last_speeds[copies], self._last_positions[copies] = (
            self.speeds()[copies],
            self.vehicle_positions(VUT)[copies],
        )
        for id_ in [self.ids(VUT)[copy] for copy in copies]:
            self.api.vehicle.remove(id_)
            del self._driving_copies[id_]
        self._driving_numbers = np.array([*self._driving_copies.values()], dtype=np.intp)

    def speeds(self) -> FloatArray:
        """Speeds of the vehicles under test in this step [m/s]; repeated calls return the same array."""
        if self._speeds_now is None:
            self._speeds_now = self._last_speeds.copy()
            self._speeds_now[self._driving_numbers] = [*map(self._get_speed, self._driving_copies)]
        return self._speeds_now

    def vehicle_positions(self, actor: str) -> FloatArray:
        return self._positions_of(actor, self._vehicle_position)

    def person_positions(self, actor: str) -> FloatArray:
        return self._positions_of(actor, self._person_position)

    def _positions_of(self, actor: str, position: Callable[[str], tuple[float, float]]) -> FloatArray:
        """The actor's positions in this step; repeated calls return the same array."""
        if actor not in self._positions:
            ids = self._driving_copies if actor == VUT else self.ids(actor)
            positions = np.fromiter(chain.from_iterable(map(position, ids)), float, 2 * len(ids)).reshape(-1, 2)
            if len(ids) < self.n:
                positions, new_positions = self._last_positions.copy(), positions
                positions[self._driving_numbers] = new_positions
            self._positions[actor] = positions
        return self._positions[actor]

    @property
    def lookup_errors(self) -> tuple[type[Exception], ...]:
        """Errors raised by queries for actors or lanes that do not exist."""
        return (self.api.TraCIException,)

    def has_left(self, id_: str) -> bool:
        """Whether a vehicle under test has left the road, for good."""
        return id_ not in self._driving_copies

    def actor_poses(self) -> dict[str, tuple[float, float, float]]:
        """x and y of the front bumper or person [m], and heading clockwise from north [degrees], of all actors on the
        road, by id.
        """
        domains = (self.api.vehicle, self.api.person)
        return {
            id_: (*domain.getPosition(id_), domain.getAngle(id_)) for domain in domains for id_ in domain.getIDList()
        }

    def actor_size(self, id_: str) -> tuple[bool, float, float]:
        """Whether an actor is a person, and its length and width [m]."""
        domain = self._domain_of(id_)
        return domain is self.api.person, domain.getLength(id_), domain.getWidth(id_)

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


def begin(scenario: Scenario, world: Any) -> ScenarioMemory:
    """Start a scenario in a world before its first step, and return the scenario's memory.

    Raises
    ------
    InputError
        If the network lacks an actor or lane of the scenario.
    """
    try:
        return scenario.begin(world)
    except world.lookup_errors as error:
        raise InputError(
            "scenario.parameters.network",
            f"the network lacks an element of the scenario: {str(error).strip()}",
            "a network and traffic with the ids that the scenario names",
        ) from None


_current_world: SumoWorld | None = None
"""The world that this process simulates; SUMO, too, allows only one per process."""


def current_world() -> SumoWorld:
    assert _current_world is not None
    return _current_world


def direction_of(angle: float) -> FloatArray:
    """Unit vector of a SUMO angle [degrees clockwise from north]."""
    return np.array([math.sin(math.radians(angle)), math.cos(math.radians(angle))])


def _api_function(api: Api, domain: str, name: str) -> Callable[..., Any]:
    """A function of traci, or one of libsumo without its Python wrapper, which takes as long as the function itself."""
    compiled = getattr(api, "_libsumo", None)
    wrapped = getattr(api, domain) if compiled is None else compiled
    return getattr(wrapped, name if compiled is None else f"{domain}_{name}")  # type: ignore[no-any-return]


FRONT, LEFT, RIGHT, REAR = "front", "left", "right", "rear"


class Contacts:
    """First contacts of N vehicles, `first`; in a Euro NCAP test (`is_tested`) only contacts of the vehicle's front are
    collisions.
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
    """The first touches of M pairs of overlapping bodies, if their velocities were constant: the side of the first
    body, the time since then [s], and how far the other's middle was behind the first one's front [m].

    Two bodies of length l, l' and width w, w' at an angle a have the joint half extent r = (l + l' |cos a| + w' |sin
    a|) / 2 along the first one and (w + l' |sin a| + w' |cos a|) / 2 across it. If their middles are x apart in such a
    direction and approach each other at v, the overlap in it began (r - |x|) / v ago. The bodies touched in the
    direction in which the overlap began last, or, if they approach each other in neither direction, in the one with the
    smaller overlap.
    """
    across = np.stack([-own.along[:, 1], own.along[:, 0]], axis=1)
    to_other = other.middle - own.middle
    relative_velocity = own.along * own.speed[:, np.newaxis] - other.along * other.speed[:, np.newaxis]
    cosine, sine = np.abs(_dot(other.along, own.along)), np.abs(_dot(other.along, across))
    extent_along = (own.length + other.length * cosine + other.width * sine) / 2
    extent_across = (own.width + other.length * sine + other.width * cosine) / 2
    x_ahead, x_left = _dot(to_other, own.along), _dot(to_other, across)
    speed_ahead = _dot(relative_velocity, own.along)
    age_along = _overlap_age(extent_along - np.abs(x_ahead), np.copysign(1.0, x_ahead) * speed_ahead)
    age_across = _overlap_age(
        extent_across - np.abs(x_left), np.copysign(1.0, x_left) * _dot(relative_velocity, across)
    )
    is_approaching = np.isfinite(np.minimum(age_along, age_across))
    is_lengthwise = np.where(
        is_approaching, age_along < age_across, extent_along - np.abs(x_ahead) < extent_across - np.abs(x_left)
    )
    age = np.where(is_approaching, np.where(is_lengthwise, age_along, age_across), 0.0)
    side = np.where(is_lengthwise, np.where(x_ahead > 0, FRONT, REAR), np.where(x_left > 0, LEFT, RIGHT))
    return side, age, own.length / 2 - (x_ahead + age * speed_ahead)


def _dot(first: FloatArray, second: FloatArray) -> FloatArray:
    return first[:, 0] * second[:, 0] + first[:, 1] * second[:, 1]


def _overlap_age(overlap: FloatArray, closing_speed: FloatArray) -> FloatArray:
    """Time since bodies began to overlap in one direction, at a closing speed [s]; infinite if they do not approach
    each other.
    """
    return np.where(
        closing_speed > 0, np.maximum(overlap, 0.0) / np.where(closing_speed > 0, closing_speed, 1.0), np.inf
    )
