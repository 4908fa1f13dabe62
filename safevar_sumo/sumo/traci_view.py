"""TraCI for one controller: one copy of the network, ids of the traffic file, other actors through the vehicle's sensors."""

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
from safevar_sumo.sumo.sensing import SENSED, Sensing
from safevar_sumo.sumo.world import SumoWorld

COMMANDS: Mapping[str, tuple[str, ...]] = {
    "setSpeed": ("speed",), "slowDown": ("speed", "duration"), "setAcceleration": ("acceleration", "duration"), "setAccel": ("accel",),
    "setDecel": ("decel",), "setMaxSpeed": ("speed",), "setSpeedMode": ("mode",)}
"""Commands of a controller, and their numeric arguments."""
IN_ITS_STEP = "a controller reads and commands in its step"
GIVE_BACK = -1.0
"""The speed and the speed mode that give control back to SUMO's own driver."""
QUERIES = re.compile("(get|is|has|find|convert|couldChangeLane).*")
DISPLAYS = ("setColor", "highlight")
ADVANCES = ("simulationStep", "simulationStepLegacy", "executeMove", "step")
STARTS_AND_ENDS = ("start", "init", "connect", "load", "close", "switch", "switchConnection", "setOrder", "loadState", "saveState")
"""Functions that advance, begin or end simulations."""
VISIBLE = re.compile("get(Length|Width|Height|MinGap|VehicleClass|ShapeClass|TypeID|Color|(Emergency|Apparent)?Decel|Accel|MaxSpeed"
                   "|Tau|Mass)")
"""Functions about other actors whose values are visible at once or known from the type of actor."""
UNSENSED: Mapping[str, re.Pattern[str]] = {
    "vehicle": re.compile("getFollower|get(Left|Right)(Followers|Leaders)|getNeighbors|getJunctionFoes|.*LaneChange.*|couldChangeLane"
                          "|getLoadedIDList|getTeleportingIDList|getTaxiFleet|getSpeedWithoutTraCI"),
    "person": re.compile("getTaxiReservations"),
    "simulation": re.compile("get(Arrived|BusStop|Colli|Departed|Emergency|Ending|Loaded|Parking|Pending|Starting|Stop).*"),
    "trafficlight": re.compile("get(Blocking|Rival|Priority|Served).*"),
}
UNSENSED_ON_ROADS = re.compile("getLastStep.*|getWaitingTime|getTraveltime|getPendingVehicles|get.*(Emission|Consumption)")
"""Functions about other actors whose values no sensor of the vehicle measures."""
WHAT_SENSORS_MEASURE = "getLeader, getIDList, and positions, speeds, angles and lanes of vehicles and persons: these pass the sensors"
INVALID = -1073741824
"""SUMO's value for a property of an actor that is not on the road."""


