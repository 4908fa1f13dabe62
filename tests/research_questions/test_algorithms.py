"""Any set of algorithms compared: pairs, ranks over runs, and what runs attain."""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest
import scipy

from safevar_sumo.analysis.research_questions.algorithm_figures import draw_attainment_surfaces, draw_critical_differences, find_cliques
from safevar_sumo.analysis.research_questions.algorithms import compare_pairs, compute_attainment, critical_difference, rank_algorithms
from safevar_sumo.analysis.research_questions.answer import answer_questions
from safevar_sumo.analysis.research_questions.case import Case, UnanswerableError
from safevar_sumo.analysis.research_questions.comparisons import compare_samples, reverse_effect
from safevar_sumo.analysis.research_questions.over_runs import correct_by_holm
from safevar_sumo.analysis.research_questions.tables import FORMATS_WITH_LAYOUT
from tests.research_questions.made_up import made_up, made_up_study, row

RUNS = 12


def three_algorithms() -> Case:
    """The second finds more severe solutions than the first, the third as the first; run 3 of the third finds none."""
    study = made_up_study()
    study = msgspec.structs.replace(study, search=msgspec.structs.replace(study.search, algorithms=["nsga2", "spea2", "mocell"], runs=RUNS))
    rng, rows = np.random.default_rng(1), []
    for (name, worse), run in itertools.product((("nsga2", 0.0), ("spea2", 1.0), ("mocell", 0.0)), range(RUNS)):
        if (name, run) != ("mocell", 3):
            rows += [row(name, run, (900.0, 1.5, 0.1), sd=2 - worse - share - 0.2 * rng.random(), f_diff=0.3 * share + 0.05 * rng.random())
                     for share in (0.2, 0.5, 0.8)]
    finished = [(name, run) for name in ("nsga2", "spea2", "mocell") for run in range(RUNS)]
    return made_up(*rows, study=study, finished=finished)


def test_every_pair_is_tested_once_and_corrected_for_all() -> None:
    case = three_algorithms()
    frame = compare_pairs(case)
    assert len(frame) == 3 * 7
    assert set(zip(frame["algorithm"], frame["other"], strict=True)) == {("nsga2", "spea2"), ("nsga2", "mocell"), ("spea2", "mocell")}
    means = {name: [group["safety_degree"].mean() for _, group in case.solutions_of(name).groupby("run")] for name in case.algorithms}
    chosen = frame[(frame["metric"] == "safety_degree") & (frame["algorithm"] == "spea2")].iloc[0]
    expected = reverse_effect(compare_samples(means["spea2"], means["mocell"]))
    assert (chosen["p_value"], chosen["effect_size"]) == (expected.p_value, expected.effect_size)
    assert (chosen["n1"], chosen["n2"]) == (RUNS, RUNS - 1)
    assert chosen["effect_size"] == 1, "every run of SPEA2 is more unsafe"
    assert frame["p_holm"].tolist() == correct_by_holm(frame["p_value"].tolist())


def test_ranks_are_friedmans_over_the_runs_that_all_have() -> None:
    case = three_algorithms()
    frame = rank_algorithms(case)
    part = frame[frame["metric"] == "safety_degree"].set_index("algorithm")
    runs = [run for run in range(RUNS) if run != 3]
    means = case.solutions.groupby(["run", "algorithm"])["safety_degree"].mean()
    values = np.array([[means[run, name] for name in case.algorithms] for run in runs])
    expected = scipy.stats.friedmanchisquare(*values.T)
    assert part["runs"].tolist() == [RUNS - 1] * 3
    assert part.loc["nsga2", "p_value"] == pytest.approx(expected.pvalue)
    assert part.loc["spea2", "mean_rank"] == 1
    assert part["mean_rank"].sum() == pytest.approx(6)
    by_metric = frame.drop_duplicates("metric")
    assert by_metric["p_holm"].tolist() == correct_by_holm(by_metric["p_value"].tolist())


@pytest.mark.parametrize(("algorithms", "runs", "published"), [(4, 14, 1.25), (5, 30, 1.11)])
def test_critical_differences_are_published_ones(algorithms: int, runs: int, published: float) -> None:
    """Demsar 2006: 2.569 sqrt(20 / 84) = 1.25; his q of five algorithms at 0.05 is 2.728."""
    assert critical_difference(algorithms, runs, 0.05) == pytest.approx(published, abs=0.006)


def test_a_bar_joins_the_largest_groups_that_are_not_told_apart() -> None:
    assert find_cliques(np.array([1.2, 1.9, 2.1, 3.5]), 1.0) == [(0, 2)]
    assert find_cliques(np.array([1.0, 1.8, 2.6]), 1.0) == [(0, 1), (1, 2)]
    assert find_cliques(np.array([1.0, 3.0]), 1.0) == []


def test_attainment_is_what_so_many_runs_reach() -> None:
    """Two runs by hand: one has (1, 0.4), the other (2, 0.2): both reach (2, 0.4)."""
    case = made_up(row("nsga2", 0, (900.0, 2.0, 0.1), sd=1.0, f_diff=0.4), row("nsga2", 1, (900.0, 2.0, 0.1), sd=2.0, f_diff=0.2))
    surface = compute_attainment(case)["nsga2"]
    assert surface[50.0].tolist() == [[1.0, 0.4], [2.0, 0.2]]
    assert surface[100.0].tolist() == [[2.0, 0.4]]


def test_what_cannot_be_asked_says_why() -> None:
    two = made_up(row("nsga2"), row("rs"))
    few = [row(name, run, (900.0, 2.0, 0.1)) for name in ("nsga2", "rs", "spea2") for run in (0, 1)]
    with pytest.raises(UnanswerableError, match="has 2 runs in which all 3 algorithms have solutions: too few"):
        draw_critical_differences(made_up(*few))
    for question in (rank_algorithms, draw_critical_differences):
        with pytest.raises(UnanswerableError, match="of 2 algorithms"):
            question(two)
    with pytest.raises(UnanswerableError, match="of 1 algorithm"):
        compare_pairs(made_up(row("nsga2")))
    with pytest.raises(UnanswerableError, match="imported"):
        compare_pairs(made_up(row("nsga2"), row("rs"), has_runs=False))


@pytest.mark.slow
def test_tables_and_figures_of_three_algorithms_can_be_made() -> None:
    case = three_algorithms()
    for name in ("rq2-pairs", "rq2-ranks"):
        for rendered in (make(answer_questions([case], name)) for make in FORMATS_WITH_LAYOUT.values()):
            assert "SPEA2" in rendered
            assert "MOCell" in rendered
    assert len(draw_critical_differences(case).axes) == 3
    assert [axis.get_title() for axis in draw_attainment_surfaces(case).axes] == ["NSGA-II", "SPEA2", "MOCell"]
