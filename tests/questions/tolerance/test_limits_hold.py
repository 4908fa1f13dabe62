"""Joint limits hold whatever their study and criterion: another optimiser than the package's finds
nothing unsafe within them, at any point, in any parameter set.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import Bounds, differential_evolution

from safevar_sumo import tolerance
from safevar_sumo.api.simulation import load_study
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.by_criterion import study_by
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.model_spread import studies_of_sets
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from tests.support.in_process import InlinePool, rows_of, write
from tests.support.made_up import HARDEST_BRAKING

ROUNDS = 12
"""Number of generations of the other optimiser."""
MANUAL = re.compile(r"(?<![\w^])\d+(?:\.\d+)?")
"""An end of a limit in a sentence of a maintenance manual."""
FEW_TESTS = {
    "aggregate": "worst",
    "tests": [
        {"name": "CPFA", "parameters": {"test": "CPFA"}, "over": {"speed": [20, 40]}},
        {
            "name": "CPNA",
            "parameters": {"test": "CPNA"},
            "over": {"speed": [40], "impact_location": [25, 75]},
        },
    ],
}
CLAIMS: dict[str, tuple[str, dict[str, Any], dict[str, Any], int, str]] = {
    "wear": (
        "wear",
        {"matrix": FEW_TESTS},
        {
            "limits": ("treadDepth >= 3",),
            "fits": 2,
            "characteristics": ("treadDepth,brakeTorque,brakeResponse",),
        },
        600,
        "at 3 mm or more",
    ),
    "a metric, worst in a matrix": (
        "wear",
        {"matrix": FEW_TESTS},
        {
            "unsafe": Unsafe.parse("drac > 8"),
            "fits": 2,
            "characteristics": ("treadDepth,brakeTorque,brakeResponse",),
        },
        600,
        "in 2 of 2 parameter sets",
    ),
    "a user's metric": (
        "rain",
        {"metrics": {"also": ["hardest_braking:HARDEST"]}},
        {
            "unsafe": Unsafe.parse("hardest > 6.8"),
            "fits": 0,
            "characteristics": ("tireFric,maxBrakeTorque",),
        },
        600,
        "hardest > 6.8",
    ),
    "SUMO's vehicle, gaps between bumpers": (
        "native",
        {},
        {"limits": ("decel >= 7",), "fits": 0},
        1500,
        "vehicle that was tested within these limits keeps at least 0.3 m",
    ),
    "several parameter sets": (
        "smoke",
        {},
        {"fits": 4},
        1500,
        "in 4 of 4 parameter sets",
    ),
    "encounters": (
        "sun",
        {"encounters": "ranges"},
        {"fits": 0, "characteristics": ("tireFric,maxBrakeTorque,dampRateZeroT_CE",)},
        4000,
        "All corner cases",
    ),
}
"""By what is special: study, what is changed of it, what is asked, simulations of the other
optimiser in each parameter set, and what is said.
"""
Judge = Callable[[FloatArray], FloatArray]


def judge_of(study: Study, unsafe: Unsafe, margin: float) -> Judge:
    """What settings leave, shape (M,), at the point where it is least: of a metric's bound, else of
    the margin; infinite where an encounter does not count.
    """
    system = assemble(study)
    contact = 4.7 if study.name == "native" else 0.0  # the vehicle's length

    def judge(settings: FloatArray) -> FloatArray:
        least = np.full(len(settings), np.inf)
        for result in simulate_all_points(system, settings):
            found = result.evaluations
            left = found.f_safe - contact - margin
            if unsafe.bound is not None:
                left = unsafe.bound.limit - found.column(unsafe.bound.measure)
            left = np.where(found.collided, -1.0, left)
            counts = system.measuring.scoring.violation(found) == 0
            least = np.fmin(least, np.where(counts, left, np.inf))
        return least

    return judge


def worst_within(
    lower: FloatArray,
    upper: FloatArray,
    judges: list[Judge],
    simulations: int,
    seed: int,
) -> float:
    """The least that settings between two ends leave, shape (n,), by any of some judges: SciPy's
    differential evolution, from random settings, half of whose values are at ends.
    """
    rng = np.random.default_rng(seed)
    shares = rng.random((simulations // ROUNDS, len(lower)))
    shares = np.where(rng.random(shares.shape) < 0.5, np.round(shares), shares)
    found = differential_evolution(
        lambda columns: np.min([judge(columns.T) for judge in judges], axis=0),
        Bounds(lower, upper),
        init=lower + shares * (upper - lower),
        maxiter=ROUNDS,
        tol=0,
        polish=False,
        vectorized=True,
        updating="deferred",
        seed=seed,
    )
    return float(found.fun)


@pytest.mark.slow
@pytest.mark.parametrize("claim", CLAIMS)
def test_another_optimiser_finds_nothing_unsafe_within_joint_limits(
    claim: str, in_tmp: Path, request: pytest.FixtureRequest
) -> None:
    """Each characteristic is as its printed sentence demands, and keeps the margin with the study's
    own parameter set; with others it does not collide.
    """
    name, changes, options, simulations, said = CLAIMS[claim]
    if claim != "several parameter sets":  # which few simulations do not reach
        request.getfixturevalue("few_simulations")
    write("hardest_braking.py", HARDEST_BRAKING)
    unsafe = options.get("unsafe", Unsafe())
    study = study_by(load_study(name, **changes), unsafe)
    evaluator = Evaluator(study, InlinePool(), verified=0)
    answer = tolerance.compute(study, evaluator, **options)
    numbers, members = answer.numbers, CharacteristicSet.of(study)
    assert numbers["box"]
    assert numbers["kept"] or not options.get("limits")
    sets = studies_of_sets(study)[: numbers["fits_tried"]] if study.spread else [study]
    assert numbers["fits"] == len(sets) == max(options["fits"], 1)
    lower, upper = (
        np.where(members.of_vehicle, members.original, ends)
        for ends in (members.lower, members.upper)
    )
    for row in rows_of(answer.to_dict(), "limits"):
        column = members.names.index(row["characteristic"])
        item = members.members[column]
        demand = row["sentence"].partition(". ")[0]
        low, *_, high = MANUAL.findall(demand) * 2
        lower[column] = item.lower if demand.endswith("or less") else low
        upper[column] = item.upper if demand.endswith("or more") else high
        ends = row["together_low"], row["together_high"]
        assert (lower[column], upper[column]) == ends, "as printed"
        assert row["alone_low"] <= ends[0] <= ends[1] <= row["alone_high"]
    assert (
        said in f"{answer.verdict} {answer.tested} {answer.values('limits.sentence')}"
    )
    judges = [
        judge_of(each, unsafe, 0.0 if number else numbers["margin"])
        for number, each in enumerate(sets)
    ]
    assert (
        min(worst_within(lower, upper, judges, simulations, seed) for seed in range(2))
        >= 0
    )
