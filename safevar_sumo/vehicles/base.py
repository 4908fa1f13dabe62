"""The contract of a vehicle model, slopes, and the guard of a user's model."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol

import numpy as np
from msgspec import Meta

from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.plugins import FINITE, POSITIVE, SHARE, Guard, Legal, open_rows, read_only_copy
from safevar_sumo.records import GRAVITY, BoolArray, Command, FloatArray, Observation
from safevar_sumo.vehicles.sensors import Sensors, sensed_observation

Positive = Annotated[float, Meta(gt=0, le=1e5)]
"""A model's parameter above 0."""


class Slope(NamedTuple):
    """Gravity on a road, scalar or shape (N,) [m/s^2]: `back` against the direction of travel, negative downhill;
    `down` onto the road.
    """

    back: float | FloatArray
    down: float | FloatArray


LEVEL = Slope(0.0, GRAVITY)


def slope_of(grade: FloatArray) -> Slope:
    """The slope of a grade, rise over run [%]: g sin and g cos of its angle."""
    rise = grade / 100
    length = np.sqrt(1 + rise * rise)
    return Slope(GRAVITY * (rise / length), GRAVITY / length)


Characteristics = Mapping[str, FloatArray]
"""Values of N vehicles by characteristic, in the units of the model's table, each of shape (N,)."""


class SumoType(NamedTuple):
    """The attributes of N SUMO vehicle types, each of shape (N,), in kg, m/s^2, m/s^2, m/s and s.

    `tau`, SUMO's desired headway, holds the actuator lag. It has no effect in SUMO, whose driver models do not drive
    the vehicle.
    """

    mass: FloatArray
    accel: FloatArray
    decel: FloatArray
    max_speed: FloatArray
    tau: FloatArray


Prepared = Any
"""A vehicle's constants of a run, as its `prepare` returns them, of its own type."""
State = Any
"""The state of N vehicles, of the model's own type; see `VehicleState`."""


class VehicleState(Protocol):
    """The columns that every model's state has, each of shape (N,): speed [m/s]; throttle, brake and gear [-]."""

    @property
    def speed(self) -> FloatArray: ...
    @property
    def throttle(self) -> FloatArray: ...
    @property
    def brake(self) -> FloatArray: ...
    @property
    def gear(self) -> FloatArray: ...


class Vehicle:
    """A vehicle model. Its fields are the parameters of `vehicle.parameters`.

    Every method is a pure function over arrays of N vehicles: element i of a result depends only on
    element i of the arguments, bit for bit. So methods use only + - * / and square roots, comparisons,
    minima and maxima: these operations give the same bits on every machine and for every N.

    Attributes
    ----------
    UNITS
        Units of the characteristics by name.
    FITTED_UP_TO
        Highest speed at which the parameters were identified [m/s].
    max_vehicles
        Largest number of vehicles at once; None if any number will do.
    remarks
        Remarks for the user.
    """

    __slots__ = ()
    UNITS: Mapping[str, str]
    FITTED_UP_TO: ClassVar[float] = np.inf
    max_vehicles: int | None = None
    remarks: Sequence[str] = ()

    @abstractmethod
    def prepare(
        self,
        characteristics: Characteristics,
        road_friction: float,
        step: float,
        slope: Slope = LEVEL,
        wet: bool | BoolArray = False,
    ) -> Prepared:
        """Constants of a run with a time step of `step` seconds.

        `road_friction` is the weather's factor on the tyres' friction; `wet` is for models in which water has further
        effects. A user's model gets `slope` and `wet` only on roads that have a slope or are wet.
        """

    @abstractmethod
    def sumo_type(self, prepared: Prepared) -> SumoType:
        """The SUMO types of the vehicles."""

    @abstractmethod
    def at_rest(self, prepared: Prepared) -> State:
        """The state at the start: standing, pedals released."""

    def at_speed(self, prepared: Prepared, speed: FloatArray) -> State:
        """The steady state at a speed above 0 [m/s], shape (N,), with the pedals that hold it."""
        raise InputError(
            type(self).__name__,
            "has no method at_speed(prepared, speed), and the traffic puts it onto the road in motion",
            "a vehicle with that method, or traffic that departs with speed 0",
        )

    def at_start(self, prepared: Prepared, speed: FloatArray) -> State:
        """The initial state at a speed [m/s], shape (N,): at rest if the speed is 0, else the steady state."""
        rest, is_rolling = self.at_rest(prepared), speed > 0
        if not is_rolling.any():
            return rest
        steady = self.at_speed(prepared, np.where(is_rolling, speed, 1.0))
        return steady if is_rolling.all() else _select_state(is_rolling, steady, rest)

    def hold_gear(self, prepared: Prepared, state: State, holds: BoolArray) -> State:
        """The state in which vehicles do not change gear where `holds`, shape (N,), is true; the robot of tests at a
        speed needs it.
        """
        return state

    def sensors(self, prepared: Prepared) -> Sensors | None:
        """Sensors of the vehicles, for a controller that reads SUMO instead of observations; None if they see
        everything at once.
        """
        return None

    @abstractmethod
    def sense(self, prepared: Prepared, state: State, seen: Observation) -> tuple[Observation, State]:
        """What the vehicles' sensors report of an observation, and the state after it."""

    @abstractmethod
    def advance(self, prepared: Prepared, state: State, command: Command) -> State:
        """The state one simulation step later."""


