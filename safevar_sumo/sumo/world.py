"""N copies of a network in a running simulation, and queries about their actors."""

from __future__ import annotations

import math
import time
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

SURE_BRAKES = 9.0
"""Deceleration of all vehicles at their insertion [m/s^2]: SUMO inserts no vehicle that could not stop before an obstacle ahead."""
FASTEST = 200.0
"""Highest speed at which a vehicle may depart in a recorded scene [m/s]."""
# Speed mode: SUMO obeys every speed that is set and yields to nobody on a junction (TraCI "set speed mode", bit 5).
OBEY = 32
# Lane change mode: none at all (TraCI "set lane change mode").
KEEP_LANE = 0


class Body(NamedTuple):
    """A vehicle or person as a rectangle: middle [m] and direction, a unit vector, shape (2,); m, m, m/s. Or M bodies in columns."""

    middle: FloatArray
    along: FloatArray
    length: Any
    width: Any
    speed: Any

    @classmethod
    def behind(cls, front: FloatArray, along: FloatArray, length: float, width: float, speed: Any) -> Body:
        """The body with the middle of its front at `front`."""
        return cls(front - along * (length / 2), along, length, width, speed)

    @classmethod
    def columns(cls, bodies: Sequence[Body]) -> Body:
        """M bodies in columns: positions and directions of shape (M, 2), the others of shape (M,)."""
        return cls._make(np.array(column) for column in zip(*bodies, strict=True))


