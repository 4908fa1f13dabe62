"""TraCI as one controller sees it: one copy of the network, with the traffic file's ids, and other actors through sensors."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.records import Nominal
from safevar_sumo.scenarios import VUT
from safevar_sumo.sumo.copies import copied_id
from safevar_sumo.sumo.engine import Engine, engine_api
from safevar_sumo.sumo.sensing import SENSED_FUNCTIONS, SensedTraffic
from safevar_sumo.sumo.world import SumoWorld

COMMANDS: Mapping[str, tuple[str, ...]] = {
    "setSpeed": ("speed",), "slowDown": ("speed", "duration"), "setAcceleration": ("acceleration", "duration"), "setAccel": ("accel",),
    "setDecel": ("decel",), "setMaxSpeed": ("speed",), "setSpeedMode": ("mode",)}
"""The commands that a controller may give, each with its numeric arguments."""
SUMO_CONTROL = -1.0
"""Value of a speed or speed mode with which a command returns control to SUMO's own driver."""
QUERY_FUNCTIONS = re.compile("(get|is|has|find|convert|couldChangeLane).*")
DISPLAY_FUNCTIONS = ("setColor", "highlight")
LOOP_FUNCTIONS = ("start", "init", "connect", "load", "close", "switch", "switchConnection", "setOrder", "loadState",
                  "saveState", "simulationStep", "simulationStepLegacy", "executeMove", "step")
"""Functions that begin, advance or end simulations."""
VISIBLE_PROPERTIES = re.compile("get(Length|Width|Height|MinGap|VehicleClass|ShapeClass|TypeID|Color|(Emergency|Apparent)?Decel|Accel"
                                "|MaxSpeed|Tau|Mass)")
"""Functions that return properties of other actors that are visible at once or follow from the actor's type."""
UNSENSED_FUNCTIONS: Mapping[str, re.Pattern[str]] = {
    "vehicle": re.compile("getFollower|get(Left|Right)(Followers|Leaders)|getNeighbors|getJunctionFoes|.*LaneChange.*|couldChangeLane"
                          "|getLoadedIDList|getTeleportingIDList|getTaxiFleet|getSpeedWithoutTraCI"),
    "person": re.compile("getTaxiReservations"),
    "simulation": re.compile("get(Arrived|BusStop|Colli|Departed|Emergency|Ending|Loaded|Parking|Pending|Starting|Stop).*"),
    "trafficlight": re.compile("get(Blocking|Rival|Priority|Served).*"),
}
UNSENSED_ROAD_FUNCTIONS = re.compile("getLastStep.*|getWaitingTime|getTraveltime|getPendingVehicles|get.*(Emission|Consumption)")
"""Functions that return values of other actors that no sensor of the vehicle measures."""
MEASURED_VALUES = "getLeader, getIDList, and positions, speeds, angles and lanes of vehicles and persons: these pass the sensors"
INVALID_NUMBER = -1073741824
"""Value that SUMO returns for a property of an actor that is not on the road."""


