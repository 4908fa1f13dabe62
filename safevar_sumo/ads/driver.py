"""Functions that drivers share: pedals for an acceleration, perception of an obstacle in the way, reaction to a danger,
car following.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.ads.base import Ads
from safevar_sumo.records import GRAVITY, TIME_ROUNDING, BoolArray, Command, FloatArray, Nominal, Observation


def interpolate_tables(table_speeds: FloatArray, speed: FloatArray, *tables: FloatArray) -> list[FloatArray]:
    """Tables over equally spaced speeds, interpolated linearly at `speed`."""
    position = np.minimum(speed / table_speeds[1], len(table_speeds) - 1.001)
    row = position.astype(np.intp)
    share, next_row = position - row, row + 1
    values = ((table[row], table[next_row]) for table in tables)
    return [low + (high - low) * share for low, high in values]


STEP_DECIMALS = 6
"""Decimals to which a delay in steps is rounded, so that a whole number of steps is exact."""


class DelayLine(NamedTuple):
    """A delay line: the delay as `steps` and a `fraction` of a step, and the past values, oldest first."""

    steps: int
    fraction: float
    past: tuple[FloatArray, ...] = ()

    @classmethod
    def by(cls, delay: float, step: float) -> DelayLine:
        """The delay line for a delay [s] at a time step [s]."""
        steps, fraction = divmod(round(delay / step, STEP_DECIMALS), 1)
        return cls(int(steps), fraction)

    def delayed(self, values: FloatArray) -> tuple[FloatArray, DelayLine]:
        """The values one delay ago, linear between two steps, and the next delay line; before the first step the first
        values hold.
        """
        past = (*(self.past[1:] or (values,) * (self.steps + 1)), values)
        older, newer = past[0], past[1]
        if self.fraction:
            with np.errstate(
                invalid="ignore"
            ):  # a value that appears or vanishes between two steps keeps its old value
                mixture = newer + (older - newer) * self.fraction
            newer = (
                mixture
                if np.count_nonzero(finite := np.isfinite(mixture)) == finite.size
                else np.where(finite, mixture, older)
            )
        return newer, DelayLine(self.steps, self.fraction, past)


class Trim(NamedTuple):
    """Pedal positions of a rolling vehicle minus the positions that hold the original vehicle's speed on a level road
    [-].
    """

    throttle: FloatArray
    brake: FloatArray


def trim_at(nominal: Nominal, seen: Observation) -> Trim:
    """The trim of a driver who already holds the speed of a rolling vehicle."""
    is_rolling = seen.speed > 0
    throttle = np.where(is_rolling, seen.throttle - _throttle_for(nominal, seen.speed, np.zeros_like(seen.speed)), 0.0)
    (coasting,) = interpolate_tables(nominal.speeds, seen.speed, nominal.coasting)
    return Trim(throttle, np.where(is_rolling & (seen.brake > 0), seen.brake + coasting / nominal.braking, 0.0))


def pedals_for(nominal: Nominal, speed: FloatArray, acceleration: FloatArray, pedal_trim: Trim) -> Command:
    """Pedals for an acceleration [m/s^2] at a speed [m/s], from the tables of the original vehicle and a trim."""
    (coasting,) = interpolate_tables(nominal.speeds, speed, nominal.coasting)
    excess = acceleration + coasting - nominal.braking * pedal_trim.brake
    brake = np.minimum(np.maximum(-excess / nominal.braking, 0.0), 1.0)
    throttle = np.minimum(np.maximum(_throttle_for(nominal, speed, acceleration) + pedal_trim.throttle, 0.0), 1.0)
    return Command(np.where(excess < 0, 0.0, throttle), brake)


def _throttle_for(nominal: Nominal, speed: FloatArray, acceleration: FloatArray) -> FloatArray:
    coasting, full_throttle = interpolate_tables(nominal.speeds, speed, nominal.coasting, nominal.full_throttle)
    return (acceleration + coasting) / (full_throttle + coasting)


LEAST_CLOSING_SPEED = 0.1
"""Lower bound of a positive closing speed [m/s]; keeps times finite."""
LARGEST_GAP = 1e6
"""Upper bound of gaps [m], also the time [s] or lateral position [m] without an obstacle; keeps them finite."""


def time_to_reach(seen: Observation) -> FloatArray:
    """Time to collision, gap over closing speed [s], shape (N,); `LARGEST_GAP` while the gap does not shrink."""
    gap = np.minimum(np.maximum(seen.gap, 0.0), LARGEST_GAP)
    return np.where(seen.closing_speed > 0, gap / np.maximum(seen.closing_speed, LEAST_CLOSING_SPEED), LARGEST_GAP)


def is_in_the_way(seen: Observation, corridor: float, reach: float = np.inf) -> BoolArray:
    """Whether a detected obstacle ahead is within `corridor` of the lane's middle [m], or will be when the vehicle
    reaches it.

    `reach` is the sensors' range in clear weather [m].
    """
    is_detected = np.isfinite(seen.gap) & (seen.gap <= reach * seen.visibility) & (seen.gap > 0)
    lateral = np.where(is_detected, seen.lateral, LARGEST_GAP)
    lateral_at_arrival = lateral + seen.lateral_speed * time_to_reach(seen)
    return np.asarray(is_detected & ((np.abs(lateral) <= corridor) | (np.abs(lateral_at_arrival) <= corridor)))


def blocks_the_way(seen: Observation, corridor: float) -> BoolArray:
    """Whether a detected obstacle ahead that does not move away is within `corridor` of the lane's middle [m] or on its
    way there.
    """
    is_ahead = np.isfinite(seen.gap) & (seen.gap > 0) & (seen.closing_speed >= 0)
    return np.asarray(
        is_ahead & ((np.abs(seen.lateral) <= corridor) | (np.sign(seen.lateral) * seen.lateral_speed < 0))
    )


HARDEST_BRAKING = 0.774 * GRAVITY
"""Deceleration of the competent and careful driver [m/s^2] (UN R157, annex 4, appendix 3)."""
JERK = 12.65
"""Jerk limit while that deceleration builds up [m/s^3] (UN R157, annex 4, appendix 3)."""
CRUISE_GAIN = 1.0
"""Acceleration per speed error [1/s]."""
StartThrottle = tuple[Annotated[float, Meta(ge=0, le=1)], ...]
"""Throttle in the run's first steps, one value per step [-]: the replayed start of another driver."""


