"""RQ1 to RQ3 and the discussion on made-up solutions of three characteristics, whose values one can
count by hand.
"""

from __future__ import annotations

import dataclasses
import math
import re
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
import pytest
import scipy
from msgspec.structs import replace

from safevar_sumo.questions.case import UnanswerableError
from safevar_sumo.questions.research_questions import budgets
from safevar_sumo.questions.research_questions.answer import answer_questions
from safevar_sumo.questions.research_questions.changes import (
    count_collisions,
    critical_solutions,
    rq33,
    rq33_safety,
)
from safevar_sumo.questions.research_questions.comparisons import (
    Choices,
    medians_over_runs,
    rq1,
    rq1_runs,
    rq2,
    rq2_runs,
)
from safevar_sumo.questions.research_questions.fronts import (
    compute_convergence,
    count_evaluations,
)
from safevar_sumo.questions.research_questions.statistics import ALPHA, compare_samples
from safevar_sumo.records import JsonObject
from tests.support.in_process import SLOW
from tests.support.made_up_results import ORIGINAL, made_up, row, three_algorithms


def only(frame: pd.DataFrame, **wanted: Any) -> JsonObject:
    """The one row with these values."""
    result = frame[(frame[list(wanted)] == pd.Series(wanted)).all(axis=1)]
    assert len(result) == 1
    return dict(result.iloc[0])


def test_rq1_is_small_where_solutions_are_more_unsafe() -> None:
    frame = rq1(
        made_up(*(row(sd=1 + i / 10, tet=2, tit=1, ave_dece=3) for i in range(5)))
    )
    assert frame["metric"].tolist() == ["safety_degree", "tet", "tit", "ave_dece"]
    assert frame[
        ["effect_size", "magnitude", "n1", "n2"]
    ].drop_duplicates().to_numpy().tolist() == [[0, "large", 5, 5]]
    safer = rq1(made_up(*(row(sd=3, tet=0.5, tit=0.1, ave_dece=7) for _ in range(5))))
    assert safer["effect_size"].tolist() == [1, 1, 1, 1]


def test_a_tet_that_stands_at_a_collision_is_not_counted() -> None:
    case = made_up(
        {**row(sd=-3), "tet": 0.0},
        row(sd=1, tet=1.4),
        {**row("rs", sd=-3), "tet": 9.0},
        row("rs", sd=1, tet=1.3),
    )
    assert only(rq1(case), algorithm="nsga2", metric="tet")["mean"] == 1.4
    assert only(rq2(case), metric="tet")["effect_size"] == 1


def test_rq2_is_high_where_nsga2_is_better() -> None:
    rows = [
        *(
            row(run=run, sd=0.5 - run / 10, tet=2, tit=1, ave_dece=3, f_diff=0.1)
            for run in (0, 1, 2)
        ),
        *(row("rs", run=run, sd=1.5 + run / 10, f_diff=0.6) for run in (0, 1, 2)),
    ]
    frame = rq2(made_up(*rows))
    assert frame["metric"].tolist() == [
        "igd_plus",
        "hypervolume",
        "igd",
        "safety_degree",
        "tet",
        "tit",
        "ave_dece",
    ]
    assert frame["effect_size"].tolist() == [1] * 7
    exchanged = [
        {**one, "algorithm": {"rs": "nsga2", "nsga2": "rs"}[one["algorithm"]]}
        for one in rows
    ]
    assert rq2(made_up(*exchanged))["effect_size"].tolist() == [0] * 7


