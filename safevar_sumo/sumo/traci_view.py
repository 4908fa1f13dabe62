"""TraCI as the controller of one vehicle sees it: only the vehicle's copy of the network, with the
ids of the traffic file, and other actors as the vehicle's sensors report them.
"""

from __future__ import annotations

import inspect
import math
import re
from collections import defaultdict, deque
from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

from safevar_sumo.ads.base import STEP_DECIMALS
from safevar_sumo.errors import InputError
from safevar_sumo.scenarios import VUT
from safevar_sumo.sumo.copies import copied_id, copy_and_name
from safevar_sumo.sumo.engine import traci_api
from safevar_sumo.sumo.traci_commands import (
    CALLS,
    COMMANDS,
    CONSTANT,
    DEFAULT_VARIABLES,
    DRIVER_COMMANDS,
    LISTS,
    POSITIONS,
    SENSED,
    SUBSCRIPTIONS,
    VARIABLES,
    CommandedSpeed,
)
from safevar_sumo.sumo.world import Api, SumoWorld
from safevar_sumo.vehicles import Sensors

Value = Any
"""An argument or a result of a function of TraCI."""
Arguments = tuple[Value, ...]
ActorValues = dict[str, Value]
"""Values of an actor by the TraCI function that returns them; its length is among them."""
Actors = dict[str, dict[str, ActorValues]]
"""Values of all actors, by domain ("vehicle" or "person") and by name in the traffic file."""
Variables = dict[int, tuple[str, Arguments]]
"""Requested variables by number: the TraCI function that returns the value of the variable, and
the arguments of this function after the actor's id.
"""

INVALID_NUMBER = -1073741824
"""Value that SUMO returns for a property of an actor that is not on the road."""
LEADER_RANGE = 1000.0
"""Distance within which SUMO looks for a leader [m]."""
OWN_LOOP = "safevar_sumo itself starts, advances and ends the simulation"
BYPASS = "it would bypass the vehicle's model or its sensors"


@cache
def real_traci() -> Api:
    """The original module traci, not the substitute that controllers import. Call this function
    before controllers run: then only the substitute is importable.
    """
    return traci_api()


def refused(domain: str, name: str, problem: str) -> InputError:
    """The error for a call that a controller must not make. `domain` is "" for a function of the
    module traci itself.
    """
    function = ".".join(part for part in ("traci", domain, name) if part)
    if function == "traci.vehicle.setType":
        return InputError(
            function,
            "makes it another vehicle, but the study's vehicle drives",
            ", ".join(DRIVER_COMMANDS),
        )
    body = (
        "the body of your script's loop, without this call, as a function"
        " step(traci, vehicle_id)"
    )
    return InputError(
        function,
        problem,
        f"{body}, with calls of {', '.join(CALLS.get(domain, CALLS))}",
    )


class Snapshot(NamedTuple):
    """The traffic in one copy of the network at one time.

    `vehicle` has the values of the vehicle under test, none once the vehicle has left the road;
    `actors` has the values of all other actors. `leader` is the name of the vehicle ahead and the
    gap to it [m], or None.
    """

    vehicle: ActorValues
    actors: Actors
    leader: tuple[str, float] | None


