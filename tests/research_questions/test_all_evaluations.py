"""Tables and figures of all that runs have evaluated, whatever they return: convergence, and RQ2 by one rule for all
algorithms; and which tests so few runs can decide.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from pathlib import Path

import matplotlib.colors
import moocore
import msgspec
import numpy as np
import pytest
import scipy

from safevar_sumo.api.study import summarise
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.case import Case
from safevar_sumo.questions.research_questions.answer import answer_questions
from safevar_sumo.questions.research_questions.comparisons import rq2_common
from safevar_sumo.questions.research_questions.figures import COLOURS, draw_convergence
from safevar_sumo.questions.research_questions.fronts import (
    compute_convergence,
    compute_indicators,
    nondominated_evaluations,
)
from safevar_sumo.questions.research_questions.statistics import can_be_significant, fewest_runs
from safevar_sumo.questions.subject import load
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Study, load_study
from tests.campaign.formulas import carried_out
from tests.research_questions.cases import made_up, row

FIVE_WORST = """
import numpy as np


class FiveWorst:
    def search(self, problem, rng):
        settings = problem.characteristics.filter(problem.uniform(problem.evaluations, rng))
        evaluated = yield settings
        return evaluated.take(np.argsort(evaluated.f_safe)[:5])
"""
RUNS = 8


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    folder = tmp_path_factory.mktemp("worst")
    (folder / "mine.py").write_text(FIVE_WORST)
    (folder / "mine.toml").write_text(
        'extends = "sun"\nname = "mine"\n[search]\nalgorithms = ["nsga2", "rs", "mine:FiveWorst"]\n'
        f"population = 20\nevaluations = 400\nruns = {RUNS}\n"
    )
    return load_study(str(folder / "mine.toml"))


@pytest.fixture(scope="module")
def results(study: Study, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs whose settings are evaluated by a formula: the sum of all changes makes a vehicle unsafe."""
    out = tmp_path_factory.mktemp("out")
    carried_out(study, out)
    return out


@pytest.fixture(scope="module")
def case(results: Path) -> Case:
    return load(results).case


@pytest.fixture(scope="module")
def answer(case: Case) -> Answer:
    return answer_questions([case])


def is_dominated(point: FloatArray, others: FloatArray) -> bool:
    return bool(((others <= point).all(axis=1) & (others < point).any(axis=1)).any())


def test_random_search_returns_what_the_common_rule_takes(case: Case) -> None:
    names = ["f_safe", "f_diff", "f_num_diff"]
    common = nondominated_evaluations(case).set_index(["algorithm", "run"])
    evaluations = case.evaluations.set_index(["algorithm", "run"])
    solutions = case.solutions.set_index(["algorithm", "run"])
    for key in itertools.product(("nsga2", "rs", "FiveWorst"), range(RUNS)):
        points = evaluations.loc[[key], names].to_numpy(float)
        expected = {tuple(point) for point in points if not is_dominated(point, points)}
        assert {*map(tuple, common.loc[[key], names].to_numpy(float))} == expected
        if key[0] == "rs":
            assert {*map(tuple, solutions.loc[[key], names].to_numpy(float))} == expected


def test_who_returns_his_five_worst_is_not_rewarded_by_the_common_rule(answer: Answer, case: Case) -> None:
    over_runs, common = (answer.tables[name].set_index(["baseline", "metric"]) for name in ("rq2-runs", "rq2-common"))
    worst = ("FiveWorst", "safety_degree")
    assert over_runs.loc[worst, "effect_size"] == 0, "its mean is better in every run"
    assert common.loc[worst, "effect_size"] > 0.5
    assert common.loc[("FiveWorst", "hypervolume"), "effect_size"] > 0.9
    # By hand: the best of a run, of all that it has evaluated, whoever returns it.
    best = case.evaluations.groupby(["algorithm", "run"])["safety_degree"].min()
    won = np.mean([ours < theirs for ours, theirs in itertools.product(best["nsga2"], best["FiveWorst"])])
    found = common.loc[("FiveWorst", "best_safety_degree")]
    assert (found["effect_size"], found["n1"], found["n2"]) == (won, RUNS, RUNS)
    p_value = scipy.stats.mannwhitneyu(best["nsga2"], best["FiveWorst"], method="exact").pvalue
    assert found["p_value"] == pytest.approx(p_value)
    assert found["p_holm"] <= p_value * len(common), "a family of its own"
    assert len(common) == len(over_runs) + 2 == 16
    remarks = " ".join(answer.only("rq2-runs").tables["remarks"]["remark"])
    assert "by different rules: FiveWorst, NSGA-II return others" in remarks