@SLOW
def test_rq2_compares_the_algorithm_asked_for_else_nsga2_else_the_first() -> None:
    case = three_algorithms()
    means = case.solutions.groupby(["algorithm", "run"])["safety_degree"].mean()
    for asked, first, others in (
        ("", "nsga2", ["rs", "safe_fuzzer"]),
        ("safe_fuzzer", "safe_fuzzer", ["nsga2", "rs"]),
    ):
        frame = rq2_runs(case, Choices(asked))
        assert (set(frame["algorithm"]), list(frame["baseline"].unique())) == (
            {first},
            others,
        )
        expected = compare_samples(means[first], means["rs"])
        chosen = only(frame, metric="safety_degree", baseline="rs")
        assert (chosen["p_value"], chosen["effect_size"]) == (
            expected.p_value,
            1 - expected.effect_size,
        )
    without = made_up(
        *(
            row(name, run, sd=sd)
            for name, sd in (("rs", 1.0), ("mine", 2.0))
            for run in (0, 1)
        )
    )
    answer = answer_questions(
        [dataclasses.replace(without, titles={"mine": "My search"})]
    ).only("rq2")
    assert (
        only(
            answer.tables["rq2"],
            algorithm="rs",
            baseline="mine",
            metric="safety_degree",
        )["effect_size"]
        == 1
    )
    assert re.search(r"RS +│ ?My search", answer.render("text"))
    asked = answer_questions([without], Choices("nsga2")).only("rq2")
    assert asked.tables["rq2"].empty
    assert "no finished run of nsga2" in " ".join(asked.tables["remarks"]["remark"])


@SLOW
def test_rq2_and_a_table_say_how_many_settings_each_algorithm_simulated() -> None:
    """Of 100 evaluations one algorithm repeats settings, the other stops early; in the last
    generation only repeats may be missing.
    """
    positions = {"nsga2": [*range(0, 90, 2), 95], "rs": range(40)}
    rows = [row(name, run) for name in positions for run in (0, 1)]
    seen = [
        {**row(name, run), "evaluation": i}
        for name in positions
        for run in (0, 1)
        for i in positions[name]
    ]
    case = made_up(*rows, evaluations=seen)
    counts = count_evaluations(case)
    assert (
        counts[["requested", "simulated"]].to_numpy().tolist()
        == [[100, 46]] * 2 + [[40, 40]] * 2
    )
    answer = answer_questions([case])
    table = answer.tables["rq2"]
    assert table[
        ["evaluations", "baseline_evaluations"]
    ].drop_duplicates().to_numpy().tolist() == [[46, 40]]
    note = "NSGA-II 46 of 100 (equal vehicles are simulated once); RS 40 of 100 (it ended early)."
    assert any(note in remark for remark in answer.tables["remarks"]["remark"])
    assert "46" in answer.render("text", "evaluations")
    imported = answer_questions([made_up(*rows, has_runs=False)])
    assert imported.tables["rq2"]["evaluations"].isna().all()
    assert "number of their simulations" in "".join(
        imported.tables["remarks"]["remark"]
    )


def test_solutions_of_one_run_are_not_taken_for_independent() -> None:
    """Runs of 40 copies each: pooled, rank tests see 320 against 320 values; over runs they see the
    8 against 8 that there are.
    """
    ours = [1.0, 1.1, 1.2, 1.3, 1.4, 1.6, 1.7, 2.2]
    theirs = [1.5, 1.8, 1.9, 2.3, 2.4, 2.5, 2.6, 2.7]
    case = made_up(
        *(
            row(name, run=run, sd=sd, values=(1100.0 + run, 2.0, 0.1))
            for name, degrees in (("nsga2", ours), ("rs", theirs))
            for run, sd in enumerate(degrees)
            for _ in range(40)
        )
    )
    paper, runs = (
        only(frame, metric="safety_degree") for frame in (rq2(case), rq2_runs(case))
    )
    assert paper["p_value"] < 1e-30
    assert (runs["n1"], runs["n2"], runs["effect_size"]) == (
        8,
        8,
        1 - (0 + 0 + 0 + 0 + 0 + 1 + 1 + 3) / 64,
    )
    assert (
        runs["p_value"]
        == scipy.stats.mannwhitneyu(ours, theirs, method="exact").pvalue
        > ALPHA / 10
    )
    original = only(rq1_runs(case), algorithm="nsga2", metric="safety_degree")
    assert original["p_value"] == 2 * 2 / 2**8, (
        "all signed ranks but the smallest are negative"
    )
    assert (original["effect_size"], original["p_holm"] >= original["p_value"] * 2) == (
        1 / 8,
        True,
    )


