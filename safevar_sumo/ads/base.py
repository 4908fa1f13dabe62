"""The contract of an automated driving system (ADS), and functions that driving systems share.

An ADS may drive N vehicles at once, or one vehicle (`ScalarAds`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple

import numpy as np
from msgspec import Meta

from safevar_sumo.errors import missing_extra
from safevar_sumo.plugins import (
    SHARE,
    TRUTH,
    Contract,
    Returned,
    UserCode,
    open_rows,
    quoted,
)
from safevar_sumo.records import (
    ZERO,
    BoolArray,
    Command,
    FloatArray,
    FloatOrArray,
    Nominal,
    Observation,
    Quantity,
    clip_to_share,
)

PositiveParameter = Annotated[float, Meta(gt=0, le=1e3)]
"""A driver's parameter above 0, in the SI unit of its quantity."""
NonNegativeParameter = Annotated[float, Meta(ge=0, le=1e3)]
"""A driver's parameter that may be 0, in the SI unit of its quantity."""

Memory = Any
"""What an ADS remembers of N vehicles between two calls: an object of the ADS's own class."""


class Ads:
    """An ADS that drives N vehicles at once. The study's table `ads.parameters` fills the class's
    fields.

    The ADS gets an `Observation` and knows the original vehicle (`Nominal`), never the setting.
    Element i of a command depends only on element i of the observations, bit for bit: neither N nor
    other vehicles change a command.

    Attributes
    ----------
    recognition_delay, hesitation
        Delays of the ADS's reaction [s]; a study may raise them in bad weather.
    max_vehicles
        Largest number of vehicles that the ADS can drive at once; None without a limit.
    tau_parameter
        The name of the parameter that the headway `tau` of the setting replaces. Only an ADS that
        is SUMO's driver has such a parameter; "" for others.
    RETURNS
        What the methods of a user's class must return.
    HELPERS
        Methods that a user's class may call, and may define differently under the same name.
    """

    __slots__ = ()
    recognition_delay = 0.0
    hesitation = 0.0
    tau_parameter = ""
    max_vehicles: int | None = None
    RETURNS: ClassVar[Contract] = {
        "drive": Returned(({"throttle": SHARE, "brake": SHARE}, {}), like=0),
        "warns": Returned(({"": TRUTH},)),
    }
    HELPERS: ClassVar[tuple[str, ...]] = ("pedals",)
    if TYPE_CHECKING:
        nominal: Nominal

    @abstractmethod
    def start(self, n: int, nominal: Nominal, step: float) -> Memory:
        """Create the memory of a run of `n` vehicles with `step` seconds between two calls of
        `drive`.
        """

    @abstractmethod
    def drive(self, observation: Observation, memory: Memory) -> tuple[Command, Memory]:
        """Command the pedals for the coming step; returns the memory for the next call."""

    def warns(self, memory: Memory) -> BoolArray | None:
        """Which drivers are warned after `drive`, shape (N,); None if the ADS never warns."""
        return None

    def pedals(
        self,
        acceleration: FloatArray,
        speed: FloatArray,
        nominal: Nominal | None = None,
        trim: Trim | None = None,
    ) -> Command:
        """The pedals with which the original vehicle reaches an acceleration [m/s^2] at a speed
        [m/s] on a dry, level road. Both arrays have shape (N,).

        `nominal` is the original vehicle, by default the attribute `nominal` that `start` has set.
        The `trim` is added to the pedals; see `trim_at`.
        """
        return pedals_for(nominal or self.nominal, speed, acceleration, trim or NO_TRIM)


class FullBrake(Ads):
    """Brakes fully from the start on. This ADS drives in scenarios that brake by themselves."""

    def start(self, n: int, nominal: Nominal, step: float) -> Command:
        return Command(np.zeros(n), np.ones(n))

    def drive(
        self, observation: Observation, memory: Command
    ) -> tuple[Command, Command]:
        return memory, memory


