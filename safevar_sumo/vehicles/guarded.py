"""A vehicle model from outside the package, held to its contract."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.errors import ForeignError
from safevar_sumo.plugins import Contract, Guard, read_only_copy, takes
from safevar_sumo.records import BoolArray, Command, FloatArray, Observation
from safevar_sumo.vehicles.base import LEVEL, Characteristics, Slope, SumoType, Vehicle
from safevar_sumo.vehicles.sensors import Sensors

VEHICLE_CONTRACT = Contract.of(Vehicle, "a vehicle", optional=("at_speed",))
FASTEST = 1000.0
"""No vehicle is faster [m/s]; what is has diverged."""
ROUNDING = 1e-9
PROBE_STEP = 0.1  # s
_BOUNDS = {"speed": (0.0, FASTEST), "throttle": (0.0, 1.0), "brake": (0.0, 1.0)}


NOWHERE = ("gap", "lateral")
"""What is infinite while nobody is detected."""


class _Prepared(NamedTuple):
    n: int
    theirs: Any
    types: SumoType


class _State(NamedTuple):
    """What is read of a state, checked, and the state itself."""

    speed: FloatArray
    throttle: FloatArray
    brake: FloatArray
    gear: FloatArray
    theirs: Any


class GuardedVehicle:
    """Gives the model copies, checks what it returns, and keeps copies of that."""

    UNITS: Mapping[str, str]

    def __init__(self, vehicle: Any, guard: Guard) -> None:
        self._vehicle, self._guard = vehicle, guard
        units = guard.field("__init__", vehicle, "UNITS")
        if not isinstance(units, Mapping) or not all(isinstance(word, str) for pair in units.items() for word in pair):
            raise guard.wrong("__init__", "UNITS", units, "a mapping from names of characteristics to their units")
        self.UNITS = dict(units)

    def prepare(self, characteristics: Characteristics, road_friction: float, step: float, slope: Slope = LEVEL,
                wet: bool | BoolArray = False) -> _Prepared:
        n, method = len(next(iter(characteristics.values()))), self._vehicle.prepare
        if slope is not LEVEL and not takes(method, 4):
            problem = f"{self._guard.name} has no slope in prepare(characteristics, road_friction, step, slope), and the road has a grade"
            raise ForeignError(self._guard.source, problem, "a vehicle with it, or scenarios with grade 0")
        given: tuple[Any, ...] = (read_only_copy(characteristics), road_friction, step)
        if np.any(wet) and takes(method, 5):
            given = (*given, read_only_copy(slope), wet if isinstance(wet, bool) else wet.copy())
        elif slope is not LEVEL:
            given = (*given, read_only_copy(slope))
        theirs = self._guard.call("prepare", method, *given)
        types = self._guard.call("sumo_type", self._vehicle.sumo_type, theirs)
        return _Prepared(n, theirs, SumoType(*(
            self._guard.numbers("sumo_type", name, self._guard.field("sumo_type", types, name), (n,), 0.0, above=True)
            for name in SumoType._fields)))

    def sumo_type(self, prepared: _Prepared) -> SumoType:
        return prepared.types

    def at_rest(self, prepared: _Prepared) -> _State:
        state = self._state("at_rest", prepared.n, self._guard.call("at_rest", self._vehicle.at_rest, prepared.theirs))
        self._guard.numbers("at_rest", "speed", state.speed, (prepared.n,), 0.0, 0.0)
        return state

    def at_speed(self, prepared: _Prepared, speed: FloatArray) -> _State:
        if not hasattr(self._vehicle, "at_speed"):
            problem = f"{self._guard.name} has no method at_speed(prepared, speed), and the traffic puts it onto the road in motion"
            raise ForeignError(self._guard.source, problem, "a vehicle with it, or traffic that departs with speed 0")
        state = self._guard.call("at_speed", self._vehicle.at_speed, prepared.theirs, read_only_copy(speed))
        return self._state("at_speed", prepared.n, state)

    def hold_gear(self, prepared: _Prepared, state: _State, holds: BoolArray) -> _State:
        if not hasattr(self._vehicle, "hold_gear"):
            return state
        given = self._guard.call("hold_gear", self._vehicle.hold_gear, prepared.theirs, state.theirs, read_only_copy(holds))
        return self._state("hold_gear", prepared.n, given)

    def sensors(self, prepared: _Prepared) -> Sensors | None:
        """What the model says of its sensors; None if it says nothing."""
        if not hasattr(self._vehicle, "sensors"):
            return None
        theirs = self._guard.call("sensors", self._vehicle.sensors, prepared.theirs)
        return Sensors(*(self._guard.numbers("sensors", name, self._guard.field("sensors", theirs, name), (prepared.n,), 0.0,
                                             above=name == "scale", infinite=name == "reach") for name in Sensors._fields))

    def refuse_unknown_sensors(self, characteristics: Characteristics) -> None:
        """Refuse a model whose `sense` changes what is seen and that has no method `sensors`, for drivers that `sense` does not reach."""
        if hasattr(self._vehicle, "sensors"):
            return
        prepared = self.prepare(characteristics, 1.0, PROBE_STEP)
        state, nothing = self.at_rest(prepared), np.zeros(prepared.n)
        for sample, gap in enumerate((60.0, 5.0, 2000.0)):
            seen = Observation(sample * PROBE_STEP, nothing, nothing + gap, nothing + sample, nothing - 1 - sample, nothing + sample, 0.5,
                               nothing - sample, nothing, nothing)
            found, state = self.sense(prepared, state, seen)
            for name, value in seen._asdict().items():
                if not np.array_equal(getattr(found, name), value):
                    problem = f"{self._guard.name} changes {name} in sense, which nothing that a controller reads through TraCI passes"
                    raise ForeignError(self._guard.source, problem, "a method sensors(prepared) that returns safevar_sumo.vehicles.Sensors("
                                       "latency, reach, scale); or an ADS that is given what is sensed, without ads.kind = \"traci\"")

    def sense(self, prepared: _Prepared, state: _State, seen: Observation) -> tuple[Observation, _State]:
        given = self._guard.call("sense", self._vehicle.sense, prepared.theirs, state.theirs, read_only_copy(seen))
        theirs, after = self._guard.parts("sense", given, "(Observation, state)")
        values: dict[str, Any] = {}
        for name, value in seen._asdict().items():
            what = self._guard.field("sense", theirs, name)
            shape = (prepared.n,) if hasattr(value, "shape") else ()
            found = self._guard.numbers("sense", name, what, shape, infinite=name in NOWHERE)
            values[name] = found if shape else float(found)
        return Observation(**values), self._state("sense", prepared.n, after)

    def advance(self, prepared: _Prepared, state: _State, command: Command) -> _State:
        given = self._guard.call("advance", self._vehicle.advance, prepared.theirs, state.theirs, read_only_copy(command))
        state = self._state("advance", prepared.n, given)
        self._refuse_faster(state.speed, prepared.types.max_speed)
        return state

    def _refuse_faster(self, speed: FloatArray, most: FloatArray) -> None:
        """Refuse speeds above what the SUMO type allows: SUMO, which we tell the speed, lets them pass."""
        for faster in np.flatnonzero(speed > most * (1 + ROUNDING))[:1]:
            raise self._guard.wrong("advance", "speed", float(speed[faster]), f"up to max_speed = {most[faster]:g} of its sumo_type")

    def _state(self, method: str, n: int, theirs: Any) -> _State:
        read = {name: self._guard.numbers(method, name, self._guard.field(method, theirs, name), (n,), *_BOUNDS.get(name, ()))
                for name in _State._fields[:-1]}
        return _State(**read, theirs=theirs)
