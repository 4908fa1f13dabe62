"""A driving system that keeps the pedals, so that tests see what a vehicle meets without a reaction."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from safevar_sumo.records import Command, FloatArray, Nominal, Observation, SimulationRuns
from safevar_sumo.scenarios import Scenario
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import simulate
from safevar_sumo.sumo.system import System, assemble

CARLA = assemble(load_study("sun"))
NATIVE = assemble(load_study("native"))


class Hold:
    """Keeps the pedals where they are; brakes vehicle i fully from `brakes_at[i]` on [s]."""

    def __init__(self, brakes_at: FloatArray | None = None) -> None:
        self._brakes_at = np.inf if brakes_at is None else brakes_at

    def start(self, n: int, nominal: Nominal, step: float) -> Any:
        return None

    def drive(self, seen: Observation, memory: Any) -> tuple[Command, Any]:
        throttle, brake = memory = memory or (seen.throttle, seen.brake)
        brakes = np.broadcast_to(seen.time >= self._brakes_at, seen.speed.shape)
        return Command(np.where(brakes, 0.0, throttle), np.where(brakes, 1.0, brake)), memory


def driven(scenario: Scenario, ads: Any = None, settings: FloatArray | None = None, system: System = CARLA) -> SimulationRuns:
    """Simulate the original vehicle of CARLA, or settings, in a scenario; an ADS holds the pedals unless another ADS is given."""
    system = replace(system, scenario=scenario, ads=ads or Hold())
    return simulate(system, system.characteristics.original[np.newaxis] if settings is None else settings)


def at_contact(run: SimulationRuns, values: FloatArray, vehicle: int = 0) -> float:
    """A value at the time when the bumper reaches the obstacle, interpolated between the two nearest samples."""
    gap = run.trace.gap[:, vehicle]
    after = int(np.argmax(gap <= 1e-9))
    share = gap[after - 1] / (gap[after - 1] - gap[after])
    return float(values[after - 1] + share * (values[after] - values[after - 1]))
