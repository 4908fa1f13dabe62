"""Whether a finding is robust or borderline: its neighbours, and other time steps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.answers.bench import Bench
from safevar_sumo.answers.unsafe import Unsafe
from safevar_sumo.records import Evaluations, FloatArray

NEIGHBOURS = 64
STEP_FACTORS = (1.0, 0.5, 2.0)
"""Of the study's time step: itself, half of it, and twice."""
BORDERLINE = 0.8
"""A share of unsafe outcomes below which a finding is called borderline."""
TOGETHER = 8
"""Failures, the smallest first, that are tried at a time."""


class Robustness(NamedTuple):
    """Shares of unsafe outcomes among the neighbours of a setting, by time step [s]."""

    by_step: dict[float, float]

    @property
    def share(self) -> float:
        return sum(self.by_step.values()) / len(self.by_step)

    @property
    def borderline(self) -> bool:
        return is_borderline(self.share)


def is_borderline(share: float) -> bool:
    """Whether so few of a finding's neighbours are unsafe too that small perturbations remove it."""
    return share < BORDERLINE


def robustness(bench: Bench, settings: FloatArray, step: float, unsafe: Unsafe) -> list[Robustness]:
    """How robust settings, shape (M, n), are.

    The neighbours of a setting differ from it in every characteristic by no more than the filter takes for no change;
    they are simulated as they are, with the study's time step (`step` seconds), half of it and twice. Neighbours that cannot be simulated
    are left out of the share.
    """
    members = bench.characteristics
    offsets = np.random.default_rng(bench.study.search.seed).uniform(-1, 1, (NEIGHBOURS, len(members))) * members.threshold
    around = np.clip(settings[:, np.newaxis] + offsets, members.lower, members.upper).reshape(-1, len(members))
    shares = {}
    for factor in STEP_FACTORS:
        on = bench if factor == 1 else bench.with_step(step * factor)
        evaluations = on.evaluate(around, f"neighbours at {step * factor:g} s a step")
        outcomes, valid = (truths.reshape(len(settings), NEIGHBOURS) for truths in (unsafe.of(evaluations), evaluations.valid))
        shares[step * factor] = (outcomes & valid).sum(axis=1) / np.maximum(valid.sum(axis=1), 1)
    return [Robustness({step: float(of_it[row]) for step, of_it in shares.items()}) for row in range(len(settings))]


def smallest_robust(bench: Bench, failures: Evaluations, step: float, unsafe: Unsafe, limit: int) -> int | None:
    """The row of the smallest failure that is not borderline: of the fewest changes, then the smallest largest change.

    They are tried in that order until one is robust or about `limit` simulations are spent; None if none is robust by then.
    """
    order = np.lexsort([failures.f_safe, failures.f_diff, failures.f_num_diff])
    most = max(TOGETHER, limit // (NEIGHBOURS * len(STEP_FACTORS)))
    for first in range(0, min(len(order), most), TOGETHER):
        rows = order[first:first + TOGETHER]
        for row, found in zip(rows.tolist(), robustness(bench, failures.settings[rows], step, unsafe), strict=True):
            if not found.borderline:
                return int(row)
    return None