class SensedTraffic:
    """The traffic around N vehicles in their copies of the network, as the vehicles' sensors report
    it: after a latency, within a range, and with a scale of distances.

    `seen` has a snapshot for each vehicle: what its sensors report now. Until the latency is over,
    sensors report the first snapshot.
    """

    def __init__(self, world: SumoWorld, sensors: Sensors, step: float) -> None:
        self._world = world
        self._sensors = sensors
        ages = (sensors.latency / step).tolist()
        # Rounded twice, so that the last bits of a quotient do not decide about half a step:
        self._past = [
            deque[Snapshot](maxlen=1 + round(round(age, STEP_DECIMALS))) for age in ages
        ]
        self.record_step()

    def record_step(self) -> None:
        """Record the traffic of this step. Call this method in every step after the first one."""
        names = defaultdict(list)
        for domain in SENSED:
            for id_ in getattr(self._world.api, domain).getIDList():
                copy, name = copy_and_name(id_)
                names[copy, domain].append(name)
        self.seen = []
        reaches = self._sensors.reach.tolist()
        scales = self._sensors.scale.tolist()
        for copy, past in enumerate(self._past):
            past.append(self._snapshot(copy, names))
            self.seen.append(_limit_to_range(past[0], reaches[copy], scales[copy]))

    def is_on_road(self, copy: int) -> bool:
        """Whether a vehicle has not left the road."""
        return bool(self._past[copy][-1].vehicle)

    def _snapshot(
        self, copy: int, names: Mapping[tuple[int, str], list[str]]
    ) -> Snapshot:
        """The traffic of this step in one copy. `names` has the actors by copy and domain."""
        api = self._world.api
        vut = copied_id(copy, VUT)
        if vut not in self._world.driving:
            return Snapshot({}, {domain: {} for domain in SENSED}, None)
        actors: Actors = {}
        for domain, functions in SENSED.items():
            functions_of_domain = getattr(api, domain)
            actors[domain] = {}
            for actor in names[copy, domain]:
                id_ = copied_id(copy, actor)
                actors[domain][actor] = {
                    name: getattr(functions_of_domain, name)(id_)
                    for name in (*functions, "getLength")
                }

        vehicle = actors["vehicle"].pop(VUT)
        leader = api.vehicle.getLeader(vut, LEADER_RANGE)
        # Without a leader, libsumo and traci return None or ("", -1).
        if not leader or not leader[0]:
            return Snapshot(vehicle, actors, None)
        leader_id, gap = leader
        return Snapshot(vehicle, actors, (copy_and_name(leader_id)[1], gap))


def _limit_to_range(snapshot: Snapshot, reach: float, scale: float) -> Snapshot:
    """The snapshot without actors beyond the sensors' range, and with distances multiplied by the
    sensors' scale.
    """
    vehicle = snapshot.vehicle
    if not vehicle or (reach == math.inf and scale == 1):
        return snapshot
    actors: Actors = {}
    for domain, members in snapshot.actors.items():
        actors[domain] = {}
        for name, values in members.items():
            # SUMO states the position of an actor's front; the rear of a vehicle may be nearer.
            length = values["getLength"] if domain == "vehicle" else 0.0
            heading = math.radians(values["getAngle"])
            front = values["getPosition"]
            position = vehicle["getPosition"]
            rear = (
                front[0] - length * math.sin(heading),
                front[1] - length * math.cos(heading),
            )
            if min(math.dist(position, front), math.dist(position, rear)) <= reach:
                actors[domain][name] = values | _positions_in_scale(
                    vehicle, values, scale
                )
    leader = snapshot.leader
    if leader is None or leader[0] not in actors["vehicle"]:
        return Snapshot(vehicle, actors, None)
    name, gap = leader
    return Snapshot(vehicle, actors, (name, gap * scale))


def _positions_in_scale(
    vehicle: ActorValues, values: ActorValues, scale: float
) -> ActorValues:
    """The positions of an actor, after the sensors' scale has multiplied the distances from the
    vehicle under test; none if the scale is 1, because the true positions stay.
    """
    if scale == 1:
        return {}
    positions = {}
    for name in POSITIONS:
        pairs = zip(vehicle[name], values[name], strict=True)
        positions[name] = tuple(start + scale * (end - start) for start, end in pairs)
    return positions


