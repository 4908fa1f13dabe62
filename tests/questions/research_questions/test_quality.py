"""Quality indicators, tests and effect sizes against closed forms and their definitions; and
answers rendered: the same numbers in every format, LaTeX that compiles, figures that can be read.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
from hypothesis import given, strategies as st

from safevar_sumo.api.simulation import load_study
from safevar_sumo.cli.program import command_function
from safevar_sumo.questions.answer import Answer, contents_of
from safevar_sumo.questions.case import Results
from safevar_sumo.questions.research_questions.answer import answer_questions
from safevar_sumo.questions.research_questions.figures import (
    draw_convergence,
    draw_pareto_fronts,
)
from safevar_sumo.questions.research_questions.fronts import (
    compute_convergence,
    compute_indicators,
    reference_front,
)
from safevar_sumo.questions.research_questions.statistics import (
    compare_samples,
    correct_by_holm,
    effect_interval,
    magnitude_of,
    median_interval,
    signed_rank_test,
)
from safevar_sumo.study import CharacteristicTable
from tests.support.in_process import SLOW
from tests.support.made_up_results import made_up, made_up_study, row, three_algorithms
from tests.support.needs import need_program


def test_indicators_are_those_of_each_runs_own_front_against_that_of_all_runs() -> None:
    case = made_up(
        row(sd=1, f_diff=0.5),
        row("rs", sd=0.5, f_diff=0.7),
        row("rs", run=1, sd=1, f_diff=0.6),
    )
    assert sorted(reference_front(case).tolist()) == [[0.5, 0.7, 0], [1, 0.5, 0]]
    result = compute_indicators(case)
    assert result.loc[("nsga2", 0), "igd"] == pytest.approx(math.hypot(0.5, 0.2) / 2)
    assert result.loc[("rs", 1), "igd"] == pytest.approx(
        (0.1 + math.hypot(0.5, 0.1)) / 2
    )
    assert result.loc[("nsga2", 0), "igd_plus"] == pytest.approx(0.5), (
        "a whole width of f_safe away from one of two"
    )
    assert result.loc[("rs", 0), "hypervolume"] == pytest.approx(1.1 * 0.1 * 1.1)
    study = load_study(case.study, search={"reference_point": 2.0})
    wide = compute_indicators(dataclasses.replace(case, study=study))
    assert wide.loc[("rs", 0), "hypervolume"] == pytest.approx(2 * 1 * 2)


def test_a_line_of_convergence_ends_where_its_algorithm_ends_and_has_its_title() -> (
    None
):
    seen = [
        {**row(name, run, sd=2 - i / 100), "evaluation": i}
        for name, ends in (("nsga2", (100, 100)), ("mine", (20, 33)))
        for run, end in enumerate(ends)
        for i in range(end)
    ]
    case = made_up(
        *(row(name, run) for name in ("nsga2", "mine") for run in (0, 1)),
        evaluations=seen,
    )
    case = dataclasses.replace(case, titles={"mine": "My search"})
    ends = compute_convergence(case).groupby(["algorithm", "run"])["evaluations"].max()
    assert ends.to_dict() == {
        ("nsga2", 0): 100,
        ("nsga2", 1): 100,
        ("mine", 0): 33,
        ("mine", 1): 33,
    }
    figures = (draw_convergence(case), draw_pareto_fronts(case))
    labels = [
        "".join(text.get_text() for text in figure.legends[0].get_texts())
        for figure in figures
    ]
    assert all("My search" in label and "mine" not in label for label in labels)
    assert "My search (2 runs)\nmean: 26 simulations" in labels[0]


SAMPLES = st.lists(st.integers(-5, 5).map(float), min_size=1, max_size=20)


@given(x=SAMPLES, y=SAMPLES)
def test_effect_size_is_the_share_of_pairs_won_and_half_of_those_tied(
    x: list[float], y: list[float]
) -> None:
    won = sum((a > b) + 0.5 * (a == b) for a in x for b in y)
    there = compare_samples(x, y)
    back = compare_samples(y, x)
    assert there.effect_size == pytest.approx(won / (len(x) * len(y)))
    assert back.oriented(larger_is_better=False).effect_size == pytest.approx(
        there.effect_size
    )
    assert 0 <= there.p_value <= 1
    assert back.p_value == pytest.approx(there.p_value)


def test_an_empty_sample_is_undefined_not_zero_and_nan_is_refused() -> None:
    assert compare_samples([], [1.0, 2])[:5] == pytest.approx(
        (math.nan, math.nan, None, 0, 2), nan_ok=True
    )
    assert math.isnan(signed_rank_test([1.0, math.nan]).p_value)
    with pytest.raises(ValueError, match="nan"):
        compare_samples([1.0, math.nan], [1.0])


def test_signed_ranks_of_a_sample_without_a_difference_and_with_ties() -> None:
    assert signed_rank_test([0.0, 0.0])[:2] == (1.0, 0.5)
    assert (
        signed_rank_test([-1.0, -1.0, 1.0, 2.0]).p_value
        == scipy.stats.wilcoxon([-1, -1, 1, 2], correction=True, method="approx").pvalue
    )


def test_values_that_rounding_errors_distinguish_are_ties() -> None:
    """Sums of multiples of 0.05 s in two orders, and their differences."""
    x = [0.05 + 0.1 + 0.15, 0.1 + 0.2, 1.2, 2.35]
    y = [0.15 + 0.1 + 0.05, 0.3, 1.0, 2.2]
    assert len({*x, *y}) > len({0.3, 1.2, 2.35, 1.0, 2.2})
    ties = [0.3, 0.3, 1.2, 2.35], [0.3, 0.3, 1.0, 2.2]
    assert compare_samples(x, y) == compare_samples(*ties)
    assert compare_samples(x, y).p_value == scipy.stats.mannwhitneyu(*ties).pvalue
    steps = [1.35, 2.35, 0.45], [1.2, 2.2, 0.3]
    assert len(np.unique(np.subtract(*steps))) > 1
    assert signed_rank_test(*steps) == signed_rank_test([0.15, 0.15, 0.15])
    assert signed_rank_test(x[:2], y[:2])[:2] == (1.0, 0.5)


@pytest.mark.parametrize(
    ("effect", "name"),
    [
        (0.4441, "negligible"),
        (0.444, "small"),
        (0.5559, "negligible"),
        (0.556, "small"),
        (0.6379, "small"),
        (0.638, "medium"),
        (0.286, "large"),
        (0.2861, "medium"),
        (1 - 0.714, "large"),
    ],
)
def test_magnitudes_are_kitchenhams(effect: float, name: str) -> None:
    assert magnitude_of(effect) == name


def test_holms_correction_of_a_worked_example() -> None:
    corrected = correct_by_holm([0.01, math.nan, 0.04, 0.03, 0.005])
    assert corrected == pytest.approx([0.03, math.nan, 0.06, 0.06, 0.02], nan_ok=True)


@pytest.mark.parametrize("count", [0, 3, 10])
def test_the_interval_against_one_value_is_wilsons_of_a_share(count: int) -> None:
    expected = scipy.stats.binomtest(count, 10).proportion_ci(0.95, "wilson")
    found = effect_interval(count / 10, 10, math.nan, 0.05)
    assert found == pytest.approx(tuple(expected), abs=1e-9)


def test_the_interval_of_samples_apart_has_a_width() -> None:
    low, high = effect_interval(1.0, 10, 10, 0.05)
    # Hanley and McNeil's (1982), for exponential values
    q1 = low / (2 - low)
    variance = (
        low * (1 - low) + 9 * (q1 - low**2) + 9 * ((2 * low**2 / (1 + low)) - low**2)
    ) / 100
    assert (1 - low) / math.sqrt(variance) == pytest.approx(scipy.stats.norm.ppf(0.975))
    assert high == 1
    assert effect_interval(0.0, 10, 10, 0.05) == pytest.approx((0, 1 - low))


@pytest.mark.parametrize(
    ("size", "alpha", "rank"),
    [(10, 0.05, 2), (30, 0.05, 10), (8, 0.01, 1), (12, 0.01, 2)],
)
def test_the_interval_of_a_median_lies_between_the_order_statistics_of_tables_of_the_sign_test(
    size: int, alpha: float, rank: int
) -> None:
    values = np.random.default_rng(1).permutation(size) + 1
    assert median_interval(values, alpha) == (rank, size + 1 - rank)
    assert np.isnan(
        [median_interval(values[:7], 0.01), median_interval([], 0.01)]
    ).all(), "too few values"


def rich_case(**changes: Any) -> Results:
    """Two algorithms, two runs, changes of one to three characteristics, collisions; every run has
    evaluations.
    """
    values = [
        (1000 + 50 * i, 2 - 0.1 * (i % 3), 0.1 if i % 2 else 0.2) for i in range(8)
    ]
    rows = [
        row(
            algorithm,
            run,
            values=value,
            sd=1 - 0.3 * i + 0.1 * run + (0.5 if algorithm == "rs" else 0),
            tet=1 + i / 10,
        )
        for algorithm in ("nsga2", "rs")
        for run in (0, 1)
        for i, value in enumerate(values)
    ]
    return made_up(
        *rows,
        study=made_up_study(**changes),
        evaluations=[{**one, "evaluation": i % 8} for i, one in enumerate(rows)],
    )


def special_case() -> Results:
    """Names and units with the characters that LaTeX reads as commands."""
    tables = {
        name: CharacteristicTable(unit=name, original=1, lower=0.5, upper=2)
        for name in (
            "a&b",
            "50%_of $x$",
            "#1 {brace}",
            r"back\slash",
            "~tilde^2",
            "[option]",
            "*star|",
            "µ ° ² ä",
        )
    }
    case = made_up(row(), row("rs"), study=made_up_study(characteristics=tables))
    solutions = case.solutions.assign(
        **{name: 1.5 if i < 4 else 1.0 for i, name in enumerate(tables)}
    )
    return dataclasses.replace(case, name="_".join(tables), solutions=solutions)


CASES = {
    "one": [rich_case()],
    "two": [rich_case(), rich_case(name="wet", weather="hard_rain")],
    "special": [special_case()],
}


@functools.cache
def answer_about(name: str) -> Answer:
    return answer_questions(CASES[name])


DOCUMENT = r"""\documentclass{article}
\usepackage[T1]{fontenc}
\usepackage[utf8]{inputenc}
\usepackage{textcomp}
\usepackage{booktabs}
\usepackage{graphicx}
\begin{document}
%s
\end{document}
"""


@SLOW
@pytest.mark.parametrize("name", CASES)
def test_latex_compiles(name: str, tmp_path: Path) -> None:
    document = DOCUMENT % answer_about(name).render("latex")
    (tmp_path / "tables.tex").write_text(document, encoding="utf-8")
    done = subprocess.run(
        [
            need_program("pdflatex"),
            "-halt-on-error",
            "-interaction=nonstopmode",
            "tables.tex",
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:]


@SLOW
def test_the_table_for_a_paper_marks_each_metric_that_is_significant() -> None:
    answer = answer_questions([three_algorithms()])
    long = answer.tables["rq2-runs"].set_index(["metric", "baseline"])
    short = answer.tables["a12"].set_index(["metric", "baseline"])
    assert long.index.tolist() == short.index.tolist()
    for key, text in short["a12"].items():
        effect, is_significant, magnitude = long.loc[
            key, ["effect_size", "significant", "magnitude"]
        ]
        letter = "" if magnitude == "negligible" else f" {magnitude[0].upper()}"
        assert text == f"{effect:.2f}{'*' if is_significant else ''}{letter}"
    assert short["significant"].any()
    lines = answer.only("a12").render("latex")
    assert (
        len(re.findall(r"^(IGD\+|HV|IGD|SD|TET|TIT|aveDece) & ", lines, re.MULTILINE))
        == 7
    )
    assert "for the 14 tests of RQ2" in lines
    assert "IGD+" in lines.partition("HV")[0]
    assert not re.search(r"^IGD & ", lines.partition("HV")[0], re.MULTILINE)


def test_tables_have_the_columns_that_their_command_declares() -> None:
    declared = contents_of(command_function("tables"))
    tables = answer_about("two").to_dict()["tables"]
    assert {*declared.tables} - {*tables} == {"causes", "budget"}
    counts = ("n1", "n2", "n", "rank", "solutions", "collisions", "count")
    for name, table in tables.items():
        assert {*table["columns"]} == {*declared.tables[name]}, name
        for cells in table["rows"]:
            numbers = [cells[count] for count in counts if cells.get(count) is not None]
            assert all(isinstance(number, int) for number in numbers), name


def test_pooled_solutions_of_too_few_runs_do_not_stand_out_either() -> None:
    """As at the end of a study: seven runs are too few for RQ1, five are enough for RQ2, whatever
    the number of solutions.
    """
    case = made_up(
        *(
            row(name, run=i % 7, sd=sd - i / 100)
            for name, sd in (("nsga2", 0.5), ("rs", 1.5))
            for i in range(30)
        )
    )
    answer = answer_questions([case])
    few = "significant for NSGA-II, RS: a test needs at least 8 runs of each algorithm."
    assert (
        "None of the 8 tests of RQ1 can be significant: after Holm's correction, a test needs at"
        " least 11 runs" in "".join(answer.only("rq1-runs").tables["remarks"]["remark"])
    )
    for name, stands_out in (("rq1", False), ("rq2", True)):
        table, remarks = answer.only(name).tables.values()
        assert (table["p_value"] < 0.001).any()
        assert table["significant"].any() == stands_out
        assert (few in "".join(remarks["remark"])) is not stands_out
    imported = answer_questions([dataclasses.replace(case, has_runs=False)])
    assert imported.tables["rq1"]["significant"].any(), (
        "the runs of imported solutions are unknown"
    )
