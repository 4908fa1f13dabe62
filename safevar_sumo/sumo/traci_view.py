"""TraCI as one controller has it: one copy of the network, the traffic file's ids, others as the vehicle's sensors tell of them."""

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

WISHES: Mapping[str, tuple[str, ...]] = {
    "setSpeed": ("speed",), "slowDown": ("speed", "duration"), "setAcceleration": ("acceleration", "duration"), "setAccel": ("accel",),
    "setDecel": ("decel",), "setMaxSpeed": ("speed",), "setSpeedMode": ("mode",)}
"""What a controller may command, and the numbers that go with it."""
ELSE = "a controller reads and commands in its step"
BACK = -1.0
"""The speed and the speed mode that give control back to SUMO's own driver."""
READS = re.compile("(get|is|has|find|convert|couldChangeLane).*")
SHOWN = ("setColor", "highlight")
STEPS = ("simulationStep", "simulationStepLegacy", "executeMove", "step")
STARTS = ("start", "init", "connect", "load", "close", "switch", "switchConnection", "setOrder", "loadState", "saveState")
"""Functions that advance, begin or end simulations."""
KNOWN = re.compile("get(Length|Width|Height|MinGap|VehicleClass|ShapeClass|TypeID|Color|(Emergency|Apparent)?Decel|Accel|MaxSpeed"
                   "|Tau|Mass)")
"""Functions that tell of others what one sees at once, or knows of their kind."""
BLIND: Mapping[str, re.Pattern[str]] = {
    "vehicle": re.compile("getFollower|get(Left|Right)(Followers|Leaders)|getNeighbors|getJunctionFoes|.*LaneChange.*|couldChangeLane"
                          "|getLoadedIDList|getTeleportingIDList|getTaxiFleet|getSpeedWithoutTraCI"),
    "person": re.compile("getTaxiReservations"),
    "simulation": re.compile("get(Arrived|BusStop|Colli|Departed|Emergency|Ending|Loaded|Parking|Pending|Starting|Stop).*"),
    "trafficlight": re.compile("get(Blocking|Rival|Priority|Served).*"),
}
BLIND_ROADS = re.compile("getLastStep.*|getWaitingTime|getTraveltime|getPendingVehicles|get.*(Emission|Consumption)")
"""Functions that tell of others what no sensor of the vehicle does."""
SENSIBLE = "getLeader, getIDList, and positions, speeds, angles and lanes of vehicles and persons: these pass the sensors"
INVALID = -1073741824
"""SUMO's value of what somebody who is not on the road does not have."""


class Wish:
    """What a controller has commanded, and what acceleration comes of it, as SUMO's speed modes have it."""

    SAFE_SPEED, OWN_ACCELERATION, OWN_DECELERATION, USUAL_MODE, LARGEST_MODE = 1, 2, 4, 31, 127

    def __init__(self, nominal: Nominal, step: float) -> None:
        self._step = step
        self._accel, self._decel, self._fastest, self._mode = nominal.accel, nominal.decel, np.inf, self.USUAL_MODE
        self._speed: float | None = None
        self._until, self._change = -1.0, 0.0

    def command(self, name: str, time: float, speed: float, values: tuple[Any, ...]) -> None:
        """Take in a command of the vehicle domain.

        Raises
        ------
        InputError
            Naming a number that means nothing.
        """
        numbers = [self._number(name, what, value) for what, value in zip(WISHES[name], values, strict=True)]
        if name == "setSpeed":
            self._speed, self._until = (None if numbers[0] == BACK else numbers[0]), -1.0
        elif name == "slowDown":
            duration = max(numbers[1], self._step)
            self._speed, self._until, self._change = None, time + duration, (numbers[0] - speed) / duration
        elif name == "setAcceleration":
            self._speed, self._until, self._change = None, time + numbers[1], numbers[0]
        elif name == "setSpeedMode":
            self._mode = self.USUAL_MODE if numbers[0] == BACK else int(numbers[0])
        else:
            setattr(self, {"setAccel": "_accel", "setDecel": "_decel", "setMaxSpeed": "_fastest"}[name], numbers[0])

    def _number(self, name: str, what: str, value: Any) -> float:
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        gives_back = number == BACK and name in ("setSpeed", "setSpeedMode")
        good = math.isfinite(number) and (number >= 0 or what == "acceleration" or gives_back)
        legal = "a finite number" if what == "acceleration" else "a finite number from 0 on"
        if name == "setSpeedMode":
            good, legal = good and number == int(number) <= self.LARGEST_MODE, f"a whole number from 0 to {self.LARGEST_MODE}"
        if not good:
            back = ", or -1, which gives control back to SUMO's own driver" if name in ("setSpeed", "setSpeedMode") else ""
            raise InputError(f"traci.vehicle.{name}", f"{what} = {value!r}", legal + back)
        return number

    def acceleration(self, speed: float, time: float, sumos: float) -> float:
        """Acceleration to ask the plant for [m/s^2], with the speed that SUMO's own driver would have next."""
        wished = speed + self._change * self._step if time < self._until else sumos if self._speed is None else self._speed
        if self._mode & self.SAFE_SPEED:
            wished = min(wished, max(sumos, speed - self._decel * self._step) if wished > sumos else wished)
        change = (min(wished, self._fastest) - speed) / self._step
        change = min(change, self._accel) if self._mode & self.OWN_ACCELERATION else change
        return max(change, -self._decel) if self._mode & self.OWN_DECELERATION else change


