"""The share of unsafe vehicles with each parameter set of the vehicle model. Every set simulates
the same vehicles: the first `VEHICLES` of those that `risk`, `rules` and `explain` sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from safevar_sumo.errors import SimulationError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.metrics.unsafe import SHARE_DECIMALS
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.model_spread import other_sets
from safevar_sumo.questions.models import models_of
from safevar_sumo.questions.sampling import share_with_interval
from safevar_sumo.questions.sentence import Sentences, condition, evidence
from safevar_sumo.questions.variation import VariationModel
from safevar_sumo.questions.words import (
    count_in_words,
    interval_in_words,
    percentage,
)
from safevar_sumo.records import (
    BoolArray,
    Evaluations,
    FloatArray,
    JsonObject,
    NamedValues,
)
from safevar_sumo.study import Study

SETS_STAGE = "check other parameter sets"
"""Phase of progress in which the vehicles are simulated with each set."""
BY_SET, INTERVALS = "by_set", "by_set_intervals"
"""Keys of the numbers of an answer: the share with each set, and the interval of each share."""
VEHICLES = 400
"""Largest number of vehicles that are simulated with each set, twice: of all vehicles, and of the
vehicles in further groups.
"""
ONE_SET = condition(
    "This share was computed with parameter set 0 of the vehicle model (the calibration that the"
    " study uses). Other parameter sets (alternative calibrations) were not simulated.",
)
OF_MOVING = evidence(
    "The share counts only vehicles that moved: {count} sampled vehicles never moved."
)
SHARES = condition(
    "The share of unsafe vehicles ranges from {least} to {greatest} over the {sets} parameter sets"
    " of the vehicle model (alternative calibrations; at most {most} vehicles with each set).",
)
NONE_UNSAFE = condition(
    "At most {most} of the vehicles were also simulated with each of the {sets} parameter sets of"
    " the vehicle model (alternative calibrations). None of these vehicles is unsafe.",
)
SAME_SHARE = condition(
    "The share of unsafe vehicles is {least} in each of the {sets} parameter sets of the vehicle"
    " model (alternative calibrations; at most {most} vehicles with each set).",
)


def simulate_sample(
    evaluator: Evaluator, model: VariationModel, number: int, stage: str
) -> Evaluations:
    """Evaluations of `number` vehicles that are sampled from a model of variation.

    Raises
    ------
    NobodyMoved
        If no vehicle moved.
    SimulationError
        If no vehicle could be simulated.
    """
    vehicles = model.draw(number, np.random.default_rng(evaluator.seed))
    evaluations = evaluator.evaluate(vehicles, stage)
    evaluator.tally.refuse_standing()
    if not evaluations.valid.any():
        raise SimulationError(
            f"study {evaluator.study.name!r}: none of {number} vehicles could be simulated"
        )
    return evaluations


def moving_in_words(evaluations: Evaluations) -> Sentences:
    """Say how many sampled vehicles a share leaves out, because they never moved."""
    standing = int(evaluations.standing.sum())
    if standing:
        yield OF_MOVING(count=count_in_words(standing, len(evaluations)))


def planned_over_sets(
    study: Study, stage: str, settings: int, fits: int | None = None
) -> NamedValues:
    """The number of settings of each of the two phases of progress.

    In the phase `stage`, all `settings` are simulated with the study's own set. In the phase
    `SETS_STAGE`, the first `VEHICLES` settings are simulated with each of the first `fits` sets (by
    default all). The study's own set is the first one. Without other sets, `SETS_STAGE` has no
    settings. Vehicles of further groups are not planned: only the sample shows their number.
    """
    sets = len(other_sets(study, fits))
    if sets:
        sets += 1
    return {stage: settings, SETS_STAGE: sets * min(settings, VEHICLES)}


class SharesOverSets(NamedTuple):
    """The shares of unsafe vehicles in G groups of vehicles, with each of S parameter sets.

    Attributes
    ----------
    study
        The study of the vehicles.
    shares
        Share of unsafe vehicles by set and group, and the lower and upper end of its 95 %
        confidence interval, shape (S, G, 3). The study's own set has the first row. The share is
        NaN if no vehicle of the group could be simulated. S is 0 if the user limits the number of
        simulations, or if the study's own set is the only one.
    """

    study: Study
    shares: FloatArray

    @classmethod
    def of(
        cls,
        evaluator: Evaluator,
        unsafe: Unsafe,
        settings: FloatArray,
        groups: Sequence[BoolArray] = (),
        fits: int | None = None,
    ) -> Self:
        """Simulate some of M settings with each set, and compute the shares of all groups.

        Parameters
        ----------
        settings
            The sampled vehicles, shape (M, n). The first `VEHICLES` of them are the first group.
        groups
            Further groups: for each group, which settings belong to it, shape (M,). In addition to
            the first group, the first `VEHICLES` settings that are in any further group are
            simulated.
        fits
            Number of sets that are simulated, with the study's own; by default all.
        """
        is_first = np.arange(len(settings)) < VEHICLES
        in_groups = np.any([np.zeros_like(is_first), *groups], axis=0)
        # The cumulative sum numbers the settings in further groups: the first ones are chosen.
        is_chosen = is_first | (in_groups & (np.cumsum(in_groups) <= VEHICLES))
        members = np.array([is_first, *groups])[:, is_chosen]
        rows = []
        if not evaluator.budget.is_few and other_sets(evaluator.study, fits):
            models = models_of(evaluator, unsafe, fits, with_unsafe_originals=True)
            for model in models.members:
                evaluations = model.evaluator.evaluate(settings[is_chosen], SETS_STAGE)
                # A vehicle that is unsafe in some repeats only counts as a part of a vehicle.
                share_of_repeats = unsafe.runs(evaluations).mean(axis=0)
                for group in members & evaluations.valid:
                    count = round(float(share_of_repeats[group].sum()), SHARE_DECIMALS)
                    rows.append(share_with_interval(count, int(group.sum())))
        return cls(evaluator.study, np.array(rows).reshape(-1, len(members), 3))

    def numbers(self, share: float) -> JsonObject:
        """The shares and intervals of the first group (all vehicles), in the order of the sets. If
        no set was simulated here, the list of shares has `share` alone.
        """
        shares = self.shares[:, 0, 0].tolist() or [share]
        return {BY_SET: shares, INTERVALS: self.shares[:, 0, 1:].tolist()}

    def ends(
        self, group: int, own_share: Sequence[float]
    ) -> tuple[float, float, float, float]:
        """The least share of a group, its greatest share, the lowest end of all intervals, and the
        highest end of all intervals.

        `own_share` is a share and the two ends of its interval, from a larger sample of the group
        with the study's own set. It counts beside the shares of all sets.
        """
        share, low, high = np.vstack([own_share, self.shares[:, group]]).T
        smallest, lowest = np.fmin.reduce([share, low], axis=1).tolist()
        greatest, highest = np.fmax.reduce([share, high], axis=1).tolist()
        return smallest, greatest, lowest, highest

    def sentences(self) -> Sentences:
        """A sentence with the least and the greatest share of all vehicles. If the study has other
        sets, but none was simulated, the sentence says so.
        """
        if not self.study.spread:
            return
        shares = self.shares[:, 0, 0]
        if np.isnan(shares).all():
            yield ONE_SET
            return
        smallest, greatest = map(
            self._in_words, (np.nanargmin(shares), np.nanargmax(shares))
        )
        template = SAME_SHARE if smallest == greatest else SHARES
        if np.nanmax(shares) == 0:
            template = NONE_UNSAFE
        yield template(
            least=smallest,
            greatest=greatest,
            sets=len(shares),
            most=VEHICLES,
        )

    def _in_words(self, number: np.intp) -> str:
        """The share of all vehicles with a set, in percent with its interval. The text names the
        set if its interval overlaps with the interval of no other set.
        """
        share, low, high = self.shares[number, 0]
        _, lows, highs = np.delete(self.shares[:, 0], number, axis=0).T
        is_apart = ((highs < low) | (lows > high)).all()
        name = f"set {number}, " if is_apart else ""
        interval = f"95 % confidence interval {interval_in_words(low, high)}"
        return f"{percentage(share)} % ({name}{interval})"
