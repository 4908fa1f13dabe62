"""Whether a failure is robust: the share of a setting's neighbours that are unsafe too, and the smallest robust
failure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.vehicles import CharacteristicSet

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
        """Whether small perturbations remove a failure, because too few of its neighbours are unsafe."""
        return self.share < MIN_ROBUST_SHARE

    def __str__(self) -> str:
        """A phrase such as `robust: 84 % of the neighbours are unsafe too, but only 53 % with a step of 0.1 s`."""
        step, least_share = min(self.shares_by_step.items(), key=lambda item: item[1])
        phrase = f"{100 * self.share:.0f} % of the neighbours are unsafe too"
        if self.borderline:
            return f"borderline: only {phrase}"
        exception = f", but only {100 * least_share:.0f} % with a step of {step:g} s"
        return f"robust: {phrase}{exception if least_share < MIN_ROBUST_SHARE else ''}"


def draw_neighbours(characteristics: CharacteristicSet, settings: FloatArray, seed: int) -> FloatArray:
    """The neighbours of M settings, shape (M, n), one setting after the other; they differ from it by at most the
    filter's threshold.
    """
    n = len(characteristics)
    offsets = np.random.default_rng(seed).uniform(-1, 1, (NEIGHBOUR_COUNT, n)) * characteristics.threshold
    neighbours = settings[:, np.newaxis] + offsets
    return np.clip(neighbours, characteristics.lower, characteristics.upper).reshape(-1, n)


def estimate_robustness(
    evaluator: Evaluator, settings: FloatArray, step: float, unsafe: Unsafe, factors: Sequence[float] = STEP_FACTORS
) -> list[Robustness]:
    """The robustness of each of M settings, shape (M, n).

    A setting's neighbours differ from it in each characteristic by at most the filter's threshold. They are simulated
    without the filter, with each of `factors` times the study's time step (`step` seconds). Neighbours that cannot be
    simulated do not count.
    """
    neighbours, shares = draw_neighbours(evaluator.characteristics, settings, evaluator.study.search.seed), {}
    for factor in factors:
        step_evaluator = evaluator if factor == 1 else evaluator.with_step(step * factor)
        evaluations = step_evaluator.evaluate(neighbours, f"neighbours at {step * factor:g} s a step")
        is_unsafe, is_valid = (
            flags.reshape(len(settings), NEIGHBOUR_COUNT) for flags in (unsafe.of(evaluations), evaluations.valid)
        )
        shares[step * factor] = (is_unsafe & is_valid).sum(axis=1) / np.maximum(is_valid.sum(axis=1), 1)
    return [Robustness(dict(zip(shares, row, strict=True))) for row in np.transpose(list(shares.values())).tolist()]


def find_smallest_robust_failure(
    evaluator: Evaluator, failures: Evaluations, step: float, unsafe: Unsafe, max_evaluations: int
) -> int | None:
    """The row of the robust failure with the fewest changes; of several, the one whose largest change is smallest.

    Failures are tried in this order until one is robust, or about `max_evaluations` settings are evaluated; None if no
    tried failure is robust. Other time steps than the study's are left out where they could not make a failure robust.
    """
    order, neighbour_sets = np.lexsort([failures.f_safe, failures.f_diff, failures.f_num_diff]), 0
    own, others = STEP_FACTORS[:1], STEP_FACTORS[1:]
    least_share = len(STEP_FACTORS) * MIN_ROBUST_SHARE - len(others)  # just robust if all other shares are 1
    for start in range(0, len(order), FAILURES_PER_BATCH):
        rows = order[start : start + FAILURES_PER_BATCH]
        neighbour_sets += len(rows)
        estimates = estimate_robustness(evaluator, failures.settings[rows], step, unsafe, own)
        candidates = [pair for pair in zip(rows.tolist(), estimates, strict=True) if pair[1].share >= least_share]
        if candidates:
            neighbour_sets += len(others) * len(candidates)
            settings = failures.settings[[row for row, _ in candidates]]
            further = estimate_robustness(evaluator, settings, step, unsafe, others)
            for (row, estimate), other in zip(candidates, further, strict=True):
                if not Robustness(estimate.shares_by_step | other.shares_by_step).borderline:
                    return int(row)
        if neighbour_sets * NEIGHBOUR_COUNT >= max_evaluations:
            break
    return None