class TraciView:
    """TraCI's functions for one vehicle; ids are those of the traffic file."""

    def __init__(self, world: SumoWorld, copy: int, names: frozenset[str], sensing: Sensing, nominal: Nominal, step: float) -> None:
        self._world, self._copy, self._names, self._sensing, self._decel = world, copy, names, sensing, nominal.decel
        self._vut = copied_id(copy, VUT)
        self.wish, self.time = Wish(nominal, step), 0.0
        self.refused: InputError | None = None
        """What the controller was refused last, even if it went on."""

    @property
    def on_the_road(self) -> bool:
        """Whether the vehicle is still there."""
        return not self._world.has_left(self._vut)

    def speed_of_sumo(self, speed: float) -> float:
        """Speed that SUMO's own driver, with the original's type, would have in the next step [m/s]: for the road and the leader."""
        vehicle, vut, seen = self._world.api.vehicle, self._vut, self._sensing.seen(self._copy)
        free = min(speed + vehicle.getAccel(vut) * self._world.step_length, vehicle.getAllowedSpeed(vut))
        if seen.leader is None:
            return float(free)
        name, gap = seen.leader
        inner = copied_id(self._copy, name)
        leaders = seen.vehicle[name]["getSpeed"]
        return float(min(free, vehicle.getFollowSpeed(vut, speed, gap, leaders, vehicle.getDecel(inner), inner)))

    def call(self, domain: str, name: str, arguments: tuple[Any, ...], named: Mapping[str, Any]) -> Any:
        """One of TraCI's functions on this copy; `domain` is "" for one of the module itself.

        Raises
        ------
        InputError
            If it is not for a controller.
        TraCIException
            If SUMO refuses it.
        """
        with self.noting():
            return self._called(domain, name, positional(domain, name, arguments, named))

    @contextmanager
    def noting(self) -> Iterator[None]:
        """Within, refusals are kept, and SUMO's errors name nobody's inner id."""
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
        if name in STEPS and domain in ("", "simulation"):
            raise InputError(called, "safevar advances the simulation; remove this call", ELSE)
        if name in STARTS and domain in ("", "simulation"):
            raise InputError(called, "safevar starts and ends the simulation; remove this call", ELSE)
        if not READS.fullmatch(name):
            return self._command(domain, name, called, arguments)
        if not domain:
            return getattr(self._world.api, name)(*arguments)
        blind = BLIND_ROADS if domain in ("edge", "lane") else BLIND.get(domain)
        if domain in SENSED:
            found = self._of_somebody(domain, name, arguments)
            if found is not NotImplemented:
                return found
        elif domain in ("edge", "lane") and name in ("getLastStepVehicleIDs", "getLastStepVehicleNumber", "getLastStepPersonIDs"):
            return self._on_road(domain, name, arguments[0])
        elif domain == "simulation" and name in ("getTime", "getCurrentTime"):
            return self.time if name == "getTime" else round(self.time * 1000)
        elif domain == "simulation" and name == "getMinExpectedNumber":
            return sum(len(self._ids(kind)) for kind in SENSED)
        if blind is not None and blind.fullmatch(name):
            raise InputError(called, "tells of others what no sensor of the vehicle does", SENSIBLE)
        if name == "getIDCount":
            return len(self._ours(getattr(self._world.api, domain).getIDList()))
        return self._passed_on(domain, name, arguments)

    def _command(self, domain: str, name: str, called: str, arguments: tuple[Any, ...]) -> Any:
        if domain != "vehicle" or name not in (*WISHES, *SHOWN):
            raise InputError(called, f"is not for a controller of {VUT!r}", f"of traci.vehicle {', '.join(WISHES)}")
        if not arguments or arguments[0] != VUT:
            given = repr(arguments[0]) if arguments else "nothing"
            raise InputError(called, f"vehID = {given} is not the vehicle under test", f"{VUT!r}: a controller commands no other vehicle")
        if name in SHOWN:
            return self._passed_on(domain, name, arguments)
        speed = float(self._world.api.vehicle.getSpeed(self._vut))
        return self.wish.command(name, self.time, speed, arguments[1:])

    def _of_somebody(self, domain: str, name: str, arguments: tuple[Any, ...]) -> Any:
        """What the sensors tell; NotImplemented where they have nothing to do with it."""
        if name in ("getIDList", "getIDCount"):
            ids = self._ids(domain)
            return ids if name == "getIDList" else len(ids)
        if domain == "vehicle" and arguments[:1] == (VUT,):
            return self._leader(*arguments[1:]) if name == "getLeader" else NotImplemented
        called, others = f"traci.{domain}.{name}", self._sensing.seen(self._copy).others(domain)
        if not arguments or KNOWN.fullmatch(name):
            return NotImplemented
        if name not in SENSED[domain]:
            raise InputError(called, f"of {arguments[0]!r} tells what no sensor of the vehicle does", SENSIBLE)
        if arguments[0] in others:
            return self._ours(others[arguments[0]][name])
        return _invalid(self._passed_on(domain, name, arguments))

    def _ids(self, domain: str) -> tuple[str, ...]:
        return (*((VUT,) if domain == "vehicle" else ()), *self._sensing.seen(self._copy).others(domain))

    def _leader(self, dist: float = 100.0) -> tuple[str, float] | None:
        """Who is ahead and how far beyond the own minGap; no farther than `dist` [m], or, if that is 0, than the vehicle needs to stop."""
        speed = float(self._world.api.vehicle.getSpeed(self._vut))
        leader = self._sensing.seen(self._copy).leader
        return leader if leader and leader[1] <= (dist or speed**2 / (2 * self._decel)) else None

    def _on_road(self, domain: str, name: str, road: str) -> Any:
        """Who is on a lane or edge, as far as the sensors tell."""
        seen, function = self._sensing.seen(self._copy), "getLaneID" if domain == "lane" else "getRoadID"
        people = seen.person if name == "getLastStepPersonIDs" else {VUT: seen.own, **seen.vehicle}
        found = tuple(one for one, values in people.items() if values.get(function) == copied_id(self._copy, road))
        return len(found) if name == "getLastStepVehicleNumber" else found

    def _passed_on(self, domain: str, name: str, arguments: tuple[Any, ...]) -> Any:
        """What SUMO itself answers."""
        function = getattr(getattr(self._world.api, domain), name)
        return self._ours(function(*(self._inner(one) for one in arguments)))

    def _inner(self, value: Any) -> Any:
        seen = self._sensing.seen(self._copy)
        if isinstance(value, str) and (value in self._names or value in seen.vehicle or value in seen.person):
            return copied_id(self._copy, value)
        return type(value)(map(self._inner, value)) if type(value) in (list, tuple) else value

    def _ours(self, value: Any) -> Any:
        """A result under the traffic file's ids, without what belongs to other copies."""
        if isinstance(value, str):
            for mark in ("", ":", "!"):
                if value.startswith(f"{mark}{self._copy}."):
                    rest = value.removeprefix(f"{mark}{self._copy}.")
                    return value if rest.isdecimal() and rest not in self._names else mark + rest
            return value
        if value is None or isinstance(value, bool | int | float | bytes):
            return value
        if isinstance(value, tuple | list):
            ours = [self._ours(one) for one in value if not self._foreign(one)]
            return type(value)(*ours) if hasattr(value, "_fields") else type(value)(ours)
        if isinstance(value, Mapping):
            return {self._ours(key): self._ours(one) for key, one in value.items() if not self._foreign(key)}
        names = [name for name in dir(value) if not name.startswith("_") and name not in ("this", "thisown")]
        return SimpleNamespace(**{name: self._ours(getattr(value, name)) for name in names if not callable(getattr(value, name))})

    def _foreign(self, value: Any) -> bool:
        if not isinstance(value, str):
            return False
        copy, dot, name = value.removeprefix(":").removeprefix("!").partition(".")
        return bool(dot and copy.isdecimal() and name in self._names and int(copy) != self._copy)


def _invalid(value: Any) -> Any:
    """What SUMO says of the same kind of value where there is none."""
    if isinstance(value, tuple):
        return tuple(map(_invalid, value))
    return "" if isinstance(value, str) else type(value)(INVALID)


def traci_exception() -> type[Exception]:
    """The exception that controllers are to catch, whichever SUMO simulates."""
    return real_traci().exceptions.TraCIException  # type: ignore[no-any-return]


@cache
def real_traci() -> Any:
    """The module itself, not what stands for it while controllers run; to be called before they do."""
    return engine_api(Engine.TRACI)


def positional(domain: str, name: str, arguments: tuple[Any, ...], named: Mapping[str, Any]) -> tuple[Any, ...]:
    """Arguments in the order in which TraCI has them."""
    signature = _signature(domain, name)
    if signature is None or not (named or name in WISHES):
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
