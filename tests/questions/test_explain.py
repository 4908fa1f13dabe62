"""Explanations of simulated failures, everything they say simulated afresh."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from io import StringIO
from itertools import combinations

import numpy as np
import pandas as pd
import pytest
import scipy
from hypothesis import given, strategies as st
from rich.console import Console

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.case import Case
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain import ExplainOptions
from safevar_sumo.questions.explain.across_fits import count_holding, measure_across_fits
from safevar_sumo.questions.explain.answer import Explained, study_verdict
from safevar_sumo.questions.explain.causes import (
    RESOLUTION,
    BoundaryState,
    Cause,
    count_distinct_causes,
    describe_causes,
    find_minimal_causes,
    necessity_frame,
    select_affordable_rows,
)
from safevar_sumo.questions.explain.compute import explain_failures
from safevar_sumo.questions.preventability import DRIVERS, Preventability
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.results import handles_of
from safevar_sumo.sumo import assemble, evaluate
from safevar_sumo.terminal import print_answer
from tests.conftest import FITS
from tests.in_process import InlinePool
from tests.questions.conftest import (
    ORIGINAL,
    Plant,
    box,
    everywhere,
    made_up_evaluator,
    made_up_study,
    nowhere,
    two_islands,
)

CAUSE_KEYS = ("changes", "boundary", "fraction", "outcome", "safety_degree", "end", "robustness")


@pytest.mark.slow
def test_the_eight_digits_of_a_command_end_alike(case: Case, explained: Explained) -> None:
    causes = [cause for one in explained.explanations for cause in one.causes]
    short = [{name: float(f"{value:.8g}") for name, value in cause.boundary.items()} for cause in causes]
    rows = np.array([case.characteristics.setting(values, "test") for values in short])
    assert (case.characteristics.filter(rows) == rows).all(), "a value that the filter takes for no change"
    assert evaluate(assemble(case.study), rows).collided.all()


@pytest.mark.slow
def test_the_records_are_those_of_the_solutions(case: Case, explained: Explained) -> None:
    *records, last = json.loads(json.dumps(explained.to_dict(), allow_nan=False))
    output = [str(handle) for handle in handles_of(case.solutions)]
    keys = (
        "algorithm run index setting outcome safety_degree changed minimal_causes robustness avoided_by reasons points"
    )
    for one in records:
        assert list(one) == keys.split()
        row = case.solutions.iloc[output.index(f"{one['algorithm']}:{one['run']}:{one['index']}")]
        assert one["setting"] == row[list(case.characteristics.names)].to_dict()
        assert (one["outcome"], one["safety_degree"]) == (row["outcome"], row["safety_degree"])
        for cause in one["minimal_causes"]:
            assert list(cause) == [*CAUSE_KEYS, "across_fits"]
            assert cause["changes"].items() <= one["setting"].items()
            assert 0 <= cause["across_fits"]["holds"] <= cause["across_fits"]["sets"] == FITS
    assert list(last["summary"]) == ["necessary", "changed", "necessary_interval", "preventable", "across_fits"]


@pytest.mark.slow
def test_the_failures_that_matter_come_first(case: Case, explained: Explained) -> None:
    crashes = case.solutions[case.solutions["outcome"] == "collision"]
    reasons = {reason: one for one in explained.explanations for reason in one.reasons}
    assert len(reasons["fewest changes"].changed) == crashes["f_num_diff"].min()
    assert reasons["most severe"].safety_degree == crashes["safety_degree"].min()
    assert explained.failures == explained.analysed == len(crashes[list(case.characteristics.names)].drop_duplicates())


@pytest.mark.slow
def test_a_named_solution_is_explained_whatever_it_is(case: Case) -> None:
    safe = case.solutions["f_num_diff"].where(case.solutions["f_safe"] > 1).idxmin()  # few changes have few subsets
    handle = str(handles_of(case.solutions)[safe])
    evaluator = Evaluator(case.study, InlinePool())
    options = ExplainOptions(solutions=(handle,), unsafe="collision", fits=0)
    (one,) = explain_failures(case, options, evaluator).explanations
    assert (str(one.handle), one.causes, one.reasons) == (handle, (), ("requested",))
    with pytest.raises(InputError, match="nsga2:7:0"):
        explain_failures(case, ExplainOptions(solutions=("nsga2:7:0",)), evaluator)


def printed(explained: Explained, *, full: bool) -> str:
    console = Console(file=StringIO(), width=80, _environ={})
    print_answer(console, explained.study, explained.no_verdict, explained.parts("here", full=full))
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


@pytest.mark.slow
def test_the_answer_takes_ten_lines_and_the_rest_is_asked_for(explained: Explained) -> None:
    short, full = printed(explained, full=False).splitlines(), printed(explained, full=True)
    assert len(short) <= 10
    assert short[:-1] == full.splitlines()[: len(short) - 1]
    assert short[-1].endswith("python -m safevar_sumo explain here --full")
    assert short[1 : 1 + len(explained.sentences())] == explained.sentences()
    assert re.search(r"max_rpm 5800 -> \d+ r/min", full), "28 r/min are no change at all: no decimals"


@pytest.mark.slow
def test_the_verdict_tells_a_manager_conditions_limits_robustness_and_who_avoids_it(explained: Explained) -> None:
    """The numbers are those of `explain`; no headline names a solution."""
    degree, leading, findings = float(explained.original.f_safe[0]), explained.explanations[0], explained.verdict[1:-1]
    start = f"With the weather 'wet leaves', the original vehicle stops {degree:.2f} m short of the pedestrian."
    assert explained.verdict[0] == start
    assert leading.cause is not None
    for item in leading.characteristics:
        if item.name in leading.cause.boundary:
            value = leading.cause.boundary[item.name]
            side = "above" if value > item.original else "below"
            assert f"{item.short_name} {side} {item.text(value)}{item.suffix}" in findings[-1]
    share = f"{100 * leading.robustness.share:.0f} % of the neighbours are unsafe too"
    assert re.search(
        rf"the vehicle collides \(.*\)\. Found .* a collision at {-leading.safety_degree:.1f} m/s, .*{share}",
        findings[-1],
    )
    assert str(leading.handle) not in str(findings)
    assert explained.verdict[-1] == str(explained.preventability)
    assert explained.counts.startswith(
        f"{explained.failures} of {explained.looked_at} different solutions of the search "
    )


@pytest.mark.slow
@pytest.mark.parametrize("collides", [True, False])
def test_a_study_ends_with_how_many_of_its_solutions_are_unsafe_and_with_the_fewest_changes(
    case: Case, collides: bool
) -> None:
    original = Evaluator(case.study, InlinePool()).evaluate_original()
    degree = float(original.f_safe[0])
    solutions = case.solutions if collides else case.solutions[case.solutions["f_safe"] > 0.3 * degree]
    first, *fewest = study_verdict(replace(case, solutions=solutions.reset_index(drop=True)), original)
    distinct = solutions.drop_duplicates(list(case.characteristics.names))
    unsafe = distinct[distinct["outcome"] == "collision" if collides else distinct["f_safe"] < degree / 2]
    counts = f"{len(unsafe)} of {len(distinct)} different solutions of the search are unsafe: "
    assert first.startswith(
        f"With the weather 'wet leaves', the original vehicle stops {degree:.2f} m short of the pedestrian. {counts}"
    )
    least = unsafe.sort_values(["f_num_diff", "f_safe"]).iloc[0]
    (line,) = fewest
    assert f"{abs(least['f_safe']):.2f} m" in line
    assert len(re.findall(r" -> ", line)) == least["f_num_diff"]


COLLISION = Unsafe()


@pytest.mark.slow
@given(table=st.lists(st.booleans(), min_size=32, max_size=32), full=st.integers(0, 31))
def test_all_smallest_unsafe_subsets_and_no_other_whatever_the_outcomes(table: list[bool], full: int) -> None:
    def outcome(settings: FloatArray) -> BoolArray:
        """Any function of which characteristics are changed, monotone or not."""
        return np.array(table)[(settings != ORIGINAL) @ (1 << np.arange(5))]

    setting = np.where(full >> np.arange(5) & 1, 9.0, ORIGINAL)
    columns = np.flatnonzero(setting != ORIGINAL).tolist()
    unsafe = [
        set(subset)
        for size in range(len(columns) + 1)
        for subset in combinations(columns, size)
        if table[sum(1 << column for column in subset)]
    ]
    smallest = [subset for subset in unsafe if len(subset) == min(map(len, unsafe))]
    (result,) = find_minimal_causes(made_up_evaluator(5, outcome), setting[np.newaxis], COLLISION)
    found = [set(map("abcde".index, cause.changes)) for cause in result]
    assert found == smallest
    for columns_of_cause in found:
        assert not any(subset < columns_of_cause for subset in unsafe)


def described(evaluator: Evaluator, *setting: float) -> Cause:
    """The only cause of a setting."""
    (causes,) = find_minimal_causes(evaluator, np.array([setting]), COLLISION)
    (result,) = describe_causes(evaluator, causes, COLLISION)
    return result


def test_a_boundary_is_the_first_unsafe_place_and_no_island_is_skipped() -> None:
    evaluator = made_up_evaluator(3, two_islands)
    result = described(evaluator, 9.5, 1.0, 8.0)
    assert result.fraction == pytest.approx(1.5 / 4.5, abs=2 * RESOLUTION)
    assert result.boundary["a"] > 6.5 >= result.boundary["a"] - 2 * RESOLUTION * 4.5
    assert result.alone == result.boundary
    assert result.end == BoundaryState.SAFE


def test_a_boundary_just_below_a_change_is_found_as_accurately() -> None:
    evaluator = made_up_evaluator(1, lambda settings: settings[:, 0] > 8.996)
    assert described(evaluator, 9.0).boundary["a"] == pytest.approx(8.996, abs=4 * RESOLUTION)


def test_nothing_is_shrunk_into_what_the_filter_takes_for_no_change() -> None:
    evaluator = made_up_evaluator(1, lambda settings: settings[:, 0] > ORIGINAL)
    result = described(evaluator, 9.0)
    threshold = evaluator.characteristics.threshold[0]
    limit = result.boundary["a"]
    assert limit == pytest.approx(ORIGINAL + threshold, rel=1e-3)
    assert evaluator.characteristics.filter(np.array([limit]))[0] == limit
    assert result.end == BoundaryState.FILTER


def test_a_boundary_that_ends_where_nothing_can_be_simulated_says_so() -> None:
    study = made_up_study(1)
    evaluator = Evaluator(
        study, Plant(study, lambda rows: rows[:, 0] > 7, failing=lambda rows: (rows[:, 0] > 6) & (rows[:, 0] <= 7))
    )
    result = described(evaluator, 9.0)
    assert (result.boundary["a"], result.end) == (pytest.approx(7, abs=1e-3), BoundaryState.NOT_SIMULATED)


def test_necessary_and_changed_over_failures() -> None:
    evaluator = made_up_evaluator(3, lambda settings: box(settings) | (settings[:, 2] > 9))
    settings, members = np.array([[9.0, 1.0, 5.0], [9.0, 1.0, 8.0], [9.0, 1.0, 9.5]]), evaluator.characteristics
    causes = find_minimal_causes(evaluator, settings, COLLISION)
    frame, of_four = (
        necessity_frame(members, members.changed(settings), causes, number).set_index("characteristic")
        for number in (3, 4)
    )
    assert frame["changed"].to_dict() == pytest.approx({"a": 1, "b": 1, "c": 2 / 3})
    assert frame["necessary"].to_dict() == pytest.approx({"a": 2 / 3, "b": 2 / 3, "c": 1 / 3})
    assert frame["necessary_lower"].equals(frame["necessary"]), "of all failures the shares are exact"
    sampled = of_four.loc["c"]
    ends = [scipy.stats.beta.ppf(q, *shape) for q, shape in ((0.025, (1, 3)), (0.975, (2, 2)))]
    assert sampled[["necessary_lower", "necessary_upper"]].tolist() == pytest.approx(ends), "1 of a sample of 3"
    distinct = count_distinct_causes(members, causes)
    assert distinct[["cause", "failures"]].to_numpy().tolist() == [[("a up", "b down"), 2], [("c up",), 1]]


def test_conclusions_across_fitted_models() -> None:
    """Own: a up and b down together are unsafe. Second: a up alone. Third: nothing. Fourth: as the own, only wider."""
    wider = made_up_evaluator(3, lambda one: (one[:, 0] > 7) & (one[:, 1] < 5))
    models = [*(made_up_evaluator(3, region) for region in (box, lambda one: one[:, 0] > 8, nowhere)), wider]
    settings = np.array([[9.0, 1.0, 5.0], [7.5, 1.0, 8.0], [9.0, 8.0, 5.0], [5.0, 5.0, 5.0]])
    evaluations = models[0].evaluate(settings, "settings")
    rows = COLLISION.of(evaluations)
    causes = [cause for of_one in find_minimal_causes(models[0], settings[rows], COLLISION) for cause in of_one]
    assert count_holding(models, causes, COLLISION) == [2] * len(causes)
    nobody = Preventability(verdicts=pd.DataFrame(columns=[*DRIVERS, "point"]), collisions=0)
    necessity = pd.DataFrame({"characteristic": ["a", "b", "c"], "necessary": [1.0, 1.0, 0.0]})
    result = measure_across_fits(models, evaluations, COLLISION, necessity, nobody)
    ranges = {"a": [1.0, 1.0], "b": [0.0, 1.0], "c": [0.0, 0.0]}
    assert result.to_dict() == {
        "unsafe": {"sets": 4, "range": [0.0, 0.5]},
        "necessary": {name: {"sets": 4, "range": ends} for name, ends in ranges.items()},
        "preventable": {},
    }
    safe = measure_across_fits(models, evaluations.take([3]), COLLISION, necessity.head(0), nobody).to_dict()
    assert safe == {"unsafe": {"sets": 4, "range": [0.0, 0.0]}, "necessary": {}, "preventable": {}}, "safe with each"


def test_more_failures_than_can_be_afforded_are_sampled_and_always_the_same() -> None:
    evaluator = made_up_evaluator(8, everywhere)
    settings = np.random.default_rng(1).uniform(6, 9, (50, 8))
    few = select_affordable_rows(settings, evaluator, 2000)
    assert few == select_affordable_rows(settings, evaluator, 2000)
    assert 0 < len(few) < 50
    assert select_affordable_rows(settings, evaluator, 10**6) == list(range(50))
    settings[:, 3:] = ORIGINAL
    assert len(select_affordable_rows(settings, evaluator, 70)) == 10, (
        "of three changes no, one and two of them: 1 + 3 + 3 simulations"
    )
