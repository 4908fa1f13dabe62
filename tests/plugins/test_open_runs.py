"""What a model does after its vehicle's own run has ended, while others in the batch still drive, is neither checked
nor an error.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from safevar_sumo.ads import Ads, PerVehicleAds, ScalarAds
from safevar_sumo.errors import InputError
from safevar_sumo.plugins import Guard
from safevar_sumo.records import Command, Evaluations, Nominal, Observation
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import evaluate, simulate
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.vehicles import GuardedVehicle

NATIVE = assemble(load_study("native"))
GUARD = Guard("it.toml", "vehicle.model = 'mine:Mine'")
ORIGINAL = NATIVE.characteristics.original
MASS = NATIVE.characteristics.names.index("mass")
HEAVY = np.where(np.arange(len(ORIGINAL)) == MASS, 1700.0, ORIGINAL)


class Brakes(Ads):
    """Full throttle; a vehicle brakes if it is the light one of two."""

    def start(self, n: int, nominal: Nominal, step: float) -> None:
        return None

    def drive(self, seen: Observation, memory: Any) -> tuple[Command, Any]:
        brakes = (np.arange(len(seen.speed)) > 0) & (seen.time > 1)
        return Command(np.where(brakes, 0.05, 1.0), np.zeros(len(seen.speed))), memory


class Diverges:
    """The heavy vehicle has this speed from so many steps on."""

    def __init__(self, steps: int, speed: float) -> None:
        self._inner, self.steps, self.speed = NATIVE.vehicle, steps, speed

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def prepare(self, characteristics: Any, *arguments: Any) -> Any:
        self._is_heavy, self._calls = characteristics["mass"] == HEAVY[MASS], 0
        return self._inner.prepare(characteristics, *arguments)

    def advance(self, prepared: Any, state: Any, command: Command) -> Any:
        self._calls += 1
        result = self._inner.advance(prepared, state, command)
        return result._replace(speed=np.where(self._is_heavy & (self._calls >= self.steps), self.speed, result.speed))


def systems(steps: int, speed: float) -> list[System]:
    """A shipped vehicle that diverges, and a user's."""
    shipped = Diverges(steps, speed)
    guarded = GuardedVehicle(Diverges(steps, speed), GUARD)
    return [
        replace(NATIVE, ads=Brakes(), vehicle=vehicle)
        for vehicle in ([shipped, guarded] if np.isnan(speed) else [guarded])
    ]


def bits(evaluations: Evaluations) -> list[bytes]:
    return [evaluations.collision_speed.tobytes(), *(values.tobytes() for values in evaluations.metrics.values())]


LENGTH = len(simulate(replace(NATIVE, ads=Brakes()), HEAVY[np.newaxis]).trace.time)
BOTH = np.stack([HEAVY, ORIGINAL])


@pytest.mark.parametrize("speed", [np.nan, -3.0, 900.0, 5000.0])
def test_a_vehicle_that_diverges_after_its_own_collision_has_the_result_that_it_has_alone(speed: float) -> None:
    for system in systems(LENGTH, speed):
        alone, together = evaluate(system, BOTH[:1]), evaluate(system, BOTH)
        assert len(simulate(system, BOTH).trace.time) > LENGTH, "the other vehicle drives longer"
        assert bits(together.take([0])) == bits(alone)
        assert alone.collided.all()


@pytest.mark.parametrize("speed", [np.nan, -3.0, 900.0, 5000.0])
def test_a_vehicle_that_diverges_before_its_end_is_an_error_in_every_batch(speed: float) -> None:
    for system in systems(LENGTH - 1, speed):
        for settings in (BOTH[:1], BOTH):
            with pytest.raises(InputError, match=f"speed (is|=) {speed}".replace(".", r"\.")):
                evaluate(system, settings)


class Ends(ScalarAds):
    """Drives one vehicle, and fails when it is called after its collision."""

    has_collided = False

    def drive(self, seen: Any) -> tuple[float, float]:
        if self.has_collided:
            raise ValueError("the drive is over")
        self.has_collided = seen.gap < 0
        return 1.0, 0.0


def test_an_ads_for_one_vehicle_is_not_asked_after_the_end() -> None:
    system = replace(NATIVE, ads=PerVehicleAds(Ends, GUARD))
    slow = np.where(np.arange(len(ORIGINAL)) == NATIVE.characteristics.names.index("accel"), 2.0, ORIGINAL)
    settings = np.stack([ORIGINAL, slow])
    assert bits(evaluate(system, settings).take([0])) == bits(evaluate(system, settings[:1]))
