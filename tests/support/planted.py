"""A vehicle whose brakes are worn, and a driver who brakes fully at a gap: the border of collisions
is a formula.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.ads import Ads
from safevar_sumo.records import Command, FloatArray, Nominal, Observation
from safevar_sumo.scenarios.published import PedestrianCrossing
from safevar_sumo.vehicles import SumoType, Vehicle

BRAKING, PULL, GAP = 10.0, 3.0, 20.0
"""Deceleration of the new vehicle on a dry road and its acceleration [m/s^2]; gap at which the
driver brakes [m].
"""


class Slope(PedestrianCrossing, frozen=True, kw_only=True):
    """A user's scenario in which others may react."""

    grade: float = -2.0
    reactive_actors = True


class Prepared(NamedTuple):
    """Deceleration [m/s^2] and time step [s]."""

    braking: FloatArray
    step: float


class State(NamedTuple):
    """The state of N vehicles."""

    speed: FloatArray
    throttle: FloatArray
    brake: FloatArray
    gear: FloatArray


class Block(Vehicle):
    """A mass on wheels that roll without drag."""

    UNITS: Mapping[str, str] = {"brakes": "-"}

    def prepare(
        self, characteristics: Any, road_friction: Any, step: float, *_: Any
    ) -> Prepared:
        return Prepared(BRAKING * characteristics["brakes"] * road_friction, step)

    def sumo_type(self, prepared: Prepared) -> SumoType:
        one = np.ones_like(prepared.braking)
        return SumoType(1000 * one, PULL * one, prepared.braking, 60 * one, 0.01 * one)

    def at_rest(self, prepared: Prepared) -> State:
        return self.at_speed(prepared, np.zeros_like(prepared.braking))

    def at_speed(self, prepared: Prepared, speed: FloatArray) -> State:
        zero = np.zeros_like(speed)
        return State(speed, zero, zero, zero)

    def sense(
        self, prepared: Prepared, state: State, seen: Observation
    ) -> tuple[Observation, State]:
        return seen, state

    def advance(self, prepared: Prepared, state: State, command: Command) -> State:
        change = (
            PULL * command.throttle - prepared.braking * command.brake
        ) * prepared.step
        return State(
            np.maximum(state.speed + change, 0.0),
            command.throttle,
            command.brake,
            state.gear,
        )


class AtGap(Ads):
    """Brakes fully from a gap on."""

    def start(self, n: int, nominal: Nominal, step: float) -> None:
        return None

    def drive(self, seen: Observation, memory: None) -> tuple[Command, None]:
        brake = np.where(seen.gap <= GAP, 1.0, 0.0)
        return Command(np.zeros_like(brake), brake), None