class CommandedSpeed:
    """A controller's commands, and the acceleration that results from them under SUMO's speed modes."""

    LIMIT_TO_SAFE_SPEED, LIMIT_ACCELERATION, LIMIT_DECELERATION, DEFAULT_MODE, LARGEST_MODE = 1, 2, 4, 31, 127

    def __init__(self, nominal: Nominal, step: float) -> None:
        self._step = step
        self._accel, self._decel, self._max_speed, self._mode = nominal.accel, nominal.decel, np.inf, self.DEFAULT_MODE
        self._speed: float | None = None
        self._end_time, self._speed_rate = -1.0, 0.0

    def command(self, name: str, time: float, speed: float, values: tuple[Any, ...]) -> None:
        """Process a command of the vehicle domain.

        Raises
        ------
        InputError
            If an argument is no legal number.
        """
        numbers = [self._number(name, argument, value) for argument, value in zip(COMMANDS[name], values, strict=True)]
        if name == "setSpeed":
            self._speed, self._end_time = (None if numbers[0] == SUMO_CONTROL else numbers[0]), -1.0
        elif name == "slowDown":
            duration = max(numbers[1], self._step)
            self._speed, self._end_time, self._speed_rate = None, time + duration, (numbers[0] - speed) / duration
        elif name == "setAcceleration":
            self._speed, self._end_time, self._speed_rate = None, time + numbers[1], numbers[0]
        elif name == "setSpeedMode":
            self._mode = self.DEFAULT_MODE if numbers[0] == SUMO_CONTROL else int(numbers[0])
        else:
            setattr(self, {"setAccel": "_accel", "setDecel": "_decel", "setMaxSpeed": "_max_speed"}[name], numbers[0])

    def _number(self, name: str, argument: str, value: Any) -> float:
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        returns_control = number == SUMO_CONTROL and name in ("setSpeed", "setSpeedMode")
        is_legal = math.isfinite(number) and (number >= 0 or argument == "acceleration" or returns_control)
        legal = "a finite number" if argument == "acceleration" else "a finite number from 0 on"
        if name == "setSpeedMode":
            is_legal, legal = is_legal and number == int(number) <= self.LARGEST_MODE, f"a whole number from 0 to {self.LARGEST_MODE}"
        if not is_legal:
            alternative = ", or -1, which gives control back to SUMO's own driver" if name in ("setSpeed", "setSpeedMode") else ""
            raise InputError(f"traci.vehicle.{name}", f"{argument} = {value!r}", legal + alternative)
        return number

    def acceleration(self, speed: float, time: float, sumo_speed: float) -> float:
        """The acceleration that results from the commands [m/s^2]; SUMO's own driver would choose `sumo_speed` next [m/s]."""
        next_speed = speed + self._speed_rate * self._step if time < self._end_time else sumo_speed if self._speed is None else self._speed
        if self._mode & self.LIMIT_TO_SAFE_SPEED:
            next_speed = min(next_speed, max(sumo_speed, speed - self._decel * self._step) if next_speed > sumo_speed else next_speed)
        acceleration = (min(next_speed, self._max_speed) - speed) / self._step
        acceleration = min(acceleration, self._accel) if self._mode & self.LIMIT_ACCELERATION else acceleration
        return max(acceleration, -self._decel) if self._mode & self.LIMIT_DECELERATION else acceleration


