"""The running simulation in SUMO of N copies of a network, each with a vehicle under test."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.records import BoolArray, FloatArray, FloatOrArray, nans
from safevar_sumo.scenarios import VUT, Lane, WorldScenario
from safevar_sumo.scenarios.base import ScenarioMemory
from safevar_sumo.scenarios.roads import Coordinates, Frame, lane_through
from safevar_sumo.sumo.bodies import Body, BodyPairs, Film, VehicleStates
from safevar_sumo.sumo.copies import copied_id, copy_and_name
from safevar_sumo.vehicles import SumoType

INSERTION_DECELERATION = 9.0
"""Least deceleration that a vehicle gets while SUMO inserts it [m/s^2]: SUMO inserts only vehicles
that could stop before every obstacle.
"""
MAX_DEPARTURE_SPEED = 200.0
"""Highest speed at which a vehicle may depart while a scene is recorded [m/s]."""
# TraCI "set speed mode", bit 5: SUMO obeys every speed that is set, and its vehicle yields to
# nobody on a junction.
SPEED_MODE = 32
# TraCI "set lane change mode": the vehicle never changes lanes.
LANE_CHANGE_MODE = 0
CUT_SHAPE = "passenger"
"""Shape of a vehicle whose front corners SUMO cuts off, also when it looks for collisions."""
FULL_SHAPE = "evehicle"
"""Shape of a vehicle that SUMO draws alike, with all corners."""

Api = Any
"""The module libsumo or traci, which have the same functions."""


class SumoWorld:
    """A `SceneWorld` that SUMO simulates: N copies of a network, in each a vehicle under test.
    `open_world` creates it. Arrays have the shape (N,) or (N, 2).
    """

    def __init__(self, api: Api, n: int) -> None:
        self.api = api
        self.n = n
        self.step_length: float = api.simulation.getDeltaT()
        self._set_speed = function_of(api, "vehicle", "setSpeed")
        self._get_speed = function_of(api, "vehicle", "getSpeed")
        self._get_position = function_of(api, "vehicle", "getPosition")
        self._get_person_position = function_of(api, "person", "getPosition")
        self._copy_of = {id_: copy for copy, id_ in enumerate(self.ids(VUT))}
        self.driving = dict(self._copy_of)
        """Copies whose vehicle under test is still on the road, by the vehicle's id."""
        self._speeds = np.zeros(n)
        self._fronts = np.zeros((n, 2))
        """Speeds [m/s] and front positions [m] of the vehicles under test. A vehicle that has left
        the road keeps its last values.
        """
        self._persons: dict[str, FloatArray] = {}
        """Positions of persons in all copies by actor, shape (N, 2) [m]. Once a person has left the
        road in a copy, positions are the last ones in copies without a vehicle under test.
        """
        self._commanded_speeds = nans(n)
        self._struck_ids: dict[int, str] = {}
        """Ids of the actors that vehicles under test collided with in the last step, by copy."""

    def ids(self, name: str) -> list[str]:
        """The ids of an actor in its copies."""
        return _copied_ids(name, self.n)

    def _set_decelerations(
        self, decel: FloatArray, emergency_decel: FloatArray
    ) -> None:
        """Set the largest decelerations of the vehicles under test, shape (N,) [m/s^2]: in usual
        braking and in emergencies.
        """
        self._set(self.api.vehicletype.setDecel, decel)
        self._set(self.api.vehicletype.setEmergencyDecel, emergency_decel)

    def _set(self, set_value: Callable[[str, float], None], values: FloatArray) -> None:
        for id_, value in zip(self.ids(VUT), values.tolist(), strict=True):
            set_value(id_, value)

    def enter(
        self, types: SumoType | None, *, keeps_drivers: bool = False
    ) -> VehicleStates:
        """Insert all actors; see `VehicleWorld.enter`.

        Raises
        ------
        SimulationError
            If SUMO cannot insert a vehicle under test.
        """
        vehicletype = self.api.vehicletype
        ids = self.ids(VUT)
        decel = np.full(self.n, INSERTION_DECELERATION)
        if types is None:
            self._set(vehicletype.setMaxSpeed, np.full(self.n, MAX_DEPARTURE_SPEED))
        else:
            decel = types.decel
            self._set(vehicletype.setMass, types.mass)
            self._set(vehicletype.setAccel, types.accel)
            self._set(vehicletype.setMaxSpeed, types.max_speed)
            if types.tau is not None:
                self._set(vehicletype.setTau, types.tau)
        emergency_decel = decel
        if keeps_drivers:
            decel = np.array([vehicletype.getDecel(name) for name in ids])
            emergency_decel = np.array(
                [vehicletype.getEmergencyDecel(name) for name in ids]
            )
        self._set_decelerations(
            np.maximum(decel, INSERTION_DECELERATION),
            np.maximum(emergency_decel, INSERTION_DECELERATION),
        )
        self._depart()
        self._set_decelerations(decel, emergency_decel)
        if keeps_drivers:
            # SUMO has drawn a random factor for each vehicle: the factor of its type replaces it.
            for id_ in ids:
                self.api.vehicle.setSpeedFactor(id_, vehicletype.getSpeedFactor(id_))
        return self._motion(np.ones(self.n, bool))

    def _depart(self) -> None:
        """Let SUMO insert all actors, with rectangles as bodies, and take control of the vehicles
        under test.
        """
        vehicletype = self.api.vehicletype
        for type_id in vehicletype.getIDList():
            if vehicletype.getShapeClass(type_id).startswith(CUT_SHAPE):
                vehicletype.setShapeClass(type_id, FULL_SHAPE)
        self.api.simulationStep()
        departed = set(self.api.vehicle.getIDList())
        for id_ in self.ids(VUT):
            if id_ not in departed:
                raise SimulationError(
                    f"SUMO could not insert vehicle {id_!r}; check the network's traffic file"
                )
            self.api.vehicle.setSpeedMode(id_, SPEED_MODE)
            self.api.vehicle.setLaneChangeMode(id_, LANE_CHANGE_MODE)

    def begin(self, scenario: WorldScenario) -> ScenarioMemory:
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

    def step(self, speeds: FloatArray, is_open: BoolArray) -> VehicleStates:
        for id_, copy in list(self.driving.items()):
            if not is_open[copy]:
                self.api.vehicle.remove(id_)
                del self.driving[id_]
            elif speeds[copy] != self._commanded_speeds[copy]:
                self._set_speed(id_, float(speeds[copy]))
        self._commanded_speeds = speeds
        self.api.simulationStep()
        return self._motion(is_open)

    def _motion(self, is_open: BoolArray) -> VehicleStates:
        self._speeds = self._speeds.copy()
        self._fronts = self._fronts.copy()
        copies = list(self.driving.values())
        self._speeds[copies] = [self._get_speed(name) for name in self.driving]
        self._fronts[copies] = [self._get_position(name) for name in self.driving]
        return VehicleStates(self._fronts, self._speeds, self._hits(is_open))

    def _hits(self, is_open: BoolArray) -> dict[int, float]:
        """Speeds [m/s] of the vehicles under test that collide in this step, by copy. Vehicles
        whose runs have ended (not `is_open`) are left out.

        On a junction SUMO's collider is the vehicle that must yield (`MSLane::detectCollisions`):
        there the vehicle under test may be the collider or the victim.
        """
        self._struck_ids = {}
        speeds = {}
        for collision in self.api.simulation.getCollisions():
            pairs = [(collision.collider, collision.colliderSpeed, collision.victim)]
            if collision.type == "junction":
                pairs.append(
                    (collision.victim, collision.victimSpeed, collision.collider)
                )
            for id_, speed, other_id in pairs:
                copy = self._copy_of.get(id_)
                if copy is not None and is_open[copy]:
                    speeds[copy] = speed
                    self._struck_ids[copy] = other_id
        return speeds

    def bodies(self, vehicles: Sequence[int]) -> BodyPairs:
        return self._pairs([(copy, self._struck_ids[copy]) for copy in vehicles])

    def bodies_around(self, vehicles: Sequence[int]) -> BodyPairs:
        pairs = []
        for id_ in (*self.api.vehicle.getIDList(), *self.api.person.getIDList()):
            copy, _ = copy_and_name(id_)
            if copy in vehicles and id_ not in self._copy_of:
                pairs.append((copy, id_))
        return self._pairs(pairs)

    def _pairs(self, pairs: Sequence[tuple[int, str]]) -> BodyPairs:
        """Pairs of the bodies of a vehicle under test, by its copy, and of an actor, by its id."""
        copies = [copy for copy, _ in pairs]
        vehicles = self._bodies([self.ids(VUT)[copy] for copy in copies])
        obstacles = self._bodies([id_ for _, id_ in pairs])
        return BodyPairs(np.array(copies), vehicles, obstacles)

    def _bodies(self, ids: Sequence[str]) -> Body:
        """The bodies of actors, by their ids, in columns."""
        persons = self.api.person.getIDList()
        rows = []
        for id_ in ids:
            domain = self.api.person if id_ in persons else self.api.vehicle
            place = domain.getPosition(id_)
            along = direction_of(domain.getAngle(id_))
            size = domain.getLength(id_), domain.getWidth(id_)
            rows.append((*place, *along, *size, domain.getSpeed(id_)))
        front, along, sizes_and_speed = np.split(
            np.reshape(rows, (-1, 7)), (2, 4), axis=1
        )
        length, width, speed = sizes_and_speed.T
        return Body.behind(front, along, length, width, speed)

    def speeds(self) -> FloatArray:
        """Speeds of the vehicles under test in this step [m/s]."""
        return self._speeds

    def vehicle_positions(self, actor: str) -> FloatArray:
        if actor == VUT:
            return self._fronts
        return np.array([self._get_position(name) for name in self.ids(actor)])

    def person_positions(self, actor: str) -> FloatArray:
        ids = self.ids(actor)
        copies = list(self.driving.values())
        try:
            positions = np.array([self._get_person_position(name) for name in ids])
        # A person has left the road in a copy: ask SUMO only where a vehicle is still driving.
        except self.api.TraCIException:
            positions = self._persons.get(actor, np.zeros((self.n, 2))).copy()
            positions[copies] = [
                self._get_person_position(ids[copy]) for copy in copies
            ]
        self._persons[actor] = positions
        return positions

    def actor_poses(self) -> dict[str, tuple[Coordinates, float]]:
        """Positions and headings of all actors on the road, by id: the position of a vehicle's
        front or of a person [m], and the heading clockwise from north [degrees].
        """
        return {
            id_: (domain.getPosition(id_), domain.getAngle(id_))
            for domain in (self.api.vehicle, self.api.person)
            for id_ in domain.getIDList()
        }

    def film(self, tracks: dict[str, Film], sample: int, length: int) -> None:
        """Write the motion of all actors on the road into `tracks`, which has a film of `length`
        samples for each name, at one of these samples.
        """
        for domain in (self.api.vehicle, self.api.person):
            for id_ in domain.getIDList():
                copy, name = copy_and_name(id_)
                if name not in tracks:
                    motion = nans((length, self.n, 5))
                    tracks[name] = Film(
                        motion,
                        domain is self.api.person,
                        domain.getLength(id_),
                        domain.getWidth(id_),
                    )
                tracks[name].motion[sample, copy] = (
                    *domain.getPosition(id_),
                    *direction_of(domain.getAngle(id_)),
                    domain.getSpeed(id_),
                )

    def vehicle_length(self, actor: str) -> float:
        return float(self.api.vehicle.getLength(self.ids(actor)[0]))

    @property
    def vehicle_width(self) -> float:
        return float(self.api.vehicle.getWidth(self.ids(VUT)[0]))

    def lane(self, lane: str) -> Lane:
        return lane_through(lane, self.api.lane.getShape(copied_id(0, lane)))

    @property
    def frame(self) -> Frame:
        return Frame.through_origin(self.lane_of(VUT))

    def lane_of(self, vehicle: str) -> Lane:
        return self.lane(
            copy_and_name(self.api.vehicle.getLaneID(self.ids(vehicle)[0]))[1]
        )

    def person_width(self, actor: str) -> float:
        return float(self.api.person.getWidth(self.ids(actor)[0]))

    def walk(self, person: str, speed: FloatOrArray) -> None:
        speeds = np.broadcast_to(speed, self.n).tolist()
        for id_, value in zip(self.ids(person), speeds, strict=True):
            self.api.person.setSpeed(id_, value)

    def turn_back(self, person: str, copies: Sequence[int] | None = None) -> None:
        api = self.api.person
        ids = self.ids(person)
        if copies is not None:
            ids = [ids[copy] for copy in copies]
        for id_ in ids:
            back = [api.getRoadID(id_), api.getEdges(id_)[0]]
            api.appendWalkingStage(id_, back, 0.0, speed=api.getSpeed(id_))
            api.removeStage(id_, 0)


@lru_cache
def _copied_ids(name: str, n: int) -> list[str]:
    return [copied_id(copy, name) for copy in range(n)]


def direction_of(angle: float) -> FloatArray:
    """Unit vector of a SUMO angle [degrees clockwise from north]."""
    return np.array([math.sin(math.radians(angle)), math.cos(math.radians(angle))])


def function_of(api: Api, domain: str, name: str) -> Callable[..., Any]:
    """A function of traci or libsumo. libsumo's Python wrapper is left out, because it takes as
    long as the function itself.
    """
    compiled = getattr(api, "_libsumo", None)
    function: Callable[..., Any] = getattr(getattr(api, domain), name)
    if compiled:
        function = getattr(compiled, f"{domain}_{name}")
    return function
