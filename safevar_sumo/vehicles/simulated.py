"""A vehicle that a simulator of the user's own moves and drives: here it has characteristics."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from safevar_sumo.vehicles.base import Characteristics, SumoType, Vehicle


class SimulatedVehicle(Vehicle):
    """The characteristics of a simulator's vehicle, in their `units`; those that are `optional` may
    be missing, or be 0 in the original.
    """

    def __init__(self, units: Mapping[str, str], optional: tuple[str, ...]) -> None:
        self.UNITS = units
        self.OPTIONAL = optional  # type: ignore[misc]

    def prepare(self, characteristics: Characteristics, *others: object) -> Characteristics:
        return characteristics

    def sumo_type(self, prepared: Characteristics) -> SumoType:
        """Undefined: no vehicle of SUMO's stands for it."""
        undefined = np.full(1, np.nan)
        return SumoType(undefined, undefined, undefined, undefined, undefined)
