"""An ADS from outside the package, and any ADS for one vehicle, held to its contract."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import repeat
from typing import Any

import numpy as np

from safevar_sumo.ads.base import Ads, ScalarAds
from safevar_sumo.plugins import Contract, Guard, read_only_copy
from safevar_sumo.records import Command, FloatArray, Nominal, Observation

ADS_CONTRACT = Contract.of(Ads, "an ADS")
SCALAR_ADS_CONTRACT = Contract.of(ScalarAds, "a ScalarAds")


class GuardedAds:
    """Gives the ADS copies, checks what it commands, and keeps copies of that."""

    def __init__(self, ads: Ads, guard: Guard) -> None:
        self._ads, self._guard = ads, guard
        self.own_reactions = bool(getattr(ads, "own_reactions", False))

    def start(self, n: int, nominal: Nominal, step: float) -> Any:
        return self._guard.call("start", self._ads.start, n, read_only_copy(nominal), step)

    def drive(self, seen: Observation, memory: Any) -> tuple[Command, Any]:
        given = self._guard.call("drive", self._ads.drive, read_only_copy(seen), memory)
        command, memory = self._guard.parts("drive", given, "(Command(throttle, brake), memory)")
        throttle, brake = self._guard.parts("drive", command, "(Command(throttle, brake), memory)")
        return Command(self._pedal("throttle", throttle, seen), self._pedal("brake", brake, seen)), memory

    def _pedal(self, name: str, value: Any, seen: Observation) -> FloatArray:
        return self._guard.numbers("drive", name, value, seen.speed.shape, 0.0, 1.0)


class PerVehicle:
    """Drives N vehicles with N instances of a `ScalarAds`."""

    def __init__(self, make: Callable[[], ScalarAds], guard: Guard, own_reactions: bool = False) -> None:
        self._make, self._guard, self.own_reactions = make, guard, own_reactions

    def start(self, n: int, nominal: Nominal, step: float) -> list[ScalarAds]:
        drivers = [self._guard.call("__init__", self._make) for _ in range(n)]
        for driver in drivers:
            self._guard.call("start", driver.start, read_only_copy(nominal), step)
        return drivers

    def drive(self, seen: Observation, memory: list[ScalarAds]) -> tuple[Command, list[ScalarAds]]:
        pedals = [self._pedals(self._guard.call("drive", driver.drive, one)) for driver, one in zip(memory, _each(seen), strict=True)]
        return Command(*np.array(pedals, dtype=float).reshape(len(memory), 2).T.copy()), memory

    def _pedals(self, given: Any) -> tuple[float, float]:
        if type(given) is tuple and len(given) == 2:
            throttle, brake = given
            if type(throttle) is type(brake) is float and 0 <= throttle <= 1 and 0 <= brake <= 1:
                return throttle, brake  # nearly always: this is called for every vehicle in every step
        throttle, brake = self._guard.parts("drive", given, "(throttle, brake), each in [0, 1]")
        return self._pedal("throttle", throttle), self._pedal("brake", brake)

    def _pedal(self, name: str, value: Any) -> float:
        return float(self._guard.numbers("drive", name, value, (), 0.0, 1.0))


def _each(seen: Observation) -> Iterator[Observation]:
    """What each vehicle sees, as plain numbers."""
    columns = [value.tolist() if isinstance(value, np.ndarray) and value.ndim else repeat(float(value)) for value in seen]
    return map(Observation._make, zip(*columns, strict=False))