Pedals = tuple[float, float]
"""Throttle and brake of one vehicle, each in [0, 1]."""


class ScalarAds(ABC):
    """Base of an ADS for one vehicle. Every simulated vehicle gets its own instance of the class.

    A study names the class as `package.module:Name`. The study's `ads.parameters` are the arguments
    of `__init__`.
    """

    HELPERS: ClassVar[tuple[str, ...]] = ("pedals",)
    nominal: Nominal
    step: float
    warns = False
    """Whether the ADS warns its driver now; `drive` may set this attribute."""

    def start(self, nominal: Nominal, step: float) -> None:
        """Prepare a run. `start` is called once before the run, with the original vehicle and the
        time between two calls of `drive` [s].
        """
        self.nominal = nominal
        self.step = step

    @abstractmethod
    def drive(self, observation: Observation) -> Pedals:
        """Command throttle and brake, each in [0, 1]. The fields of the observation are numbers."""

    def pedals(
        self, acceleration: Quantity, speed: Quantity, trim: Trim | None = None
    ) -> Pedals:
        """The throttle and brake with which the original vehicle reaches an acceleration [m/s^2] at
        a speed [m/s] on a dry, level road.

        The `trim` is added to the pedals; see `trim_at`.
        """
        throttle, brake = pedals_for(self.nominal, speed, acceleration, trim or NO_TRIM)
        return float(throttle), float(brake)


def library(model: str, extra: str, module: str) -> Any:
    """Import a module of the library that a shipped driving system needs. Raise an InputError if
    the package's `extra` with this library is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        raise missing_extra("", f"ads.model = {model!r} needs {extra}", extra) from None


class PerVehicleAds(Ads):
    """Drives N vehicles with N instances of a `ScalarAds`."""

    def __init__(self, create: Callable[[], ScalarAds], code: UserCode) -> None:
        self._create = create
        self._code = code

    def start(self, n: int, nominal: Nominal, step: float) -> list[ScalarAds]:
        drivers = [self._create() for _ in range(n)]
        with np.errstate():
            for driver in drivers:
                self._code.call("start", driver.start, nominal, step)
        return drivers

    def drive(
        self, observation: Observation, memory: list[ScalarAds]
    ) -> tuple[Command, list[ScalarAds]]:
        n = len(memory)
        values = np.array(np.broadcast_arrays(*observation), float)
        observations = [Observation._make(row) for row in values.T.tolist()]
        pedals = [(0.0, 0.0)] * n
        # The driver of a vehicle whose run has ended is not called: the vehicle may be in a state
        # that the driver does not expect.
        rows = open_rows(np.ones(n, bool)).tolist()
        with np.errstate():
            for i in rows:
                command = self._code.call("drive", memory[i].drive, observations[i])
                pedals[i] = self._checked_pedals(command)
        return Command(*np.array(pedals, float).reshape(n, 2).T.copy()), memory

    def warns(self, memory: list[ScalarAds]) -> BoolArray:
        return np.array([bool(driver.warns) for driver in memory], bool)

    def _checked_pedals(self, command: Any) -> Pedals:
        """Refuse an illegal result of a user's `drive`, and convert a legal result to pedals."""
        if not isinstance(command, tuple | list) or len(command) != 2:
            raise self._code.wrong(
                "drive", quoted(command), "(throttle, brake), each in [0, 1]"
            )
        throttle, brake = command
        # The fast path skips the general check, because this code runs for every vehicle in every
        # step.
        if (
            type(throttle) is type(brake) is float
            and 0 <= throttle <= 1
            and 0 <= brake <= 1
        ):
            return throttle, brake
        pedals = zip(Command._fields, command, strict=True)
        throttle, brake = (
            self._code.check_numbers("drive", name, value, (), SHARE)
            for name, value in pedals
        )
        return float(throttle), float(brake)


