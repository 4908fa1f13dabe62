"""Parts of several drivers: pedals for an acceleration, perception of an obstacle in the way, reaction to a danger, car following."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.records import GRAVITY, TIME_ROUNDING, BoolArray, Command, FloatArray, Nominal, Observation


def looked_up(speeds: FloatArray, speed: FloatArray, *tables: FloatArray) -> list[FloatArray]:
    """Tables over equally spaced speeds, interpolated linearly at `speed`."""
    place = np.minimum(speed / speeds[1], len(speeds) - 1.001)
    row = place.astype(np.intp)
    share, next_row = place - row, row + 1
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

    def delayed(self, now: FloatArray) -> tuple[FloatArray, DelayLine]:
        """The values of a delay ago, linear between two steps, and the next state; before the first step the first values hold."""
        past = (*(self.past[1:] or (now,) * (self.steps + 1)), now)
        before, after = past[0], past[1]
        if self.fraction:
            with np.errstate(invalid="ignore"):  # a value that appears or vanishes in between keeps its old value
                between = after + (before - after) * self.fraction
            after = between if np.count_nonzero(finite := np.isfinite(between)) == finite.size else np.where(finite, between, before)
        return after, DelayLine(self.steps, self.fraction, past)


class Trim(NamedTuple):
    """Pedal positions of a rolling vehicle beyond those that hold the original vehicle's speed on a level road [-]."""

    throttle: FloatArray
    brake: FloatArray


def trim(nominal: Nominal, seen: Observation) -> Trim:
    """The trim of a driver who already holds the speed of a rolling vehicle."""
    rolls = seen.speed > 0
    throttle = np.where(rolls, seen.throttle - _throttle(nominal, seen.speed, np.zeros_like(seen.speed)), 0.0)
    (coasting,) = looked_up(nominal.speeds, seen.speed, nominal.coasting)
    return Trim(throttle, np.where(rolls & (seen.brake > 0), seen.brake + coasting / nominal.braking, 0.0))


def pedals(nominal: Nominal, speed: FloatArray, acceleration: FloatArray, trimmed: Trim) -> Command:
    """Pedals for an acceleration [m/s^2] at a speed [m/s], from the tables of the original vehicle and a `trim`."""
    (coasting,) = looked_up(nominal.speeds, speed, nominal.coasting)
    beyond = acceleration + coasting - nominal.braking * trimmed.brake
    brake = np.minimum(np.maximum(-beyond / nominal.braking, 0.0), 1.0)
    throttle = np.minimum(np.maximum(_throttle(nominal, speed, acceleration) + trimmed.throttle, 0.0), 1.0)
    return Command(np.where(beyond < 0, 0.0, throttle), brake)


def _throttle(nominal: Nominal, speed: FloatArray, acceleration: FloatArray) -> FloatArray:
    coasting, full = looked_up(nominal.speeds, speed, nominal.coasting, nominal.full_throttle)
    return (acceleration + coasting) / (full + coasting)


SLOWEST_CLOSING = 0.1
"""Lower bound of a positive closing speed [m/s]; keeps times finite."""
FARTHEST = 1e6
"""Upper bound of gaps [m]; keeps times finite."""


def time_to_reach(seen: Observation) -> FloatArray:
    """Time to collision, gap over closing speed [s], shape (N,); `FARTHEST` while the gap does not shrink."""
    gap = np.minimum(np.maximum(seen.gap, 0.0), FARTHEST)
    return np.where(seen.closing_speed > 0, gap / np.maximum(seen.closing_speed, SLOWEST_CLOSING), FARTHEST)


def in_the_way(seen: Observation, corridor: float, reach: float = np.inf) -> BoolArray:
    """Whether a detected obstacle ahead is within `corridor` of the lane's middle [m], or will be when the vehicle reaches it.

    `reach` is the sensors' range in clear weather [m].
    """
    detected = np.isfinite(seen.gap) & (seen.gap <= reach * seen.visibility) & (seen.gap > 0)
    lateral = np.where(detected, seen.lateral, FARTHEST)
    lateral_then = lateral + seen.lateral_speed * time_to_reach(seen)
    return np.asarray(detected & ((np.abs(lateral) <= corridor) | (np.abs(lateral_then) <= corridor)))


def blocks_the_way(seen: Observation, corridor: float) -> BoolArray:
    """Whether a detected obstacle ahead that does not move away is within `corridor` of the lane's middle [m] or on its way there."""
    ahead = np.isfinite(seen.gap) & (seen.gap > 0) & (seen.closing_speed >= 0)
    return np.asarray(ahead & ((np.abs(seen.lateral) <= corridor) | (np.sign(seen.lateral) * seen.lateral_speed < 0)))


