"""Do conclusions hold with the other parameter sets of the vehicle model, those of [spread]?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain.causes import (
    Cause,
    count_needed,
    find_minimal_causes,
    settings_of,
)
from safevar_sumo.questions.explain.failures import Population
from safevar_sumo.questions.model_spread import across
from safevar_sumo.questions.preventability import assess_sample, avoided_shares
from safevar_sumo.questions.sampling import Interval
from safevar_sumo.records import BoolArray, Evaluations

MAX_SHARE_SETS = 8
"""Maximum number of sets with which shares are computed; the first sets lie farthest apart."""
MAX_VEHICLES = 300
"""Maximum number of sampled vehicles that are simulated with each set; those that collide
show which collisions the reference drivers avoid.
"""
MAX_FAILURES = 20
"""Maximum number of failures, those with the fewest changes, whose minimal causes are found with
each set.
"""
PHASE = "other parameter sets"
Ranges = dict[tuple[str, str], Interval]
"""Ranges over parameter sets by kind and name of a share: (`unsafe`, ""), the settings that are
unsafe; (`needed`, a characteristic), the failures that need it; (`avoided`, a driver), the
collisions that he avoids.

The ends of a range are the share with the study's own parameters plus the least, and plus the
greatest difference that another set makes on a sample.
"""


def are_causes(evaluator: Evaluator, causes: Sequence[Cause], unsafe: Unsafe) -> BoolArray:
    """Whether each of M causes is one with an evaluator's parameters: its changes alone are unsafe,
    and safe if any one of them is left out.
    """
    if not causes:
        return np.zeros(0, dtype=bool)
    characteristics = evaluator.characteristics
    groups = []
    for setting in settings_of(characteristics, causes):
        is_changed = (setting != characteristics.original) & characteristics.of_vehicle
        is_left_out = np.diag(is_changed)[is_changed]  # in a row for each change
        groups.append(
            np.vstack([setting, np.where(is_left_out, characteristics.original, setting)])
        )
    starts = np.cumsum([0, *map(len, groups[:-1])])
    is_unsafe = unsafe.of(evaluator.evaluate(np.concatenate(groups), PHASE))
    # The first setting of a group, with all changes, is the only unsafe one.
    return np.asarray(is_unsafe[starts] & (np.add.reduceat(is_unsafe, starts, dtype=int) == 1))


def ranges_across_sets(
    evaluator: Evaluator,
    sets: int,
    evaluations: Evaluations,
    unsafe: Unsafe,
    needed: pd.Series[float],
    avoided: pd.Series[float],
) -> Ranges:
    """The ranges of the shares over the study's own parameters and the first `sets` sets.

    With its own parameters, the shares of failures that need a characteristic are `needed`, and of
    collisions that a driver avoids `avoided`.
    """
    # A sample of vehicles, and of failures with few changes.
    shuffled = np.random.default_rng(evaluator.study.search.seed).permutation(len(evaluations))
    vehicles = evaluations.settings[shuffled[:MAX_VEHICLES]]
    failures = evaluations.take(unsafe.of(evaluations))
    failures = failures.take(np.argsort(failures.f_num_diff, kind="stable")[:MAX_FAILURES])

    def sample_shares(of_set: Evaluator) -> pd.Series[float]:
        """All shares of the sample with the parameters of a set."""
        causes = find_minimal_causes(of_set, failures.settings, unsafe)
        rows = [row for row, of_failure in enumerate(causes) if of_failure]
        changed = of_set.characteristics.changed(failures.settings[rows])
        frame = count_needed(
            of_set.characteristics, changed, [causes[row] for row in rows], len(rows)
        )
        runs = of_set.evaluate(vehicles, PHASE)
        avoided_here = avoided
        if not avoided.empty:
            assessed, *_ = assess_sample(of_set, runs.take(runs.collided))
            avoided_here = avoided_shares(assessed)
        return _shares_by_kind(
            unsafe.of(runs), frame.set_index("characteristic")["needed"], avoided_here
        )

    # Shares with every set, as differences from those with the study's own parameters.
    shares = _shares_by_kind(unsafe.of(evaluations), needed, avoided)
    of_sets = across(evaluator, min(sets, MAX_SHARE_SETS), sample_shares)
    samples = pd.concat(of_sets, axis=1).reindex(shares.index)
    # There is no share where a sample has no failure, or no collision.
    of_own_parameters = samples[0].fillna(shares)
    differences = samples.sub(of_own_parameters, axis=0)
    lows = (shares + differences.min(axis=1).fillna(0.0)).clip(0.0, 1.0)
    highs = (shares + differences.max(axis=1).fillna(0.0)).clip(0.0, 1.0)
    ranges = zip(lows.tolist(), highs.tolist(), strict=True)
    return dict(zip(shares.index, ranges, strict=True))


def conclusions_across_sets(
    evaluator: Evaluator,
    sets: int,
    population: Population,
    causes: Sequence[Sequence[Cause]],
    needed: pd.Series[float],
    avoided: pd.Series[float],
) -> tuple[list[BoolArray], Ranges]:
    """Whether each cause is one, with each of the first `sets` sets, and the result of
    `ranges_across_sets`; nothing without sets or settings.
    """
    unsafe = population.unsafe
    evaluations = population.evaluations
    if not (sets and evaluator.study.spread and len(evaluations)):
        return [], {}
    evaluator = evaluator.for_study(evaluator.study, verified=0)  # as those of the sets
    flat = [cause for group in causes for cause in group]
    holding = across(evaluator, sets, lambda of_set: are_causes(of_set, flat, unsafe))
    return holding, ranges_across_sets(evaluator, sets, evaluations, unsafe, needed, avoided)


def _shares_by_kind(
    is_unsafe: BoolArray, needed: pd.Series[float], avoided: pd.Series[float]
) -> pd.Series[float]:
    kinds = {"unsafe": {"": is_unsafe.mean()}, "needed": needed, "avoided": avoided}
    shares: pd.Series[float] = pd.concat(
        {kind: pd.Series(values, dtype=float) for kind, values in kinds.items()}
    )
    return shares
