"""Pedals for the acceleration that a driver wants, from the tables of the original vehicle."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.records import Command, FloatArray, Nominal, Observation


def looked_up(speeds: FloatArray, speed: FloatArray, *tables: FloatArray) -> list[FloatArray]:
    """Tables over equally spaced speeds, interpolated linearly at `speed`."""
    place = np.minimum(speed / speeds[1], len(speeds) - 1.001)
    row = place.astype(np.intp)
    share, next_row = place - row, row + 1
    values = ((table[row], table[next_row]) for table in tables)
    return [here + (there - here) * share for here, there in values]


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
