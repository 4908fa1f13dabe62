"""An ADS with other parameters in each vehicle, and the parameters that a repair may change."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import force_setattr

from safevar_sumo.ads.base import Ads, Memory, PerVehicleAds
from safevar_sumo.records import BoolArray, Command, FloatArray, Nominal, Observation
from safevar_sumo.shipped import shipped_table
from safevar_sumo.study import FreeParameter

CHANGEABLE = msgspec.convert(
    shipped_table("ads/changeable.toml"), dict[str, dict[str, FreeParameter]]
)
"""The parameters that a repair may change, by the name of the shipped ADS and of the parameter. The
file changeable.toml beside this module has them.
"""


class VariedAds(Ads):
    """An ADS with other values of some parameters in each vehicle.

    Parameters
    ----------
    ads
        The ADS with the study's parameters.
    names
        Names of the parameters that vary.
    values
        Values of these parameters, shape (m, number of names). N vehicles consist of N / m groups.
        Vehicle i of each group has row i.

    Notes
    -----
    A driving system that drives all vehicles at once gets an array of N values in each varied
    field. It must compute with the field value by value. Constants of the driving system, such as
    `max_vehicles`, are not read from this object.
    """

    def __init__(self, ads: Ads, names: tuple[str, ...], values: FloatArray) -> None:
        self._ads = ads
        self._names = names
        self._values = values
        self.tau_parameter = ads.tau_parameter

    def with_another(self, name: str, column: FloatArray) -> VariedAds:
        """The same ADS in which one more parameter varies. `column` has its value in each of N
        vehicles, shape (N,).
        """
        groups = len(column) // len(self._values)
        values = np.column_stack([np.tile(self._values, (groups, 1)), column])
        return VariedAds(self._ads, (*self._names, name), values)

    def start(self, n: int, nominal: Nominal, step: float) -> Memory:
        columns = [np.tile(column, n // len(column)) for column in self._values.T]
        varied: Any = copy.copy(self._ads)
        if isinstance(varied, PerVehicleAds):
            drivers = varied.start(n, nominal, step)
            for name, column in zip(self._names, columns, strict=True):
                for driver, value in zip(drivers, column.tolist(), strict=True):
                    setattr(driver, name, value)
            return varied, drivers
        # Frozen records refuse new values of their fields, unless msgspec sets the values.
        set_field: Callable[..., None] = object.__setattr__
        if isinstance(varied, msgspec.Struct):
            set_field = force_setattr
        for name, column in zip(self._names, columns, strict=True):
            set_field(varied, name, column)
        return varied, varied.start(n, nominal, step)

    def drive(self, observation: Observation, memory: Memory) -> tuple[Command, Memory]:
        varied, memory_of_varied = memory
        command, memory_of_varied = varied.drive(observation, memory_of_varied)
        return command, (varied, memory_of_varied)

    def warns(self, memory: Memory) -> BoolArray | None:
        varied, memory_of_varied = memory
        warned: BoolArray | None = varied.warns(memory_of_varied)
        return warned


def with_tau(ads: Ads, tau: FloatArray | None) -> Ads:
    """The ADS with the headways `tau` of N vehicles [s]. An ADS without a parameter for the headway
    stays.
    """
    if tau is None or not ads.tau_parameter:
        return ads
    if not isinstance(ads, VariedAds):
        return VariedAds(ads, (ads.tau_parameter,), tau[:, np.newaxis])
    return ads.with_another(ads.tau_parameter, tau)