def test_collisions_in_which_the_original_is_not_safe_either_are_no_findings() -> None:
    """The first collision of each run is in such an encounter, the second, in its fifth evaluation,
    is not.
    """
    seen = [
        {**row(name, sd=-1.0 if i in (1, 4) else 1.0, f_diff=0.5), "evaluation": i}
        for name in ("nsga2", "rs")
        for i in range(100)
    ]
    case = made_up(
        row(sd=-1.0, f_diff=0.5), row("rs", sd=1.0, f_diff=0.5), evaluations=seen
    )
    degrees = np.where(case.evaluations["evaluation"] == 1, 0.1, 2.0)
    joint = dataclasses.replace(
        case,
        evaluations=case.evaluations.assign(original_safety_degree=degrees),
        scoring=replace(case.scoring, safe_original=0.5),
    )
    none = dataclasses.replace(
        joint, evaluations=joint.evaluations.assign(original_safety_degree=0.1)
    )
    assert (compute_convergence(none)["hypervolume"] == 0).all()
    assert (compute_convergence(joint)["hypervolume"] > 0).any()


def test_a_reader_chooses_the_level_of_significance() -> None:
    case = three_algorithms()
    strict, loose = (rq2_runs(case, Choices(alpha=alpha)) for alpha in (1e-9, 0.3))
    assert not strict["significant"].any()
    assert not strict["enough_runs"].any(), "12 runs cannot reach such a level"
    assert loose["significant"].any()
    widths = [
        frame["effect_size_high"] - frame["effect_size_low"]
        for frame in (strict, loose)
    ]
    assert (widths[0] > widths[1]).all()
    medians = medians_over_runs(case, Choices(alpha=0.05))
    means = (
        case.solutions.groupby(["algorithm", "run"])["safety_degree"]
        .mean()["rs"]
        .sort_values()
    )
    median = only(medians, algorithm="rs", metric="safety_degree")
    assert (median["median"], median["median_low"], median["median_high"]) == (
        means.median(),
        *means.iloc[[2, 9]],  # the third and the tenth of twelve
    )


