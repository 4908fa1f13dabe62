"""TraCI as one controller sees it: one copy of the network, ids of the traffic file, other actors through sensors."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from safevar_sumo.errors import InputError
from safevar_sumo.scenarios import VUT
from safevar_sumo.sumo.copies import copied_id
from safevar_sumo.sumo.perception import SENSED_FUNCTIONS, SensedTraffic
from safevar_sumo.sumo.traci_module import (
    COMMANDS,
    Arguments,
    CommandedSpeed,
    Named,
    Value,
    all_arguments,
    full_name,
    real_traci,
    refuse_own_loop,
)
from safevar_sumo.sumo.world import SumoWorld

DISPLAY_FUNCTIONS = ("setColor", "highlight")
LISTS = ("getIDList", "getIDCount")
CONSTANT_FUNCTIONS = (
    "getTypeID",
    "getLength",
    "getWidth",
    "getHeight",
    "getMinGap",
    "getVehicleClass",
    "getShapeClass",
    "getColor",
    "getAccel",
    "getDecel",
    "getEmergencyDecel",
    "getApparentDecel",
    "getMaxSpeed",
    "getTau",
    "getMass",
)
"""Functions that return properties of actors that are visible at once or follow from the actor's type."""
OWN_FUNCTIONS = (
    "getLeader",
    "getRoute",
    "getRouteID",
    "getRouteIndex",
    "getDistance",
    "getDrivingDistance",
    "getDrivingDistance2D",
    "getAllowedSpeed",
    "getSpeedFactor",
    "getSpeedMode",
    "getSlope",
    "getWaitingTime",
    "getAccumulatedWaitingTime",
    "getTimeLoss",
    "getNextTLS",
    "isStopped",
    "getFollowSpeed",
    "getSecureGap",
    "getStopSpeed",
    "getImperfection",
    "getActionStepLength",
    "getDeparture",
)
"""Functions that return values of the vehicle under test alone."""
ACTORS_ON_ROAD = ("getLastStepVehicleIDs", "getLastStepVehicleNumber", "getLastStepPersonIDs")
QUERIES: Mapping[str, tuple[str, ...]] = {
    "": ("getVersion", "isLibsumo", "hasGUI"),
    "vehicle": (*LISTS, *SENSED_FUNCTIONS["vehicle"], *CONSTANT_FUNCTIONS, *OWN_FUNCTIONS),
    "person": (*LISTS, *SENSED_FUNCTIONS["person"], *CONSTANT_FUNCTIONS),
    "simulation": (
        "getTime",
        "getDeltaT",
        "getMinExpectedNumber",
        "getNetBoundary",
        "getDistance2D",
        "getDistanceRoad",
        "convert2D",
        "convert3D",
        "convertGeo",
        "convertRoad",
    ),
    "edge": (*LISTS, *ACTORS_ON_ROAD, "getLaneNumber", "getStreetName", "getFromJunction", "getToJunction", "getAngle"),
    "lane": (
        *LISTS,
        *ACTORS_ON_ROAD[:2],
        "getEdgeID",
        "getLength",
        "getWidth",
        "getShape",
        "getMaxSpeed",
        "getFriction",
        "getAllowed",
        "getDisallowed",
        "getLinkNumber",
        "getLinks",
        "getFoes",
        "getInternalFoes",
    ),
    "junction": (*LISTS, "getPosition", "getShape", "getIncomingEdges", "getOutgoingEdges"),
    "trafficlight": (
        *LISTS,
        "getRedYellowGreenState",
        "getPhase",
        "getPhaseName",
        "getPhaseDuration",
        "getSpentDuration",
        "getNextSwitch",
        "getProgram",
        "getControlledLanes",
        "getControlledLinks",
    ),
    "vehicletype": (*LISTS, *CONSTANT_FUNCTIONS[1:], "getSpeedFactor", "getImperfection"),
    "route": (*LISTS, "getEdges"),
}
"""The functions that a controller may query, by domain; "" is the module itself."""
VARIABLES: Mapping[str, str] = {
    "TRACI_ID_LIST": "getIDList",
    "ID_COUNT": "getIDCount",
    "VAR_POSITION": "getPosition",
    "VAR_POSITION3D": "getPosition3D",
    "VAR_SPEED": "getSpeed",
    "VAR_ANGLE": "getAngle",
    "VAR_ROAD_ID": "getRoadID",
    "VAR_LANE_ID": "getLaneID",
    "VAR_LANE_INDEX": "getLaneIndex",
    "VAR_LANEPOSITION": "getLanePosition",
    "VAR_LANEPOSITION_LAT": "getLateralLanePosition",
    "VAR_SPEED_LAT": "getLateralSpeed",
    "VAR_ACCELERATION": "getAcceleration",
    "VAR_SIGNALS": "getSignals",
    "VAR_LEADER": "getLeader",
    "VAR_DISTANCE": "getDistance",
    "VAR_LENGTH": "getLength",
    "VAR_WIDTH": "getWidth",
    "VAR_HEIGHT": "getHeight",
    "VAR_TYPE": "getTypeID",
    "VAR_VEHICLECLASS": "getVehicleClass",
    "VAR_MINGAP": "getMinGap",
    "VAR_ALLOWED_SPEED": "getAllowedSpeed",
    "VAR_MAXSPEED": "getMaxSpeed",
    "VAR_ACCEL": "getAccel",
    "VAR_DECEL": "getDecel",
    "VAR_TAU": "getTau",
    "VAR_ROUTE_ID": "getRouteID",
    "VAR_WAITING_TIME": "getWaitingTime",
    "VAR_TIME": "getTime",
    "VAR_DELTA_T": "getDeltaT",
}
"""TraCI's variables for subscriptions, each with the function that returns the same value."""
DEFAULT_VARIABLES: Mapping[str, tuple[str, ...]] = {
    "vehicle": ("VAR_ROAD_ID", "VAR_LANEPOSITION"),
    "person": ("VAR_ROAD_ID", "VAR_LANEPOSITION"),
    "simulation": ("VAR_TIME",),
}
"""Domains for subscriptions, each with the variables of a subscription that names none."""
CONTEXT_DOMAINS = {"CMD_GET_VEHICLE_VARIABLE": "vehicle", "CMD_GET_PERSON_VARIABLE": "person"}
INVALID_NUMBER = -1073741824
"""Value that SUMO returns for a property of an actor that is not on the road."""

