"""An ADS from outside the package, and any ADS for one vehicle, held to its contract."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from safevar_sumo.ads.base import Ads, ScalarAds
from safevar_sumo.plugins import Contract, Guard, lent
from safevar_sumo.records import Command, FloatArray, Nominal, Observation

ADS_CONTRACT = Contract.of(Ads, "an ADS")
SCALAR_ADS_CONTRACT = Contract.of(ScalarAds, "a ScalarAds")


class GuardedAds:
    """Gives the ADS copies, checks what it commands, and keeps copies of that."""

    def __init__(self, ads: Ads, guard: Guard) -> None:
        self._ads, self._guard = ads, guard

    def start(self, n: int, nominal: Nominal, step: float) -> Any:
        return self._guard.call("start", self._ads.start, n, lent(nominal), step)

    def drive(self, seen: Observation, memory: Any) -> tuple[Command, Any]:
        given = self._guard.call("drive", self._ads.drive, lent(seen), memory)
        command, memory = self._guard.parts("drive", given, "(Command(throttle, brake), memory)")
        throttle, brake = self._guard.parts("drive", command, "(Command(throttle, brake), memory)")
        return Command(self._pedal("throttle", throttle, seen), self._pedal("brake", brake, seen)), memory

    def _pedal(self, name: str, value: Any, seen: Observation) -> FloatArray:
        return self._guard.numbers("drive", name, value, seen.speed.shape, 0.0, 1.0)


class PerVehicle:
    """Drives N vehicles with N instances of a `ScalarAds`."""

    def __init__(self, make: Callable[[], ScalarAds], guard: Guard) -> None:
        self._make, self._guard = make, guard

    def start(self, n: int, nominal: Nominal, step: float) -> list[ScalarAds]:
        drivers = [self._guard.call("__init__", self._make) for _ in range(n)]
        for driver in drivers:
            self._guard.call("start", driver.start, lent(nominal), step)
        return drivers

    def drive(self, seen: Observation, memory: list[ScalarAds]) -> tuple[Command, list[ScalarAds]]:
        pedals = np.empty((2, len(memory)))
        for i, driver in enumerate(memory):
            given = self._guard.call("drive", driver.drive, _one(seen, i))
            pair = self._guard.parts("drive", given, "(throttle, brake), each in [0, 1]")
            for place, name, value in zip(pedals, ("throttle", "brake"), pair, strict=True):
                place[i] = value if type(value) is float and 0 <= value <= 1 else self._guard.numbers("drive", name, value, (), 0.0, 1.0)
        return Command(*pedals), memory


def _one(seen: Observation, i: int) -> Observation:
    """What vehicle `i` sees, as plain numbers."""
    return Observation(*(float(value[i] if isinstance(value, np.ndarray) and value.ndim else value) for value in seen))  # type: ignore[arg-type]
