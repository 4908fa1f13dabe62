"""Explanations of simulated failures, everything they say simulated afresh."""

from __future__ import annotations

import re
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.case import Results, build_case
from safevar_sumo.questions.cause_limits import BoundaryState, Limits, find_cause_limits
from safevar_sumo.questions.causes import (
    Causes,
    are_causes,
    causes_of_runs,
    count_distinct_causes,
    count_needed,
    find_minimal_causes,
    select_affordable_rows,
)
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain import explain, failures
from safevar_sumo.questions.explain.tables import (
    CAUSE_COLUMNS,
    printed_limits,
)
from safevar_sumo.questions.sampling import clopper_pearson
from safevar_sumo.questions.tables import cell_text
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.results import handles_of, solutions_frame
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble
from tests.support.in_process import SLOW, InlinePool, json_of, numbers_of, rows_of
from tests.support.made_up import FITS
from tests.support.made_up_studies import (
    ORIGINAL,
    Plant,
    Region,
    box,
    everywhere,
    made_up_evaluator,
    made_up_model,
    made_up_study,
    nowhere,
    two_islands,
)

pytestmark = pytest.mark.usefixtures("made_up_studies")

RESOLUTION = 1 / 16_384
"""Accuracy of a boundary that `find_boundary_shares` promises, as a share of the line."""


@SLOW
def test_the_rows_are_those_of_the_solutions(case: Results, explained: Answer) -> None:
    answer = explained.to_dict()
    handles = map(str, handles_of(case.solutions))
    solutions = dict(zip(handles, case.solutions.to_dict("records"), strict=True))
    rows = {row["solution"]: row for row in rows_of(answer, "solutions")}
    for handle, row in rows.items():
        assert row["outcome"] == solutions[handle]["outcome"]
        assert row["safety_degree"] == solutions[handle]["safety_degree"]
    causes = rows_of(answer, "causes")
    assert {cause["solution"] for cause in causes} == rows.keys()
    for cause in causes:
        changes = cause["changes"]
        assert changes.items() <= solutions[cause["solution"]].items()
        assert (
            cause["boundary"].keys()
            == cause["single_boundary"].keys()
            == changes.keys()
        )
        assert cause["size"] == len(changes)
        assert 0 <= cause["holds"] <= cause["fits"] == FITS
        assert cause["avoided_by"] == rows[cause["solution"]]["avoided_by"]


@SLOW
def test_the_failures_that_matter_come_first(case: Results, explained: Answer) -> None:
    crashes = case.solutions[case.solutions["outcome"] == "collision"]
    by_reason = {
        reason: row
        for row in explained.tables["solutions"].to_dict("records")
        for reason in row["reason"].split("; ")
    }
    assert by_reason["fewest changes"]["changed"] == crashes["f_num_diff"].min()
    assert (
        by_reason["lowest safety degree"]["safety_degree"]
        == crashes["safety_degree"].min()
    )
    assert [
        explained.numbers[name] for name in ("failures", "analysed", "collisions")
    ] == [len(crashes[list(case.characteristics.names)].drop_duplicates())] * 3
    assert explained.numbers["explained"] == len(explained.tables["solutions"]) == 3


@SLOW
def test_a_named_solution_is_explained_whatever_it_is(case: Results) -> None:
    safe = (
        case.solutions["f_num_diff"].where(case.solutions["f_safe"] > 1).idxmin()
    )  # few changes have few subsets
    handle = str(handles_of(case.solutions)[safe])
    evaluator = Evaluator(case.study, InlinePool())
    answer = explain.compute(
        case, evaluator, solution=(handle,), unsafe=Unsafe(), fits=0
    )
    (row,) = answer.tables["solutions"].to_dict("records")
    assert (row["solution"], row["reason"], row["avoided_by"]) == (
        handle,
        "requested",
        None,
    )
    assert answer.tables["causes"].empty
    with pytest.raises(InputError, match="nsga2:7:0"):
        explain.compute(case, evaluator, solution=("nsga2:7:0",))


def test_every_boundary_is_unsafe_as_it_is_printed(
    case: Results, explained: Answer
) -> None:
    """Also each change alone at its boundary."""
    table = explained.tables.records["causes"]

    def printed(row: dict[Any, Any], name: str) -> dict[str, float]:
        text = cell_text(row[name], table.columns[name].number_format)
        found = re.findall(r"(\w+) ([\d.]+)", text)
        return {name: float(value) for name, value in found}

    typed = []
    for row in table.frame.to_dict("records"):
        typed.append(printed(row, "boundary"))
        alone = printed(row, "single_boundary")
        typed += [row["changes"] | {name: value} for name, value in alone.items()]
    settings = [case.characteristics.setting(values) for values in typed]
    assert case.unsafe.of(
        drive_and_score(assemble(case.study), np.array(settings))
    ).all()


