"""A controller that was written for SUMO: it reads the running simulation and commands the vehicle through TraCI.

The controller's `step(traci, vehicle_id)` sees one copy of the network, with the ids of the traffic file, and other
actors through the vehicle's sensors. Queries of the vehicle's type return the values of the original vehicle. Commanded
speeds and accelerations are converted to pedal positions of the vehicle model.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from types import ModuleType
from typing import NamedTuple

import numpy as np

from safevar_sumo.ads import Ads
from safevar_sumo.ads.base import Trim, pedals_for, trim_at
from safevar_sumo.errors import InputError
from safevar_sumo.plugins import Guard
from safevar_sumo.records import Command, Nominal, Observation
from safevar_sumo.scenarios import VUT
from safevar_sumo.sumo.traci_view import (
    COMMANDS,
    OWN_LOOP,
    Arguments,
    SensedTraffic,
    TraciView,
    Value,
    real_traci,
    refused,
)
from safevar_sumo.sumo.world import current_world
from safevar_sumo.vehicles import SumoType

Controller = Callable[..., None]
"""A user's function `step(traci, vehicle_id)`, or an object with such a method and, perhaps, `start`."""


class TraciController(Ads):
    """Drives each vehicle with a controller of its own: a function `step(traci, vehicle_id)`, or a class with `step`.

    Parameters
    ----------
    create
        Creates a vehicle's controller.
    """

    def __init__(self, create: Callable[[], Controller], guard: Guard) -> None:
        self._create, self._guard = create, guard

    def start(self, n: int, nominal: Nominal, step: float) -> _Memory:
        world, drivers = current_world(), []
        values = nominal.mass, nominal.accel, nominal.decel, nominal.max_speed, nominal.actuator_lag
        world.set_types(SumoType(*(np.full(n, value) for value in values)))
        traffic = SensedTraffic(world, step)
        with substitute_traci():
            for copy in range(n):
                commands, controller = CommandedSpeed(nominal, step), self._create()
                view = TraciView(world, copy, traffic, commands.command)
                if hasattr(controller, "start"):
                    self._call(view, "start", controller.start)
                drivers.append((view, commands, getattr(controller, "step", controller)))
        return _Memory(nominal, traffic, drivers, initial_trim=None)

    def drive(self, seen: Observation, memory: _Memory) -> tuple[Command, _Memory]:
        initial_trim, accelerations = memory.initial_trim, np.zeros(len(memory.drivers))
        if initial_trim is None:  # `start` recorded the first step
            initial_trim = trim_at(memory.nominal, seen)
        else:
            memory.traffic.record_step()
        with substitute_traci():
            for i, (view, commands, step) in enumerate(memory.drivers):
                if memory.traffic.is_on_road(i):
                    view.time, speed = seen.time, float(seen.speed[i])
                    self._call(view, "step", step)
                    accelerations[i] = commands.acceleration(speed, seen.time, view.speed_of_sumo(speed))
        command = pedals_for(memory.nominal, seen.speed, accelerations, initial_trim)
        return command, memory._replace(initial_trim=initial_trim)

    def _call(self, view: TraciView, method: str, function: Callable[..., None]) -> None:
        global _active_view
        _active_view = view
        try:
            self._guard.call(method, function, traci_module(), VUT)
        finally:
            _active_view = None
        if view.last_error is not None:  # the controller caught the error and continued
            raise self._guard.failure(method, view.last_error)


class _Memory(NamedTuple):
    """The original vehicle, the sensed traffic, each vehicle's view, commands and step function, and the initial trim;
    the trim is None before the first step.
    """

    nominal: Nominal
    traffic: SensedTraffic
    drivers: list[tuple[TraciView, CommandedSpeed, Controller]]
    initial_trim: Trim | None


_active_view: TraciView | None = None
"""The view of the vehicle whose controller runs at the moment."""

SUMO_CONTROL = -1.0
"""Value of a speed or speed mode with which a command returns control to SUMO's own driver."""
LEGAL_NUMBERS = (
    "a finite number from 0 on; any acceleration; a whole mode up to 127; speed or mode -1 for SUMO's driver"
)


