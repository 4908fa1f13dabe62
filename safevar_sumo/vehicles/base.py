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

Positive = Annotated[float, Meta(gt=0, le=1e5)]
"""A model's parameter above 0."""


class Plausible(NamedTuple):
    """The plausible values of a characteristic, in its unit, or of a parameter, in `unit`: wide
    enough for every road vehicle, too narrow for another unit.
    """

    lowest: float
    highest: float
    unit: str = ""


MASS = Plausible(50, 60_000, "kg")
"""Mass of a vehicle, from a moped to a loaded truck."""
FRICTION = Plausible(0.05, 3, "-")
"""Friction coefficient of tyres."""
SECONDS = Plausible(1e-12, 20, "s")
"""Delays, time constants and headways: above 0."""


class Slope(NamedTuple):
    """Gravity on a road, scalar or shape (N,) [m/s^2]: `back` against the direction of travel,
    negative downhill; `down` onto the road.
    """

    back: FloatOrArray
    down: FloatOrArray


LEVEL = Slope(0.0, GRAVITY)


def slope_of(grade: FloatArray) -> Slope:
    """The slope of a grade, rise over run [%]: g sin and g cos of its angle."""
    rise = grade / 100
    length = np.sqrt(1 + rise * rise)
    return Slope(GRAVITY * (rise / length), GRAVITY / length)


Characteristics = Mapping[str, FloatArray]
"""Values of N vehicles by characteristic, in the units of the model's table, each of shape (N,)."""


class SumoType(NamedTuple):
    """N vehicles as SUMO and driving systems see them; every column has shape (N,).

    Mass [kg], largest acceleration and deceleration [m/s^2] and top speed [m/s] are those of a SUMO
    vehicle type. `actuator_lag` is the time constant with which the wheels follow the pedals [s].
    `tau` is the time headway that SUMO's driver of the vehicle keeps [s]; None if it is not among
    the characteristics.
    """

    mass: FloatArray
    accel: FloatArray
    decel: FloatArray
    max_speed: FloatArray
    actuator_lag: FloatArray
    tau: FloatArray | None = None


class Sensors(NamedTuple):
    """Properties of the sensors of N vehicles, each of shape (N,): latency [s], range in clear
    weather [m], factor on distances [-].

    A vehicle's method `sensors(prepared)` returns them; `Vehicle.sense` applies the same sensors to
    an observation.
    """

    latency: FloatArray
    reach: FloatArray
    scale: FloatArray

    @classmethod
    def perfect(cls, n: int) -> Sensors:
        """Sensors without latency and with unlimited range."""
        return cls(np.zeros(n), np.full(n, np.inf), np.ones(n))


Prepared = Any
"""A vehicle's constants of a run, as its `prepare` returns them, of its own type."""
State = Any
"""The state of N vehicles, of the model's own type; see `VehicleState`."""


HIGHEST_SPEED = 1000.0
"""Highest speed of a vehicle [m/s]; beyond it a model has diverged."""
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
    # While no obstacle is detected.
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
    """A vehicle model. Its fields are the parameters of `vehicle.parameters`.

    Every method is a pure function over arrays of N vehicles: element i of a result depends only on
    element i of the arguments, bit for bit. So methods use only + - * / and square roots,
    comparisons, minima and maxima: these operations give the same bits on every machine and for
    every N.

    Attributes
    ----------
    UNITS
        Units of the characteristics by name.
    OPTIONAL
        Characteristics that a study may leave out: then they have no effect. Their original value
        may be 0.
    PLAUSIBLE
        Plausible values of characteristics and parameters by name; a study with others is refused.
        A name may be missing.
    FITTED_UP_TO
        Highest speed at which the parameters were identified [m/s].
    remarks
        Remarks for the user.
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
        """The vehicle with the study's seed, for what is random in it, the same for all vehicles;
        most need none.
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
        """Constants of a run with a time step of `step` seconds.

        `road_friction` is the weather's factor on the tyres' friction; the depth of the `water`
        [mm] is for models that compute its effect, for which `road_friction` is that of the road
        without it. `slope` and `water` are passed only on roads that have a slope or are wet.
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
            "has no method at_speed(prepared, speed), and the simulation begins with it in motion",
            "a vehicle with that method, or a scenario and traffic that let it start with speed 0",
        )

    def at_start(self, prepared: Prepared, speed: FloatArray) -> State:
        """The initial state at a speed [m/s], shape (N,): at rest if the speed is 0, else the
        steady state.
        """
        standing = self.at_rest(prepared)
        is_rolling = speed > 0
        if not is_rolling.any():
            return standing
        # Those that stand get any speed above 0, and their state is not used.
        steady = self.at_speed(prepared, np.where(is_rolling, speed, 1.0))
        if is_rolling.all():
            return steady
        return _select_state(is_rolling, steady, standing)

    def hold_gear(self, prepared: Prepared, state: State, holds: BoolArray) -> State:
        """The state in which vehicles do not change gear where `holds`, shape (N,), is true; for
        the robot of tests.
        """
        return state

    def sensors(self, prepared: Prepared) -> Sensors | None:
        """Sensors of the vehicles, for a controller that reads SUMO instead of observations; None
        if they see everything at once.
        """
        return None

    def compile(self, *, only_load: bool = False) -> bool:
        """Compile what `advance` calls, or with `only_load` take it only from an earlier process;
        returns whether it is ready.
        """
        return True

    @abstractmethod
    def sense(
        self, prepared: Prepared, state: State, observation: Observation
    ) -> tuple[Observation, State]:
        """What the vehicles' sensors report of an observation, and the state after it."""

    @abstractmethod
    def advance(self, prepared: Prepared, state: State, command: Command) -> State:
        """The state one simulation step later."""


class SimulatedVehicle(Vehicle):
    """A vehicle that a simulator of the user's own moves and drives: here it has characteristics,
    in their `units`; those that are `optional` may be missing, or be 0 in the original.
    """

    def __init__(self, units: Mapping[str, str], optional: tuple[str, ...]) -> None:
        self.UNITS = units
        self.OPTIONAL = optional  # type: ignore[misc]

    def prepare(
        self, characteristics: Characteristics, *conditions: object
    ) -> Characteristics:
        return characteristics

    def sumo_type(self, prepared: Characteristics) -> SumoType:
        """Undefined: no vehicle of SUMO's stands for it."""
        undefined = nans(1)
        return SumoType(undefined, undefined, undefined, undefined, undefined)


def _select_state(is_rolling: BoolArray, steady: State, standing: State) -> State:
    """The state `steady` of the vehicles that roll, and `standing` of the others; a state may
    consist of states, and a delayed signal, the only part with a method `where`, has a way of its
    own.
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
