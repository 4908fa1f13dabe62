"""A controller that was written for SUMO: it reads the running simulation through TraCI's functions, and what it commands is a wish.

Its `step(traci, vehicle_id)` sees its own copy of the network under the traffic file's ids. What it asks of the vehicle's
type is answered with the original's. A speed or an acceleration that it commands goes through pedals to the plant.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.ads.pedals import Trim, pedals, trim
from safevar_sumo.errors import InputError
from safevar_sumo.plugins import Guard
from safevar_sumo.records import Command, Nominal, Observation
from safevar_sumo.scenarios import VUT
from safevar_sumo.simulation.copies import copied_id
from safevar_sumo.simulation.world import SumoWorld, present_world
from safevar_sumo.vehicles import SumoType

WISHES = "setSpeed, slowDown, setAcceleration, setAccel, setDecel, setMaxSpeed, setSpeedMode"
HARMLESS = {"setColor", "highlight", "subscribe", "subscribeContext", "unsubscribe"}
CHANGES = ("set", "add", "remove", "change", "move", "slowDown", "reroute", "resume", "replace", "append", "insert", "dispatch", "load",
           "save", "start", "close", "simulationStep", "updateBestLanes", "clear", "deactivate", "rename")
SAFE_SPEED, OWN_ACCELERATION, OWN_DECELERATION = 1, 2, 4
"""Bits of SUMO's speed mode."""
USUAL_MODE = 31
LOOKS_AHEAD = 200.0  # m, for a leader


class TraciController:
    """Drives every vehicle with a controller of its own, a function `step(traci, vehicle_id)` or a class with `start` and `step`."""

    def __init__(self, make: Callable[[], Any], guard: Guard) -> None:
        self._make, self._guard = make, guard

    def start(self, n: int, nominal: Nominal, step: float) -> _Memory:
        world = present_world()
        world.set_types(SumoType(*(np.full(n, getattr(nominal, name)) for name in SumoType._fields)))
        names = world.names()
        views = [_Traci(world, copy, names, nominal, step) for copy in range(n)]
        controllers = [self._make() for _ in range(n)]
        for controller, view in zip(controllers, views, strict=True):
            if hasattr(controller, "start"):
                self._guard.call("start", controller.start, view, VUT)
        return _Memory(nominal, views, controllers, None)

    def drive(self, seen: Observation, memory: _Memory) -> tuple[Command, _Memory]:
        trimmed = trim(memory.nominal, seen) if memory.trimmed is None else memory.trimmed
        wanted = np.zeros(len(memory.views))
        for i, (view, controller) in enumerate(zip(memory.views, memory.controllers, strict=True)):
            if not view.on_the_road:
                continue
            view.time, speed = seen.time, float(seen.speed[i])
            self._guard.call("step", controller.step if hasattr(controller, "step") else controller, view, VUT)
            wanted[i] = view.wish.acceleration(speed, seen.time, view.speed_of_sumo(speed))
        return pedals(memory.nominal, seen.speed, wanted, trimmed), memory._replace(trimmed=trimmed)


class _Memory(NamedTuple):
    """The original vehicle, a view and a controller for each vehicle, and the pedals' trim of the first look."""

    nominal: Nominal
    views: list[_Traci]
    controllers: list[Any]
    trimmed: Trim | None


class _Wish:
    """What a controller has commanded, and what acceleration comes of it, as SUMO's speed modes have it."""

    def __init__(self, nominal: Nominal, step: float) -> None:
        self._step = step
        self._accel, self._decel, self._fastest, self._mode = nominal.accel, nominal.decel, np.inf, USUAL_MODE
        self._speed: float | None = None
        self._until, self._change = -1.0, 0.0

    def command(self, name: str, time: float, speed: float, values: tuple[float, ...]) -> None:
        """Take in a command of the vehicle domain."""
        if name == "setSpeed":
            self._speed, self._until = (values[0] if values[0] >= 0 else None), -1.0
        elif name == "slowDown":
            duration = max(values[1], self._step)
            self._speed, self._until, self._change = None, time + duration, (values[0] - speed) / duration
        elif name == "setAcceleration":
            self._speed, self._until, self._change = None, time + values[1], values[0]
        elif name == "setSpeedMode":
            self._mode = int(values[0])
        else:
            setattr(self, {"setAccel": "_accel", "setDecel": "_decel", "setMaxSpeed": "_fastest"}[name], values[0])

    def acceleration(self, speed: float, time: float, sumos: float) -> float:
        """Acceleration to ask the plant for [m/s^2], with the speed that SUMO's own driver would have next."""
        wished = speed + self._change * self._step if time < self._until else sumos if self._speed is None else self._speed
        if self._mode & SAFE_SPEED:
            wished = min(wished, max(sumos, speed - self._decel * self._step) if wished > sumos else wished)
        change = (min(wished, self._fastest) - speed) / self._step
        change = min(change, self._accel) if self._mode & OWN_ACCELERATION else change
        return max(change, -self._decel) if self._mode & OWN_DECELERATION else change