def pedal_tables_at(nominal: Nominal, speed: Quantity) -> list[FloatArray]:
    """Return the original vehicle's deceleration without pedals, and its acceleration at full
    throttle, at these speeds [m/s^2]. The values are interpolated linearly between the equally
    spaced speeds of the tables.
    """
    tables = nominal.tables()
    # A speed beyond the table counts as just below the last row, because row + 1 must exist.
    position = np.minimum(speed / tables.speeds[1], len(tables.speeds) - 1.001)
    row = position.astype(np.intp)
    share = position - row
    return [
        table[row] + (table[row + 1] - table[row]) * share
        for table in (tables.coasting, tables.full_throttle)
    ]


STEP_DECIMALS = 6
"""Decimals to which a delay in steps is rounded, so that a whole number of steps is exact."""


class DelayLine(NamedTuple):
    """Delays the values of N vehicles.

    The delay is `steps` whole steps and a `fraction` of a step; the fraction is a number, or an
    array with a value for each vehicle. `past` has the past values, oldest first.
    """

    steps: int
    fraction: FloatOrArray
    past: tuple[FloatArray, ...] = ()

    @classmethod
    def by(cls, delay: float, step: float) -> DelayLine:
        """The delay line for a delay [s] at a time step [s]."""
        steps, fraction = cls.parts(delay, step)
        return cls(int(steps), float(fraction))

    @staticmethod
    def parts(delay: FloatOrArray, step: float) -> tuple[FloatArray, FloatArray]:
        """Split a delay [s], or an array of delays, into whole steps and the fraction of a step."""
        return np.divmod(np.round(delay / step, STEP_DECIMALS), 1)

    def delayed(self, values: FloatArray) -> tuple[FloatArray, DelayLine]:
        """Return the values one delay ago (linear between two steps), and the delay line for the
        next step.

        Until the first values are one delay old, `delayed` returns the first values. If a value is
        infinite in one of the two steps, no mean is defined: the value of the earlier step holds.
        """
        # Before the first call, all past values count as equal to the first values.
        earlier_past = self.past or (values,) * (self.steps + 2)
        past = (*earlier_past[1:], values)
        older = past[0]
        newer = past[1]
        delayed = newer
        if np.ndim(self.fraction) or self.fraction:
            # infinity - infinity is NaN: such values are replaced below.
            with np.errstate(invalid="ignore"):
                delayed = newer + (older - newer) * self.fraction
            earlier = np.where(np.equal(self.fraction, 0), newer, older)
            delayed = np.where(np.isfinite(delayed), delayed, earlier)
        return delayed, DelayLine(self.steps, self.fraction, past)


class Trim(NamedTuple):
    """The pedals of a rolling vehicle, minus the pedals with which the original vehicle holds this
    speed on a level road [-]. On a slope, the trim balances gravity.
    """

    throttle: FloatArray
    brake: FloatArray


NO_TRIM = Trim(ZERO, ZERO)
"""The trim on a level road."""


def trim_at(nominal: Nominal, observation: Observation) -> Trim:
    """The trim of a driver who already holds the speed of a rolling vehicle. The trim is 0 at
    standstill.
    """
    is_rolling = observation.speed > 0
    is_braking = is_rolling & (observation.brake > 0)
    coasting, full_throttle = pedal_tables_at(nominal, observation.speed)
    holding_throttle = coasting / (full_throttle + coasting)
    # A negative brake would push the vehicle: without pedals, the vehicle slows down by `coasting`.
    holding_brake = -coasting / nominal.braking
    return Trim(
        throttle=np.where(is_rolling, observation.throttle - holding_throttle, 0.0),
        brake=np.where(is_braking, observation.brake - holding_brake, 0.0),
    )


def cruise_at(
    nominal: Nominal, observation: Observation, speed: float | None
) -> tuple[FloatArray, Trim]:
    """The speed that a cruise control holds [m/s], and its trim. If `speed` is None, the cruise
    control holds the present speed.
    """
    speeds = observation.speed
    if speed is not None:
        speeds = np.full_like(speeds, speed)
    return speeds, trim_at(nominal, observation)


