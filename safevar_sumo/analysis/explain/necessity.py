"""Statistics of many failures: how often each characteristic is changed and needed, distinct minimal causes, and robustness."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.analysis.evaluator import Evaluator, clopper_pearson
from safevar_sumo.analysis.explain.causes import MinimalCause, involved_columns, necessary_columns
from safevar_sumo.analysis.words import direction_in_words
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import BoolArray, Evaluations, FloatArray
from safevar_sumo.vehicles import CharacteristicSet

CauseKey = tuple[str, ...]
"""The directions of a cause's changes, without their sizes, such as ('mass up', 'tireFric down')."""


def cause_key(characteristics: CharacteristicSet, cause: MinimalCause) -> CauseKey:
    return tuple(direction_in_words(characteristics.members[column], float(cause.setting[column])) for column in cause.columns)


def necessity_frame(characteristics: CharacteristicSet, changed: BoolArray, causes: Sequence[Sequence[MinimalCause]],
                    failures: int) -> pd.DataFrame:
    """How often each characteristic is changed, and how often it is needed.

    Parameters
    ----------
    changed
        Which characteristics each of M failures changes, shape (M, n).
    causes
        The minimal causes of each of the M failures.
    failures
        Number of all failures; if it is larger than M, the M failures are a random sample of them.

    Returns
    -------
    pandas.DataFrame
        One row per characteristic: `characteristic`, and the shares of failures in which it is `changed`, `necessary` (part of every
        minimal cause) and `involved` (part of at least one). `necessary_lower` and `necessary_upper` are the 95 % interval of
        `necessary` among all failures: Clopper and Pearson's for a sample (slightly too wide, because the sample is drawn without
        replacement from finitely many failures), the share itself if all failures were analysed. Ordered by necessary, involved,
        changed; no rows if there is no failure.
    """
    columns = range(len(characteristics) if len(changed) else 0)
    counts = {"changed": Counter(np.nonzero(changed)[1].tolist()),
              "necessary": Counter(column for failure_causes in causes for column in necessary_columns(failure_causes)),
              "involved": Counter(column for failure_causes in causes for column in involved_columns(failure_causes))}
    is_sample = len(changed) < failures
    intervals = [clopper_pearson(counts["necessary"][column], len(changed)) if is_sample
                 else (counts["necessary"][column] / len(changed),) * 2 for column in columns]
    frame = pd.DataFrame({
        "characteristic": pd.Series([characteristics.names[column] for column in columns], dtype=object),
        **{name: pd.Series([count[column] / len(changed) for column in columns], dtype=float) for name, count in counts.items()},
        "necessary_lower": pd.Series([low for low, _ in intervals], dtype=float),
        "necessary_upper": pd.Series([high for _, high in intervals], dtype=float)})
    return frame.sort_values(["necessary", "involved", "changed"], ascending=False, kind="stable", ignore_index=True)


def count_distinct_causes(characteristics: CharacteristicSet, causes: Sequence[Sequence[MinimalCause]]) -> pd.DataFrame:
    """Every distinct minimal cause, most frequent first.

    Returns
    -------
    pandas.DataFrame
        Columns `cause`, a tuple of changes with their directions; `failures`, the number of failures with this cause; and `share`, their
        share of all failures.
    """
    counts = Counter(key for failure_causes in causes for key in {cause_key(characteristics, cause) for cause in failure_causes})
    order = sorted(counts, key=lambda key: (-counts[key], len(key), key))
    return pd.DataFrame({
        "cause": pd.Series(order, dtype=object), "failures": pd.Series([counts[key] for key in order], dtype=int),
        "share": pd.Series([counts[key] / len(causes) for key in order], dtype=float)})


NEIGHBOUR_COUNT = 64
"""Number of neighbours of a setting that are simulated with each time step."""
STEP_FACTORS = (1.0, 0.5, 2.0)
"""Factors by which the study's time step is multiplied."""
MIN_ROBUST_SHARE = 0.8
"""Share of unsafe neighbours from which on a failure is called robust; below, it is borderline."""
FAILURES_PER_BATCH = 8
"""Number of failures whose robustness is estimated at a time, the smallest failures first."""


