"""Functions that drivers share: delays, pedals for an acceleration, and perception of an obstacle in the way."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.records import BoolArray, Command, FloatArray, Nominal, Observation


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
