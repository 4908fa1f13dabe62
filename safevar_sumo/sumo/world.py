"""N copies of a network in a running simulation, and queries about their actors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.scenarios import VUT, Lane, Scenario
from safevar_sumo.scenarios.base import lane_through
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
    def behind(cls, front: FloatArray, along: FloatArray, length: float, width: float, speed: Any) -> Body:
        """The body whose front has its middle at `front`."""
        return cls(front - along * (length / 2), along, length, width, speed)

    @classmethod
    def columns(cls, bodies: Sequence[Body]) -> Body:
        """M bodies in columns: `middle` and `along` of shape (M, 2), the other columns of shape (M,)."""
        return cls._make(np.array(column) for column in zip(*bodies, strict=True))


class SumoWorld:
    """N copies of a network in a running simulation, created by `open_world`. Arrays have shape (N,) or (N, 2)."""

    def __init__(self, api: Any, n: int) -> None:
        self._api, self.n = api, n
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
        vehicletype = self._api.vehicletype
        columns = (values.tolist() for values in (types.mass, types.accel, types.max_speed, types.tau))
        for id_, mass, accel, max_speed, tau in zip(self.ids(VUT), *columns, strict=True):
            vehicletype.setMass(id_, mass)
            vehicletype.setAccel(id_, accel)
            vehicletype.setMaxSpeed(id_, max_speed)
            vehicletype.setTau(id_, tau)
        self.set_decelerations(types.decel)

    def allow_departure(self) -> None:
        """Set SUMO vehicle types that let SUMO insert the vehicles under test at any speed."""
        for id_ in self.ids(VUT):
            self._api.vehicletype.setMaxSpeed(id_, MAX_DEPARTURE_SPEED)
        self.set_decelerations(np.full(self.n, INSERTION_DECELERATION))

    def set_decelerations(self, decel: FloatArray) -> None:
        """Set the largest decelerations of the vehicles under test, also in emergencies [m/s^2]."""
        for id_, value in zip(self.ids(VUT), decel.tolist(), strict=True):
            self._api.vehicletype.setDecel(id_, value)
            self._api.vehicletype.setEmergencyDecel(id_, value)

    def depart(self) -> None:
        """Insert all actors, and take control of the vehicles under test.

        Raises
        ------
        SimulationError
            If SUMO cannot insert a vehicle under test.
        """
        global _current_world
        _current_world = self
        self._api.simulationStep()
        departed = set(self._api.vehicle.getIDList())
        for id_ in self.ids(VUT):
            if id_ not in departed:
                raise SimulationError(f"SUMO could not insert vehicle {id_!r}; check the network's traffic file")
            self._api.vehicle.setSpeedMode(id_, SPEED_MODE)
            self._api.vehicle.setLaneChangeMode(id_, LANE_CHANGE_MODE)

    def advance(self, speeds: FloatArray) -> None:
        """Simulate one step, in which the vehicles under test reach `speeds` [m/s]."""
        set_speed, ids = self._set_speed, self.ids(VUT)
        changed_copies = self._driving_numbers[(speeds != self._commanded_speeds)[self._driving_numbers]]
        for copy, speed in zip(changed_copies.tolist(), speeds[changed_copies].tolist(), strict=True):
            set_speed(ids[copy], speed)
        self._commanded_speeds = speeds
        self._api.simulationStep()
        self._positions.clear()
        self._speeds_now = None

    def collisions(self, is_open: BoolArray) -> dict[int, float]:
        """Speeds [m/s] of the vehicles under test of open runs that collide in this step, by copy.

        On a junction SUMO's collider is the vehicle that must yield (`MSLane::detectCollisions`): the vehicle under
        test may be either.
        """
        self._struck_ids, speeds = {}, dict[int, float]()
        for collision in self._api.simulation.getCollisions():
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
        domain = self._api.person if id_ in self._api.person.getIDList() else self._api.vehicle
        return Body.behind(
            np.array(domain.getPosition(id_)),
            direction_of(domain.getAngle(id_)),
            domain.getLength(id_),
            domain.getWidth(id_),
            domain.getSpeed(id_),
        )

    def end_runs(self, copies: Sequence[int]) -> None:
        """Remove vehicles whose runs end from SUMO's simulation, and keep their last positions and speeds."""
        if not copies:
            return
        self._last_speeds[copies], self._last_positions[copies] = (
            self.speeds()[copies],
            self.vehicle_positions(VUT)[copies],
        )
        for id_ in [self.ids(VUT)[copy] for copy in copies]:
            self._api.vehicle.remove(id_)
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
        return (self._api.TraCIException,)

    @property
    def api(self) -> Any:
        """The module libsumo or traci."""
        return self._api

    def has_left(self, id_: str) -> bool:
        """Whether a vehicle under test has left the road, for good."""
        return id_ not in self._driving_copies

    def actor_poses(self) -> dict[str, tuple[float, float, float]]:
        """x and y of the front bumper or person [m], and heading clockwise from north [degrees], of all actors on the
        road, by id.
        """
        domains = (self._api.vehicle, self._api.person)
        return {
            id_: (*domain.getPosition(id_), domain.getAngle(id_)) for domain in domains for id_ in domain.getIDList()
        }

    def actor_size(self, id_: str) -> tuple[bool, float, float]:
        """Whether an actor is a person, and its length and width [m]."""
        is_person = id_ in self._api.person.getIDList()
        domain = self._api.person if is_person else self._api.vehicle
        return is_person, domain.getLength(id_), domain.getWidth(id_)

    def vehicle_length(self, actor: str) -> float:
        return float(self._api.vehicle.getLength(self.ids(actor)[0]))

    def vehicle_width(self, actor: str) -> float:
        return float(self._api.vehicle.getWidth(self.ids(actor)[0]))

    def lane(self, lane: str) -> Lane:
        return lane_through(lane, self._api.lane.getShape(copied_id(0, lane)))

    def lane_of(self, vehicle: str) -> Lane:
        return self.lane(copy_and_name(self._api.vehicle.getLaneID(self.ids(vehicle)[0]))[1])

    def lane_start(self, lane: str) -> tuple[float, float]:
        x, y = self._api.lane.getShape(copied_id(0, lane))[0]
        return x, y

    def person_width(self, actor: str) -> float:
        return float(self._api.person.getWidth(self.ids(actor)[0]))

    def walk(self, person: str, speed: float) -> None:
        for id_ in self.ids(person):
            self._api.person.setSpeed(id_, speed)

    def drive(self, vehicle: str, speed: float) -> None:
        for id_ in self.ids(vehicle):
            self._api.vehicle.setSpeedMode(id_, SPEED_MODE)
            self._api.vehicle.setSpeed(id_, speed)

    def turn_back(self, person: str) -> None:
        api = self._api.person
        for id_ in self.ids(person):
            back = [api.getRoadID(id_), api.getEdges(id_)[0]]
            api.appendWalkingStage(id_, back, 0.0, speed=api.getSpeed(id_))
            api.removeStage(id_, 0)


def begin(scenario: Scenario, world: Any) -> Any:
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


def _api_function(api: Any, domain: str, name: str) -> Callable[..., Any]:
    """A function of traci, or one of libsumo without its Python wrapper, which takes as long as the function itself."""
    compiled = getattr(api, "_libsumo", None)
    wrapped = getattr(api, domain) if compiled is None else compiled
    return getattr(wrapped, name if compiled is None else f"{domain}_{name}")  # type: ignore[no-any-return]