class Robustness(NamedTuple):
    """Shares of unsafe outcomes among the neighbours of a setting, by time step [s]."""

    shares_by_step: dict[float, float]

    @property
    def share(self) -> float:
        return sum(self.shares_by_step.values()) / len(self.shares_by_step)

    @property
    def borderline(self) -> bool:
        return is_borderline(self.share)

    def __str__(self) -> str:
        """A phrase such as `robust: 84 % of the neighbours are unsafe too, but only 53 % with a step of 0.1 s`."""
        step, least_share = min(self.shares_by_step.items(), key=lambda item: item[1])
        disagrees = is_borderline(least_share) and not self.borderline
        return robustness_in_words(self.share) + (f", but only {100 * least_share:.0f} % with a step of {step:g} s" if disagrees else "")


def is_borderline(share: float) -> bool:
    """Whether small perturbations remove a failure, because too few of its neighbours are unsafe."""
    return share < MIN_ROBUST_SHARE


def robustness_in_words(share: float) -> str:
    """A phrase such as `borderline: only 44 % of the neighbours are unsafe too`."""
    return f"{'borderline: only' if is_borderline(share) else 'robust:'} {100 * share:.0f} % of the neighbours are unsafe too"


def estimate_robustness(evaluator: Evaluator, settings: FloatArray, step: float, unsafe: Unsafe,
                        factors: Sequence[float] = STEP_FACTORS) -> list[Robustness]:
    """The robustness of each of M settings, shape (M, n).

    A setting's neighbours differ from it in each characteristic by at most the filter's threshold. They are simulated without the filter,
    with each of `factors` times the study's time step (`step` seconds). Neighbours that cannot be simulated do not count.
    """
    characteristics = evaluator.characteristics
    rng = np.random.default_rng(evaluator.study.search.seed)
    offsets = rng.uniform(-1, 1, (NEIGHBOUR_COUNT, len(characteristics))) * characteristics.threshold
    neighbours = np.clip(settings[:, np.newaxis] + offsets, characteristics.lower, characteristics.upper).reshape(-1, len(characteristics))
    shares = {}
    for factor in factors:
        step_evaluator = evaluator if factor == 1 else evaluator.with_step(step * factor)
        evaluations = step_evaluator.evaluate(neighbours, f"neighbours at {step * factor:g} s a step")
        is_unsafe, is_valid = (flags.reshape(len(settings), NEIGHBOUR_COUNT) for flags in (unsafe.of(evaluations), evaluations.valid))
        shares[step * factor] = (is_unsafe & is_valid).sum(axis=1) / np.maximum(is_valid.sum(axis=1), 1)
    return [Robustness({step: float(step_shares[row]) for step, step_shares in shares.items()}) for row in range(len(settings))]


def find_smallest_robust_failure(evaluator: Evaluator, failures: Evaluations, step: float, unsafe: Unsafe,
                                 max_evaluations: int) -> int | None:
    """The row of the robust failure with the fewest changes; of several, the one whose largest change is smallest.

    Failures are tried in this order until one is robust, or about `max_evaluations` settings are evaluated; None if no tried failure is
    robust. Other time steps than the study's are left out where they could not make a failure robust.
    """
    order = np.lexsort([failures.f_safe, failures.f_diff, failures.f_num_diff])
    least_share = len(STEP_FACTORS) * MIN_ROBUST_SHARE - len(STEP_FACTORS[1:])  # with it, the mean is just robust if all others are 1
    neighbour_sets = 0
    for start in range(0, len(order), FAILURES_PER_BATCH):
        rows = order[start:start + FAILURES_PER_BATCH]
        candidates = [(row, estimate) for row, estimate in zip(
            rows.tolist(), estimate_robustness(evaluator, failures.settings[rows], step, unsafe, STEP_FACTORS[:1]), strict=True)
            if estimate.share >= least_share]
        if candidates:
            other_steps = estimate_robustness(evaluator, failures.settings[[row for row, _ in candidates]], step, unsafe, STEP_FACTORS[1:])
            for (row, estimate), others in zip(candidates, other_steps, strict=True):
                if not Robustness(estimate.shares_by_step | others.shares_by_step).borderline:
                    return int(row)
        neighbour_sets += len(rows) + len(STEP_FACTORS[1:]) * len(candidates)
        if neighbour_sets * NEIGHBOUR_COUNT >= max_evaluations:
            break
    return None
