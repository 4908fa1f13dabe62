"""Whether a finding hangs on a hair: its neighbours, and other time steps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from safevar_sumo.answers.bench import Bench
from safevar_sumo.answers.unsafe import Unsafe
from safevar_sumo.records import FloatArray

NEIGHBOURS = 64
STEP_FACTORS = (1.0, 0.5, 2.0)
"""Of the study's time step: itself, half of it, and twice."""
BORDERLINE = 0.8
"""A share of unsafe outcomes below which a finding is called borderline."""


class Robustness(NamedTuple):
    """Shares of unsafe outcomes among the neighbours of a setting, by time step [s]."""

    by_step: dict[float, float]

    @property
    def share(self) -> float:
        return sum(self.by_step.values()) / len(self.by_step)

    @property
    def borderline(self) -> bool:
        return self.share < BORDERLINE


def robustness(bench: Bench, settings: FloatArray, step: float, unsafe: Unsafe) -> list[Robustness]:
    """How robust settings, shape (M, n), are.

    The neighbours of a setting differ from it in every characteristic by no more than the filter takes for no change;
    they are simulated as they are, with the study's time step (`step` seconds), half of it and twice.
    """
    members = bench.characteristics
    offsets = np.random.default_rng(bench.study.search.seed).uniform(-1, 1, (NEIGHBOURS, len(members))) * members.threshold
    around = np.clip(settings[:, np.newaxis] + offsets, members.lower, members.upper).reshape(-1, len(members))
    shares = {}
    for factor in STEP_FACTORS:
        on = bench if factor == 1 else bench.with_step(step * factor)
        outcomes = unsafe.of(on.evaluate(around, f"neighbours at {step * factor:g} s a step"))
        shares[step * factor] = outcomes.reshape(len(settings), NEIGHBOURS).mean(axis=1)
    return [Robustness({step: float(of_it[row]) for step, of_it in shares.items()}) for row in range(len(settings))]
