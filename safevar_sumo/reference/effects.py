"""How strongly each characteristic acts on the safety degree, there and here; and how many rows the model's uncertainty covers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import msgspec
import numpy as np

from safevar_sumo.analysis.model_spread import BAND, band_of, distance, evaluations_of_sets
from safevar_sumo.records import BoolArray, Evaluations, FloatArray
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.study import SAFETY_DEGREE, Study
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


class Coverage(NamedTuple):
    """How many sets of parameters there are, and the share of rows within the band of their predictions and of repeats.

    `held_back` is the share of those that were not used for the fit, `width` the band's median width [m], `needed` by how much it would
    have to be wider on each side to cover 90 % of the rows held back [m].
    """

    sets: int
    rows: int
    all_rows: float
    held_back: float
    width: float
    needed: float

    def to_dict(self) -> dict[str, float]:
        """As plain values."""
        return self._asdict()

    def __str__(self) -> str:
        return (f"The {BAND:.0%} band of {self.sets} parameter sets, of repeats and of the model's error is {self.width:.2f} m wide "
                f"(median) and covers {self.all_rows:.0%} of {self.rows} rows, {self.held_back:.0%} of those held back; {self.needed:.2f} "
                f"m more on each side would cover {BAND:.0%} of these.")


def covered_by_spread(data: ReferenceData, study: Study) -> Coverage:
    """How many published rows lie within the model's own uncertainty.

    Raises
    ------
    InputError
        If the study has no spread.
    """
    evaluations = evaluations_of_sets(study, data.settings)
    lower, upper = band_of(study, evaluations)
    there = data.metrics[SAFETY_DEGREE]
    outside = _outside(there, lower, upper)
    held_back = np.arange(len(there)) % study.fit.hold_out == study.fit.hold_out - 1
    of = held_back if held_back.any() else np.ones(len(there), dtype=bool)
    return Coverage(len(evaluations), len(there), float(np.mean(outside == 0)), float(np.mean(outside[of] == 0)),
                    float(np.median(upper - lower)), float(np.quantile(outside[of], BAND)))


def _outside(there: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """By how much values miss a band; zero inside it."""
    return np.asarray(np.maximum(np.maximum(lower - there, there - upper), 0.0))


def error_beyond_spread(study: Study, references: Mapping[str, ReferenceData]) -> float:
    """By how much a band is to be wider on each side for `BAND` of new rows to lie in it [m per domain's width from the original].

    Split conformal prediction (Lei et al. 2018), the score being what a row misses the band by over its distance; each file counts alike.
    """
    bare = msgspec.structs.replace(study, model_error={})
    scores, weights = [], []
    for data in references.values():
        away, there = distance(study, data.settings), data.metrics[SAFETY_DEGREE]
        counts = (away > 0) & np.isfinite(there)
        if counts.any():
            lower, upper = band_of(bare, evaluations_of_sets(bare, data.settings[counts]))
            scores.append(_outside(there[counts], lower, upper) / away[counts])
            weights.append(np.full(len(scores[-1]), 1 / len(scores[-1])))
    if not scores:
        return 0.0
    every = np.concatenate(scores)
    share = min(1.0, BAND * (1 + 1 / len(every)))  # a new row is one more among them
    return float(np.quantile(every, share, weights=np.concatenate(weights), method="inverted_cdf"))