class CommandedSpeed:
    """Commands of a controller, and the acceleration that they result in under SUMO's speed modes."""

    SAFE_SPEED, OWN_ACCELERATION, OWN_DECELERATION, USUAL_MODE, LARGEST_MODE = 1, 2, 4, 31, 127

    def __init__(self, nominal: Nominal, step: float) -> None:
        self._step = step
        self._accel, self._decel, self._fastest, self._mode = nominal.accel, nominal.decel, np.inf, self.USUAL_MODE
        self._speed: float | None = None
        self._until, self._change = -1.0, 0.0

    def command(self, name: str, time: float, speed: float, values: tuple[Any, ...]) -> None:
        """Process a command of the vehicle domain.

        Raises
        ------
        InputError
            Naming an illegal number.
        """
        numbers = [self._number(name, what, value) for what, value in zip(COMMANDS[name], values, strict=True)]
        if name == "setSpeed":
            self._speed, self._until = (None if numbers[0] == GIVE_BACK else numbers[0]), -1.0
        elif name == "slowDown":
            duration = max(numbers[1], self._step)
            self._speed, self._until, self._change = None, time + duration, (numbers[0] - speed) / duration
        elif name == "setAcceleration":
            self._speed, self._until, self._change = None, time + numbers[1], numbers[0]
        elif name == "setSpeedMode":
            self._mode = self.USUAL_MODE if numbers[0] == GIVE_BACK else int(numbers[0])
        else:
            setattr(self, {"setAccel": "_accel", "setDecel": "_decel", "setMaxSpeed": "_fastest"}[name], numbers[0])

    def _number(self, name: str, what: str, value: Any) -> float:
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        gives_back = number == GIVE_BACK and name in ("setSpeed", "setSpeedMode")
        good = math.isfinite(number) and (number >= 0 or what == "acceleration" or gives_back)
        legal = "a finite number" if what == "acceleration" else "a finite number from 0 on"
        if name == "setSpeedMode":
            good, legal = good and number == int(number) <= self.LARGEST_MODE, f"a whole number from 0 to {self.LARGEST_MODE}"
        if not good:
            back = ", or -1, which gives control back to SUMO's own driver" if name in ("setSpeed", "setSpeedMode") else ""
            raise InputError(f"traci.vehicle.{name}", f"{what} = {value!r}", legal + back)
        return number

    def acceleration(self, speed: float, time: float, sumo_speed: float) -> float:
        """Acceleration to command [m/s^2]; `sumo_speed` is the next speed of SUMO's own driver [m/s]."""
        wanted = speed + self._change * self._step if time < self._until else sumo_speed if self._speed is None else self._speed
        if self._mode & self.SAFE_SPEED:
            wanted = min(wanted, max(sumo_speed, speed - self._decel * self._step) if wanted > sumo_speed else wanted)
        change = (min(wanted, self._fastest) - speed) / self._step
        change = min(change, self._accel) if self._mode & self.OWN_ACCELERATION else change
        return max(change, -self._decel) if self._mode & self.OWN_DECELERATION else change