def pedals_for(
    nominal: Nominal, speed: Quantity, acceleration: Quantity, pedal_trim: Trim
) -> Command:
    """The pedals for an acceleration [m/s^2] at a speed [m/s], according to the tables of the
    original vehicle. `pedal_trim` is added to the pedals.
    """
    coasting, full_throttle = pedal_tables_at(nominal, speed)
    push = acceleration + coasting
    excess = push - nominal.braking * pedal_trim.brake
    brake = clip_to_share(-excess / nominal.braking)
    throttle = push / (full_throttle + coasting) + pedal_trim.throttle
    throttle = clip_to_share(throttle)
    return Command(np.where(excess < 0, 0.0, throttle), brake)


CORRIDOR = 1.15
"""Half the width of the corridor that a driver watches [m]. An obstacle with a side in the corridor
is in the way. The middle of an adult in the way is up to 1.4 m from the lane's middle, and the
middle of a car (1.7 m wide) up to 2.0 m.
"""
LEAST_APPROACH_SPEED = 0.1
"""Lower bound of a positive closing speed [m/s]. Without this bound, times would become
infinite.
"""
LARGEST_GAP = 1e6
"""Upper bound of gaps [m]. The same number stands for an infinite time [s], and for the lateral
position of a missing obstacle [m], because arithmetic with infinities gives NaN.
"""


def time_to_reach(observation: Observation) -> FloatArray:
    """The time to collision (gap / closing speed) [s], shape (N,). The time is `LARGEST_GAP` while
    the gap does not shrink.
    """
    gap = np.minimum(np.maximum(observation.gap, 0.0), LARGEST_GAP)
    closing_speed = observation.closing_speed
    time = gap / np.maximum(closing_speed, LEAST_APPROACH_SPEED)
    return np.where(closing_speed > 0, time, LARGEST_GAP)


def is_in_the_way(
    observation: Observation, corridor: float, reach: float = np.inf
) -> BoolArray:
    """Return whether a detected obstacle ahead has a side within `corridor` of the lane's middle
    [m], now or when the vehicle reaches the obstacle.

    `reach` is the sensors' range in clear weather [m].
    """
    return depth_in_the_way(observation, corridor, reach) >= 0


def depth_in_the_way(
    observation: Observation, corridor: float, reach: float = np.inf
) -> FloatArray:
    """The distance by which a side of a detected obstacle ahead is inside the `corridor` [m], now
    or when the vehicle reaches the obstacle. The distance is below 0 outside of the corridor, and
    `-LARGEST_GAP` without an obstacle.
    """
    is_in_reach = observation.gap <= reach * observation.visibility
    is_detected = is_ahead(observation) & is_in_reach
    lateral = np.where(is_detected, observation.lateral, LARGEST_GAP)
    way = observation.lateral_speed * time_to_reach(observation)
    nearest = np.minimum(np.abs(lateral), np.abs(lateral + way))
    watched = corridor + observation.obstacle_width / 2
    return np.where(is_detected, watched - nearest, -LARGEST_GAP)


def is_ahead(observation: Observation) -> BoolArray:
    """Return whether an obstacle exists that the vehicle has not passed yet."""
    return np.isfinite(observation.gap) & (observation.gap > 0)


def moves_inwards(observation: Observation) -> BoolArray:
    """Return whether an obstacle moves towards the middle of the lane."""
    return np.sign(observation.lateral) * observation.lateral_speed < 0


def blocks_the_way(observation: Observation, corridor: float) -> BoolArray:
    """Return whether an obstacle has a side within `corridor` of the lane's middle [m], or moves
    towards the middle.
    """
    reach = corridor + observation.obstacle_width / 2
    is_inside = np.abs(observation.lateral) <= reach
    return is_inside | moves_inwards(observation)
