"""How strongly each characteristic acts on the safety degree, there and here: linear regression over all rows of a file."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.records import BoolArray, Evaluations, FloatArray
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.study import SAFETY_DEGREE
from safevar_sumo.vehicles import CharacteristicSet

SHARE, LEAST = 0.2, 0.1
"""Effects agree that differ by no more than this share of the published one, or by no more than so many metres."""
ROWS_EACH = 10
"""Rows for each characteristic below which a regression says nothing."""


class Effect(NamedTuple):
    """Effect of a characteristic on the safety degree over its whole domain [m], there and here; None where it hardly varies."""

    name: str
    reference: float | None
    here: float | None

    @property
    def agrees(self) -> bool | None:
        """Whether the effect here is near enough to the published one."""
        if self.reference is None or self.here is None:
            return None
        return abs(self.here - self.reference) <= max(LEAST, SHARE * abs(self.reference))


def linear_effects(settings: FloatArray, safety_degree: FloatArray, characteristics: CharacteristicSet) -> FloatArray:
    """Slopes of a linear regression on all characteristics, times the widths of their domains; shape (n,) [m], NaN where one is fixed."""
    width = characteristics.upper - characteristics.lower
    defined = np.isfinite(safety_degree)
    shares = (settings[defined] - characteristics.original) / width
    varies = _varies(shares)
    design = np.column_stack([np.ones(len(shares)), shares[:, varies]])
    effects = np.full(len(characteristics), np.nan)
    if len(shares) >= ROWS_EACH * design.shape[1]:
        effects[varies] = np.linalg.lstsq(design, safety_degree[defined], rcond=None)[0][1:]
    return effects


def _varies(shares: FloatArray) -> BoolArray:
    return np.asarray(np.ptp(shares, axis=0) > 0) if len(shares) else np.zeros(shares.shape[1], dtype=bool)


def effects_apart(data: ReferenceData, here: Evaluations, characteristics: CharacteristicSet) -> FloatArray:
    """Effects here minus those there [m]; zero where the rows tell neither."""
    there, ours = (linear_effects(data.settings, values, characteristics) for values in (data.metrics[SAFETY_DEGREE], here.f_safe))
    return np.nan_to_num(ours - there)


def effects_of(data: ReferenceData, here: Evaluations, characteristics: CharacteristicSet) -> list[Effect]:
    """The effects of all characteristics, in the study's order."""
    there, ours = (linear_effects(data.settings, values, characteristics) for values in (data.metrics[SAFETY_DEGREE], here.f_safe))
    return [Effect(name, *(None if np.isnan(value) else float(value) for value in pair))
            for name, *pair in zip(characteristics.names, there, ours, strict=True)]