def _select_state(is_rolling: BoolArray, steady: State, rest: State) -> State:
    """The state `steady` of the vehicles that roll, and `rest` of the others; a state may consist of states."""
    if isinstance(steady, tuple):
        columns = [_select_state(is_rolling, *states) for states in zip(steady, rest, strict=True)]
        return type(steady)(*columns) if hasattr(steady, "_fields") else tuple(columns)
    return steady if steady is None else np.where(is_rolling, steady, rest)


class SensingVehicle(Vehicle):
    """A vehicle with delayed sensors of limited range, whose pedals balance the slope at a steady speed.

    Its constants have a `step` [s], the sensors' `latency` [s] and `sensor_range` [m]; its state has the history
    `seen`.
    """

    __slots__ = ()

    def sensors(self, prepared: Prepared) -> Sensors:
        return Sensors(prepared.latency, prepared.sensor_range, np.ones_like(prepared.sensor_range))

    def sense(self, prepared: Prepared, state: State, seen: Observation) -> tuple[Observation, State]:
        """Sensors report the scene as it was one latency ago, and nothing beyond their range times the visibility."""
        sensed, past = sensed_observation(seen, state.seen, prepared.latency, prepared.sensor_range, prepared.step)
        return sensed, state._replace(seen=past)


def pedals_on_slope(back: float | FloatArray, drive: FloatArray, brake: FloatArray) -> Command:
    """Pedals that balance the deceleration `back` by the slope, the only resistance, given the accelerations by full
    pedals [m/s^2].
    """
    return Command(*(np.minimum(np.maximum(pedal, 0.0), 1.0) for pedal in (back / drive, -back / brake)))


HIGHEST_SPEED = 1000.0
"""Highest speed of a vehicle [m/s]; beyond it a model has diverged."""
SPEED_ROUNDING = 1e-9  # relative tolerance of speeds
LEGAL_STATE = {"speed": Legal(0.0, HIGHEST_SPEED), "throttle": SHARE, "brake": SHARE, "gear": FINITE}
LEGAL_SENSORS = {"latency": Legal(0.0), "reach": Legal(0.0, infinite=True), "scale": POSITIVE}
LEGAL_OBSERVATION = {
    **dict.fromkeys(Observation._fields, FINITE),
    **dict.fromkeys(("gap", "lateral"), Legal(infinite=True)),  # while no obstacle is detected
}


class _Prepared(NamedTuple):
    """Number of vehicles, the constants that the user's model returned, and its SUMO types after the check."""

    n: int
    constants: Prepared
    types: SumoType


class _State(NamedTuple):
    """The columns of a state after the check, and the state that the user's model returned."""

    speed: FloatArray
    throttle: FloatArray
    brake: FloatArray
    gear: FloatArray
    model_state: State


