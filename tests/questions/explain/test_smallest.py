"""The smallest changes to an end of the domain: all minimal ones by brute force, the staircase, and
what the verdict claims of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from msgspec.structs import replace as replace_in

import safevar_sumo as sv
from safevar_sumo.campaign.evaluation import Task, evaluate_settings
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.causes import Cause
from safevar_sumo.questions.evaluator import FRESH_RUNS, Evaluator
from safevar_sumo.questions.explain.combinations import enumerate_causes, staircase
from safevar_sumo.questions.explain.smallest import Smallest
from safevar_sumo.questions.explain.tell import smallest_sentences
from safevar_sumo.questions.sampling import clopper_pearson
from safevar_sumo.questions.sentence import Verdict
from safevar_sumo.questions.words import percentage
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import Study
from tests.support.in_process import SLOW, InlinePool, json_of, rows_of
from tests.support.made_up_studies import (
    ORIGINAL,
    Plant,
    Region,
    made_up_evaluator,
    made_up_study,
    nowhere,
)

pytestmark = pytest.mark.usefixtures("made_up_studies")

COLLISION = Unsafe()
SIDES = (0.0, ORIGINAL, 10.0)


@SLOW
@given(table=st.lists(st.booleans(), min_size=27, max_size=27))
def test_all_minimal_combinations_of_ends_and_no_other_are_found_whatever_the_outcomes(
    table: list[bool],
) -> None:
    table[13] = False  # the original itself

    def region(settings: FloatArray) -> BoolArray:
        """Any function of which characteristics are at which end, monotone or not."""
        return np.array(table)[
            (np.sign(settings - ORIGINAL) + 1).astype(int) @ [1, 3, 9]
        ]

    unsafe = [
        {
            (name, side)
            for name, side in zip("abc", sides, strict=True)
            if side != ORIGINAL
        }
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


def test_likely_combinations_come_first_and_an_unfinished_size_is_not_called_complete() -> (
    None
):
    evaluator = made_up_evaluator(6, lambda one: (one[:, 4] > 9) & (one[:, 5] > 9))
    found = enumerate_causes(evaluator, COLLISION, 12 + 30)
    assert found.simulated == {1: 12, 2: 30}
    assert found.existing == {1: 12, 2: 60}
    assert found.complete_up_to == 1
    assert enumerate_causes(evaluator, COLLISION, 5).complete_up_to == 0


def test_the_staircase_goes_on_below_the_first_share_without_any() -> None:
    """One change alone from 80 % of the way on, two from 50 % on."""

    def region(settings: FloatArray) -> BoolArray:
        share = (settings[:, :2] - ORIGINAL) / (10 - ORIGINAL)
        return (share.max(axis=1) > 0.79) | (share.min(axis=1) > 0.49)

    evaluator = made_up_evaluator(3, region)
    steps = staircase(
        evaluator, COLLISION, enumerate_causes(evaluator, COLLISION, 1000), 1000
    )
    assert [(step.share, step.size) for step in steps] == [
        *((share, 1) for share in (1.0, 0.9, 0.8)),
        *((share, 2) for share in (0.7, 0.6, 0.5)),
        *((share, 0) for share in (0.4, 0.3, 0.2, 0.1)),
    ]
    assert steps[-1].tried == 6 + 12 + 8
    assert not any(step.is_cut for step in steps)


def test_with_few_settings_single_changes_are_simulated_at_every_share() -> None:
    """Two changes are enough at the ends; one alone would be, between 25 and 35 % of the way."""

    def region(settings: FloatArray) -> BoolArray:
        share = (settings - ORIGINAL) / 5
        is_between = (share[:, 0] > 0.25) & (share[:, 0] < 0.35)
        return is_between | (share[:, :2].min(axis=1) > 0.9)

    evaluator = made_up_evaluator(6, region)
    at_ends = enumerate_causes(evaluator, COLLISION, 200)
    steps = staircase(evaluator, COLLISION, at_ends, 12 * 9)
    assert [(step.size, step.tried, step.is_cut) for step in steps[1:]] == [
        *[(0, 12, True)] * 6,
        (1, 12, False),
        *[(0, 12, True)] * 2,
    ]


def answer_of(
    evaluator: Evaluator, sampled: Sequence[dict[str, float]] = ()
) -> tuple[Smallest, str]:
    """The answer, which may know causes of sampled vehicles, and its sentences."""
    causes = [Cause(changes, "collision", -1.0, {}) for changes in sampled]
    smallest = Smallest.of(evaluator, COLLISION, 0, causes)
    return smallest, Verdict(smallest_sentences(smallest, evaluator, COLLISION))


def smallest_of(
    n: int, region: Region, *sampled: dict[str, float]
) -> tuple[Smallest, str]:
    """The answer about a region of n characteristics."""
    return answer_of(made_up_evaluator(n, region), sampled)


def way(settings: FloatArray) -> FloatArray:
    """The share of the way to the upper ends, below 0 to the lower ones."""
    return (settings - ORIGINAL) / 5


def test_one_change_at_half_its_way_leads_where_all_ends_are_safe() -> None:
    smallest, verdict = smallest_of(
        2, lambda rows: np.abs(way(rows)[:, 0] - 0.5) < 0.049
    )
    (row,) = smallest.table.to_dict("records")
    assert (row["causes"], row["begins_at"], row["boundary"]) == (
        {"a": 7.5},
        0.46,
        {"a": 7.3},
    )
    assert row["safe_again"] == 0.55
    assert verdict.startswith(
        "One change is enough for a collision: a at 7.3 N m, 46 % of the way"
    )
    assert (
        "has a gap: at 55 % of the way to the ends, the vehicle is safe again."
        in verdict
    )
    assert "None of the 4 changes of a single characteristic to an end" in verdict
    assert (
        "1 change is enough for a collision if each change goes 50 % of the way"
        in verdict
    )


def test_a_beginning_is_rounded_to_the_unsafe_side() -> None:
    """0.3008 of the way is not 30 %, where nothing is unsafe."""
    smallest, verdict = smallest_of(2, lambda rows: way(rows)[:, 0] > 0.3007)
    assert smallest.table["begins_at"].tolist() == [0.31]
    assert "a at 6.55 N m, 31 % of the way" in verdict
    assert "at 10 to 30 % of the way to the ends" in verdict
    assert "The checks of similar vehicles use these values: a at 10 N m." in verdict
    assert "parameter set" not in verdict


def test_a_cause_begins_where_none_of_its_parts_is_unsafe() -> None:
    """Five changes from 84.3 % of the way on; one of them alone near 44 % of it."""

    def region(settings: FloatArray) -> BoolArray:
        share = way(settings)
        return (np.abs(share[:, 0] - 0.438) < 0.004) | (share.min(axis=1) > 0.843)

    smallest, verdict = smallest_of(5, region)
    found = {
        row.size: (row.begins_at, row.safe_again) for row in smallest.table.itertuples()
    }
    assert found[5][0] == 0.85
    assert np.isnan(found[5][1])
    assert found[1] == (0.44, 0.45)
    assert verdict.startswith(
        "One change is enough for a collision: a at 7.2 N m, 44 % of the way"
    )


def test_a_cause_before_the_ends_is_not_at_the_end_where_few_simulations_are_allowed() -> (
    None
):
    """Two changes at 70 % of the way; one of them alone near 35 % of it."""

    def region(settings: FloatArray) -> BoolArray:
        first, second = way(settings).T
        return (np.abs(first - 0.35) < 0.045) | (
            (np.minimum(first, second) > 0.3) & (first < 0.95)
        )

    evaluator = made_up_evaluator(2, region)
    evaluator.budget.limit = 200
    smallest, _ = answer_of(evaluator)
    assert smallest.table["begins_at"].tolist() == [0.35, 0.7]


def test_combinations_that_contain_a_cause_and_cures_are_counted() -> None:
    """`a` up is unsafe, but not with `b` up."""

    def region(settings: FloatArray) -> BoolArray:
        return (way(settings)[:, 0] > 0.5) & (way(settings)[:, 1] < 0.5)

    smallest, verdict = smallest_of(4, region)
    sides = np.array([*product(SIDES, repeat=4)])
    size = np.count_nonzero(sides != ORIGINAL, axis=1)
    contains = (sides[:, 0] == 10) & (size > 1)
    is_unsafe = region(sides)
    numbers = smallest.numbers
    assert numbers["containing"] == numbers["containing_tried"] == contains.sum()
    assert numbers["tried"] == ((size > 0) & ~contains).sum()
    assert numbers["causes"] == (is_unsafe & ~contains).sum()
    assert numbers["cures"] == (contains & ~is_unsafe).sum()
    assert (
        "The counts of combinations leave out 26 combinations with a smaller cause"
        in verdict
    )
    assert "prevents the failure in 9 of the 26 simulated combinations" in verdict


@SLOW
def test_the_answer_leads_with_the_smallest_changes() -> None:
    """Of rain: one pair, one of three, two of four (the enumeration of another implementation)."""
    answer = json_of("explain rain --fits 2 --jobs 1")
    rows = rows_of(answer, "causes")
    assert sorted(row["size"] for row in rows if row["size"] < 5) == [2, 3, 4, 4]
    (pair,) = (row for row in rows if row["size"] == 2)
    assert pair["causes"] == {"dampRateZeroT_CE": 1.0, "tireFric": 1.0}
    assert 0.95 < pair["begins_at"] <= 1
    numbers = answer["numbers"]
    assert numbers["complete_up_to"] == 4
    assert numbers["causes"] == len(rows)
    assert answer["verdict"].startswith(
        "Two changes together are enough for a collision:"
    )
    counted = "1 of the 264 combinations of two changes causes a collision"
    assert counted in answer["verdict"]
    assert "All causes" not in answer["verdict"]
    first, *_, last = rows_of(answer, "staircase")
    assert (first["share"], first["fewest"], last["fewest"]) == (1.0, 2, None)
    assert "over the 2 parameter sets" in answer["verdict"].replace("each of", "over")


def test_the_study_of_results_is_explained_as_without_results(slippery: Path) -> None:
    answer = sv.explain(slippery, of_study=True, simulations=600, pool=InlinePool())
    assert (
        answer.to_dict()
        == sv.explain(
            sv.load(slippery).study, simulations=600, pool=InlinePool()
        ).to_dict()
    )


def test_the_verdict_claims_no_more_than_was_simulated() -> None:
    """Two changes collide and, without them, three others."""

    def region(settings: FloatArray) -> BoolArray:
        moved = settings - ORIGINAL
        return ((moved[:, 0] > 3) & (moved[:, 1] > 3)) | (
            (moved[:, 1:] < -3).all(axis=1)
        )

    _, sentences = smallest_of(4, region)
    assert "1 of the 24 combinations of two changes causes a collision." in sentences
    assert "1 of the 28 combinations of three changes causes a collision." in sentences
    assert (
        "None of 480 simulated combinations of up to four changes causes a collision at"
        in sentences
    )


class Noisy(Plant):
    """A pool in which each vehicle runs several times. Each run collides with the probability that
    `probability` gives the vehicle; batches of many vehicles are those of searches.
    """

    def __init__(
        self,
        study: Study,
        probability: Callable[[FloatArray], FloatArray],
        bad_luck: float,
        seed: int,
    ):
        super().__init__(study, nowhere)
        self._probability = probability
        self._bad_luck = bad_luck
        self._random = np.random.default_rng(seed)

    def compute(self, function: Callable[..., Any], task: Task, *arguments: Any) -> Any:
        if function is not evaluate_settings:
            return ""
        (settings,) = arguments
        evaluations = self.evaluate(settings)
        repeats = task.study.scenario.repeats
        probability = self._probability(settings)
        if repeats == REPEATS:
            # Runs of the search, not fresh runs.
            probability = np.maximum(probability, self._bad_luck)
        fails = self._random.random((repeats, len(settings))) < probability
        degrees = np.where(fails, -1.0, 2.0)
        runs = {f"safety_degree_{number}": row for number, row in enumerate(degrees, 1)}
        is_unsafe = fails.any(axis=0)
        return replace(
            evaluations,
            outcome=np.where(is_unsafe, "collision", "stopped").astype("U16"),
            metrics=evaluations.metrics | runs | {"safety_degree": degrees.min(axis=0)},
        )


REPEATS = 4


def noisy_answer(
    probability: Callable[[FloatArray], FloatArray], bad_luck: float, seed: int = 5
) -> tuple[Smallest, str]:
    """The answer about two characteristics, of vehicles that run four times."""
    study = made_up_study(2)
    scenario = replace_in(study.scenario, repeats=REPEATS)
    study = replace_in(study, scenario=scenario)
    return answer_of(Evaluator(study, Noisy(study, probability, bad_luck, seed)))


def test_a_cause_that_no_fresh_run_confirms_is_none() -> None:
    """In the search 5 % of the runs of each vehicle fail, in fresh runs none."""
    smallest, verdict = noisy_answer(lambda rows: np.zeros(len(rows)), 0.05)
    assert smallest.table.empty
    assert verdict.startswith("The search found no cause of a collision")


def test_with_repeats_a_cause_has_its_fresh_runs_and_is_not_enough() -> None:
    """Only changes beyond 60 % of the way ever fail, in 30 % of their runs."""
    smallest, verdict = noisy_answer(
        lambda rows: np.where(way(rows)[:, 0] > 0.6, 0.3, 0.0), 0.01
    )
    (row,) = smallest.table.to_dict("records")
    assert row["boundary"]["a"] > 8
    assert row["runs"] == FRESH_RUNS
    assert row["unsafe_runs"] == row["failing_runs"] / FRESH_RUNS > 0
    assert np.isnan(row["safe_again"])
    number = row["failing_runs"]
    low, high = (percentage(end) for end in clopper_pearson(number, FRESH_RUNS))
    assert (
        f"With 1 change the vehicle fails in {number} of 20 repeated runs (95 %: {low} to {high}"
        " %): a at"
    ) in verdict
    assert "enough" not in verdict


def test_of_many_noisy_searches_the_interval_holds_the_truth() -> None:
    """The intervals hold the true share, 25 %, although the search chooses its unluckiest runs."""
    held = []
    for seed in range(20):
        smallest, _ = noisy_answer(
            lambda rows: np.where(way(rows)[:, 0] > 0.5, 0.25, 0.0), 0.0, seed
        )
        row = smallest.table.iloc[0]
        low, high = clopper_pearson(row["failing_runs"], row["runs"])
        held.append(low <= 0.25 <= high)
    assert np.mean(held) >= 0.85


@SLOW
def test_what_is_left_of_few_simulations_explains_a_sampled_failure() -> None:
    """Of one failure there are causes, but no shares."""
    answer = sv.explain(
        "native", simulations=300, unsafe="collision", pool=InlinePool()
    )
    assert answer.numbers["failures"] > answer.numbers["analysed"] == 1
    assert answer.tables["characteristics"].empty
    assert len(answer.tables["distinct_causes"])
    assert (
        "simulated combinations of two changes cause a collision (145 such"
        in answer.verdict
    )


def test_an_island_that_only_sampled_vehicles_hit_leads() -> None:
    """One change at 43.2 to 43.8 % of the way, and two changes at the ends."""

    def region(settings: FloatArray) -> BoolArray:
        share = way(settings)
        is_island = np.abs(share[:, 2] - 0.435) < 0.003
        return is_island | (share[:, :2].min(axis=1) > 0.95)

    smallest, verdict = smallest_of(3, region, {"c": 7.176}, {"c": 7.172})
    first, second = smallest.table.to_dict("records")
    assert (first["size"], second["size"]) == (1, 2)
    assert 7.16 < first["boundary"]["c"] < 7.19
    assert 0.432 <= first["begins_at"] <= 0.4344
    assert first["safe_again"] == 0.44
    value = first["boundary"]["c"]
    assert verdict.startswith(f"One change is enough for a collision: c at {value} N m")
    assert first["robust_share"] < 0.8
    assert "The cause is borderline" in verdict
    assert "includes" not in verdict


def test_a_sampled_vehicle_shows_that_a_known_cause_begins_nearer() -> None:
    """One change at its end, and at 20.2 to 20.8 % of the way."""

    def region(settings: FloatArray) -> BoolArray:
        share = way(settings)[:, 0]
        return (np.abs(share - 0.205) < 0.003) | (share > 0.9)

    smallest, _ = smallest_of(3, region, {"a": 6.025})
    (row,) = smallest.table.to_dict("records")
    assert row["causes"] == {"a": 10.0}
    assert region(np.array([[row["boundary"]["a"], ORIGINAL, ORIGINAL]]))[0]
    assert 0.202 <= row["begins_at"] <= 0.205
    assert (row["safe_again"], row["robust_share"]) == (0.21, 1.0)


def test_sampled_changes_at_different_shares_are_told_without_a_share() -> None:
    """Two changes, one of them small, and the ends are safe."""

    def region(settings: FloatArray) -> BoolArray:
        share = way(settings)
        is_first = (share[:, 0] > 0.15) & (share[:, 0] < 0.25)
        return is_first & (share[:, 1] > 0.6) & (share[:, 1] < 0.68)

    smallest, verdict = smallest_of(3, region, {"a": 6.0, "b": 8.3})
    (row,) = smallest.table.to_dict("records")
    assert np.isnan(row["begins_at"])
    boundary = row["boundary"]
    assert region(np.array([[boundary["a"], boundary["b"], ORIGINAL]]))[0]
    assert verdict.startswith(
        "Two changes together are enough for a collision: a at"
        f" {boundary['a']} N m and b at {boundary['b']} N m. All other"
    )
    assert "includes c." in verdict


def test_causes_with_fewer_changes_come_first_and_then_the_more_robust() -> None:
    """One change just at its end, another one from half of its way on, and a pair."""

    def region(settings: FloatArray) -> BoolArray:
        share = way(settings)
        pair = (share[:, 2] > 0.5) & (share[:, 0] < -0.5)
        return (share[:, 0] > 0.999) | (share[:, 1] > 0.5) | pair

    smallest, _ = smallest_of(3, region)
    table = smallest.table
    assert [list(changes) for changes in table["causes"]] == [["b"], ["a"], ["a", "c"]]
    assert table["robust_share"][0] > table["robust_share"][1]
