"""What a controller calls: substitutes for the modules traci and libsumo, and the commands to the vehicle that it
drives.
"""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, partial
from types import ModuleType
from typing import Any

from safevar_sumo.errors import InputError
from safevar_sumo.records import Nominal
from safevar_sumo.sumo.engine import Engine, engine_api
from safevar_sumo.sumo.world import Api

LOOP_FUNCTIONS = (
    "start",
    "init",
    "connect",
    "load",
    "close",
    "switch",
    "setOrder",
    "loadState",
    "saveState",
    "simulationStep",
    "executeMove",
    "step",
)
"""Functions that begin, advance or end simulations."""
Value = Any
"""An argument or a result of a function of TraCI."""
Arguments = tuple[Value, ...]
Named = Mapping[str, Value]
"""Named arguments of a call."""
Call = Callable[[str, str, Arguments, Named], Value]
"""Calls a function of a domain, "" for the module itself, with positional and named arguments."""

_active_calls: list[Call] = []
"""The calls of the vehicle whose controller runs at the moment."""


@contextmanager
def bind_traci(call: Call) -> Iterator[None]:
    """Context in which TraCI's functions refer to one vehicle."""
    _active_calls.append(call)
    try:
        yield
    finally:
        _active_calls.pop()


@contextmanager
def substitute_traci() -> Iterator[None]:
    """Context in which `import traci` and `import libsumo` import the substitutes for controllers."""
    real_traci()
    modules = {name: sys.modules.get(name) for name in ("traci", "libsumo")}
    sys.modules.update({name: traci_module(name) for name in modules})
    try:
        yield
    finally:
        for name, module in modules.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


@cache
def real_traci() -> Api:
    """The original module traci, not its substitute for controllers; must be called before controllers run."""
    return engine_api(Engine.TRACI)


@cache
def traci_module(name: str = "traci") -> ModuleType:
    """The substitute for the module traci or libsumo."""
    return _Module(engine_api(Engine.LIBSUMO if name == "libsumo" else Engine.TRACI))


class _Module(ModuleType):
    """A substitute for traci or libsumo: original constants and classes, functions of the driven vehicle."""

    def __init__(self, real: ModuleType) -> None:
        super().__init__(real.__name__, real.__doc__)
        self.__path__, self.__file__, self.__spec__, self._real = real.__path__, real.__file__, real.__spec__, real

    def __getattr__(self, name: str) -> Value:
        if name == "TraCIException":
            return real_traci().exceptions.TraCIException
        real = getattr(self._real, name)
        if hasattr(real, "subscribe") or name in ("simulation", "gui"):
            return _Domain(name, real)
        return real if isinstance(real, type | ModuleType) or not callable(real) else partial(_call, "", name)


class _Domain:
    """A domain of TraCI, such as `traci.vehicle`."""

    def __init__(self, name: str, real: Api) -> None:
        self._name, self._real = name, real

    def __getattr__(self, name: str) -> Value:
        member = getattr(self._real, name)
        return partial(_call, self._name, name) if callable(member) and not isinstance(member, type) else member


def _call(domain: str, name: str, /, *arguments: Value, **named: Value) -> Value:
    if _active_calls:
        return _active_calls[-1](domain, name, arguments, named)
    refuse_own_loop(domain, name)
    raise InputError(
        full_name(domain, name),
        "is called while no vehicle is driven",
        "calls within start and step, not where a module is imported",
    )


def refuse_own_loop(domain: str, name: str) -> None:
    """Refuse a function that begins, advances or ends the simulation; raises InputError."""
    if name in LOOP_FUNCTIONS and domain in ("", "simulation"):
        raise InputError(
            full_name(domain, name),
            "safevar_sumo itself starts, advances and ends the simulation",
            "the body of your script's loop, without this call, as a function step(traci, vehicle_id)",
        )


def full_name(domain: str, name: str) -> str:
    return ".".join(part for part in ("traci", domain, name) if part)