@SLOW
def test_the_fewest_changes_collide_as_they_are_printed_and_no_fewer_of_them_do(
    slippery: Path, case: Results
) -> None:
    """In the verdict of `study`, as `simulate` chooses them, and typed as the verdict says."""
    verdict = json_of(f"study {slippery.parent / 'slippery.toml'} --out {slippery}")[
        "verdict"
    ]
    command = verdict.partition(
        "This command simulates the vehicle: python -m safevar_sumo "
    )[2].partition(". ")[0]
    command = command.rstrip(".")
    typed = numbers_of(command)
    chosen = numbers_of(f"simulate {slippery} --solution fewest")
    assert (
        f"The changed vehicle collides at {-typed['safety_degree']:.2f} m/s" in verdict
    )
    assert chosen["safety_degree"] == typed["safety_degree"]
    values = dict(re.findall(r"--set (\w+)=(\S+)", command))
    assert f"with only {len(values)} change" in verdict
    crashes = case.solutions[case.solutions["outcome"] == "collision"]
    assert len(values) <= crashes["f_num_diff"].min()
    for left_out in values:
        rest = [
            f"--set={name}={value}"
            for name, value in values.items()
            if name != left_out
        ]
        assert numbers_of(f"simulate {slippery}", *rest)["outcome"] == "stopped"


def test_the_verdict_tells_a_colleague_limits_robustness_and_who_avoids_it(
    case: Results, explained: Answer
) -> None:
    """The limits are those of the first row; nothing names a solution."""
    leading, verdict = explained.tables["causes"].iloc[0], explained.verdict
    for item in case.characteristics:
        if item.name in leading["boundary"]:
            value = leading["boundary"][item.name]
            assert (
                float(re.search(rf"{item.short_name} at ([\d.]*\d)", verdict)[1])
                == value
            )  # type: ignore[index]
    share = f"{100 * leading['robust_share']:.0f} % of vehicles with slightly different values"
    assert re.search(
        r"^One change is enough for a collision: .* \d+ failures .* 256 vehicles .*\."
        rf" The cause is [^:]*: (only )?{share} are unsafe",
        verdict,
    )
    assert f"cause was found in {leading['holds']} of {FITS} parameter sets" in verdict
    assert leading["solution"] not in verdict
    numbers = explained.numbers
    assert (
        f"{numbers['failures']} of the {numbers['settings']} different vehicles that the search"
        " returned (its solutions) collide." in verdict
    )
    assert (
        explained.tables["drivers"].set_index("driver")["avoided"]["competent_driver"]
        <= numbers["avoidable"]
        == numbers["collisions"] - numbers["unavoidable"]
    )


COLLISION = Unsafe()


@SLOW
@given(table=st.lists(st.booleans(), min_size=32, max_size=32), full=st.integers(0, 31))
def test_all_minimal_unsafe_subsets_and_no_other_whatever_the_outcomes(
    table: list[bool], full: int
) -> None:
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
    minimal = [each for each in unsafe if not any(other < each for other in unsafe)]
    (result,) = find_minimal_causes(
        made_up_evaluator(5, outcome), setting[np.newaxis], COLLISION
    )
    assert [set(map("abcde".index, cause.changes)) for cause in result] == minimal


def test_the_minimal_causes_of_a_run_are_those_of_its_unsafe_solutions_each_once() -> (
    None
):
    """`a` above 9 or `b` below 2 collides; the failures with the fewest changes come first, equal
    ones count once.
    """
    evaluator = made_up_evaluator(
        3, lambda settings: (settings[:, 0] > 9) | (settings[:, 1] < 2)
    )
    settings = np.array(
        [
            (9.5, 5.0, 5.0),
            (9.5, 5.0, 5.0),
            (9.9, 1.0, 5.0),
            (9.6, 5.0, 9.0),
            (8.0, 4.0, 9.0),
        ]
    )
    found = evaluator.evaluate(settings, "solutions")
    frame = solutions_frame(
        evaluator.characteristics.names,
        [(("rs", 0), found), (("nsga2", 1), found.take([0, 4]))],
    )
    finished = [("rs", 0), ("nsga2", 1), ("nsga2", 0)]
    case = build_case(evaluator.study, {"safety_degree": 2.0}, frame, frame, finished)
    counts = [
        causes_of_runs(case, evaluator, limit).to_numpy().tolist() for limit in (1, 9)
    ]
    assert counts[0] == [["rs", 0, 3, 1, 1], ["nsga2", 1, 1, 1, 1], ["nsga2", *[0] * 4]]
    assert counts[1][0] == ["rs", 0, 3, 3, 2], "a up, b down"


