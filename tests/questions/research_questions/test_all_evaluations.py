"""Tables and figures of all that runs have evaluated, whatever they return: convergence, and RQ2 by
one rule for all algorithms; and which tests so few runs can decide.
"""

from __future__ import annotations

import re
from itertools import product
from pathlib import Path

import moocore
import numpy as np
import pytest
import scipy

from safevar_sumo.api.simulation import load_study
from safevar_sumo.api.study import summarise
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.case import Results
from safevar_sumo.questions.research_questions.answer import answer_questions
from safevar_sumo.questions.research_questions.figures import draw_convergence
from safevar_sumo.questions.research_questions.fronts import (
    compute_indicators,
    nondominated_evaluations,
)
from safevar_sumo.questions.research_questions.statistics import can_be_significant
from safevar_sumo.questions.subject import load
from tests.support.formulas import carried_out
from tests.support.in_process import SLOW, rows_of
from tests.support.made_up_results import made_up, row

FIVE_WORST = """
import numpy as np


class FiveWorst:
    def search(self, problem, rng):
        settings = problem.characteristics.filter(problem.uniform(problem.evaluations, rng))
        evaluated = yield settings
        return evaluated.take(np.argsort(evaluated.f_safe)[:5])
"""
STUDY = """
extends = "sun"
name = "mine"
[search]
algorithms = ["nsga2", "rs", "mine:FiveWorst"]
population = 20
evaluations = 400
runs = 8
"""
OBJECTIVES = ["f_safe", "f_diff", "f_num_diff"]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("worst")
    (folder / "mine.py").write_text(FIVE_WORST)
    (folder / "mine.toml").write_text(STUDY)
    return folder / "mine.toml"


@pytest.fixture(scope="module")
def case(study: Path) -> Results:
    """Runs whose settings are evaluated by a formula: the sum of all changes makes a vehicle
    unsafe.
    """
    carried_out(load_study(str(study)), study.parent / "out")
    return load(study.parent / "out")


@pytest.fixture(scope="module")
def answer(case: Results) -> Answer:
    return answer_questions([case])


def test_random_search_returns_what_the_common_rule_takes(case: Results) -> None:
    common, returned = nondominated_evaluations(case), case.solutions
    columns = ["run", *case.characteristics.names]
    sets = [
        {*frame.query("algorithm == 'rs'")[columns].itertuples(index=False)}
        for frame in (common, returned)
    ]
    assert sets[0] == sets[1]
    assert set(common["algorithm"]) == {"nsga2", "rs", "FiveWorst"}


def test_who_returns_the_five_worst_is_not_rewarded_by_the_common_rule(
    answer: Answer, case: Results
) -> None:
    over_runs, common = (
        answer.tables[name].set_index(["baseline", "metric"])
        for name in ("rq2-runs", "rq2-common")
    )
    worst = ("FiveWorst", "safety_degree")
    assert over_runs.loc[worst, "effect_size"] == 0, "its mean is better in every run"
    assert common.loc[worst, "effect_size"] > 0.5
    best = case.evaluations.groupby(["algorithm", "run"])["safety_degree"].min()
    found = common.loc[("FiveWorst", "best_safety_degree")]
    won = [ours < theirs for ours, theirs in product(best["nsga2"], best["FiveWorst"])]
    assert found["effect_size"] == np.mean(won), (
        "of all that it has evaluated, whoever returns it"
    )
    assert len(common) == len(over_runs) + 2
    remarks = " ".join(answer.only("rq2-runs").tables["remarks"]["remark"])
    assert "The solutions of FiveWorst, NSGA-II are not all" in remarks