def all_arguments(domain: str, name: str, arguments: Arguments, named: Named) -> Arguments:
    """The arguments of a call in the order of TraCI's function, defaults too."""
    bound = _signature(domain, name).bind(*arguments, **named)
    bound.apply_defaults()
    return bound.args


@cache
def _signature(domain: str, name: str) -> inspect.Signature:
    return inspect.signature(getattr(getattr(real_traci(), domain) if domain else real_traci(), name))


COMMANDS: Mapping[str, tuple[str, ...]] = {
    "setSpeed": ("speed",),
    "slowDown": ("speed", "duration"),
    "setAcceleration": ("acceleration", "duration"),
    "setAccel": ("accel",),
    "setDecel": ("decel",),
    "setMaxSpeed": ("speed",),
    "setSpeedMode": ("mode",),
}
"""The commands that a controller may give, each with its numeric arguments."""
SUMO_CONTROL = -1.0
"""Value of a speed or speed mode with which a command returns control to SUMO's own driver."""
LEGAL_NUMBERS = (
    "a finite number from 0 on; any acceleration; a whole mode up to 127; speed or mode -1 for SUMO's driver"
)


class CommandedSpeed:
    """A controller's commands, and the acceleration that results from them under SUMO's speed modes."""

    LIMIT_TO_SAFE_SPEED, LIMIT_ACCELERATION, LIMIT_DECELERATION, DEFAULT_MODE = 1, 2, 4, 31

    def __init__(self, nominal: Nominal, step: float) -> None:
        self._step, self.nominal_decel = step, nominal.decel
        self._limits = {"setAccel": nominal.accel, "setDecel": nominal.decel, "setMaxSpeed": math.inf}
        self._mode = self.DEFAULT_MODE
        self._speed: float | None = None
        self._end_time, self._speed_rate = -1.0, 0.0

    def command(self, name: str, time: float, speed: float, values: Arguments) -> None:
        """Process a command of the vehicle domain.

        Raises
        ------
        InputError
            If an argument is no legal number.
        """
        for argument, value in zip(COMMANDS[name], values, strict=True):
            returns_control = value == SUMO_CONTROL and name in ("setSpeed", "setSpeedMode")
            is_legal_mode = argument != "mode" or value in range(-1, 128)
            if not (
                returns_control
                or (math.isfinite(value) and is_legal_mode and (value >= 0 or argument == "acceleration"))
            ):
                raise InputError(f"traci.vehicle.{name}", f"{argument} = {value!r}", LEGAL_NUMBERS)
        first, *rest = map(float, values)
        if name == "setSpeedMode":
            self._mode = self.DEFAULT_MODE if first == SUMO_CONTROL else int(first)
        elif name in self._limits:
            self._limits[name] = first
        else:
            duration = max(rest[0], self._step) if name == "slowDown" else sum(rest)
            self._speed = first if name == "setSpeed" and first != SUMO_CONTROL else None
            self._end_time = time + duration
            self._speed_rate = (first - speed) / duration if name == "slowDown" else first

    def acceleration(self, speed: float, time: float, sumo_speed: float) -> float:
        """The acceleration by the commands [m/s^2]; SUMO's own driver would choose `sumo_speed` next [m/s]."""
        accel, decel, max_speed = self._limits.values()
        next_speed = sumo_speed if self._speed is None else self._speed
        if time < self._end_time:
            next_speed = speed + self._speed_rate * self._step
        if self._mode & self.LIMIT_TO_SAFE_SPEED and next_speed > sumo_speed:
            next_speed = min(next_speed, max(sumo_speed, speed - decel * self._step))
        acceleration = (min(next_speed, max_speed) - speed) / self._step
        acceleration = min(acceleration, accel) if self._mode & self.LIMIT_ACCELERATION else acceleration
        return max(acceleration, -decel) if self._mode & self.LIMIT_DECELERATION else acceleration