class Reaction(NamedTuple):
    """The original vehicle; time between calls [s]; speed to hold [m/s], trim and brake pedal [-], as first observed.

    `speed` is that of the last call [m/s], `danger_time` the time since the danger was first seen [s], negative before;
    `coasting` is the deceleration that the driver felt before braking, `braking` the intended one [m/s^2]. Shape (N,).
    """

    nominal: Nominal
    step: float
    cruise: tuple[FloatArray, Trim, FloatArray] | None
    speed: FloatArray
    danger_time: FloatArray
    coasting: FloatArray
    braking: FloatArray


def initial_reaction(n: int, nominal: Nominal, step: float) -> Reaction:
    """The state before a danger appears."""
    return Reaction(nominal, step, None, np.zeros(n), np.full(n, -1.0), np.zeros(n), np.zeros(n))


def react(
    seen: Observation,
    reaction: Reaction,
    danger: BoolArray,
    deceleration: FloatArray,
    *,
    reaction_time: float,
    corridor: float,
    jerk: float = JERK,
    cruise_speed: float | None = None,
    start: StartThrottle = (),
    following: FloatArray | float = np.inf,
) -> tuple[Command, Reaction]:
    """Drive on, or react to a danger: release the accelerator, and brake when the reaction time is over.

    The danger is over when no obstacle ahead approaches or blocks the way. The original vehicle's tables were written
    in other gears. So a driver who reacts uses the felt deceleration: the brake adds what coasting lacks.

    Parameters
    ----------
    danger
        Whether the driver sees a danger now; shape (N,).
    deceleration
        Deceleration after the reaction time, shape (N,) [m/s^2]; it rises at `jerk` [m/s^3].
    reaction_time
        Time from the first sight of the danger to braking [s].
    corridor
        Half the width of the way [m].
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    start
        Throttle in the first steps without a danger.
    following
        Upper limit of the acceleration when following a leader, shape (N,) [m/s^2].
    """
    nominal, step, cruise, last_speed = reaction[:4]
    if cruise is None:
        last_speed, speed = seen.speed, seen.speed if cruise_speed is None else np.full_like(seen.speed, cruise_speed)
        cruise = speed, trim_at(nominal, seen), seen.brake
    speed_to_hold, initial_trim, initial_brake = cruise
    is_approaching = np.isfinite(seen.gap) & (seen.gap > 0) & (seen.closing_speed > 0)
    danger_lasts = is_approaching | blocks_the_way(seen, corridor)
    is_aware, was_braking = reaction.danger_time >= 0, reaction.danger_time >= reaction_time - TIME_ROUNDING
    is_reacting = np.where(is_aware, danger_lasts, danger)
    danger_time = np.where(is_reacting, np.where(is_aware, reaction.danger_time + step, 0.0), -1.0)
    is_braking = danger_time >= reaction_time - TIME_ROUNDING
    coasting = np.where(was_braking, reaction.coasting, np.maximum((last_speed - seen.speed) / step, 0.0))
    braking = np.where(is_braking, np.minimum(np.maximum(reaction.braking, coasting) + jerk * step, deceleration), 0.0)
    brake = np.minimum(initial_brake + np.maximum(braking - coasting, 0.0) / nominal.braking, 1.0)
    if (step_index := round(seen.time / step)) < len(start):
        calm = Command(np.full_like(brake, start[step_index]), np.zeros_like(brake))
    else:
        acceleration = np.minimum(CRUISE_GAIN * (speed_to_hold - seen.speed), following)
        calm = pedals_for(nominal, seen.speed, acceleration, initial_trim)
    command = Command(np.where(is_reacting, 0.0, calm.throttle), np.where(is_reacting, brake, calm.brake))
    return command, Reaction(nominal, step, cruise, seen.speed, danger_time, coasting, braking)