class TraciView:
    """TraCI's functions for one vehicle, with the ids of the traffic file."""

    def __init__(self, world: SumoWorld, copy: int, names: frozenset[str], traffic: SensedTraffic, nominal: Nominal, step: float) -> None:
        self._world, self._copy, self._names, self._traffic, self._decel = world, copy, names, traffic, nominal.decel
        self._vut = copied_id(copy, VUT)
        self.commanded_speed, self.time = CommandedSpeed(nominal, step), 0.0
        self.last_error: InputError | None = None
        """The last error raised to the controller, even if the controller caught it."""

    @property
    def on_the_road(self) -> bool:
        return not self._world.has_left(self._vut)

    def speed_of_sumo(self, speed: float) -> float:
        """Speed that SUMO's own driver, with the original vehicle's type, would choose next for road and leader [m/s]."""
        vehicle, vut, snapshot = self._world.api.vehicle, self._vut, self._traffic.snapshot(self._copy)
        free_speed = min(speed + vehicle.getAccel(vut) * self._world.step_length, vehicle.getAllowedSpeed(vut))
        if snapshot.leader is None:
            return float(free_speed)
        name, gap = snapshot.leader
        leader = copied_id(self._copy, name)
        leader_speed = snapshot.vehicle[name]["getSpeed"]
        return float(min(free_speed, vehicle.getFollowSpeed(vut, speed, gap, leader_speed, vehicle.getDecel(leader), leader)))

    def call(self, domain: str, name: str, arguments: tuple[Any, ...], named: Mapping[str, Any]) -> Any:
        """Call a TraCI function in this copy; `domain` is "" for functions of the module itself.

        Raises
        ------
        InputError
            If a controller must not call the function.
        TraCIException
            If SUMO refuses the call.
        """
        with self.translated_errors():
            return self._dispatch(domain, name, positional_arguments(domain, name, arguments, named))

    @contextmanager
    def translated_errors(self) -> Iterator[None]:
        """Context that stores errors for the controller, and replaces ids of copies in SUMO's errors by the traffic file's ids."""
        api = self._world.api
        try:
            yield
        except InputError as error:
            self.last_error = error
            raise
        except (api.TraCIException, api.FatalTraCIError) as error:
            raise traci_exception()(str(error).replace(f"'{self._copy}.", "'")) from None

    def _dispatch(self, domain: str, name: str, arguments: tuple[Any, ...]) -> Any:
        full_name = f"traci.{domain}.{name}" if domain else f"traci.{name}"
        refuse_own_loop(domain, name, full_name)
        if not QUERY_FUNCTIONS.fullmatch(name):
            return self._command(domain, name, full_name, arguments)
        if not domain:
            return getattr(self._world.api, name)(*arguments)
        unsensed_functions = UNSENSED_ROAD_FUNCTIONS if domain in ("edge", "lane") else UNSENSED_FUNCTIONS.get(domain)
        if domain in SENSED_FUNCTIONS:
            value = self._sensed_value(domain, name, arguments)
            if value is not NotImplemented:
                return value
        elif domain in ("edge", "lane") and name in ("getLastStepVehicleIDs", "getLastStepVehicleNumber", "getLastStepPersonIDs"):
            return self._actors_on_road(domain, name, arguments[0])
        elif domain == "simulation" and name in ("getTime", "getCurrentTime"):
            return self.time if name == "getTime" else round(self.time * 1000)
        elif domain == "simulation" and name == "getMinExpectedNumber":
            return sum(len(self._ids(actors)) for actors in SENSED_FUNCTIONS)
        if unsensed_functions is not None and unsensed_functions.fullmatch(name):
            raise InputError(full_name, "returns values of other actors that no sensor of the vehicle measures", MEASURED_VALUES)
        if name == "getIDCount":
            return len(self._to_original_ids(getattr(self._world.api, domain).getIDList()))
        return self._sumo_value(domain, name, arguments)

    def _command(self, domain: str, name: str, full_name: str, arguments: tuple[Any, ...]) -> Any:
        if domain != "vehicle" or name not in (*COMMANDS, *DISPLAY_FUNCTIONS):
            raise InputError(full_name, f"is not for a controller of {VUT!r}", f"of traci.vehicle {', '.join(COMMANDS)}")
        if not arguments or arguments[0] != VUT:
            vehicle_id = repr(arguments[0]) if arguments else "nothing"
            raise InputError(full_name, f"vehID = {vehicle_id} is not the vehicle under test",
                             f"{VUT!r}: a controller commands no other vehicle")
        if name in DISPLAY_FUNCTIONS:
            return self._sumo_value(domain, name, arguments)
        speed = float(self._world.api.vehicle.getSpeed(self._vut))
        return self.commanded_speed.command(name, self.time, speed, arguments[1:])

    def _sensed_value(self, domain: str, name: str, arguments: tuple[Any, ...]) -> Any:
        """An actor's value as the sensors report it; NotImplemented if the function does not depend on sensors."""
        if name in ("getIDList", "getIDCount"):
            ids = self._ids(domain)
            return ids if name == "getIDList" else len(ids)
        if domain == "vehicle" and arguments[:1] == (VUT,):
            return self._leader(*arguments[1:]) if name == "getLeader" else NotImplemented
        actors = self._traffic.snapshot(self._copy).actors(domain)
        if not arguments or VISIBLE_PROPERTIES.fullmatch(name):
            return NotImplemented
        if name not in SENSED_FUNCTIONS[domain]:
            raise InputError(f"traci.{domain}.{name}", f"returns a value of {arguments[0]!r} that no sensor of the vehicle measures",
                             MEASURED_VALUES)
        if arguments[0] in actors:
            return self._to_original_ids(actors[arguments[0]][name])
        return _invalid_value(self._sumo_value(domain, name, arguments))

    def _ids(self, domain: str) -> tuple[str, ...]:
        return (*((VUT,) if domain == "vehicle" else ()), *self._traffic.snapshot(self._copy).actors(domain))

    def _leader(self, dist: float = 100.0) -> tuple[str, float] | None:
        """The leader and the gap to it minus the vehicle's minGap, if at most `dist` [m]; a `dist` of 0 means the stopping distance."""
        speed = float(self._world.api.vehicle.getSpeed(self._vut))
        leader = self._traffic.snapshot(self._copy).leader
        return leader if leader and leader[1] <= (dist or speed**2 / (2 * self._decel)) else None

    def _actors_on_road(self, domain: str, name: str, road: str) -> Any:
        """Actors on a lane or edge, or their number, as the sensors report them."""
        snapshot, function = self._traffic.snapshot(self._copy), "getLaneID" if domain == "lane" else "getRoadID"
        actors = snapshot.person if name == "getLastStepPersonIDs" else {VUT: snapshot.own_values, **snapshot.vehicle}
        names = tuple(actor for actor, values in actors.items() if values.get(function) == copied_id(self._copy, road))
        return len(names) if name == "getLastStepVehicleNumber" else names

    def _sumo_value(self, domain: str, name: str, arguments: tuple[Any, ...]) -> Any:
        function = getattr(getattr(self._world.api, domain), name)
        return self._to_original_ids(function(*(self._to_copied_ids(argument) for argument in arguments)))

    def _to_copied_ids(self, value: Any) -> Any:
        snapshot = self._traffic.snapshot(self._copy)
        if isinstance(value, str) and (value in self._names or value in snapshot.vehicle or value in snapshot.person):
            return copied_id(self._copy, value)
        return type(value)(map(self._to_copied_ids, value)) if type(value) in (list, tuple) else value

    def _to_original_ids(self, value: Any) -> Any:
        """A result with the ids of the traffic file, and without elements of other copies."""
        if isinstance(value, str):
            for prefix in ("", ":", "!"):
                if value.startswith(f"{prefix}{self._copy}."):
                    name = value.removeprefix(f"{prefix}{self._copy}.")
                    return value if name.isdecimal() and name not in self._names else prefix + name
            return value
        if value is None or isinstance(value, bool | int | float | bytes):
            return value
        if isinstance(value, tuple | list):
            elements = [self._to_original_ids(element) for element in value if not self._is_of_other_copy(element)]
            return type(value)(*elements) if hasattr(value, "_fields") else type(value)(elements)
        if isinstance(value, Mapping):
            return {self._to_original_ids(key): self._to_original_ids(element)
                    for key, element in value.items() if not self._is_of_other_copy(key)}
        fields = {name: getattr(value, name) for name in dir(value) if not name.startswith("_") and name not in ("this", "thisown")}
        return SimpleNamespace(**{name: self._to_original_ids(field) for name, field in fields.items() if not callable(field)})

    def _is_of_other_copy(self, value: Any) -> bool:
        if not isinstance(value, str):
            return False
        copy, dot, name = value.removeprefix(":").removeprefix("!").partition(".")
        return bool(dot and copy.isdecimal() and name in self._names and int(copy) != self._copy)