def causes_and_limits(
    evaluator: Evaluator, *setting: float
) -> tuple[Causes, list[Limits]]:
    """The causes of a setting, and their limits."""
    (causes,) = find_minimal_causes(evaluator, np.array([setting]), COLLISION)
    return causes, find_cause_limits(evaluator, causes, COLLISION)


def printed_of(n: int, region: Region, *setting: float) -> Any:
    """The limits of the only cause of a setting, as they are printed."""
    model = made_up_model(n, region)
    return printed_limits(model, *causes_and_limits(model.evaluator, *setting))[0]


def test_a_boundary_is_the_first_unsafe_place_and_no_island_is_skipped() -> None:
    evaluator = made_up_evaluator(3, two_islands)
    _, (result,) = causes_and_limits(evaluator, 9.5, 1.0, 8.0)
    assert result.fraction == pytest.approx(1.5 / 4.5, abs=2 * RESOLUTION)
    assert result.boundary["a"] > 6.5 >= result.boundary["a"] - 2 * RESOLUTION * 4.5
    assert result.single_boundary == result.boundary
    assert result.end == BoundaryState.SAFE


@pytest.mark.parametrize(
    ("low", "high", "value", "printed"),
    [
        (8.12341, 10, 9.0, "8.2"),
        (0, 1.23441, 1.0, "1.2"),
        (8.12341, 8.12349, 8.12345, "8.12345"),
        (1.23441, 1.23449, 1.23445, "1.23445"),
    ],
)
def test_a_boundary_is_rounded_to_the_unsafe_side_with_as_many_digits_as_it_needs(
    low: float, high: float, value: float, printed: str
) -> None:
    """Between `low` and `high` it is unsafe."""
    rounded = printed_of(
        1, lambda rows: (rows[:, 0] > low) & (rows[:, 0] < high), value
    )
    number_format = CAUSE_COLUMNS["boundary"].number_format
    for values in (rounded["boundary"], rounded["single_boundary"]):
        assert cell_text(values["a"], number_format) == printed
        assert low < values["a"] < high


def test_a_boundary_of_a_single_change_is_unsafe_when_typed_with_the_others() -> None:
    """From 7.45 on `a` is unsafe beside 8.55 of `b`, but at 7.5 it is not; beside 8.6, it is."""

    def region(rows: FloatArray) -> BoolArray:
        total = rows[:, 0] + rows[:, 1]
        return ((total > 16) & (total < 16.04)) | (total > 16.08)

    alone = printed_of(2, region, 9.0, 8.55)["single_boundary"]
    assert region(np.array([[alone["a"], 8.55], [9.0, alone["b"]]])).all()


def test_nothing_is_shrunk_into_what_the_filter_takes_for_no_change() -> None:
    evaluator = made_up_evaluator(1, lambda settings: settings[:, 0] > ORIGINAL)
    _, (result,) = causes_and_limits(evaluator, 9.0)
    threshold = evaluator.characteristics.threshold[0]
    boundary = result.boundary["a"]
    assert boundary == pytest.approx(ORIGINAL + threshold, rel=1e-3)
    assert evaluator.characteristics.filter(np.array([boundary]))[0] == boundary
    assert result.end == BoundaryState.FILTER


def test_a_boundary_that_ends_where_nothing_can_be_simulated_says_so() -> None:
    study = made_up_study(1)
    evaluator = Evaluator(
        study,
        Plant(
            study,
            lambda rows: rows[:, 0] > 7,
            failing=lambda rows: (rows[:, 0] > 6) & (rows[:, 0] <= 7),
        ),
    )
    _, (result,) = causes_and_limits(evaluator, 9.0)
    assert (result.boundary["a"], result.end) == (
        pytest.approx(7, abs=1e-3),
        BoundaryState.NOT_SIMULATED,
    )


