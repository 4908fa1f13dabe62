"""The contract of a vehicle model, and slopes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol

import numpy as np
from msgspec import Meta

from safevar_sumo.errors import InputError
from safevar_sumo.plugins import FINITE, POSITIVE, SHARE, Contract, Legal, Returned
from safevar_sumo.records import (
    GRAVITY,
    BoolArray,
    Command,
    FloatArray,
    FloatOrArray,
    Observation,
    nans,
)

WHEELS = 4
"""Number of wheels of a vehicle."""
Positive = Annotated[float, Meta(gt=0, le=1e5)]
"""A model's parameter above 0."""


class Plausible(NamedTuple):
    """The range of plausible values of a characteristic (in the unit of the characteristic) or of a
    parameter (in `unit`). The range is wide enough for every road vehicle, and so narrow that a
    value in another unit is outside.
    """

    lowest: float
    highest: float
    unit: str = ""


MASS = Plausible(50, 60_000, "kg")
"""Mass of a vehicle, from a moped to a loaded truck."""
FRICTION = Plausible(0.05, 3, "-")
"""Friction coefficient of tyres."""
SECONDS = Plausible(1e-12, 20, "s")
"""Delays, time constants and headways; a plausible value is above 0."""


class Slope(NamedTuple):
    """The components of gravity on a road, numbers or shape (N,) [m/s^2]: `back` acts against the
    direction of travel (negative downhill), `down` acts onto the road.
    """

    back: FloatOrArray
    down: FloatOrArray


LEVEL = Slope(0.0, GRAVITY)


def slope_of(grade: FloatArray) -> Slope:
    """The slope of a road with this grade (rise over run) [%]: g sin and g cos of its angle."""
    rise = grade / 100
    length = np.sqrt(1 + rise * rise)
    return Slope(GRAVITY * (rise / length), GRAVITY / length)


Characteristics = Mapping[str, FloatArray]
"""Values of N vehicles by characteristic, each of shape (N,), in the units of `Vehicle.UNITS`."""


class SumoType(NamedTuple):
    """N vehicles as SUMO and driving systems know them; every column has the shape (N,).

    Mass [kg], largest acceleration and deceleration [m/s^2] and top speed [m/s] are attributes of a
    SUMO vehicle type. `actuator_lag` is the time constant with which the wheels follow the pedals
    [s]. `tau` is the time headway that SUMO's driver of the vehicle keeps [s]; None if `tau` is not
    among the characteristics.
    """

    mass: FloatArray
    accel: FloatArray
    decel: FloatArray
    max_speed: FloatArray
    actuator_lag: FloatArray
    tau: FloatArray | None = None


class Sensors(NamedTuple):
    """Properties of the sensors of N vehicles, each of shape (N,): latency [s], `reach`, the range
    in clear weather [m], and `scale`, the factor on distances [-].

    The method `Vehicle.sensors` returns these properties; `Vehicle.sense` applies the same sensors
    to an observation.
    """

    latency: FloatArray
    reach: FloatArray
    scale: FloatArray

    @classmethod
    def perfect(cls, n: int) -> Sensors:
        """Sensors without latency and with unlimited range."""
        return cls(np.zeros(n), np.full(n, np.inf), np.ones(n))


Prepared = Any
"""Constants of N vehicles in a run, as the model's `prepare` returns them; each model has its own
type of constants.
"""
State = Any
"""The state of N vehicles. Each model has its own type of state, with the columns of
`VehicleState`.
"""


HIGHEST_SPEED = 1000.0
"""Highest legal speed of a vehicle [m/s]: a model with a higher speed has diverged."""
LEGAL_STATE = {
    "speed": Legal(0.0, HIGHEST_SPEED),
    "throttle": SHARE,
    "brake": SHARE,
    "gear": FINITE,
}
LEGAL_SENSORS = {
    "latency": Legal(0.0),
    "reach": Legal(0.0, infinite=True),
    "scale": POSITIVE,
}
LEGAL_OBSERVATION = {
    **dict.fromkeys(Observation._fields, Legal(scalar=True)),
    # Both are infinite while no obstacle is detected.
    **dict.fromkeys(("gap", "lateral"), Legal(infinite=True)),
}


class VehicleState(Protocol):
    """The columns that every model's state has, each of shape (N,): speed [m/s]; throttle, brake
    and gear [-].
    """

    @property
    def speed(self) -> FloatArray: ...
    @property
    def throttle(self) -> FloatArray: ...
    @property
    def brake(self) -> FloatArray: ...
    @property
    def gear(self) -> FloatArray: ...


