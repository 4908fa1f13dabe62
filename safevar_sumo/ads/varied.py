"""An ADS whose parameters differ from vehicle to vehicle, and the parameters that a repair may change."""

from __future__ import annotations

import copy
import tomllib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import force_setattr

from safevar_sumo.ads.base import Ads, GuardedAds, Memory, PerVehicleAds
from safevar_sumo.records import BoolArray, Command, FloatArray, Nominal, Observation
from safevar_sumo.study.schema import FreeParameter

CHANGEABLE = msgspec.convert(
    tomllib.loads(Path(__file__).with_name("changeable.toml").read_text(encoding="utf-8")),
    dict[str, dict[str, FreeParameter]],
)
"""Parameters that a repair may change, by shipped ADS and name: changeable.toml beside this module."""


class VariedAds(Ads):
    """An ADS with own values of some `names` for each vehicle: `values` has shape (m, number of names).

    With K points, vehicle i of each group of m has row i.
    """

    def __init__(self, ads: Ads, names: tuple[str, ...], values: FloatArray) -> None:
        self._ads, self._names, self._values = ads, names, values

    def start(self, n: int, nominal: Nominal, step: float) -> Memory:
        columns = [np.tile(column, n // len(column)) for column in self._values.T]
        own: Any = copy.copy(self._ads)
        if isinstance(own, PerVehicleAds):
            drivers = own.start(n, nominal, step)
            for name, column in zip(self._names, columns, strict=True):
                for driver, value in zip(drivers, column.tolist(), strict=True):
                    setattr(driver, name, value)
            return own, drivers
        model = own
        if isinstance(own, GuardedAds):
            model = own._ads = copy.copy(own._ads)
        for name, column in zip(self._names, columns, strict=True):
            (force_setattr if isinstance(model, msgspec.Struct) else object.__setattr__)(model, name, column)
        return own, own.start(n, nominal, step)

    def drive(self, seen: Observation, memory: Memory) -> tuple[Command, Memory]:
        own, inner = memory
        command, inner = own.drive(seen, inner)
        return command, (own, inner)

    def warns(self, memory: Memory) -> BoolArray | None:
        own, inner = memory
        warned: BoolArray | None = own.warns(inner)
        return warned