def test_needed_and_changed_over_failures() -> None:
    evaluator = made_up_evaluator(
        3, lambda settings: box(settings) | (settings[:, 2] > 9)
    )
    settings = np.array([[9.0, 1.0, 5.0], [9.0, 1.0, 8.0], [9.0, 1.0, 9.5]])
    members = evaluator.characteristics
    causes = find_minimal_causes(evaluator, settings, COLLISION)
    frame, of_four = (
        count_needed(members, members.changed(settings), causes, number).set_index(
            "characteristic"
        )
        for number in (3, 4)
    )
    assert frame["changed"].to_dict() == pytest.approx({"a": 1, "b": 1, "c": 2 / 3})
    assert frame["needed"].to_dict() == pytest.approx(
        {"a": 2 / 3, "b": 2 / 3, "c": 0}
    ), "the third failure has two minimal causes"
    assert frame["needed_low"].equals(frame["needed"]), (
        "of all failures the shares are exact"
    )
    ends = of_four.loc["a", ["needed_low", "needed_high"]]
    assert ends.tolist() == pytest.approx(clopper_pearson(2, 3)), "2 of a sample of 3"
    assert count_distinct_causes(members, causes)[
        ["cause", "failures"]
    ].to_numpy().tolist() == [
        [("a up", "b down"), 3],
        [("c up",), 1],
    ]


def test_a_cause_is_one_with_some_fitted_models() -> None:
    """Own: a up and b down together are unsafe. Second: a up alone. Third: nothing. Fourth: as the
    own, only wider.
    """
    regions: list[Region] = [
        box,
        lambda one: one[:, 0] > 8,
        nowhere,
        lambda one: (one[:, 0] > 7) & (one[:, 1] < 5),
    ]
    models = [made_up_evaluator(3, region) for region in regions]
    settings = np.array([[9.0, 1.0, 5.0], [7.5, 1.0, 8.0]])
    causes = [cause for (cause,) in find_minimal_causes(models[0], settings, COLLISION)]
    holding = [are_causes(model, causes, COLLISION).tolist() for model in models]
    assert holding == [[holds] * 2 for holds in (True, False, False, True)]


def test_more_failures_than_can_be_afforded_are_sampled_and_always_the_same() -> None:
    evaluator = made_up_evaluator(8, everywhere)
    settings = np.random.default_rng(1).uniform(6, 9, (50, 8))
    few = select_affordable_rows(settings, evaluator, 2000)
    assert few == select_affordable_rows(settings, evaluator, 2000)
    assert 0 < len(few) < 50
    assert select_affordable_rows(settings, evaluator, 10**6) == list(range(50))
    settings[:, 3:] = ORIGINAL
    assert len(select_affordable_rows(settings, evaluator, 80)) == 10, (
        "2 ** 3 subsets of each"
    )


def test_progress_of_a_stage_counts_the_settings_of_all_its_evaluators() -> None:
    """The second one simulates another study."""
    shown = list[tuple[str, int, int]]()
    study = made_up_study(1)
    evaluator = Evaluator(
        study, Plant(study, nowhere), lambda *values: shown.append(values)
    )
    evaluator.begin({"all calls": 5})
    with evaluator.phases.stage("all calls"):
        evaluator.evaluate(np.array([[1.0], [2.0], [3.0]]), "a call")
        another = evaluator.for_study(study)
        another.evaluate(np.array([[4.0], [5.0]]), "another")
    counts = [done for stage, done, _ in shown if stage == "all calls"]
    assert [*dict.fromkeys(counts)] == [0, 3, 5]
    assert shown[-1] == ("all calls", 5, 5)


def test_of_an_unsafe_original_no_change_is_a_cause(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(failures, "SAMPLED_SETTINGS", 4)
    study = load_study("smoke")
    answer = explain.compute(
        study,
        Evaluator(study, InlinePool(), verified=0),
        unsafe=Unsafe(degree=99),
        fits=0,
        top=1,
    )
    degree = f"{answer.numbers['original_degree']:.3g}"
    said = (
        f"The original vehicle is already unsafe: it has a safety degree of {degree} m, below 99 m."
        " A failure needs no change of the vehicle. Ask again with a weaker criterion"
    )
    assert answer.verdict.startswith(f"{said} (--unsafe). All 4 vehicles")
    assert [
        len(answer.tables[name])
        for name in ("causes", "characteristics", "distinct_causes")
    ] == [0, 0, 0]
    assert "Minimal causes" not in answer.render("text")
    assert answer.failures
    assert "simulate" in answer.next
