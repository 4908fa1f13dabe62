"""The smallest changes to an end of the domain: all minimal ones by brute force, the staircase, and
what the verdict claims of them.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

import safevar_sumo as sv
from safevar_sumo.api.simulation import load_study
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.evaluator import Evaluator, open_evaluator
from safevar_sumo.questions.explain.combinations import enumerate_causes, staircase
from safevar_sumo.questions.explain.smallest import Smallest
from safevar_sumo.questions.model_spread import studies_of_sets
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble
from tests.in_process import InlinePool, json_of
from tests.questions.conftest import ORIGINAL, made_up_evaluator, nowhere

COLLISION = Unsafe()
SIDES = (0.0, ORIGINAL, 10.0)


@pytest.mark.slow
@given(table=st.lists(st.booleans(), min_size=27, max_size=27))
def test_all_minimal_combinations_of_ends_and_no_other_are_found_whatever_the_outcomes(
    table: list[bool],
) -> None:
    table[13] = False  # the original itself

    def region(settings: FloatArray) -> BoolArray:
        """Any function of which characteristics are at which end, monotone or not."""
        return np.array(table)[(np.sign(settings - ORIGINAL) + 1).astype(int) @ [1, 3, 9]]

    unsafe = [
        {(name, side) for name, side in zip("abc", sides, strict=True) if side != ORIGINAL}
        for sides in product(SIDES, repeat=3)
        if region(np.array([sides]))[0]
    ]
    minimal = [each for each in unsafe if not any(other < each for other in unsafe)]
    found = enumerate_causes(made_up_evaluator(3, region), COLLISION, 1000)
    assert sorted(sorted(cause.changes.items()) for cause in found.causes) == sorted(
        sorted(each) for each in minimal
    )
    assert found.simulated == found.existing
    assert found.complete_up_to == 3


def test_likely_combinations_come_first_and_an_unfinished_size_is_not_called_complete() -> None:
    evaluator = made_up_evaluator(6, lambda one: (one[:, 4] > 9) & (one[:, 5] > 9))
    found = enumerate_causes(evaluator, COLLISION, 12 + 30)
    assert found.simulated == {1: 12, 2: 30}
    assert found.existing == {1: 12, 2: 60}
    assert found.complete_up_to == 1
    assert enumerate_causes(evaluator, COLLISION, 5).complete_up_to == 0


def test_the_staircase_ends_at_the_first_share_without_any() -> None:
    """One change alone from 80 % of the way on, two from 50 % on."""

    def region(settings: FloatArray) -> BoolArray:
        share = (settings[:, :2] - ORIGINAL) / (10 - ORIGINAL)
        return (share.max(axis=1) > 0.79) | (share.min(axis=1) > 0.49)

    evaluator = made_up_evaluator(3, region)
    steps = staircase(evaluator, COLLISION, enumerate_causes(evaluator, COLLISION, 1000), 1000)
    assert [(step.share, step.size) for step in steps] == [
        *((share, 1) for share in (1.0, 0.9, 0.8)),
        *((share, 2) for share in (0.7, 0.6, 0.5)),
        (0.4, 0),
    ]
    assert steps[-1].tried == 6 + 12 + 8
    nothing = made_up_evaluator(2, nowhere)
    assert len(staircase(nothing, COLLISION, enumerate_causes(nothing, COLLISION, 99), 99)) == 1


@pytest.mark.parametrize(
    ("name", "budget", "sizes"), [("native", 165, (2, 13)), ("wear", 50, (4, 0, 1))]
)
def test_few_settings_find_the_causes_of_shipped_studies(
    name: str, budget: int, sizes: tuple[int, ...]
) -> None:
    evaluator = Evaluator(load_study(name), InlinePool(), verified=0)
    found = enumerate_causes(evaluator, COLLISION, budget)
    counts = [len(cause.changes) for cause in found.causes]
    assert tuple(counts.count(size) for size in range(1, len(sizes) + 1)) == sizes
    assert evaluator.simulated <= budget


@pytest.mark.slow
def test_the_answer_leads_with_the_smallest_changes() -> None:
    """Of rain: one pair, one of three, two of four (the enumeration of another implementation)."""
    answer = json_of("explain", "rain", "--fits", "2", "--jobs", "1")
    rows = answer["tables"]["causes"]["rows"]
    assert sorted(row["size"] for row in rows if row["size"] < 5) == [2, 3, 4, 4]
    (pair,) = (row for row in rows if row["size"] == 2)
    assert pair["causes"] == {"dampRateZeroT_CE": 1.0, "tireFric": 1.0}
    assert 0.95 < pair["begins_at"] <= 1
    numbers = answer["numbers"]
    assert numbers["complete_up_to"] == 4
    assert numbers["causes"] == len(rows)
    assert answer["verdict"].startswith(
        "All 24 single changes to an end of the domain are safe. Of the 264 pairs one collides:"
    )
    assert "All causes" not in answer["verdict"]
    first, *_, last = answer["tables"]["staircase"]["rows"]
    assert (first["share"], first["fewest"], last["fewest"]) == (1.0, 2, None)

    # A tenth of the sampled vehicles with the other parameter set.
    study = load_study("rain")
    with open_evaluator(study, InlinePool()) as evaluator:
        drawn = evaluator.feasible_settings(4096, study.search.seed, feasible_after_filter=True)
        tenth = evaluator.characteristics.filter(drawn)[:409]
    other = drive_and_score(assemble(studies_of_sets(study)[1]), tenth).collided.mean()
    own = numbers["failures"] / numbers["settings"]
    assert numbers["by_set"] == [own, other]
    assert "Over 2 parameter sets of the vehicle model the share of unsafe" in answer["verdict"]


def test_the_study_of_results_is_explained_as_without_results(slippery: Path) -> None:
    answer = sv.explain(slippery, of_study=True, simulations=600, jobs=1)
    study = sv.load(slippery).study
    assert answer.to_dict() == sv.explain(study, simulations=600, jobs=1).to_dict()


@pytest.mark.slow
def test_of_a_searched_scenario_each_combination_meets_critical_encounters() -> None:
    answer = sv.explain("sun", ranges=True, fits=0, quick=True, pool=InlinePool())
    assert "Scope: each combination was simulated in the original encounter" in answer.verdict


def test_the_verdict_claims_no_more_than_was_simulated() -> None:
    """Two changes collide and, without them, three others."""

    def region(settings: FloatArray) -> BoolArray:
        moved = settings - ORIGINAL
        return ((moved[:, 0] > 3) & (moved[:, 1] > 3)) | ((moved[:, 1:] < -3).all(axis=1))

    evaluator = made_up_evaluator(4, region)
    smallest = Smallest.of(evaluator, COLLISION, 0)
    sentences = " ".join(smallest.sentences(evaluator, COLLISION))
    assert "pairs one collides: a and b." in sentences
    assert "combinations of three one collides without a smaller cause: b, c and d." in sentences
    last = smallest.steps[-1]
    assert f"none of {last.tried} combinations of up to four changes at" in sentences