class FollowingMemory(NamedTuple):
    """The original vehicle; time between calls [s]; trim of the pedals at the first observation."""

    nominal: Nominal
    step: float
    initial_trim: Trim | None


class CarFollowing(Ads, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of car-following models: an acceleration from gap and speeds, converted to pedals.

    They ignore obstacles beside the way.

    Parameters
    ----------
    corridor
        Half the width of the way [m].
    """

    corridor: float

    def start(self, n: int, nominal: Nominal, step: float) -> FollowingMemory:
        return FollowingMemory(nominal, step, None)

    def drive(self, seen: Observation, memory: FollowingMemory) -> tuple[Command, FollowingMemory]:
        initial_trim = trim_at(memory.nominal, seen) if memory.initial_trim is None else memory.initial_trim
        gap = np.where(is_in_the_way(seen, self.corridor), seen.gap, LARGEST_GAP)
        acceleration = self.acceleration_at(gap, seen.speed, seen.obstacle_speed)
        return pedals_for(memory.nominal, seen.speed, acceleration, initial_trim), memory._replace(
            initial_trim=initial_trim
        )

    def acceleration_at(self, gap: FloatArray, speed: FloatArray, leader_speed: FloatArray) -> FloatArray:
        """Commanded acceleration [m/s^2] at a gap from bumper to bumper [m] and speeds [m/s], shape (N,)."""
        raise NotImplementedError