class SumoWorld:
    """N copies of a network in a running simulation; created by `open_world`. Shapes: (N,) or (N, 2)."""

    def __init__(self, api: Any, n: int, *, watched: bool = False) -> None:
        self._api, self.n = api, n
        self._set_speed, self._get_speed = _direct(api, "vehicle", "setSpeed"), _direct(api, "vehicle", "getSpeed")
        self._vehicle_position, self._person_position = _direct(api, "vehicle", "getPosition"), _direct(api, "person", "getPosition")
        self._last_speeds, self._last_positions = np.zeros(n), np.zeros((n, 2))
        """Speeds and positions of vehicles under test that have left the road."""
        self._speeds_now: FloatArray | None = None
        self._struck: dict[int, str] = {}
        """By copy, the id of the actor in the vehicle under test's last collision."""
        self._ids: dict[str, list[str]] = {}
        self._positions: dict[str, FloatArray] = {}
        self._copy_of = {name: copy for copy, name in enumerate(self.ids(VUT))}
        self._driving, self._rows = dict(self._copy_of), np.arange(len(self._copy_of))
        """Copies whose vehicle under test is on the road."""
        self._commanded = np.full(len(self._rows), np.nan)
        """Last speeds commanded to the vehicles under test [m/s]."""
        self.step_length: float = api.simulation.getDeltaT()
        self._pause = self.step_length if watched else 0.0
        self.sensors = Sensors.perfect(n)
        """Sensors of ADSs that read the world themselves, including the weather."""

    def ids(self, name: str) -> list[str]:
        """The ids of an actor in its copies."""
        if name not in self._ids:
            self._ids[name] = [copied_id(copy, name) for copy in range(self.n)]
        return self._ids[name]

    def set_types(self, types: SumoType) -> None:
        """Set the SUMO vehicle types of the vehicles under test."""
        vehicletype = self._api.vehicletype
        columns = (values.tolist() for values in (types.mass, types.accel, types.max_speed, types.tau))
        for name, mass, accel, max_speed, tau in zip(self.ids(VUT), *columns, strict=True):
            vehicletype.setMass(name, mass)
            vehicletype.setAccel(name, accel)
            vehicletype.setMaxSpeed(name, max_speed)
            vehicletype.setTau(name, tau)
        self.set_decelerations(types.decel)

    def allow_departure(self) -> None:
        """Set types of the vehicles under test with which SUMO inserts them at any speed."""
        for name in self.ids(VUT):
            self._api.vehicletype.setMaxSpeed(name, FASTEST)
        self.set_decelerations(np.full(self.n, SURE_BRAKES))

    def set_decelerations(self, decel: FloatArray) -> None:
        """Set the largest decelerations of the vehicles under test, also in emergencies [m/s^2]."""
        for name, value in zip(self.ids(VUT), decel.tolist(), strict=True):
            self._api.vehicletype.setDecel(name, value)
            self._api.vehicletype.setEmergencyDecel(name, value)

    def depart(self) -> None:
        """Insert all actors, and take control of the vehicles under test.

        Raises
        ------
        SimulationError
            If SUMO cannot insert a vehicle under test.
        """
        global _present
        _present = self
        self._api.simulationStep()
        departed = set(self._api.vehicle.getIDList())
        for name in self.ids(VUT):
            if name not in departed:
                raise SimulationError(f"SUMO found no place for vehicle {name!r}: look at the network's traffic file")
            self._api.vehicle.setSpeedMode(name, OBEY)
            self._api.vehicle.setLaneChangeMode(name, KEEP_LANE)

    def advance(self, speeds: FloatArray) -> None:
        """One simulation step in which the vehicles under test reach `speeds` [m/s]."""
        set_speed, names = self._set_speed, self.ids(VUT)
        changed = self._rows[(speeds != self._commanded)[self._rows]]
        for copy, speed in zip(changed.tolist(), speeds[changed].tolist(), strict=True):
            set_speed(names[copy], speed)
        self._commanded = speeds
        self._api.simulationStep()
        self._positions.clear()
        self._speeds_now = None
        if self._pause:
            time.sleep(self._pause)

    def collisions(self, open_: BoolArray) -> dict[int, float]:
        """Copies of open runs whose vehicle under test collides in this step, and its speed [m/s].

        On a junction SUMO calls the vehicle that must yield the collider (`MSLane::detectCollisions`): either may be under test.
        """
        self._struck, speeds = {}, dict[int, float]()
        for collision in self._api.simulation.getCollisions():
            pairs = [(collision.collider, collision.colliderSpeed, collision.victim)]
            if collision.type == "junction":
                pairs.append((collision.victim, collision.victimSpeed, collision.collider))
            for name, speed, other in pairs:
                if (copy := self._copy_of.get(name)) is not None and open_[copy]:
                    speeds[copy], self._struck[copy] = speed, other
        return speeds

    def bodies(self, copies: Sequence[int]) -> tuple[Body, Body]:
        """Vehicles under test that collide in this step, and the bodies that they collide with; in columns."""
        return (Body.columns([self._body_of(self.ids(VUT)[copy]) for copy in copies]),
                Body.columns([self._body_of(self._struck[copy]) for copy in copies]))

    def _body_of(self, name: str) -> Body:
        kind = self._api.person if name in self._api.person.getIDList() else self._api.vehicle
        return Body.behind(np.array(kind.getPosition(name)), direction_of(kind.getAngle(name)), kind.getLength(name),
                           kind.getWidth(name), kind.getSpeed(name))

    def leave(self, copies: Sequence[int]) -> None:
        """Remove vehicles under test whose runs are over: their last state is kept, and SUMO no longer simulates them."""
        if not copies:
            return
        self._last_speeds[copies], self._last_positions[copies] = self.speeds()[copies], self.vehicle_positions(VUT)[copies]
        for name in [self.ids(VUT)[copy] for copy in copies]:
            self._api.vehicle.remove(name)
            del self._driving[name]
        self._rows = np.array([*self._driving.values()], dtype=np.intp)

    def speeds(self) -> FloatArray:
        """Speeds of the vehicles under test in this step [m/s]; repeated calls return the same array."""
        if self._speeds_now is None:
            self._speeds_now = self._last_speeds.copy()
            self._speeds_now[self._rows] = [*map(self._get_speed, self._driving)]
        return self._speeds_now

    def vehicle_positions(self, actor: str) -> FloatArray:
        return self._positions_of(actor, self._vehicle_position)

    def person_positions(self, actor: str) -> FloatArray:
        return self._positions_of(actor, self._person_position)

    def _positions_of(self, actor: str, position: Callable[[str], tuple[float, float]]) -> FloatArray:
        """Positions in this step; repeated calls return the same array."""
        if actor not in self._positions:
            names = self._driving if actor == VUT else self.ids(actor)
            positions = np.fromiter(chain.from_iterable(map(position, names)), float, 2 * len(names)).reshape(-1, 2)
            if len(names) < self.n:
                positions, on_the_road = self._last_positions.copy(), positions
                positions[self._rows] = on_the_road
            self._positions[actor] = positions
        return self._positions[actor]

    @property
    def lookup_errors(self) -> tuple[type[Exception], ...]:
        """Errors raised by queries for actors or lanes that do not exist."""
        return (self._api.TraCIException,)

    @property
    def api(self) -> Any:
        """libsumo, or traci."""
        return self._api

    def has_left(self, name: str) -> bool:
        """Whether a vehicle under test is off the road for good."""
        return name not in self._driving

    def names(self) -> frozenset[str]:
        """Names of vehicles, persons, roads and types in the original network."""
        api = self._api
        kinds = (api.vehicle, api.person, api.edge, api.lane, api.route, api.vehicletype, api.junction)
        return frozenset(name.removeprefix(":").partition(".")[2] for kind in kinds for name in kind.getIDList())

    def whereabouts(self) -> dict[str, tuple[float, float, float]]:
        """Positions of all actors on the road by id: front bumper or person [m], heading clockwise from north [degrees]."""
        kinds = (self._api.vehicle, self._api.person)
        return {name: (*kind.getPosition(name), kind.getAngle(name)) for kind in kinds for name in kind.getIDList()}

    def measures(self, name: str) -> tuple[bool, float, float]:
        """Whether an actor is a person, and its length and width [m]."""
        is_person = name in self._api.person.getIDList()
        kind = self._api.person if is_person else self._api.vehicle
        return is_person, kind.getLength(name), kind.getWidth(name)

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
        for name in self.ids(person):
            self._api.person.setSpeed(name, speed)

    def drive(self, vehicle: str, speed: float) -> None:
        for name in self.ids(vehicle):
            self._api.vehicle.setSpeedMode(name, OBEY)
            self._api.vehicle.setSpeed(name, speed)

    def turn_back(self, person: str) -> None:
        api = self._api.person
        for name in self.ids(person):
            back = [api.getRoadID(name), api.getEdges(name)[0]]
            api.appendWalkingStage(name, back, 0.0, speed=api.getSpeed(name))
            api.removeStage(name, 0)


def begin(scenario: Scenario, world: Any) -> Any:
    """Start a scenario in a world before the first step; returns the scenario's memory.

    Raises
    ------
    InputError
        If the network lacks an actor or lane of the scenario.
    """
    try:
        return scenario.begin(world)
    except world.lookup_errors as error:
        raise InputError("scenario.parameters.network", f"the network lacks an element of the scenario: {str(error).strip()}",
                         "a network and traffic with the ids that the scenario names") from None


_present: SumoWorld | None = None
"""The world that is being simulated in this process; SUMO allows one per process, too."""


def present_world() -> SumoWorld:
    """The world that is being simulated."""
    assert _present is not None
    return _present


def direction_of(angle: float) -> FloatArray:
    """Unit vector of a SUMO angle [degrees clockwise from north]."""
    return np.array([math.sin(math.radians(angle)), math.cos(math.radians(angle))])


def _direct(api: Any, domain: str, name: str) -> Callable[..., Any]:
    """A function of libsumo without its Python wrapper, which costs as much as the call; a function of traci as it is."""
    compiled = getattr(api, "_libsumo", None)
    return getattr(getattr(api, domain), name) if compiled is None else getattr(compiled, f"{domain}_{name}")  # type: ignore[no-any-return]
