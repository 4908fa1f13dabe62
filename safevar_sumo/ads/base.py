"""The contract of an automated driving system, and the base of one that drives a single vehicle."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Any, Protocol

from msgspec import Meta

from safevar_sumo.records import Command, Nominal, Observation

Positive = Annotated[float, Meta(gt=0, le=1e3)]
"""A driver's parameter above 0, in SI units."""
NotNegative = Annotated[float, Meta(ge=0, le=1e3)]
"""One that may be 0."""


class Ads(Protocol):
    """An ADS that drives N vehicles at once. Its fields are the parameters of `ads.parameters`.

    It sees an `Observation` and knows the original vehicle (`Nominal`); no ADS sees the setting.
    Element i of a command depends on element i of the observations alone, to the bit.

    A class with `own_reactions = True` has a reaction time of its own: a weather's `recognition_delay` and `hesitation`,
    which were measured on another driver, do not act on it. Without the attribute they do.
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
    own_reactions = False

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
