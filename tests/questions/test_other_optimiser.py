"""Joint limits against another optimiser than the package's: random settings, then local search
from the six worst.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safevar_sumo import tolerance
from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import Model, limit_criterion, models_of
from safevar_sumo.questions.tolerance.together import MAX_SIMULATIONS
from safevar_sumo.records import FloatArray
from safevar_sumo.vehicles import CharacteristicSet
from tests.in_process import InlinePool

SIMULATIONS, WORST, STEPS = 3000, 6, 20
"""Simulations of the other optimiser, half of them random; settings from which it searches on;
neighbours at once.
"""


def worst_within(
    lower: FloatArray, upper: FloatArray, models: tuple[Model, ...], seed: int
) -> float:
    """The least that settings between two ends leave, shape (n,), in any of some models."""
    rng = np.random.default_rng(seed)
    n = len(lower)
    # Random settings, half of whose values are at ends, each in a random model.
    shares = rng.random((SIMULATIONS // 2, n))
    shares = np.where(rng.random(shares.shape) < 0.5, np.round(shares), shares)
    settings = lower + shares * (upper - lower)
    of_model = rng.integers(len(models), size=len(settings))
    robustness = np.full(len(settings), np.inf)
    for number, model in enumerate(models):
        robustness[of_model == number] = model.robustness(settings[of_model == number], "random")
    # From the six worst, steps of some values, which become smaller.
    order = np.argsort(robustness)[:WORST]
    best = [(robustness[row], settings[row], models[of_model[row]]) for row in order]
    step = 0.3
    for _ in range(SIMULATIONS // 2 // (WORST * STEPS)):
        for place, (least, setting, model) in enumerate(best):
            is_moved = rng.random((STEPS, n)) < rng.choice([0.15, 0.3, 0.6])
            moves = rng.normal(0.0, step, (STEPS, n)) * is_moved * (upper - lower)
            near = np.clip(setting + moves, lower, upper)
            of_near = model.robustness(near, "local")
            if of_near.min() < least:
                best[place] = of_near.min(), near[np.argmin(of_near)], model
        step *= 0.9
    return float(min(least for least, _, _ in best))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("rain", {"limits": ("tireFric >= 3",), "fits": 3}),
        ("native", {"limits": ("decel >= 7",), "fits": 0}),
        ("smoke", {"fits": 4}),
    ],
)
def test_another_optimiser_finds_nothing_unsafe_within_joint_limits(
    name: str, options: dict[str, Any]
) -> None:
    study = load_study(name)
    members = CharacteristicSet.of(study)
    evaluator = Evaluator(study, InlinePool(), verified=0)
    answer = tolerance.compute(study, evaluator, **options)
    assert evaluator.simulated < 2 * MAX_SIMULATIONS
    assert answer.numbers["box"]
    rows = {row["characteristic"]: row for row in answer.to_dict()["tables"]["limits"]["rows"]}
    lower, upper = (
        np.array([rows[one][f"together_{end}"] for one in members.names]) for end in ("low", "high")
    )
    unsafe = limit_criterion(evaluator, study, None, None, evaluator.evaluate_original())
    models = models_of(evaluator, unsafe, options["fits"]).members
    assert min(worst_within(lower, upper, models, seed) for seed in range(2)) >= 0