class CommandedSpeed:
    """A controller's commands, and the acceleration that results from them under SUMO's speed modes.

    A command holds until the next one. `setAcceleration` and `slowDown` change the speed evenly until `_end_time`;
    then SUMO's own driver takes over.
    """

    LIMIT_TO_SAFE_SPEED, LIMIT_ACCELERATION, LIMIT_DECELERATION, DEFAULT_MODE = 1, 2, 4, 31

    def __init__(self, nominal: Nominal, step: float) -> None:
        self._step = step
        self._limits = {"setAccel": nominal.accel, "setDecel": nominal.decel, "setMaxSpeed": math.inf}
        self._mode, self._speed = self.DEFAULT_MODE, SUMO_CONTROL
        self._end_time, self._speed_rate = -1.0, 0.0

    def command(self, name: str, time: float, speed: float, values: Arguments) -> None:
        """Process a command of the vehicle domain; raises `InputError` if an argument is no legal number."""
        for argument, number in zip(COMMANDS[name], values, strict=True):
            returns_control = number == SUMO_CONTROL and name in ("setSpeed", "setSpeedMode")
            is_legal = math.isfinite(number) and (number >= 0 or argument == "acceleration" or returns_control)
            if not is_legal or (argument == "mode" and number not in range(-1, 128)):
                raise InputError(f"traci.vehicle.{name}", f"{argument} = {number!r}", LEGAL_NUMBERS)
        value, *durations = map(float, values)
        if name == "setSpeedMode":
            self._mode = self.DEFAULT_MODE if value == SUMO_CONTROL else int(value)
        elif name in self._limits:
            self._limits[name] = value
        elif name == "setSpeed":
            self._speed, self._end_time = value, time
        else:
            is_slowing = name == "slowDown"
            duration = max(durations[0], self._step) if is_slowing else durations[0]
            self._speed, self._end_time = SUMO_CONTROL, time + duration
            self._speed_rate = (value - speed) / duration if is_slowing else value

    def acceleration(self, speed: float, time: float, sumo_speed: float) -> float:
        """The acceleration by the commands [m/s^2]; SUMO's own driver would choose `sumo_speed` next [m/s]."""
        decel = self._limits["setDecel"]
        next_speed = sumo_speed if self._speed == SUMO_CONTROL else self._speed
        if time < self._end_time:
            next_speed = speed + self._speed_rate * self._step
        if self._mode & self.LIMIT_TO_SAFE_SPEED and next_speed > sumo_speed:
            next_speed = min(next_speed, max(sumo_speed, speed - decel * self._step))
        acceleration = (min(next_speed, self._limits["setMaxSpeed"]) - speed) / self._step
        if self._mode & self.LIMIT_ACCELERATION:
            acceleration = min(acceleration, self._limits["setAccel"])
        return max(acceleration, -decel) if self._mode & self.LIMIT_DECELERATION else acceleration


@contextmanager
def substitute_traci() -> Iterator[None]:
    """Context in which `import traci` and `import libsumo` import the substitute for controllers."""
    real_traci()
    modules = {name: sys.modules.get(name) for name in ("traci", "libsumo")}
    sys.modules.update(dict.fromkeys(modules, traci_module()))
    try:
        yield
    finally:
        for name, module in modules.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


@cache
def traci_module() -> ModuleType:
    """The substitute for traci and libsumo."""
    return _Substitute(real_traci())


class _Substitute(ModuleType):
    """A substitute for traci, or for a domain of it: traci's constants and classes, and functions that answer for the
    driven vehicle.
    """

    def __init__(self, real: Value, domain: str = "") -> None:
        super().__init__("traci", real.__doc__)
        self._real, self._domain = real, domain
        if not domain:
            self.__path__, self.__file__, self.__spec__ = real.__path__, real.__file__, real.__spec__

    def __getattr__(self, name: str) -> Value:
        if name == "TraCIException":
            return real_traci().exceptions.TraCIException
        real = getattr(self._real, name)
        if hasattr(real, "getIDList") or name in ("simulation", "gui"):
            return _Substitute(real, name)
        return partial(_call, self._domain, name) if callable(real) and not isinstance(real, type) else real


def _call(domain: str, name: str, /, *arguments: Value, **named: Value) -> Value:
    if _active_view is None:
        raise refused(domain, name, f"is called while no vehicle is driven: {OWN_LOOP}")
    return _active_view.call(domain, name, arguments, named)