class Vehicle:
    """A vehicle model. Its fields are the keys of `vehicle.parameters` in a study.

    Every method is a pure function over arrays of N vehicles: element i of a result depends only on
    element i of the arguments, bit for bit. So methods use only + - * / and square roots,
    comparisons, minima and maxima: these operations give the same bits on every machine and for
    every N.

    Attributes
    ----------
    UNITS
        Units of the characteristics by name.
    OPTIONAL
        Characteristics that a study may leave out: then they have no effect.
    PLAUSIBLE
        Plausible values of characteristics and parameters by name. A study with other values is
        refused; a name that is missing here may have any value.
    FITTED_UP_TO
        Highest speed of the drives to which the model was fitted [m/s]; infinite if unknown.
    remarks
        Remarks for the user on the vehicle.
    RETURNS
        What the methods of a user's class must return.
    """

    __slots__ = ()
    RETURNS: ClassVar[Contract] = {
        "prepare": Returned(like=0),
        # The last field, tau, may be None.
        "sumo_type": Returned((dict.fromkeys(SumoType._fields[:-1], POSITIVE),)),
        "at_rest": Returned(({**LEGAL_STATE, "speed": Legal(0.0, 0.0)},)),
        "at_speed": Returned((LEGAL_STATE,), like=1),
        "hold_gear": Returned((LEGAL_STATE,), like=2),
        "sensors": Returned((LEGAL_SENSORS,)),
        "sense": Returned((LEGAL_OBSERVATION, LEGAL_STATE), like=2),
        "advance": Returned((LEGAL_STATE,), like=2),
    }
    UNITS: Mapping[str, str]
    OPTIONAL: ClassVar[tuple[str, ...]] = ()
    PLAUSIBLE: Mapping[str, Plausible] = MappingProxyType({})
    FITTED_UP_TO: ClassVar[float] = np.inf
    remarks: Sequence[str] = ()

    def seeded(self, seed: int) -> Vehicle:
        """The vehicle with the study's seed, from which a model draws what is random in it, the
        same for all vehicles. By default nothing is random, and the vehicle stays as it is.
        """
        return self

    @abstractmethod
    def prepare(
        self,
        characteristics: Characteristics,
        road_friction: float,
        step: float,
        slope: Slope = LEVEL,
        water: FloatOrArray = 0.0,
    ) -> Prepared:
        """The constants of N vehicles in a run with a time step of `step` seconds.

        `road_friction` is the weather's factor on the tyres' friction. `water` is the depth of
        water on the road [mm], for models that compute its effect: then `road_friction` is the
        factor without water. `slope` and `water` are passed only if a road has a slope or is wet.
        """

    @abstractmethod
    def sumo_type(self, prepared: Prepared) -> SumoType:
        """The SUMO types of the vehicles."""

    @abstractmethod
    def at_rest(self, prepared: Prepared) -> State:
        """The state at the start: standing, pedals released."""

    def at_speed(self, prepared: Prepared, speed: FloatArray) -> State:
        """The steady state at a speed above 0, shape (N,) [m/s]; its pedals hold this speed."""
        raise InputError(
            type(self).__name__,
            "has no method at_speed(prepared, speed), and the simulation begins with it in motion",
            "a vehicle with that method, or a scenario and traffic that let it start with speed 0",
        )

    def at_start(self, prepared: Prepared, speed: FloatArray) -> State:
        """The state in which a run begins, at a speed of shape (N,) [m/s]: vehicles with speed 0
        are at rest, all others are in the steady state.
        """
        standing = self.at_rest(prepared)
        is_rolling = speed > 0
        if not is_rolling.any():
            return standing
        # `at_speed` needs speeds above 0: vehicles at rest get 1 m/s, and this state is not used.
        steady = self.at_speed(prepared, np.where(is_rolling, speed, 1.0))
        if is_rolling.all():
            return steady
        return _select_state(is_rolling, steady, standing)

    def hold_gear(self, prepared: Prepared, state: State, holds: BoolArray) -> State:
        """The state in which vehicles keep their gear if `holds`, shape (N,), is true. The robot
        that drives tests holds gears. By default the model has no gears to hold.
        """
        return state

    def sensors(self, prepared: Prepared) -> Sensors | None:
        """The vehicles' sensors, for a controller that reads SUMO instead of observations; None if
        the vehicles see everything without delay.
        """
        return None

    def compile(self, *, only_load: bool = False) -> bool:
        """Compile the functions that `advance` calls. With `only_load`, only load functions that an
        earlier process has compiled. Returns whether all functions are ready.
        """
        return True

    @abstractmethod
    def sense(
        self, prepared: Prepared, state: State, observation: Observation
    ) -> tuple[Observation, State]:
        """The observation as the vehicles' sensors report it, and the state afterwards (which may
        keep past observations).
        """

    @abstractmethod
    def advance(self, prepared: Prepared, state: State, command: Command) -> State:
        """The state one simulation step later."""


class SimulatedVehicle(Vehicle):
    """A vehicle that a user's simulator moves and drives. This package knows only the `units` of
    its characteristics. Characteristics that are `optional` may be missing, or 0 in the original.
    """

    def __init__(self, units: Mapping[str, str], optional: tuple[str, ...]) -> None:
        self.UNITS = units
        self.OPTIONAL = optional  # type: ignore[misc]

    def prepare(
        self, characteristics: Characteristics, *conditions: object
    ) -> Characteristics:
        return characteristics

    def sumo_type(self, prepared: Characteristics) -> SumoType:
        """NaN in every column: no SUMO type stands for a vehicle in a user's simulator."""
        undefined = nans(1)
        return SumoType(undefined, undefined, undefined, undefined, undefined)


def _select_state(is_rolling: BoolArray, steady: State, standing: State) -> State:
    """The state `steady` for the vehicles that roll, and the state `standing` for all others.

    A state may be a tuple of states. A part with a method `where` (a delayed signal) selects for
    itself. A part that is None in one of the two states is taken from `standing`.
    """
    if hasattr(standing, "where"):
        return steady.where(is_rolling, standing)
    if isinstance(steady, tuple):
        columns = [
            _select_state(is_rolling, *pair)
            for pair in zip(steady, standing, strict=True)
        ]
        if hasattr(steady, "_fields"):
            return type(steady)(*columns)
        return tuple(columns)
    if steady is None or standing is None:
        return standing
    return np.where(is_rolling, steady, standing)
