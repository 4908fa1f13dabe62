"""A driving system that holds the pedals: the encounters of a vehicle that nobody brakes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from safevar_sumo.ads import Ads
from safevar_sumo.records import (
    Command,
    FloatArray,
    Nominal,
    Observation,
    SimulationRuns,
)
from safevar_sumo.scenarios import Scenario
from safevar_sumo.sumo.matrix import drive_worst
from safevar_sumo.sumo.system import System
from tests.support.made_up import original_of, system_of

CARLA = system_of("sun")


class Hold(Ads):
    """Holds the pedals; from `brakes_at[i]` on [s], brakes vehicle i fully."""

    def __init__(self, brakes_at: FloatArray | None = None) -> None:
        self._brakes_at = np.inf if brakes_at is None else brakes_at

    def start(self, n: int, nominal: Nominal, step: float) -> Any:
        return None

    def drive(self, seen: Observation, memory: Any) -> tuple[Command, Any]:
        throttle, brake = memory = memory or (seen.throttle, seen.brake)
        brakes = np.broadcast_to(seen.time >= self._brakes_at, seen.speed.shape)
        return Command(
            np.where(brakes, 0.0, throttle), np.where(brakes, 1.0, brake)
        ), memory


class Pedals(Ads):
    """A driving system whose pedals are a function of the observation."""

    def __init__(self, pedals: Callable[[Observation], tuple[Any, Any]]) -> None:
        self._pedals = pedals

    def start(self, n: int, nominal: Nominal, step: float) -> None: ...

    def drive(self, seen: Observation, memory: None) -> tuple[Command, None]:
        throttle, brake = (
            np.zeros(len(seen.speed)) + value for value in self._pedals(seen)
        )
        return Command(throttle, brake), None


def driven(
    scenario: Scenario,
    ads: Any = None,
    settings: FloatArray | None = None,
    system: System = CARLA,
) -> SimulationRuns:
    """Simulates the original vehicle of a system, or settings, in a scenario; without an ADS, the
    vehicle keeps its speed.
    """
    alone = system.at(system.points[0]._replace(scenario=scenario))
    system = replace(alone, ads=ads or Hold())
    return drive_worst(
        system,
        original_of(system) if settings is None else settings,
    )


def at_contact(run: SimulationRuns, values: FloatArray) -> float:
    """The value when the bumper reaches the obstacle, interpolated linearly between two samples."""
    gap = run.trace.gap[:, 0]
    after = int(np.argmax(gap <= 1e-9))
    share = gap[after - 1] / (gap[after - 1] - gap[after])
    return float(values[after - 1] + share * (values[after] - values[after - 1]))
