"""The contract of an automated driving system, and the adapter for one that drives a single vehicle."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from safevar_sumo.errors import InputError, told
from safevar_sumo.records import Command, FloatArray, Nominal, Observation


class Ads(Protocol):
    """An ADS that drives N vehicles at once. Its fields are the parameters of `ads.parameters`.

    It sees an `Observation` and knows the original vehicle (`Nominal`); no ADS sees the setting.
    Element i of a command depends on element i of the observations alone, to the bit.
    """

    def start(self, n: int, nominal: Nominal, step: float) -> Any:
        """Memory at the start of a run of `n` vehicles with `step` seconds between two calls of `drive`."""

    def drive(self, seen: Observation, memory: Any) -> tuple[Command, Any]:
        """Command the pedals for the coming step; returns the memory to pass in at the next one."""


class ScalarAds(ABC):
    """Base of an ADS that is written for one vehicle; every simulated vehicle gets an instance of its own.

    A study names it as `package.module:Name`; its parameters are the arguments of `__init__`.
    """

    nominal: Nominal
    step: float

    def start(self, nominal: Nominal, step: float) -> None:
        """Called once before the run; keeps what is known of the original vehicle and the time between two calls.

        Parameters
        ----------
        nominal
            What is known of the original vehicle.
        step
            Time between two calls of `drive` [s].
        """
        self.nominal, self.step = nominal, step

    @abstractmethod
    def drive(self, seen: Observation) -> tuple[float, float]:
        """Command throttle and brake, each in [0, 1], from an observation whose fields are numbers."""


class PerVehicle:
    """Drives N vehicles with N instances of a `ScalarAds`."""

    def __init__(self, make: Callable[[], ScalarAds]) -> None:
        self._make = make

    def start(self, n: int, nominal: Nominal, step: float) -> list[ScalarAds]:
        drivers = [self._make() for _ in range(n)]
        for driver in drivers:
            driver.start(nominal, step)
        return drivers

    def drive(self, seen: Observation, memory: list[ScalarAds]) -> tuple[Command, list[ScalarAds]]:
        pedals = [driver.drive(_one(seen, i)) for i, driver in enumerate(memory)]
        throttle, brake = np.array(pedals, dtype=float).reshape(len(memory), 2).T
        return Command(throttle, brake), memory


class Checked:
    """Wraps an ADS from outside the package: whatever it does wrong is told with its name."""

    def __init__(self, ads: Ads, source: object, name: str) -> None:
        self._ads, self._source, self._name = ads, source, name

    def start(self, n: int, nominal: Nominal, step: float) -> Any:
        try:
            return self._ads.start(n, nominal, step)
        except (Exception, SystemExit, GeneratorExit) as error:
            raise self._failed("start", error) from error

    def drive(self, seen: Observation, memory: Any) -> tuple[Command, Any]:
        try:
            command, memory = self._ads.drive(seen, memory)
            pedals = {name: np.broadcast_to(np.asarray(value, dtype=float), seen.speed.shape)
                      for name, value in zip(("throttle", "brake"), command, strict=True)}
        except (Exception, SystemExit, GeneratorExit) as error:
            raise self._failed("drive", error) from error
        for name, values in pedals.items():
            self._check(name, values)
        return Command(**pedals), memory

    def _check(self, pedal: str, values: FloatArray) -> None:
        wrong = values[~((values >= 0) & (values <= 1))]
        if wrong.size:
            raise InputError(self._source, f"ads.model = {self._name!r} commanded {pedal} = {wrong[0]}", "a number in [0, 1]")

    def _failed(self, call: str, error: BaseException) -> InputError:
        return InputError(self._source, f"ads.model = {self._name!r} raised in {call}: {told(error)}")


def _one(seen: Observation, i: int) -> Observation:
    """What vehicle `i` sees, as plain numbers."""
    return Observation(*(float(value[i] if isinstance(value, np.ndarray) and value.ndim else value) for value in seen))  # type: ignore[arg-type]
