"""The unsafe shares of a sample over all parameter sets of the vehicle model: the study's own has
the whole sample, each other set a tenth of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.model_spread import other_sets
from safevar_sumo.questions.models import models_of
from safevar_sumo.questions.sampling import Interval
from safevar_sumo.questions.words import percentage
from safevar_sumo.records import BoolArray, FloatArray, NamedValues
from safevar_sumo.study import Study

STAGE = "other parameter sets"
"""Phase of progress."""
PART = 10
"""In each other set one of so many vehicles of a sample is simulated."""


def planned_over_sets(
    study: Study, stage: str, settings: int, fits: int | None = None
) -> NamedValues:
    """The phases of progress of a sample, each with its number of settings: `stage`, in which all
    are simulated with the study's own set, and that of a tenth of them with each other one of the
    first `fits` sets, by default of all.
    """
    return {stage: settings, STAGE: len(other_sets(study, fits)) * (settings // PART)}


class SharesOverSets(NamedTuple):
    """The unsafe shares of G groups of vehicles with each other parameter set.

    Attributes
    ----------
    vehicles
        Number of vehicles that were simulated with each of them.
    others
        The shares, shape (sets, G); NaN for a group of which no vehicle could be simulated. No row
        where the number of simulations is bounded, or the study has one set.
    """

    study: Study
    vehicles: int
    others: FloatArray

    @classmethod
    def of(
        cls,
        evaluator: Evaluator,
        unsafe: Unsafe,
        settings: FloatArray,
        groups: Sequence[BoolArray] = (),
        fits: int | None = None,
    ) -> Self:
        """Simulate a tenth of M settings, shape (M, n), which are the first group, and for further
        groups, shape (M,) each, as many of their settings, with the first `fits` sets, by default
        with all.
        """
        number = len(settings) // PART
        is_first = np.arange(len(settings)) < number
        in_groups = np.any([np.zeros_like(is_first), *groups], axis=0)
        is_chosen = is_first | (in_groups & (np.cumsum(in_groups) <= number))
        part = settings[is_chosen]
        members = np.array([is_first, *groups])[:, is_chosen]
        others = list[FloatArray]()
        if evaluator.left is None and number:
            for model in models_of(evaluator, unsafe, fits, with_unsafe_originals=True).members[1:]:
                runs = model.evaluator.evaluate(part, STAGE)
                counted = members & runs.valid
                totals = counted.sum(axis=1)
                failing = (counted & unsafe.of(runs)).sum(axis=1)
                others.append(np.where(totals, failing / np.maximum(totals, 1), np.nan))
        return cls(evaluator.study, number, np.array(others).reshape(-1, len(members)))

    def of_all(self, own: float) -> list[float]:
        """The share of all vehicles, by the number of the set; `own` is that of the study's own."""
        return [own, *self.others[:, 0].tolist()]

    def ends(self, group: int, own: float) -> Interval:
        """The least and the greatest share of a group."""
        shares = [own, *self.others[:, group]]
        return float(np.fmin.reduce(shares)), float(np.fmax.reduce(shares))

    def in_words(self, own: float) -> str:
        """The least and the greatest share of all vehicles with their sets; that the study's own
        was the only one if there are others.
        """
        if not self.study.spread:
            return ""
        if not len(self.others):
            return " This holds for the study's own parameter set of the vehicle model alone."
        shares = self.of_all(own)
        ends = [
            f"{percentage(shares[number])} % (set {number})"
            for number in (int(np.nanargmin(shares)), int(np.nanargmax(shares)))
        ]
        return (
            f" Over {len(shares)} parameter sets of the vehicle model the share of unsafe vehicles"
            f" is {' to '.join(ends)}, with {self.vehicles:,} vehicles in each set but the study's"
            " own."
        )