HARDEST = 0.774 * GRAVITY
"""Deceleration of the competent and careful driver [m/s^2] (UN R157, annex 4, appendix 3)."""
JERK = 12.65
"""Jerk limit of that deceleration [m/s^3] (ibid.)."""
CRUISE_GAIN = 1.0
"""Acceleration per speed error [1/s]."""
Start = tuple[Annotated[float, Meta(ge=0, le=1)], ...]
"""Throttle in the run's first steps, one value per step [-]: the replayed start of another driver."""


class Reaction(NamedTuple):
    """The original vehicle; time between calls [s]; speed to hold [m/s] and trim, both from the first observation.

    `waited` is the time since the danger was first seen, negative before [s]; `commanded` is the deceleration [m/s^2]; both shape (N,).
    """

    nominal: Nominal
    step: float
    held: tuple[FloatArray, Trim] | None
    waited: FloatArray
    commanded: FloatArray


def unaware(n: int, nominal: Nominal, step: float) -> Reaction:
    """The state before a danger appears."""
    return Reaction(nominal, step, None, np.full(n, -1.0), np.zeros(n))


def react(seen: Observation, reaction: Reaction, danger: BoolArray, deceleration: FloatArray, *, reaction_time: float, corridor: float,
          jerk: float = JERK, coasting_deceleration: float = 0.0, cruise_speed: float | None = None, start: Start = (),
          following: FloatArray | float = np.inf) -> tuple[Command, Reaction]:
    """Pedals of drivers who may face a danger; the danger is over when no obstacle ahead approaches or blocks the way.

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
    coasting_deceleration
        Deceleration during the reaction time [m/s^2].
    cruise_speed
        Speed to hold [m/s], by default the initial speed.
    start
        Throttle in the first steps without a danger.
    following
        Upper limit of the acceleration when following a leader, shape (N,) [m/s^2].
    """
    held = reaction.held
    if held is None:
        speed = seen.speed if cruise_speed is None else np.full_like(seen.speed, cruise_speed)
        held = speed, trim(reaction.nominal, seen)
    nears = np.isfinite(seen.gap) & (seen.gap > 0) & (seen.closing_speed > 0)
    lasts = nears | blocks_the_way(seen, corridor)
    aware = reaction.waited >= 0
    waited = np.where(aware, np.where(lasts, reaction.waited + reaction.step, -1.0), np.where(danger, 0.0, -1.0))
    brakes = waited >= reaction_time - TIME_ROUNDING
    commanded = np.where(brakes, np.minimum(reaction.commanded + jerk * reaction.step, deceleration), 0.0)
    holding = np.minimum(CRUISE_GAIN * (held[0] - seen.speed), following)
    acceleration = np.where(brakes, -commanded, np.where((waited >= 0) & (coasting_deceleration > 0), -coasting_deceleration, holding))
    command = pedals(reaction.nominal, seen.speed, acceleration, held[1])
    sample = round(seen.time / reaction.step)
    if sample < len(start):
        starts = waited < 0
        command = Command(np.where(starts, start[sample], command.throttle), np.where(starts, 0.0, command.brake))
    return command, reaction._replace(held=held, waited=waited, commanded=commanded)


class FollowingMemory(NamedTuple):
    """The original vehicle; time between calls [s]; trim of the pedals at the first observation."""

    nominal: Nominal
    step: float
    trimmed: Trim | None


class Following(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of car-following models: an acceleration from gap and speeds, converted to pedals.

    Obstacles beside the way are ignored.

    Parameters
    ----------
    corridor
        Half the width of its way [m].
    """

    corridor: float

    def start(self, n: int, nominal: Nominal, step: float) -> FollowingMemory:
        return FollowingMemory(nominal, step, None)

    def drive(self, seen: Observation, memory: FollowingMemory) -> tuple[Command, FollowingMemory]:
        trimmed = trim(memory.nominal, seen) if memory.trimmed is None else memory.trimmed
        gap = np.where(in_the_way(seen, self.corridor), seen.gap, FARTHEST)
        wanted = self.acceleration_at(gap, seen.speed, seen.obstacle_speed)
        return pedals(memory.nominal, seen.speed, wanted, trimmed), memory._replace(trimmed=trimmed)

    def acceleration_at(self, gap: FloatArray, speed: FloatArray, leader_speed: FloatArray) -> FloatArray:
        """Commanded acceleration [m/s^2] at a gap from bumper to bumper [m] and speeds [m/s], shape (N,)."""
        raise NotImplementedError