class TraciView:
    """TraCI's functions as the controller of one vehicle calls them: ids are those of the traffic
    file, without the number of the vehicle's copy.
    """

    def __init__(self, world: SumoWorld, copy: int, traffic: SensedTraffic) -> None:
        self._api = world.api
        self._copy = copy
        self._vut = copied_id(copy, VUT)
        self._traffic = traffic
        self._step = world.step_length
        self._commands = CommandedSpeed(world.step_length)
        self._steps_of_action = round(
            self._api.vehicle.getActionStepLength(self._vut) / self._step
        )
        self._acceleration = 0.0
        self._subscriptions: dict[tuple[str, str], Variables] = {}
        self.time = 0.0
        self.last_error: InputError | None = None
        """The last error raised to the controller, even if the controller caught it."""

    def commanded_acceleration(self, speed: float) -> float:
        """The acceleration [m/s^2] that the controller's commands and SUMO's driver ask for, at the
        speed of the vehicle [m/s].
        """
        accel = self._api.vehicle.getAccel(self._vut)
        decel = self._api.vehicle.getDecel(self._vut)
        # Between two actions the driver asks for its last acceleration again, even if the vehicle's
        # delays let through only a part of this acceleration.
        sumo_speed = speed + self._acceleration * self._step
        steps = round(self.time / self._step)
        is_action = steps % self._steps_of_action == 0
        if is_action:
            sumo_speed = self._speed_of_sumo(speed, accel, decel)
        self._acceleration = self._commands.acceleration(
            speed, self.time, sumo_speed, accel, decel
        )
        return self._acceleration

    def _speed_of_sumo(self, speed: float, accel: float, decel: float) -> float:
        """The speed [m/s] that SUMO's driver would choose for the next step, within the limits of
        road and vehicle, and behind the leader that the sensors see.
        """
        vehicle = self._api.vehicle
        vut = self._vut
        _, actors, leader = self._traffic.seen[self._copy]
        limit = vehicle.getAllowedSpeed(vut)
        if self._commands.mode & CommandedSpeed.BEYOND_LIMIT:
            limit = vehicle.getMaxSpeed(vut)
        slowest = max(limit, speed - decel * self._step)
        sumo_speed = min(speed + accel * self._step, slowest)
        if leader is not None:
            name, gap = leader
            id_ = copied_id(self._copy, name)
            follow_speed = vehicle.getFollowSpeed(
                vut,
                speed,
                gap,
                actors["vehicle"][name]["getSpeed"],
                vehicle.getApparentDecel(id_),
                id_,
            )
            sumo_speed = min(sumo_speed, follow_speed)
        return float(sumo_speed)

    def call(
        self, domain: str, name: str, arguments: Arguments, named: Mapping[str, Value]
    ) -> Value:
        """Call a TraCI function in this copy.

        Raises
        ------
        InputError
            If a controller must not call the function; the error is kept in `last_error`.
        TraCIException
            If SUMO refuses the call; ids in the message are those of the traffic file.
        """
        try:
            if name not in CALLS.get(domain, ()):
                reason = OWN_LOOP if domain in ("", "simulation") else BYPASS
                raise refused(
                    domain, name, f"is not for a controller of {VUT!r}: {reason}"
                )
            bound = _signature(domain, name).bind(*arguments, **named)
            if name in COMMANDS or name in SUBSCRIPTIONS:
                bound.apply_defaults()
            if name in COMMANDS:
                return self._command(name, *bound.args)
            if name == "subscribe":
                return self._subscribe(domain, *bound.args)
            if name in SUBSCRIPTIONS:
                return self._subscribed_values(domain, *bound.args)
            return self._query(domain, name, *bound.args)
        except InputError as error:
            self.last_error = error
            raise
        except (self._api.TraCIException, self._api.FatalTraCIError) as error:
            # The controller knows the ids of the traffic file.
            raise real_traci().exceptions.TraCIException(
                re.sub(r"'([:!]?)\d+\.", r"'\1", str(error))
            ) from None

    def _command(self, name: str, vehicle: str, *values: Value) -> Value:
        """Note a command for the vehicle under test. SUMO itself only gets commands that change
        attributes of its driver.
        """
        if vehicle != VUT:
            raise refused(
                "vehicle",
                name,
                f"vehID = {vehicle!r} is not the vehicle under test, {VUT!r}",
            )
        speed = float(self._api.vehicle.getSpeed(self._vut))
        self._commands.command(name, self.time, speed, values)
        if name in DRIVER_COMMANDS:
            self._sumo_value("vehicle", name, VUT, *values)

    def _query(self, domain: str, name: str, *arguments: Value) -> Value:
        """The value of a function that only reads: what the sensors report of another actor, and
        what SUMO knows of everything else.
        """
        if name == "getIDList":
            return self._ids(domain)
        if name in LISTS:
            return len(self._ids(domain))
        if domain in SENSED and name not in CONSTANT and arguments[0] != VUT:
            return self._sensed_value(domain, name, *arguments)
        if name == "getLeader":
            return self._leader(*arguments[1:])
        if name == "getSpeedMode":
            return self._commands.mode
        return self._sumo_value(domain, name, *arguments)

    def _sensed_value(
        self, domain: str, name: str, actor: str, *arguments: Value
    ) -> Value:
        """A value of another actor, as the sensors report it. If the sensors do not see the actor,
        the value is the one that SUMO returns for an actor that is not on the road.
        """
        if name not in SENSED[domain]:
            raise refused(
                domain,
                name,
                f"returns a value of {actor!r} that no sensor of the vehicle measures",
            )

        actors = self._traffic.seen[self._copy].actors[domain]
        if actor in actors:
            return _original_ids(actors[actor][name])
        value = self._sumo_value(domain, name, actor, *arguments)
        if isinstance(value, str):
            return ""
        if isinstance(value, tuple):
            return (float(INVALID_NUMBER),) * len(value)
        # Controllers may compare types: an int stays an int.
        return type(value)(INVALID_NUMBER)

    def _ids(self, domain: str) -> tuple[str, ...]:
        """The ids in a domain: the actors that the sensors see, after the vehicle under test, or
        the parts of the network (such as its edges).
        """
        if domain not in SENSED:
            return tuple(dict.fromkeys(self._sumo_value(domain, "getIDList")))
        ids = [VUT] if domain == "vehicle" else []
        return (*ids, *self._traffic.seen[self._copy].actors[domain])

    def _leader(self, dist: float = 100.0) -> tuple[str, float] | None:
        """The leader that the sensors see, and the gap to it minus SUMO's minGap [m]; None if this
        gap is larger than `dist` [m]. A `dist` of 0 stands for the vehicle's stopping distance.
        """
        vehicle = self._api.vehicle
        vut = self._vut
        dist = dist or vehicle.getSpeed(vut) ** 2 / (2 * vehicle.getDecel(vut))
        leader = self._traffic.seen[self._copy].leader
        if leader and leader[1] <= dist:
            return leader
        return None

    def _sumo_value(self, domain: str, name: str, *arguments: Value) -> Value:
        copied = [_copied_ids(self._copy, argument) for argument in arguments]
        return _original_ids(getattr(getattr(self._api, domain), name)(*copied))

    def _subscribe(
        self,
        domain: str,
        actor: str,
        requested: Value,
        begin: float,
        end: float,
        parameters: Value,
    ) -> Value:
        """Subscribe to variables of an actor, by their numbers in TraCI. The times `begin` and
        `end` are ignored: a subscription is always valid.
        """
        functions = {_constant(name): function for name, function in VARIABLES.items()}
        if requested is None:
            requested = (_constant(name) for name in DEFAULT_VARIABLES)
        variables = {}
        for number in requested:
            if functions.get(number) not in CALLS[domain]:
                raise refused(
                    domain,
                    "subscribe",
                    f"variable {number!r} is none of {', '.join(VARIABLES)}",
                )
            # In TraCI the first element of such a tuple states the type of the other elements.
            extras = (parameters or {}).get(number, ())
            extras = extras[1:] if isinstance(extras, tuple) else (extras,)
            variables[number] = functions[number], extras
        self._subscriptions[domain, actor] = variables

    def _subscribed_values(self, domain: str, actor: str | None = None) -> Value:
        """The values of the variables to which the controller subscribed, of one actor or, without
        `actor`, by actor. An actor that the sensors do not see has no values.
        """
        values = {}
        ids = self._ids(domain)
        for (of_domain, id_), variables in self._subscriptions.items():
            if of_domain == domain and id_ in ids:
                values[id_] = {
                    number: self._query(domain, name, id_, *extras)
                    for number, (name, extras) in variables.items()
                }
        if actor is None:
            return values
        return values.get(actor, {})


def _copied_ids(copy: int, value: Value) -> Value:
    """Arguments of a TraCI function with the ids of a copy. Every text is an id. SUMO's default
    types (DEFAULT_...) have the same ids in all copies.
    """
    if isinstance(value, str):
        return re.sub(r"^(?!DEFAULT_)([:!]?)(?=.)", rf"\g<1>{copy}.", value)
    if isinstance(value, list | tuple):
        return type(value)(_copied_ids(copy, element) for element in value)
    return value


def _original_ids(value: Value) -> Value:
    """A result of a TraCI function, with the ids of the traffic file instead of those of a copy."""
    if isinstance(value, str):
        return re.sub(r"^([:!]?)\d+\.", r"\1", value)
    # TraCI's own classes derive from tuple, but have other constructors: they stay as they are.
    if type(value) in (list, tuple):
        return type(value)(_original_ids(item) for item in value)
    return value


def _constant(name: str) -> int:
    return int(getattr(real_traci().constants, name))


@cache
def _signature(domain: str, name: str) -> inspect.Signature:
    return inspect.signature(getattr(getattr(real_traci(), domain), name))
