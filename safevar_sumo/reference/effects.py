"""Effects of the characteristics on the safety degree, in a reference and here; rows that the model's uncertainty covers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import msgspec
import numpy as np

from safevar_sumo.analysis.model_spread import BAND, band_of, distance_from_original, evaluations_of_sets
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, finite_or_none
from safevar_sumo.reference.rows import ReferenceData
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.vehicles import CharacteristicSet

SHARE, LEAST = 0.2, 0.1
"""Effects agree if they differ by at most this share of the published effect, or by at most this many metres."""
ROWS_EACH = 10
"""Minimum number of rows for each coefficient of a regression."""


class Effect(NamedTuple):
    """Effect of a characteristic on the safety degree over its whole domain [m], in the reference and here; None if undefined."""

    name: str
    reference: float | None
    here: float | None

    @property
    def agrees(self) -> bool | None:
        """Whether the effect here is near enough to the published one."""
        if self.reference is None or self.here is None:
            return None
        return abs(self.here - self.reference) <= max(LEAST, SHARE * abs(self.reference))


class Regression(NamedTuple):
    """Linear regression of values on all characteristics, for the same settings each time.

    `shares` are the settings' differences from the original in widths of the domains, shape (rows, n); `varies` tells which
    characteristics vary, shape (n,); `slopes_of` maps values to the slopes of those, shape (k, rows), None for too few rows.
    """

    shares: FloatArray
    varies: BoolArray
    slopes_of: FloatArray | None

    @classmethod
    def over(cls, settings: FloatArray, characteristics: CharacteristicSet) -> Regression:
        """The regression for settings, shape (rows, n)."""
        return cls._on((settings - characteristics.original) / (characteristics.upper - characteristics.lower))

    @classmethod
    def _on(cls, shares: FloatArray) -> Regression:
        varies = np.asarray(np.ptp(shares, axis=0) > 0) if len(shares) else np.zeros(shares.shape[1], dtype=bool)
        design = np.column_stack([np.ones(len(shares)), shares[:, varies]])
        enough = len(shares) >= ROWS_EACH * design.shape[1]
        return cls(shares, varies, np.linalg.pinv(design)[1:] if enough else None)

    def effects(self, values: FloatArray) -> FloatArray:
        """Slopes over the whole domains, shape (n,), in the unit of `values`, shape (rows,); NaN if undefined."""
        defined = np.isfinite(values)
        if not defined.all():
            return Regression._on(self.shares[defined]).effects(values[defined])
        effects = np.full(len(self.varies), np.nan)
        if self.slopes_of is not None:
            effects[self.varies] = self.slopes_of @ values
        return effects


def effects_of(data: ReferenceData, here: Evaluations, characteristics: CharacteristicSet) -> list[Effect]:
    """The effects of all characteristics, in the study's order."""
    regression = Regression.over(data.settings, characteristics)
    effects = (regression.effects(values) for values in (data.metrics[SAFETY_DEGREE], here.f_safe))
    return [Effect(name, *(finite_or_none(value) for value in pair))
            for name, *pair in zip(characteristics.names, *effects, strict=True)]


class Coverage(NamedTuple):
    """Numbers of parameter sets and rows, and the share of rows within the band of the sets' predictions and of repeats.

    `held_back` is the share of the rows that the fit did not use, `width` the band's median width [m], `needed` how much wider on each
    side the band must be to cover 90 % of the rows held back [m].
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
                f"(median) and covers {self.all_rows:.0%} of {self.rows} rows, {self.held_back:.0%} of the rows held back; "
                f"{self.needed:.2f} m more on each side would cover {BAND:.0%} of the latter.")


def covered_by_spread(data: ReferenceData, study: Study) -> Coverage:
    """The published rows within the band of the model's own uncertainty.

    Raises
    ------
    InputError
        If the study has no spread.
    """
    evaluations = evaluations_of_sets(study, data.settings)
    lower, upper = band_of(study, evaluations)
    published = data.metrics[SAFETY_DEGREE]
    outside = _outside(published, lower, upper)
    held_back = np.arange(len(published)) % study.fit.hold_out == study.fit.hold_out - 1
    chosen = held_back if held_back.any() else np.ones(len(published), dtype=bool)
    return Coverage(len(evaluations), len(published), float(np.mean(outside == 0)), float(np.mean(outside[chosen] == 0)),
                    float(np.median(upper - lower)), float(np.quantile(outside[chosen], BAND)))


def _outside(values: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Distance of values from a band; zero inside it."""
    return np.asarray(np.maximum(np.maximum(lower - values, values - upper), 0.0))


def error_beyond_spread(study: Study, references: Mapping[str, ReferenceData]) -> float:
    """How much wider on each side a band must be to hold `BAND` of new rows [m per domain's width from the original].

    Split conformal prediction (Lei et al. 2018), with a row's distance from the band over its `distance` as score; files weigh alike.
    """
    bare = msgspec.structs.replace(study, model_error={})
    scores, weights = [], []
    for data in references.values():
        distances, published = distance_from_original(study, data.settings), data.metrics[SAFETY_DEGREE]
        used = (distances > 0) & np.isfinite(published)
        if used.any():
            lower, upper = band_of(bare, evaluations_of_sets(bare, data.settings[used]))
            scores.append(_outside(published[used], lower, upper) / distances[used])
            weights.append(np.full(len(scores[-1]), 1 / len(scores[-1])))
    if not scores:
        return 0.0
    all_scores = np.concatenate(scores)
    share = min(1.0, BAND * (1 + 1 / len(all_scores)))  # the new row counts too
    return float(np.quantile(all_scores, share, weights=np.concatenate(weights), method="inverted_cdf"))