Variables = dict[int, tuple[str, Arguments]]
"""Requested variables, each with its function and that function's arguments after the actor's id."""


class TraciView:
    """TraCI's functions for one vehicle, with the ids of the traffic file."""

    def __init__(self, world: SumoWorld, copy: int, traffic: SensedTraffic, commands: CommandedSpeed) -> None:
        self._world, self._copy, self._traffic = world, copy, traffic
        self._vut = copied_id(copy, VUT)
        self._subscriptions: dict[tuple[bool, str, str], tuple[str, float, Variables]] = {}
        self.commands, self.time = commands, 0.0
        self.last_error: InputError | None = None
        """The last error raised to the controller, even if the controller caught it."""

    @property
    def on_the_road(self) -> bool:
        return not self._world.has_left(self._vut)

    def speed_of_sumo(self, speed: float) -> float:
        """Speed that SUMO's driver, with the original vehicle's type, would choose next for road and leader [m/s]."""
        vehicle, vut, snapshot = self._world.api.vehicle, self._vut, self._traffic.snapshot(self._copy)
        free_speed = min(speed + vehicle.getAccel(vut) * self._world.step_length, vehicle.getAllowedSpeed(vut))
        if snapshot.leader is None:
            return float(free_speed)
        name, gap = snapshot.leader
        leader, leader_speed = copied_id(self._copy, name), snapshot.actors["vehicle"][name]["getSpeed"]
        follow_speed = vehicle.getFollowSpeed(vut, speed, gap, leader_speed, vehicle.getDecel(leader), leader)
        return float(min(free_speed, follow_speed))

    def call(self, domain: str, name: str, arguments: Arguments, named: Named) -> Value:
        """Call a TraCI function in this copy; `domain` is "" for functions of the module itself.

        Raises
        ------
        InputError
            If a controller must not call the function; kept in `last_error`.
        TraCIException
            If SUMO refuses the call; its message has the traffic file's ids.
        """
        api = self._world.api
        try:
            refuse_own_loop(domain, name)
            if "ubscri" in name and domain in DEFAULT_VARIABLES:
                return self._subscription(domain, name, all_arguments(domain, name, arguments, named))
            if domain == "vehicle" and name in (*COMMANDS, *DISPLAY_FUNCTIONS):
                return self._command(name, all_arguments(domain, name, arguments, named))
            return self._query(domain, name, *arguments, **named)
        except InputError as error:
            self.last_error = error
            raise
        except (api.TraCIException, api.FatalTraCIError) as error:
            raise real_traci().exceptions.TraCIException(re.sub(r"'([:!]?)\d+\.", r"'\1", str(error))) from None

    def _command(self, name: str, arguments: Arguments) -> None:
        if arguments[0] != VUT:
            raise InputError(
                f"traci.vehicle.{name}",
                f"vehID = {arguments[0]!r} is not the vehicle under test",
                f"{VUT!r}: a controller commands no other vehicle",
            )
        if name in DISPLAY_FUNCTIONS:
            self._sumo_value("vehicle", name, arguments)
        else:
            speed = float(self._world.api.vehicle.getSpeed(self._vut))
            self.commands.command(name, self.time, speed, arguments[1:])

    def _query(self, domain: str, name: str, /, *given: Value, **named: Value) -> Value:
        allowed = QUERIES.get(domain, ())
        if name not in allowed:
            legal = (*allowed, *COMMANDS) if domain == "vehicle" else allowed or QUERIES
            problem = f"is not for a controller of {VUT!r}"
            raise InputError(full_name(domain, name), problem, ", ".join(filter(None, legal)))
        arguments = all_arguments(domain, name, given, named) if named else given
        if name in LISTS:
            ids = self._ids(domain)
            return ids if name == "getIDList" else len(ids)
        is_own = (domain, *arguments[:1]) == ("vehicle", VUT)
        if domain in SENSED_FUNCTIONS and name not in CONSTANT_FUNCTIONS and not is_own:
            return self._sensed_value(domain, name, arguments)
        if name == "getLeader":
            return self._leader(*arguments[1:])
        if name in ACTORS_ON_ROAD:
            return self._actors_on_road(domain, name, arguments[0])
        if name == "getTime":
            return self.time
        if name == "getMinExpectedNumber":
            return sum(len(self._ids(actors)) for actors in SENSED_FUNCTIONS)
        return self._sumo_value(domain, name, arguments)

    def _sensed_value(self, domain: str, name: str, arguments: Arguments) -> Value:
        """Another actor's value as the sensors report it."""
        if name not in SENSED_FUNCTIONS[domain]:
            problem = f"returns a value of {arguments[0]!r} that no sensor of the vehicle measures"
            legal = (*SENSED_FUNCTIONS[domain], *CONSTANT_FUNCTIONS)
            raise InputError(full_name(domain, name), problem, ", ".join(legal))
        actors = self._traffic.snapshot(self._copy).actors[domain]
        if arguments[0] in actors:
            return _original_ids(actors[arguments[0]][name])
        value = self._sumo_value(domain, name, arguments)
        if isinstance(value, tuple):
            return (float(INVALID_NUMBER),) * len(value)
        return "" if isinstance(value, str) else type(value)(INVALID_NUMBER)

    def _ids(self, domain: str) -> tuple[str, ...]:
        if domain in SENSED_FUNCTIONS:
            return (*((VUT,) if domain == "vehicle" else ()), *self._traffic.snapshot(self._copy).actors[domain])
        return tuple(dict.fromkeys(map(_original_ids, getattr(self._world.api, domain).getIDList())))

    def _leader(self, dist: float = 100.0) -> tuple[str, float] | None:
        """The leader and the gap to it minus minGap, if at most `dist` [m]; 0 means the stopping distance."""
        speed = float(self._world.api.vehicle.getSpeed(self._vut))
        leader = self._traffic.snapshot(self._copy).leader
        return leader if leader and leader[1] <= (dist or speed**2 / (2 * self.commands.nominal_decel)) else None

    def _actors_on_road(self, domain: str, name: str, road: str) -> Value:
        """Actors on a lane or edge, or their number, as the sensors report them."""
        snapshot, function = self._traffic.snapshot(self._copy), "getLaneID" if domain == "lane" else "getRoadID"
        persons, vehicles = snapshot.actors["person"], {VUT: snapshot.own, **snapshot.actors["vehicle"]}
        actors = persons if name == "getLastStepPersonIDs" else vehicles
        names = tuple(actor for actor, values in actors.items() if values.get(function) == copied_id(self._copy, road))
        return len(names) if name == "getLastStepVehicleNumber" else names

    def _sumo_value(self, domain: str, name: str, arguments: Arguments) -> Value:
        api = self._world.api
        function = getattr(getattr(api, domain) if domain else api, name)
        return _original_ids(function(*(_copied_ids(self._copy, argument) for argument in arguments)))

    def _subscription(self, domain: str, name: str, arguments: Arguments) -> Value:
        """Subscribe, unsubscribe, or return the values of functions subscribed to, as the sensors report them."""
        is_context = "Context" in name
        if name.startswith("get"):
            results = self._results(is_context, domain)
            return results if name.startswith("getAll") else results.get(arguments[0] if arguments else "", {})
        actor, *details = ("", *arguments) if domain == "simulation" else arguments
        if name.startswith("unsubscribe"):
            self._subscriptions.pop((is_context, domain, actor), None)
            return None
        around, dist = details[:2] if is_context else (0, 0.0)
        domains = {_constant(name): other for name, other in CONTEXT_DOMAINS.items()} if is_context else {0: domain}
        if name not in ("subscribe", "subscribeContext") or around not in domains:
            raise InputError(
                full_name(domain, name),
                f"is not for a controller of {VUT!r}",
                f"subscribe, or subscribeContext with {' or '.join(CONTEXT_DOMAINS)}",
            )
        variables = _requested_variables(domains[around], details[-4], details[-1])
        self._subscriptions[is_context, domain, actor] = domains[around], dist, variables
        return None

    def _results(self, is_context: bool, domain: str) -> dict[str, Value]:
        results: dict[str, Value] = {}
        for (*kind, actor), (other_domain, dist, variables) in self._subscriptions.items():
            if kind == [is_context, domain] and actor in (("",) if domain == "simulation" else self._ids(domain)):
                results[actor] = (
                    self._values(domain, actor, variables)
                    if not is_context
                    else {
                        other: self._values(other_domain, other, variables)
                        for other in self._ids(other_domain)
                        if math.dist(
                            *(
                                self._query(*of)[:2]
                                for of in ((domain, "getPosition", actor), (other_domain, "getPosition", other))
                            )
                        )
                        <= dist
                    }
                )
        return results

    def _values(self, domain: str, actor: str, variables: Variables) -> dict[int, Value]:
        return {
            variable: self._query(domain, function, *((actor,) if actor else ()), *arguments)
            for variable, (function, arguments) in variables.items()
        }


