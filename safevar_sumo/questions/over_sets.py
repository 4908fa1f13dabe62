"""The unsafe shares of a sample over the parameter sets of the vehicle model, each with the same
vehicles: the first ones that `risk`, `rules` and `explain` sample.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np

from safevar_sumo.errors import SimulationError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.metrics.unsafe import SHARE_DECIMALS
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.model_spread import other_sets
from safevar_sumo.questions.models import models_of
from safevar_sumo.questions.sampling import share_with_interval
from safevar_sumo.questions.sentence import Sentence
from safevar_sumo.questions.variation import VariationModel
from safevar_sumo.questions.words import interval_in_words, percentage
from safevar_sumo.records import (
    BoolArray,
    Evaluations,
    FloatArray,
    JsonObject,
    NamedValues,
)
from safevar_sumo.study import Study

STAGE = "check other parameter sets"
"""Phase of progress."""
BY_SET, INTERVALS = "by_set", "by_set_intervals"
"""The numbers of an answer that have the shares, and their intervals."""
VEHICLES = 400
"""Number of vehicles that are simulated with each set."""
ONE_SET = Sentence(
    "condition",
    "This share was computed with parameter set 0 of the vehicle model (the calibration that the"
    " study uses). Other parameter sets (alternative calibrations) were not simulated.",
)
SHARES = Sentence(
    "condition",
    "The share of unsafe vehicles ranges from {least} to {greatest} over the {sets} parameter sets"
    " of the vehicle model (alternative calibrations; at most {most} vehicles with each set).",
)
SAME_SHARE = Sentence(
    "condition",
    "The share of unsafe vehicles is {least} in each of the {sets} parameter sets of the vehicle"
    " model (alternative calibrations; at most {most} vehicles with each set).",
)


def simulate_sample(
    evaluator: Evaluator, model: VariationModel, number: int, stage: str
) -> Evaluations:
    """Evaluations of vehicles that vary as a study states.

    Raises
    ------
    SimulationError
        If none of them could be simulated.
    """
    vehicles = model.draw(number, np.random.default_rng(evaluator.seed))
    evaluations = evaluator.evaluate(vehicles, stage)
    if not evaluations.valid.any():
        raise SimulationError(
            f"study {evaluator.study.name!r}: none of {number} vehicles could be simulated"
        )
    return evaluations


def planned_over_sets(
    study: Study, stage: str, settings: int, fits: int | None = None
) -> NamedValues:
    """The phases of progress of a sample, each with its number of settings: `stage`, in which all
    are simulated with the study's own set, and that of its first vehicles with each of the first
    `fits` sets, by default with all.
    """
    number = len(other_sets(study, fits))
    return {stage: settings, STAGE: (number + bool(number)) * min(settings, VEHICLES)}


class SharesOverSets(NamedTuple):
    """The unsafe shares of G groups of vehicles with each parameter set, that of the study first.

    Attributes
    ----------
    shares
        Shape (sets, G); NaN for a group of which no vehicle could be simulated. No row where the
        number of simulations is bounded, or a single set is asked about.
    intervals
        Their 95 % intervals, shape (sets, G, 2).
    """

    study: Study
    shares: FloatArray
    intervals: FloatArray

    @classmethod
    def of(
        cls,
        evaluator: Evaluator,
        unsafe: Unsafe,
        settings: FloatArray,
        groups: Sequence[BoolArray] = (),
        fits: int | None = None,
    ) -> Self:
        """Simulate the first `VEHICLES` of M settings, shape (M, n), which are the first group, and
        for further groups, shape (M,) each, as many of their settings, with the first `fits` sets,
        by default with all.
        """
        is_first = np.arange(len(settings)) < VEHICLES
        in_groups = np.any([np.zeros_like(is_first), *groups], axis=0)
        is_chosen = is_first | (in_groups & (np.cumsum(in_groups) <= VEHICLES))
        members = np.array([is_first, *groups])[:, is_chosen]
        rows = []
        if evaluator.left is None and other_sets(evaluator.study, fits):
            models = models_of(evaluator, unsafe, fits, with_unsafe_originals=True)
            for model in models.members:
                runs = model.evaluator.evaluate(settings[is_chosen], STAGE)
                of_runs = unsafe.runs(runs).mean(axis=0)
                for group in members & runs.valid:
                    count = round(float(of_runs[group].sum()), SHARE_DECIMALS)
                    rows.append(share_with_interval(count, int(group.sum())))
        table = np.array(rows).reshape(-1, len(members), 3)
        return cls(evaluator.study, table[..., 0], table[..., 1:])

    def numbers(self, share: float) -> JsonObject:
        """The shares of all vehicles and their intervals, by the number of the set; `share` alone
        where a single set was asked about.
        """
        shares = self.shares[:, 0].tolist() or [share]
        return {BY_SET: shares, INTERVALS: self.intervals[:, 0].tolist()}

    def ends(
        self, group: int, facts: Sequence[float]
    ) -> tuple[float, float, float, float]:
        """The least and the greatest share of a group, and the ends of their intervals; `facts` are
        the share and interval of more of its vehicles with the study's own set.
        """
        rows = np.column_stack([self.shares[:, group], self.intervals[:, group]])
        share, low, high = np.vstack([facts, rows]).T
        smallest, lowest = np.fmin.reduce([share, low], axis=1).tolist()
        greatest, highest = np.fmax.reduce([share, high], axis=1).tolist()
        return smallest, greatest, lowest, highest

    def sentences(self) -> Iterator[Sentence]:
        """The least and the greatest share of all vehicles; that the study's own set was the only
        one if there are others.
        """
        if not self.study.spread:
            return
        shares = self.shares[:, 0]
        if np.isnan(shares).all():
            yield ONE_SET
            return
        smallest, greatest = map(
            self._in_words, (np.nanargmin(shares), np.nanargmax(shares))
        )
        template = SAME_SHARE if smallest == greatest else SHARES
        yield template(
            least=smallest,
            greatest=greatest,
            sets=len(shares),
            most=VEHICLES,
        )

    def _in_words(self, number: np.intp) -> str:
        """The share of all vehicles with a set, and its number if no other interval overlaps."""
        intervals = np.delete(self.intervals[:, 0], number, axis=0)
        low, high = self.intervals[number, 0]
        is_apart = ((intervals[:, 1] < low) | (intervals[:, 0] > high)).all()
        name = f"set {number}, " if is_apart else ""
        interval = f"95 % confidence interval {interval_in_words(low, high)}"
        return f"{percentage(self.shares[number, 0])} % ({name}{interval})"