class TraciView:
    """TraCI's functions for one vehicle; ids are those of the traffic file."""

    def __init__(self, world: SumoWorld, copy: int, names: frozenset[str], sensing: Sensing, nominal: Nominal, step: float) -> None:
        self._world, self._copy, self._names, self._sensing, self._decel = world, copy, names, sensing, nominal.decel
        self._vut = copied_id(copy, VUT)
        self.commanded, self.time = CommandedSpeed(nominal, step), 0.0
        self.refused: InputError | None = None
        """The last error that was raised to the controller, even if the controller caught it."""

    @property
    def on_the_road(self) -> bool:
        """Whether the vehicle is still on the road."""
        return not self._world.has_left(self._vut)

    def speed_of_sumo(self, speed: float) -> float:
        """Speed that SUMO's own driver, with the original vehicle's type, would choose next for road and leader [m/s]."""
        vehicle, vut, seen = self._world.api.vehicle, self._vut, self._sensing.seen(self._copy)
        free = min(speed + vehicle.getAccel(vut) * self._world.step_length, vehicle.getAllowedSpeed(vut))
        if seen.leader is None:
            return float(free)
        name, gap = seen.leader
        leader = copied_id(self._copy, name)
        leader_speed = seen.vehicle[name]["getSpeed"]
        return float(min(free, vehicle.getFollowSpeed(vut, speed, gap, leader_speed, vehicle.getDecel(leader), leader)))

    def call(self, domain: str, name: str, arguments: tuple[Any, ...], named: Mapping[str, Any]) -> Any:
        """Call a TraCI function on this copy; `domain` is "" for functions of the module itself.

        Raises
        ------
        InputError
            If controllers must not call the function.
        TraCIException
            If SUMO refuses the call.
        """
        with self.translated_errors():
            return self._called(domain, name, positional(domain, name, arguments, named))

    @contextmanager
    def translated_errors(self) -> Iterator[None]:
        """Context that stores errors for the controller, and replaces ids of copies in SUMO's errors by those of the traffic file."""
        api = self._world.api
        try:
            yield
        except InputError as error:
            self.refused = error
            raise
        except (api.TraCIException, api.FatalTraCIError) as error:
            raise traci_exception()(str(error).replace(f"'{self._copy}.", "'")) from None

    def _called(self, domain: str, name: str, arguments: tuple[Any, ...]) -> Any:
        called = f"traci.{domain}.{name}" if domain else f"traci.{name}"
        if name in ADVANCES and domain in ("", "simulation"):
            raise InputError(called, "safevar advances the simulation; remove this call", IN_ITS_STEP)
        if name in STARTS_AND_ENDS and domain in ("", "simulation"):
            raise InputError(called, "safevar starts and ends the simulation; remove this call", IN_ITS_STEP)
        if not QUERIES.fullmatch(name):
            return self._command(domain, name, called, arguments)
        if not domain:
            return getattr(self._world.api, name)(*arguments)
        unsensed = UNSENSED_ON_ROADS if domain in ("edge", "lane") else UNSENSED.get(domain)
        if domain in SENSED:
            value = self._sensed(domain, name, arguments)
            if value is not NotImplemented:
                return value
        elif domain in ("edge", "lane") and name in ("getLastStepVehicleIDs", "getLastStepVehicleNumber", "getLastStepPersonIDs"):
            return self._on_road(domain, name, arguments[0])
        elif domain == "simulation" and name in ("getTime", "getCurrentTime"):
            return self.time if name == "getTime" else round(self.time * 1000)
        elif domain == "simulation" and name == "getMinExpectedNumber":
            return sum(len(self._ids(kind)) for kind in SENSED)
        if unsensed is not None and unsensed.fullmatch(name):
            raise InputError(called, "returns values of other actors that no sensor of the vehicle measures", WHAT_SENSORS_MEASURE)
        if name == "getIDCount":
            return len(self._with_original_ids(getattr(self._world.api, domain).getIDList()))
        return self._from_sumo(domain, name, arguments)

    def _command(self, domain: str, name: str, called: str, arguments: tuple[Any, ...]) -> Any:
        if domain != "vehicle" or name not in (*COMMANDS, *DISPLAYS):
            raise InputError(called, f"is not for a controller of {VUT!r}", f"of traci.vehicle {', '.join(COMMANDS)}")
        if not arguments or arguments[0] != VUT:
            vehicle_id = repr(arguments[0]) if arguments else "nothing"
            raise InputError(called, f"vehID = {vehicle_id} is not the vehicle under test",
                             f"{VUT!r}: a controller commands no other vehicle")
        if name in DISPLAYS:
            return self._from_sumo(domain, name, arguments)
        speed = float(self._world.api.vehicle.getSpeed(self._vut))
        return self.commanded.command(name, self.time, speed, arguments[1:])

    def _sensed(self, domain: str, name: str, arguments: tuple[Any, ...]) -> Any:
        """The value of an actor as sensed; NotImplemented if the function does not depend on sensors."""
        if name in ("getIDList", "getIDCount"):
            ids = self._ids(domain)
            return ids if name == "getIDList" else len(ids)
        if domain == "vehicle" and arguments[:1] == (VUT,):
            return self._leader(*arguments[1:]) if name == "getLeader" else NotImplemented
        called, others = f"traci.{domain}.{name}", self._sensing.seen(self._copy).others(domain)
        if not arguments or VISIBLE.fullmatch(name):
            return NotImplemented
        if name not in SENSED[domain]:
            raise InputError(called, f"returns a value of {arguments[0]!r} that no sensor of the vehicle measures", WHAT_SENSORS_MEASURE)
        if arguments[0] in others:
            return self._with_original_ids(others[arguments[0]][name])
        return _invalid(self._from_sumo(domain, name, arguments))

    def _ids(self, domain: str) -> tuple[str, ...]:
        return (*((VUT,) if domain == "vehicle" else ()), *self._sensing.seen(self._copy).others(domain))

    def _leader(self, dist: float = 100.0) -> tuple[str, float] | None:
        """The leader and the gap to it beyond the own minGap, up to `dist` [m] or, if `dist` is 0, up to the stopping distance."""
        speed = float(self._world.api.vehicle.getSpeed(self._vut))
        leader = self._sensing.seen(self._copy).leader
        return leader if leader and leader[1] <= (dist or speed**2 / (2 * self._decel)) else None

    def _on_road(self, domain: str, name: str, road: str) -> Any:
        """Actors on a lane or edge, as sensed."""
        seen, function = self._sensing.seen(self._copy), "getLaneID" if domain == "lane" else "getRoadID"
        actors = seen.person if name == "getLastStepPersonIDs" else {VUT: seen.own, **seen.vehicle}
        names = tuple(actor for actor, values in actors.items() if values.get(function) == copied_id(self._copy, road))
        return len(names) if name == "getLastStepVehicleNumber" else names

    def _from_sumo(self, domain: str, name: str, arguments: tuple[Any, ...]) -> Any:
        """The value from SUMO itself."""
        function = getattr(getattr(self._world.api, domain), name)
        return self._with_original_ids(function(*(self._with_copied_ids(argument) for argument in arguments)))

    def _with_copied_ids(self, value: Any) -> Any:
        seen = self._sensing.seen(self._copy)
        if isinstance(value, str) and (value in self._names or value in seen.vehicle or value in seen.person):
            return copied_id(self._copy, value)
        return type(value)(map(self._with_copied_ids, value)) if type(value) in (list, tuple) else value

    def _with_original_ids(self, value: Any) -> Any:
        """A result with the traffic file's ids, without elements of other copies."""
        if isinstance(value, str):
            for mark in ("", ":", "!"):
                if value.startswith(f"{mark}{self._copy}."):
                    rest = value.removeprefix(f"{mark}{self._copy}.")
                    return value if rest.isdecimal() and rest not in self._names else mark + rest
            return value
        if value is None or isinstance(value, bool | int | float | bytes):
            return value
        if isinstance(value, tuple | list):
            elements = [self._with_original_ids(element) for element in value if not self._is_of_other_copy(element)]
            return type(value)(*elements) if hasattr(value, "_fields") else type(value)(elements)
        if isinstance(value, Mapping):
            return {self._with_original_ids(key): self._with_original_ids(element)
                    for key, element in value.items() if not self._is_of_other_copy(key)}
        fields = {name: getattr(value, name) for name in dir(value) if not name.startswith("_") and name not in ("this", "thisown")}
        return SimpleNamespace(**{name: self._with_original_ids(field) for name, field in fields.items() if not callable(field)})

    def _is_of_other_copy(self, value: Any) -> bool:
        if not isinstance(value, str):
            return False
        copy, dot, name = value.removeprefix(":").removeprefix("!").partition(".")
        return bool(dot and copy.isdecimal() and name in self._names and int(copy) != self._copy)


def _invalid(value: Any) -> Any:
    """SUMO's invalid value of the same type."""
    if isinstance(value, tuple):
        return tuple(map(_invalid, value))
    return "" if isinstance(value, str) else type(value)(INVALID)


def traci_exception() -> type[Exception]:
    """The exception that controllers catch, with every engine."""
    return real_traci().exceptions.TraCIException  # type: ignore[no-any-return]


@cache
def real_traci() -> Any:
    """The original module, not its substitute for controllers; first called before controllers run."""
    return engine_api(Engine.TRACI)


def positional(domain: str, name: str, arguments: tuple[Any, ...], named: Mapping[str, Any]) -> tuple[Any, ...]:
    """Positional arguments in the order of TraCI's function."""
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