def test_the_table_has_the_median_and_quartiles_of_the_hypervolume_of_all_so_far(
    answer: Answer, case: Results
) -> None:
    front = moocore.filter_dominated(case.solutions[OBJECTIVES].to_numpy(float))
    low = front.min(axis=0)
    width = front.max(axis=0) - low
    rows = rows_of(answer.to_dict(), "convergence")
    for name, number in product(("nsga2", "FiveWorst"), (4, -1)):
        found = [one for one in rows if one["algorithm"] == name][number]
        count = found["evaluations"]
        runs = case.evaluations.query(f"algorithm == '{name}'").groupby("run")
        different = [
            group[:count] for _, group in runs
        ]  # a journal has each setting once
        points = [
            (group[OBJECTIVES].to_numpy(float) - low) / width for group in different
        ]
        volumes = [moocore.hypervolume(run, ref=[1.1] * 3) for run in points]
        assert found["case"] == "mine"
        assert [found[key] for key in ("hypervolume", "low", "high")] == pytest.approx(
            np.percentile(volumes, [50, 25, 75])
        )


def test_the_figure_shows_all_that_was_evaluated_and_marks_what_is_returned(
    answer: Answer, case: Results
) -> None:
    (axis,) = draw_convergence(case).axes
    medians = answer.tables["convergence"].groupby("algorithm")["hypervolume"].last()
    returned = (
        compute_indicators(case)["hypervolume"].groupby(level="algorithm").median()
    )
    names = ["nsga2", "rs", "FiveWorst"]
    assert [line.get_ydata()[-1] for line in axis.lines[:3]] == pytest.approx(
        [*medians[names]]
    )
    assert np.asarray(axis.collections[-1].get_offsets())[:, 1] == pytest.approx(
        [*returned[names]]
    )
    assert medians["FiveWorst"] > 3 * returned["FiveWorst"], "five of what was found"


@pytest.mark.parametrize(("m", "n"), [(3, 3), (3, 12), (5, 5), (2, 30)])
def test_whether_runs_can_be_significant_follows_from_the_exact_distribution(
    m: int, n: int
) -> None:
    smallest = {
        "RQ1": scipy.stats.wilcoxon(np.arange(1, m + 1), method="exact").pvalue,
        "RQ2": scipy.stats.mannwhitneyu(
            range(m), range(m, m + n), method="exact"
        ).pvalue,
    }
    for question, p_value in smallest.items():
        found = [
            can_be_significant(question, m, n, 7 * p_value * share, 7)
            for share in (0.999, 1.001)
        ]
        assert found == [False, True]


@SLOW
def test_what_was_not_tested_is_neither_significant_nor_not() -> None:
    """The original's TET is unknown, and all of one algorithm's solutions collide, which have no
    TET.
    """
    rows = [
        row(name, run, sd=sd - run / 20)
        for name, sd in (("nsga2", -1.0), ("rs", 1.5))
        for run in range(12)
    ]
    answer = answer_questions(
        [made_up(*rows, original={"safety_degree": 2.0, "tit": 0.5, "ave_dece": 6.0})]
    )
    for name, untested in (
        ("rq1", 3),
        ("rq1-runs", 3),
        ("rq2", 2),
        ("rq2-runs", 2),
        ("a12", 2),
    ):
        table = rows_of(answer.to_dict(), name)
        values = [one["significant"] for one in table]
        assert [value is None for value in values] == [
            one["effect_size"] is None for one in table
        ]
        assert (values.count(None), True in values) == (untested, True)
    assert re.search(r"│ ?TET .* - ?│", answer.render("text", "rq1"))


@SLOW
def test_a_study_prints_tests_only_where_its_runs_can_be_significant(
    case: Results, study: Path, tmp_path: Path
) -> None:
    text = summarise(load(study.parent / "out")).render("text", details=True)
    assert "RQ2 over runs" in text
    assert "RQ1 over runs" not in text
    (told,) = re.findall(
        r"None of the (\d+) tests of RQ1 can be signif.* a test needs at least (\d+) runs",
        text,
    )
    tests, needed = map(int, told)
    assert tests / 2 ** (needed - 1) < 0.01 <= tests / 2 ** (needed - 2)
    carried_out(load_study(str(study), search={"runs": 2}), tmp_path / "two")
    answer = summarise(load(tmp_path / "two"))
    text = answer.render("text", details=True)
    assert "over runs" not in text
    assert "of RQ2 can be significant" in text
    assert len(answer.tables["rq2-runs"]) == 14, "in JSON"
