"""Settings that are simulated several times, as their simulator is not deterministic."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from safevar_sumo.metrics import METRICS, UNSAFE_SHARE, Unsafe
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.study import SAFETY_DEGREE

SEVERITY = [
    Outcome.COLLISION,
    Outcome.INVALID_TEST,
    Outcome.TIMEOUT,
    Outcome.NEVER_MOVED,
    Outcome.PASSED,
    Outcome.STOPPED,
]
"""Outcomes of the rounds of a setting, the worst first."""
COLLISION = Unsafe()


def joined(evaluations: Evaluations, repeats: int, criterion: Unsafe = COLLISION) -> Evaluations:
    """Of N settings that were simulated in several rounds, in their order, the worst outcome, the
    safety degree and the collision speed of the worst run, the share of runs that are unsafe by the
    study's own criterion, and the mean of each other metric over the runs that define it. Metrics
    by which a run is unsafe are kept of each round, too.
    """
    n = len(evaluations) // repeats
    columns = np.arange(n)

    def mean(values: FloatArray) -> FloatArray:
        rounds = values.reshape(repeats, n)
        number = np.count_nonzero(~np.isnan(rounds), axis=0)
        total = np.add.reduce(np.nan_to_num(rounds, nan=0.0), axis=0)
        return np.where(number, total / np.maximum(number, 1), np.nan)

    # The worst run.
    outcomes = evaluations.outcome.reshape(repeats, n)
    rank = {str(name): number for number, name in enumerate(SEVERITY)}
    severity = np.reshape([rank[name] for name in evaluations.outcome.tolist()], (repeats, n))
    degrees = evaluations.f_safe.reshape(repeats, n)
    worst = np.argmin(np.where(np.isnan(degrees), np.inf, degrees), axis=0)
    metrics = {name: mean(values) for name, values in evaluations.metrics.items()}
    metrics[SAFETY_DEGREE] = degrees[worst, columns]

    # The share of unsafe runs.
    is_of_shares = criterion.measure == UNSAFE_SHARE.name
    is_unsafe = (COLLISION if is_of_shares else criterion).of(evaluations)
    metrics[UNSAFE_SHARE.name] = mean(is_unsafe.astype(float))
    means_alone = {*METRICS, UNSAFE_SHARE.name} - {SAFETY_DEGREE}
    rounds = {
        f"{name}_{k + 1}": values
        for name in evaluations.metrics
        if name not in means_alone
        for k, values in enumerate(evaluations.metrics[name].reshape(repeats, n))
    }
    return replace(
        evaluations.take(columns),
        outcome=outcomes[np.argmin(severity, axis=0), columns],
        collision_speed=evaluations.collision_speed.reshape(repeats, n)[worst, columns],
        metrics={**metrics, **rounds},
    )
