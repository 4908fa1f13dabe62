"""From the acceleration that a driver wants to the pedals, through what is known of the original vehicle."""

from __future__ import annotations

import numpy as np

from safevar_sumo.records import Command, FloatArray, Nominal, Observation


def looked_up(table: FloatArray, speeds: FloatArray, speed: FloatArray) -> FloatArray:
    """Linear between the rows of a table over equally spaced speeds."""
    place = np.minimum(speed / speeds[1], len(speeds) - 1.001)
    row = place.astype(np.intp)
    return np.asarray(table[row] + (table[row + 1] - table[row]) * (place - row))


def trim(nominal: Nominal, seen: Observation) -> FloatArray:
    """How much farther the accelerator of a rolling vehicle stands than the original's would to hold its speed [-].

    Who has driven at a speed for a while has found the pedal that holds it.
    """
    return np.where(seen.speed > 0, seen.throttle - _throttle(nominal, seen.speed, np.zeros_like(seen.speed)), 0.0)


def pedals(nominal: Nominal, speed: FloatArray, acceleration: FloatArray, trimmed: FloatArray) -> Command:
    """Pedals for an acceleration [m/s^2] at a speed [m/s], from the tables of the original vehicle and a `trim`."""
    beyond = acceleration + looked_up(nominal.coasting, nominal.speeds, speed)
    brake = np.minimum(np.maximum(-beyond / nominal.braking, 0.0), 1.0)
    throttle = np.minimum(np.maximum(_throttle(nominal, speed, acceleration) + trimmed, 0.0), 1.0)
    return Command(np.where(beyond < 0, 0.0, throttle), brake)


def _throttle(nominal: Nominal, speed: FloatArray, acceleration: FloatArray) -> FloatArray:
    coasting = looked_up(nominal.coasting, nominal.speeds, speed)
    return (acceleration + coasting) / (looked_up(nominal.full_throttle, nominal.speeds, speed) + coasting)