def test_algorithms_are_compared_after_equal_numbers_of_simulations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A run finds (1, 0) in the square of the two objectives that differ, with the reference point
    (1.1, 1.1): worth 0.11. Then it finds the collision (0, 1): both are worth 0.21. The third
    objective adds a length of 1.1. The third runs have no valid setting within 10. By Noether,
    (2.394 + 0.842)^2 / (6 * 0.1667^2) = 62.8 runs show 0.6667 at 0.05 / 3, for three tests.
    """
    monkeypatch.setattr(budgets, "BUDGETS", (10, 20))
    points = {
        "a": row(sd=1.0, f_diff=0.1),
        "b": row(sd=-1.0, f_diff=0.5),
        "-": row(sd=9.0),
    }
    points["x"] = row(f_diff=math.nan)
    journals = {"nsga2": ["-----a--------b", "a----", "xxxxxxxxxxb"]}
    journals["rs"] = [f"{'-' * 20}a", "a", "x"]
    seen = [
        {**points[point], "algorithm": name, "run": run, "evaluation": 2 * number}
        for name in journals
        for run, journal in enumerate(journals[name])
        for number, point in enumerate(journal)
    ]
    case = made_up(
        points["a"],
        points["b"],
        evaluations=seen,
        finished=[*product(journals, (0, 1, 2))],
    )
    tables = answer_questions([case], Choices(alpha=0.05), ["budget"]).tables
    assert "; 95 % intervals)" in tables.records["budget"].title
    table = tables["budget"]
    names = [
        "simulations",
        "effect_size",
        "runs_needed",
        "hypervolume",
        "hypervolume_baseline",
    ]
    assert table[[*names, "unsafe"]].to_numpy() == pytest.approx(
        np.array(
            [
                (10, 6 / 9, 63, 0.121, 0, 0),
                (20, 8 / 9, 12, 0.121, 0, 2 / 3),
                (100, 7 / 9, 23, 0.121, 0.121, 2 / 3),
            ]
        )
    )


@SLOW
def test_minimal_causes_of_runs_are_compared_if_they_were_counted() -> None:
    case = three_algorithms()
    counts = [
        (name, run, 9, 5, 7 if name == "nsga2" else run % 3)
        for name in case.algorithms
        for run in range(8)
    ]
    frame = pd.DataFrame(
        counts, columns=["algorithm", "run", "failures", "examined", "causes"]
    )
    choices = Choices(causes={case.name: frame})
    found = only(rq2_runs(case, choices), metric="causes", baseline="rs")
    assert (found["effect_size"], found["n1"], found["significant"]) == (1, 8, True)
    assert "causes" not in [*rq2_runs(case)["metric"]]
    assert answer_questions([case], choices).tables["causes"]["causes"].tolist() == [
        row[-1] for row in counts
    ]
    assert "causes" not in answer_questions([case]).tables


def test_a_run_without_solutions_is_the_worst_run() -> None:
    """One of two algorithms finds something in a single run, as in two runs of the other one."""
    rows = [row("nsga2", 0, sd=0.5), row("rs", 0), row("rs", 1)]
    runs = [*product(("nsga2", "rs"), range(3))]
    empty = [
        row(*run, f_diff=math.nan)
        for run in runs
        if run not in {("nsga2", 0), *runs[3:5]}
    ]
    seen = [{**one, "evaluation": 0} for one in [*rows, *empty]]
    case = made_up(*rows, evaluations=seen, finished=runs)
    answer = answer_questions([case])
    for name, metrics in (("rq2-runs", 3), ("rq2-common", 4)):
        tests = answer.tables[name].dropna(subset="p_value")
        of_fronts = tests[~tests["metric"].isin(case.original_metrics)]
        assert of_fronts[["n1", "n2"]].to_numpy().tolist() == [[3, 3]] * metrics
        # of nine pairs of runs three are won and two tied
        assert of_fronts["effect_size"].to_numpy() == pytest.approx(4 / 9)
        assert only(tests, metric="safety_degree")["n1"] == 1
    medians = answer.tables["medians"]
    found = only(medians, algorithm="nsga2", metric="hypervolume")
    assert (found["runs"], found["median"]) == (3, 0)
    assert only(medians, algorithm="nsga2", metric="igd")["median"] == math.inf
    text = answer.render("text", "medians")
    assert (
        "Only these runs of made-up have a solution: NSGA-II 1 of 3, RS 2 of 3. Runs without"
        in text
    )


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"finished": []}, "no run is finished"),
        (
            {},
            "selected none of the 2 simulated vehicles that have a value for every objective",
        ),
        (
            {"f_diff": math.nan},
            "None of the 0 vehicles with such values is unsafe",
        ),
        (
            {"original_safety_degree": 0.4},
            "m of clearance (scenario.margin) in none of the 2 encounters",
        ),
    ],
)
def test_results_without_a_solution_say_why(changes: JsonObject, reason: str) -> None:
    changes = dict(changes)
    finished = changes.pop("finished", [("rs", 0)])
    seen = [{**row("rs", sd=sd), "evaluation": i} for i, sd in enumerate((0.5, 1.5))]
    case = made_up(evaluations=seen, finished=finished)
    case = dataclasses.replace(
        case,
        evaluations=case.evaluations.assign(**changes),
        scoring=replace(case.scoring, safe_original=0.5),
    )
    assert reason in case.why_no_solution
    with pytest.raises(UnanswerableError, match="has no solution: "):
        rq1_runs(case)


HEAVY, GRIPLESS, BOTH = (1100.0, 2.0, 0.1), (1000.0, 1.0, 0.1), (1200.0, 1.5, 0.1)


def test_critical_solutions_are_strictly_below_the_original() -> None:
    case = made_up(
        row(sd=2.0), row(sd=1.999), row(sd=-1), row("rs", sd=1), row(sd=math.nan)
    )
    assert critical_solutions(case)["safety_degree"].tolist() == [1.999, -1]
    with pytest.raises(UnanswerableError, match="safety degree"):
        critical_solutions(made_up(row(), original={}))


def test_rq33_tells_increases_from_decreases() -> None:
    frame = rq33(
        made_up(
            row(values=HEAVY),
            row(values=(1300, 2, 0.1)),
            row(values=(900, 2, 0.1)),
            row(values=BOTH),
        )
    )
    cells = {
        (one["characteristic"], one["direction"], one["j"]): (
            one["pc"],
            one["delta"],
            one["n"],
        )
        for one in frame.to_dict("records")
    }
    assert cells["mass", "increase", "1"] == (pytest.approx(0.2), 200, 2)
    assert cells["mass", "decrease", "any"] == (pytest.approx(0.1), -100, 1)
    assert cells["mass", "increase", "any"][1] == 200
    assert cells["grip", "decrease", "2"][0] == 0.25
    assert cells["lag", "increase", "any"] == pytest.approx(
        (np.nan, np.nan, 0), nan_ok=True
    )


def test_the_footer_of_rq33() -> None:
    """A TET that stands at a collision is not counted, and nothing is a share of an original value
    of zero.
    """
    rows = [
        row(values=HEAVY, sd=1.5, tet=1.5, tit=0.6, ave_dece=5),
        row(values=HEAVY, sd=0.5, tet=2, tit=1, ave_dece=4),
        {**row(values=HEAVY, sd=-3, ave_dece=3), "tet": 0.0, "tit": 0.0},
    ]
    expected = {
        "avgSD_mD": (1, 50, 2),
        "avgSD_cS": (3, np.nan, 1),
        "TET": (0.75, 75, 2),
        "TIT": (0.3, 60, 2),
        "aveDece": (2, 100 / 3, 3),
    }
    frame = rq33_safety(made_up(*rows))
    for quantity, (value, percent, n) in expected.items():
        result = only(frame, quantity=quantity, j="1")
        assert (result["value"], result["n"]) == (pytest.approx(value), n)
        assert result["percent"] == pytest.approx(percent, nan_ok=True)
    assert only(frame, quantity="avgSD_cS", j="2")["n"] == 0
    zero = only(
        rq33_safety(made_up(*rows, original={**ORIGINAL, "tet": 0.0})),
        quantity="TET",
        j="any",
    )
    assert (zero["value"], zero["percent"]) == pytest.approx(
        (1.75, np.nan), nan_ok=True
    )


def test_collisions_and_their_share() -> None:
    frame = count_collisions(made_up(row(sd=-1), row(sd=0), row(sd=1), row("rs")))
    assert frame.to_numpy().tolist() == [
        ["nsga2", 3, 2, pytest.approx(2 / 3)],
        ["rs", 1, 0, 0],
    ]


@SLOW
def test_equal_solutions_of_a_run_are_counted_and_said_in_pooled_tables() -> None:
    """Equal ones of two runs are not equal solutions of a run."""
    rows = [row("nsga2", run) for run in (0, 0, 0, 1)] + [row("rs", 0)]
    answer = answer_questions([made_up(*rows)])
    twice = "2 of 5 solutions equal an earlier solution of the same run"
    for name in ("rq1", "rq2", "collisions"):
        assert twice in " ".join(answer.only(name).tables["remarks"]["remark"])
    assert twice not in " ".join(answer.only("rq1-runs").tables["remarks"]["remark"])
    assert answer.numbers["solutions"] == 5
    assert "0 of the 1 different solutions of " in answer.verdict, (
        "as the verdict of study counts"
    )
    different = answer_questions(
        [made_up(row("nsga2", 0), row("nsga2", 1), row("rs", 0))]
    )
    assert "equal an earlier" not in " ".join(different.tables["remarks"]["remark"])