class _Traci:
    """TraCI for one copy: domains as attributes, ids as in the traffic file."""

    def __init__(self, world: SumoWorld, copy: int, names: frozenset[str], nominal: Nominal, step: float) -> None:
        self._world, self._copy, self._names = world, copy, names
        self._vut = copied_id(copy, VUT)
        self.wish, self.time = _Wish(nominal, step), 0.0

    def __getattr__(self, domain: str) -> Any:
        if domain.startswith("_"):
            raise AttributeError(domain)
        if domain.startswith(CHANGES):
            raise InputError(f"traci.{domain}", "is not the controller's", "simulations are stepped and loaded for it")
        found = getattr(self._world.api, domain)
        return _Domain(self, domain, found) if hasattr(found, "getIDList") or domain == "simulation" else found

    @property
    def on_the_road(self) -> bool:
        """Whether the vehicle is still there."""
        return not self._world.has_left(self._vut)

    def speed_of_sumo(self, speed: float) -> float:
        """Speed that SUMO's own driver, with the original's type, would have in the next step [m/s]: for the road and the leader."""
        vehicle, vut = self._world.api.vehicle, self._vut
        free = min(speed + vehicle.getAccel(vut) * self._world.step_length, vehicle.getAllowedSpeed(vut))
        leader = vehicle.getLeader(vut, LOOKS_AHEAD)
        if not leader or not leader[0]:
            return float(free)
        name, gap = leader[0], leader[1]
        return float(min(free, vehicle.getFollowSpeed(vut, speed, gap, vehicle.getSpeed(name), vehicle.getDecel(name), name)))

    def call(self, domain: str, name: str, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        """One of TraCI's functions on this copy."""
        if domain == "simulation" and name in ("getTime", "getCurrentTime"):
            return self.time if name == "getTime" else round(self.time * 1000)
        if name.startswith(CHANGES) and name not in HARMLESS:
            if domain != "vehicle" or name not in WISHES.split(", ") or arguments[0] != VUT:
                raise InputError(f"traci.{domain}.{name}", f"is not for a controller of {VUT!r}", WISHES)
            speed = float(self._world.api.vehicle.getSpeed(self._vut))
            self.wish.command(name, self.time, speed, tuple(map(float, arguments[1:])))
            return None
        return self._ours(function(*(copied_id(self._copy, one) if isinstance(one, str) and one in self._names else one
                                     for one in arguments)))

    def _ours(self, value: Any) -> Any:
        """A result under the traffic file's ids, without what belongs to other copies."""
        if isinstance(value, str):
            colon = ":" if value.startswith(":") else ""
            return colon + value.removeprefix(f"{colon}{self._copy}.") if value.startswith(f"{colon}{self._copy}.") else value
        if isinstance(value, tuple | list) and not hasattr(value, "_fields"):
            return type(value)(self._ours(one) for one in value if not self._foreign(one))
        return value

    def _foreign(self, value: Any) -> bool:
        if not isinstance(value, str):
            return False
        copy, dot, name = value.removeprefix(":").partition(".")
        return bool(dot and copy.isdecimal() and name in self._names and int(copy) != self._copy)


class _Domain:
    """A domain of TraCI, such as `traci.vehicle`."""

    def __init__(self, traci: _Traci, name: str, domain: Any) -> None:
        self._traci, self._name, self._domain = traci, name, domain

    def __getattr__(self, name: str) -> Any:
        member = getattr(self._domain, name)
        if not callable(member):
            return member
        return lambda *arguments, **named: self._traci.call(self._name, name, lambda *given: member(*given, **named), arguments)