def test_there_is_no_remark_on_rules_where_all_return_what_the_common_rule_takes(case: Case) -> None:
    same = dataclasses.replace(case, solutions=nondominated_evaluations(case))
    frames = answer_questions([same]).tables
    assert "by different rules" not in " ".join(frames["remarks"]["remark"])
    one, other = (frames[name].set_index(["baseline", "metric"])["effect_size"] for name in ("rq2-runs", "rq2-common"))
    assert other.drop("best_safety_degree", level="metric").dropna().to_dict() == one.dropna().to_dict()


def test_settings_in_whose_encounter_the_original_is_unsafe_count_nowhere() -> None:
    seen = [
        {**row(name, sd=sd, f_diff=0.1 + 0.1 * i), "evaluation": i}
        for name in ("nsga2", "rs")
        for i, sd in enumerate((-5.0, 1.0, 0.5))
    ]
    case = made_up(row(sd=0.5, f_diff=0.3), row("rs", sd=0.5, f_diff=0.3), evaluations=seen)
    degrees = np.where(case.evaluations["safety_degree"] < 0, 0.1, 2.0)
    joint = dataclasses.replace(
        case,
        evaluations=case.evaluations.assign(original_safety_degree=degrees),
        scoring=msgspec.structs.replace(case.scoring, safe_original=0.5),
    )
    assert nondominated_evaluations(case)["safety_degree"].tolist() == [-5.0] * 2
    assert nondominated_evaluations(joint)["safety_degree"].tolist() == [1.0, 0.5] * 2
    assert len(rq2_common(joint)) == 8


def test_the_table_has_the_median_and_quartiles_of_the_hypervolume_of_all_so_far(answer: Answer, case: Case) -> None:
    names = ["f_safe", "f_diff", "f_num_diff"]
    front = moocore.filter_dominated(case.solutions[names].to_numpy(float))
    low, high = front.min(axis=0), front.max(axis=0)
    rows = answer.to_dict()["tables"]["convergence"]["rows"]
    assert {one["case"] for one in rows} == {"mine"}
    assert {one["algorithm"] for one in rows} == {"nsga2", "rs", "FiveWorst"}
    assert {40, 200, 400} <= {one["evaluations"] for one in rows}
    for one in rows:
        if one["evaluations"] not in (40, 200, 400):
            continue
        so_far = case.evaluations.query(f"algorithm == '{one['algorithm']}' and evaluation < {one['evaluations']}")
        points = ((group[names].to_numpy(float) - low) / (high - low) for _, group in so_far.groupby("run"))
        volumes = [moocore.hypervolume(run, ref=[1.1] * 3) for run in points]
        expected = np.percentile(volumes, [50, 25, 75])
        assert [one["hypervolume"], one["low"], one["high"]] == pytest.approx(expected)
    text = answer.only("convergence").render("text")
    assert "NSGA-II" in text
    assert "400" in text


def test_the_figure_shows_all_that_was_evaluated_and_marks_what_is_returned(case: Case) -> None:
    (axis,) = draw_convergence(case).axes
    growth = compute_convergence(case)
    medians = growth.groupby(["algorithm", "evaluations"])["hypervolume"].median()
    returned = compute_indicators(case)["hypervolume"].groupby(level="algorithm").median()
    marks = axis.collections[-1]
    for name, colour, line, place in zip(
        ("nsga2", "rs", "FiveWorst"), COLOURS, axis.lines, marks.get_offsets(), strict=False
    ):
        assert np.allclose(line.get_ydata(), medians[name])
        assert np.allclose(place, (400, returned[name]))
        assert matplotlib.colors.to_hex(line.get_color()) == colour
    ends = medians.groupby(level="algorithm").last()
    assert ends["FiveWorst"] > 3 * returned["FiveWorst"], "five of what was found"
    assert ends["rs"] == pytest.approx(returned["rs"])
    assert "all settings so far" in axis.get_ylabel()