def _requested_variables(domain: str, requested: Value, parameters: Value) -> Variables:
    functions = {_constant(name): function for name, function in VARIABLES.items()}
    variables = map(_constant, DEFAULT_VARIABLES[domain]) if requested is None else requested
    result: Variables = {}
    for variable in variables:
        if variable not in functions:
            raise InputError(f"traci.{domain}.subscribe", f"variable {variable!r}", ", ".join(VARIABLES))
        argument = (parameters or {}).get(variable, ())
        result[variable] = functions[variable], argument[1:] if isinstance(argument, tuple) else (argument,)
    return result


def _copied_ids(copy: int, value: Value) -> Value:
    """Arguments for a copy: every text is an id; default types of SUMO are the same in all copies."""
    if isinstance(value, str):
        return re.sub(r"^(?!DEFAULT_)([:!]?)(?=.)", rf"\g<1>{copy}.", value)
    return type(value)(_copied_ids(copy, element) for element in value) if isinstance(value, list | tuple) else value


def _original_ids(value: Value) -> Value:
    """A result with the ids of the traffic file."""
    if isinstance(value, str):
        return re.sub(r"^([:!]?)\d+\.", r"\1", value)
    if isinstance(value, dict):
        return {_original_ids(key): _original_ids(element) for key, element in value.items()}
    return type(value)(map(_original_ids, value)) if type(value) in (list, tuple) else value


def _constant(name: str) -> int:
    return int(getattr(real_traci().constants, name))