def refuse_own_loop(domain: str, name: str, full_name: str) -> None:
    """Refuse a function that begins, advances or ends the simulation; raises InputError."""
    if name in LOOP_FUNCTIONS and domain in ("", "simulation"):
        raise InputError(full_name, "safevar_sumo itself starts, advances and ends the simulation",
                         "the body of your script's loop, without this call, as a function step(traci, vehicle_id)")


def _invalid_value(value: Any) -> Any:
    """The value of this type that SUMO returns for an actor that is not on the road."""
    if isinstance(value, tuple):
        return tuple(map(_invalid_value, value))
    return "" if isinstance(value, str) else type(value)(INVALID_NUMBER)


def traci_exception() -> type[Exception]:
    """The exception that controllers catch, whatever the engine."""
    return real_traci().exceptions.TraCIException  # type: ignore[no-any-return]


@cache
def real_traci() -> Any:
    """The original module traci, not its substitute for controllers; must be called before controllers run."""
    return engine_api(Engine.TRACI)


def positional_arguments(domain: str, name: str, arguments: tuple[Any, ...], named: Mapping[str, Any]) -> tuple[Any, ...]:
    """Positional and named arguments as positional arguments, in the order of TraCI's function."""
    signature = _signature(domain, name)
    if signature is None or not (named or name in COMMANDS):
        return arguments
    bound = signature.bind(*arguments, **named)
    bound.apply_defaults()
    return bound.args


@cache
def _signature(domain: str, name: str) -> inspect.Signature | None:
    api = real_traci()
    function: Callable[..., Any] | None = getattr(getattr(api, domain, None) if domain else api, name, None)
    try:
        return None if function is None else inspect.signature(function)
    except (TypeError, ValueError):
        return None