@pytest.mark.parametrize("sizes", [(3, 3), (4, 5), (3, 12), (5, 5), (2, 30)])
def test_whether_runs_can_be_significant_follows_from_the_exact_distribution(sizes: tuple[int, int]) -> None:
    m, n = sizes
    smallest = scipy.stats.mannwhitneyu(range(m), range(m, m + n), method="exact").pvalue
    of_ranks = scipy.stats.wilcoxon(np.arange(1, m + 1), method="exact").pvalue
    for tests in (1, 7, 16):
        for question, p_value in (("RQ1", of_ranks), ("RQ2", smallest)):
            limit = tests * p_value
            assert can_be_significant(question, m, n, limit * 1.001, tests)
            assert not can_be_significant(question, m, n, limit * 0.999, tests)
    assert fewest_runs("RQ2", 0.01, 14) == 7, "14 * 2 / C(14, 7) = 0.0082, 14 * 2 / C(12, 6) = 0.03"


def test_three_runs_against_many_may_be_significant() -> None:
    """2 / C(43, 3) = 0.00016: as the shorter of two equal samples three would be too few."""
    degrees = {"nsga2": [0.1 + run / 100 for run in range(3)], "rs": [1.0 + run / 100 for run in range(40)]}
    case = made_up(*(row(name, run, sd=sd) for name in degrees for run, sd in enumerate(degrees[name])))
    found = answer_questions([case]).tables["rq2-runs"].set_index("metric").loc["safety_degree"]
    assert found["p_value"] == pytest.approx(2 / (43 * 42 * 41 / 6))
    assert (found["enough_runs"], found["significant"]) == (True, True)


def test_what_was_not_tested_is_neither_significant_nor_not() -> None:
    """The original's TET is unknown, and all of one algorithm's solutions collide, which have no TET."""
    case = made_up(
        *(row(name, run, sd=sd - run / 20) for name, sd in (("nsga2", -1.0), ("rs", 1.5)) for run in range(12)),
        original={"safety_degree": 2.0, "tit": 0.5, "ave_dece": 6.0},
    )
    answer = answer_questions([case])
    for name, untested in (("rq1", 3), ("rq1-runs", 3), ("rq2", 2), ("rq2-runs", 2), ("a12", 2)):
        rows = answer.to_dict()["tables"][name]["rows"]
        values = [one["significant"] for one in rows]
        is_defined = [one["effect_size"] is not None for one in rows]
        assert [value is not None for value in values] == is_defined
        assert values.count(None) == untested
        assert True in values
    lines = [line for line in answer.only("rq1").render("text").splitlines() if "│TET" in line]
    assert lines
    assert all(line.rstrip("│ ").endswith("-") for line in lines)


def test_a_study_prints_tests_only_where_its_runs_can_be_significant(
    study: Study, results: Path, tmp_path: Path
) -> None:
    text = summarise(load(results)).render("text")
    assert "RQ2 over runs" in text, "8 runs, of which 7 are needed"
    assert "RQ1 over runs" not in text
    few = r"too few runs for (\d+) of (\d+) tests of {} \((\d+) are needed after the correction\)\."
    all_tests = re.search(f"all: mine: {few.format('RQ1')}", " ".join(text.split()))
    assert all_tests is not None
    tests, _, needed = map(int, all_tests.groups())
    assert tests / 2 ** (needed - 1) < 0.01 <= tests / 2 ** (needed - 2)
    carried_out(load_study(study, search={"runs": 2}), tmp_path / "two")
    answer = summarise(load(tmp_path / "two"))
    text = answer.render("text")
    assert "over runs" not in text
    (line,) = [line for line in text.splitlines() if "too few" in line]
    assert re.fullmatch(f"all: mine: {few.format('RQ1')} {few.format('RQ2')}", line)
    assert "--all" not in text, "an option that `study` does not have"
    assert len(answer.to_dict()["tables"]["rq2-runs"]["rows"]) == 14