class GuardedVehicle(Vehicle):
    """Guards a user's model: passes read-only copies to it, and checks its results."""

    UNITS: Mapping[str, str]

    def __init__(self, vehicle: Any, guard: Guard) -> None:
        self.model, self._guard = vehicle, guard
        self.UNITS = guard.field("__init__", vehicle, "UNITS")
        if not isinstance(self.UNITS, Mapping):
            raise guard.wrong_value("__init__", "UNITS", self.UNITS, "units of the characteristics by name")

    def prepare(
        self,
        characteristics: Characteristics,
        road_friction: float,
        step: float,
        slope: Slope = LEVEL,
        wet: bool | BoolArray = False,
    ) -> _Prepared:
        n = len(next(iter(characteristics.values())))
        road = (slope, wet) if np.any(wet) else (slope,) if slope is not LEVEL else ()
        arguments = read_only_copy(characteristics), road_friction, step, *read_only_copy(road)
        constants = self._guard.call("prepare", self.model.prepare, *arguments)
        types = self._guard.call("sumo_type", self.model.sumo_type, constants)
        legal = dict.fromkeys(SumoType._fields, POSITIVE)
        return _Prepared(n, constants, SumoType(**self._guard.columns("sumo_type", types, (n,), legal)))

    def sumo_type(self, prepared: _Prepared) -> SumoType:
        return prepared.types

    def at_rest(self, prepared: _Prepared) -> _State:
        state = self._next_state("at_rest", prepared)
        self._guard.numbers("at_rest", "speed", state.speed, (prepared.n,), Legal(0.0, 0.0))
        return state

    def at_speed(self, prepared: _Prepared, speed: FloatArray) -> _State:
        return self._next_state("at_speed", prepared, speed)

    def hold_gear(self, prepared: _Prepared, state: _State, holds: BoolArray) -> _State:
        return self._next_state("hold_gear", prepared, state, holds)

    def sensors(self, prepared: _Prepared) -> Sensors | None:
        sensors = self._result("sensors", prepared)
        if sensors is None:
            return None
        return Sensors(**self._guard.columns("sensors", sensors, (prepared.n,), LEGAL_SENSORS))

    def require_sensors(self) -> None:
        """Refuse a model without a method `sensors`: a controller that reads through TraCI bypasses `sense`."""
        if type(self.model).sensors is Vehicle.sensors:
            raise UserCodeError(
                self._guard.source,
                f"{self._guard.name} has no method sensors, and a controller that reads through TraCI bypasses sense",
                "a method sensors(prepared) that returns safevar_sumo.vehicles.Sensors(latency, reach, scale), or None",
            )

    def sense(self, prepared: _Prepared, state: _State, seen: Observation) -> tuple[Observation, _State]:
        result = self._result("sense", prepared, state, seen)
        sensed, next_state = self._guard.elements("sense", result, "(Observation, state)")
        scalars = [name for name, value in seen._asdict().items() if not hasattr(value, "shape")]
        columns = self._guard.columns("sense", sensed, (prepared.n,), LEGAL_OBSERVATION, scalars)
        return Observation(**columns), self._checked("sense", prepared, next_state)

    def advance(self, prepared: _Prepared, state: _State, command: Command) -> _State:
        state, max_speed = self._next_state("advance", prepared, state, command), prepared.types.max_speed
        for i in open_rows(state.speed > max_speed * (1 + SPEED_ROUNDING))[:1]:  # SUMO itself accepts any speed
            expected = f"up to max_speed = {max_speed[i]:g} of its sumo_type"
            raise self._guard.wrong_value("advance", "speed", float(state.speed[i]), expected)
        return state

    def _next_state(self, method: str, prepared: _Prepared, *arguments: object) -> _State:
        return self._checked(method, prepared, self._result(method, prepared, *arguments))

    def _result(self, method: str, prepared: _Prepared, *arguments: object) -> Any:
        """What a method of the user's model returns; it gets its own constants and state as it returned them."""
        own = [each.model_state if isinstance(each, _State) else read_only_copy(each) for each in arguments]
        return self._guard.call(method, getattr(self.model, method), prepared.constants, *own)

    def _checked(self, method: str, prepared: _Prepared, state: State) -> _State:
        return _State(**self._guard.columns(method, state, (prepared.n,), LEGAL_STATE), model_state=state)
