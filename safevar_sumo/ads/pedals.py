"""From the acceleration that a driver wants to the pedals, through what is known of the original vehicle."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.records import Command, FloatArray, Nominal, Observation


def looked_up(table: FloatArray, speeds: FloatArray, speed: FloatArray) -> FloatArray:
    """Linear between the rows of a table over equally spaced speeds."""
    place = np.minimum(speed / speeds[1], len(speeds) - 1.001)
    row = place.astype(np.intp)
    return np.asarray(table[row] + (table[row + 1] - table[row]) * (place - row))


class Trim(NamedTuple):
    """How much farther the pedals of a rolling vehicle stand than the original's would on a level road to hold its speed [-]."""

    throttle: FloatArray
    brake: FloatArray


def trim(nominal: Nominal, seen: Observation) -> Trim:
    """Who has driven at a speed for a while has found the pedals that hold it."""
    rolls = seen.speed > 0
    throttle = np.where(rolls, seen.throttle - _throttle(nominal, seen.speed, np.zeros_like(seen.speed)), 0.0)
    coasts = looked_up(nominal.coasting, nominal.speeds, seen.speed) / nominal.braking
    return Trim(throttle, np.where(rolls & (seen.brake > 0), seen.brake + coasts, 0.0))


def pedals(nominal: Nominal, speed: FloatArray, acceleration: FloatArray, trimmed: Trim) -> Command:
    """Pedals for an acceleration [m/s^2] at a speed [m/s], from the tables of the original vehicle and a `trim`."""
    beyond = acceleration + looked_up(nominal.coasting, nominal.speeds, speed) - nominal.braking * trimmed.brake
    brake = np.minimum(np.maximum(-beyond / nominal.braking, 0.0), 1.0)
    throttle = np.minimum(np.maximum(_throttle(nominal, speed, acceleration) + trimmed.throttle, 0.0), 1.0)
    return Command(np.where(beyond < 0, 0.0, throttle), brake)


def _throttle(nominal: Nominal, speed: FloatArray, acceleration: FloatArray) -> FloatArray:
    coasting = looked_up(nominal.coasting, nominal.speeds, speed)
    return (acceleration + coasting) / (looked_up(nominal.full_throttle, nominal.speeds, speed) + coasting)
