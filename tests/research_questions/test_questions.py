"""RQ1, RQ2, RQ3 and the discussion on made-up solutions with values that one can count by hand."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any

import msgspec
import pandas as pd
import pytest
import scipy

from safevar_sumo.analysis.research_questions.answer import answer_questions
from safevar_sumo.analysis.research_questions.case import UnanswerableError
from safevar_sumo.analysis.research_questions.changes import (
    compare_weathers,
    count_collisions,
    critical_solutions,
    find_weather_pairs,
    frequent_combinations,
    rq31,
    rq32,
    rq33,
    rq33_safety,
)
from safevar_sumo.analysis.research_questions.comparisons import ALPHA, rq1, rq2
from safevar_sumo.analysis.research_questions.over_runs import correct_by_holm, rq1_runs, rq2_runs, significance_change_line, summary_lines
from safevar_sumo.errors import InputError
from safevar_sumo.study import CharacteristicTable, load_study
from tests.research_questions.made_up import CHARACTERISTICS, ORIGINAL, made_up, made_up_study, row

HEAVY, GRIPLESS, BOTH = (1100.0, 2.0, 0.1), (1000.0, 1.0, 0.1), (1200.0, 1.5, 0.1)


def only(frame: pd.DataFrame, **wanted: Any) -> dict[str, Any]:
    """The one row with these values."""
    result = frame[(frame[list(wanted)] == pd.Series(wanted)).all(axis=1)]
    assert len(result) == 1
    return dict(result.iloc[0])


def test_rq1_is_small_where_solutions_are_more_unsafe() -> None:
    case = made_up(*(row(sd=1 + i / 10, tet=2, tit=1, ave_dece=3) for i in range(5)))
    frame = rq1(case)
    assert frame["metric"].tolist() == ["safety_degree", "tet", "tit", "ave_dece"]
    assert frame["effect_size"].tolist() == [0, 0, 0, 0]
    assert set(frame["magnitude"]) == {"large"}
    assert (frame["n1"] == 5).all()
    assert (frame["n2"] == 5).all()
    safer = rq1(made_up(*(row(sd=3, tet=0.5, tit=0.1, ave_dece=7) for _ in range(5))))
    assert safer["effect_size"].tolist() == [1, 1, 1, 1]


def test_a_tet_that_stands_at_a_collision_is_not_counted() -> None:
    case = made_up({**row(sd=-3), "tet": 0.0, "tit": 0.0}, row(sd=1, tet=1.4, tit=0.7), {**row("rs", sd=-3), "tet": 9.0, "tit": 9.0},
                      row("rs", sd=1, tet=1.3, tit=0.6))
    assert only(rq1(case), algorithm="nsga2", metric="tet")["mean"] == 1.4
    assert only(rq2(case), metric="tet")["effect_size"] == 1
    assert only(rq33_safety(case), quantity="TIT", j="any")["value"] == pytest.approx(0.2)


def test_rq1_says_which_values_are_undefined() -> None:
    result = answer_questions([made_up(row(tet=None), row(sd=-1), row(), original={**ORIGINAL, "tit": None})], "rq1")[0]
    assert only(result.frame, metric="tet")["n1"] == 1
    assert only(result.frame, metric="tit")["p_value"] is None
    assert any("tet is undefined in 1 of 2 solutions" in note for note in result.notes)
    assert any("the original vehicle's tit is undefined" in note for note in result.notes)


def test_rq2_is_high_where_nsga2_is_better() -> None:
    rows = [*(row(run=run, sd=0.5 - run / 10, tet=2, tit=1, ave_dece=3, f_diff=0.1) for run in (0, 1, 2)),
            *(row("rs", run=run, sd=1.5 + run / 10, f_diff=0.6) for run in (0, 1, 2))]
    frame = rq2(made_up(*rows))
    assert frame["metric"].tolist() == ["igd", "igd_plus", "hypervolume", "safety_degree", "tet", "tit", "ave_dece"]
    assert frame["effect_size"].tolist() == [1] * 7
    assert set(frame["baseline"]) == {"rs"}
    exchanged = [{**one, "algorithm": {"rs": "nsga2", "nsga2": "rs"}[one["algorithm"]]} for one in rows]
    assert rq2(made_up(*exchanged))["effect_size"].tolist() == [0] * 7


def test_rq2_compares_runs_by_front_and_pooled_solutions_by_metric() -> None:
    frame = rq2(made_up(row(), row(), row(run=1), row("rs"), row("rs", run=1), row("rs", run=1), row("rs", run=1)))
    assert (only(frame, metric="igd")["n1"], only(frame, metric="igd")["n2"]) == (2, 2)
    assert (only(frame, metric="tet")["n1"], only(frame, metric="tet")["n2"]) == (3, 4)


def test_rq2_of_imported_solutions_leaves_the_fronts_open() -> None:
    result = answer_questions([made_up(row(sd=1), row("rs", sd=2), has_runs=False)], "rq2")[0]
    assert only(result.frame, metric="igd")["p_value"] is None
    assert only(result.frame, metric="igd")["n1"] == 0
    assert only(result.frame, metric="safety_degree")["effect_size"] == 1
    assert any("need runs" in note for note in result.notes)


@pytest.mark.parametrize(("rows", "expected"), [([row("rs")], "no finished run of nsga2"), ([row()], "only nsga2"),
                                                   ([], "no finished run")])
def test_rq2_without_an_algorithm_is_refused(rows: list[dict[str, Any]], expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        answer_questions([made_up(*rows)], "rq2")


def test_critical_solutions_are_strictly_below_the_original() -> None:
    case = made_up(row(sd=2.0), row(sd=1.999), row(sd=-1), row("rs", sd=1), row(sd=math.nan))
    assert critical_solutions(case)["safety_degree"].tolist() == [1.999, -1]
    with pytest.raises(UnanswerableError, match="safety degree"):
        critical_solutions(made_up(row(), original={}))


def test_rq31_counts_runs_without_any() -> None:
    case = made_up(row(values=HEAVY), row(values=GRIPLESS), row(values=BOTH), finished=[("nsga2", 0), ("nsga2", 1)])
    counts = {(one.run, one.j): one.count_ for one in rq31(case).rename(columns={"count": "count_"}).itertuples()}
    assert counts == {(0, "1"): 2, (0, "2"): 1, (0, "3"): 0, (1, "1"): 0, (1, "2"): 0, (1, "3"): 0}


def test_rq32_shares_and_ranks() -> None:
    frame = rq32(made_up(row(values=HEAVY), row(values=GRIPLESS), row(values=BOTH), row(values=HEAVY)))
    assert only(frame, characteristic="mass", j="1")["percent"] == pytest.approx(200 / 3)
    assert only(frame, characteristic="mass", j="2")["percent"] == 100
    assert only(frame, characteristic="mass", j="any")["percent"] == 75
    assert only(frame, characteristic="lag", j="any")["percent"] == 0
    assert only(frame, characteristic="mass", j="3")["percent"] is None
    assert frame[frame["j"] == "any"]["rank"].tolist() == [1, 2, 3]


def test_rq33_tells_increases_from_decreases() -> None:
    frame = rq33(made_up(row(values=HEAVY), row(values=(1300, 2, 0.1)), row(values=(900, 2, 0.1)), row(values=BOTH)))
    up = only(frame, characteristic="mass", direction="increase", j="1")
    assert (up["pc"], up["delta"], up["n"]) == (pytest.approx(0.2), 200, 2)
    down = only(frame, characteristic="mass", direction="decrease", j="any")
    assert (down["pc"], down["delta"], down["n"]) == (pytest.approx(0.1), -100, 1)
    assert only(frame, characteristic="mass", direction="increase", j="any")["delta"] == 200
    assert only(frame, characteristic="grip", direction="decrease", j="2")["pc"] == 0.25
    assert only(frame, characteristic="lag", direction="increase", j="any")["pc"] is None


def test_the_footer_of_rq33() -> None:
    frame = rq33_safety(made_up(row(values=HEAVY, sd=1.5, tet=1.5, tit=0.6, ave_dece=5),
                                row(values=HEAVY, sd=0.5, tet=2, tit=1, ave_dece=4),
                                row(values=HEAVY, sd=-3, ave_dece=3)))
    expected = {"avgSD_mD": (1, 50, 2), "avgSD_cS": (3, None, 1), "TET": (0.75, 75, 2), "TIT": (0.3, 60, 2), "aveDece": (2, 100 / 3, 3)}
    for quantity, (value, percent, n) in expected.items():
        result = only(frame, quantity=quantity, j="1")
        assert (result["value"], result["n"]) == (pytest.approx(value), n)
        assert result["percent"] == (None if percent is None else pytest.approx(percent))
    assert only(frame, quantity="avgSD_cS", j="2")["value"] is None


def test_collisions_and_their_share() -> None:
    frame = count_collisions(made_up(row(sd=-1), row(sd=0), row(sd=1), row("rs")))
    assert only(frame, algorithm="nsga2") == {"setting": "made-up", "algorithm": "nsga2", "solutions": 3, "collisions": 2,
                                              "share": pytest.approx(2 / 3)}
    assert only(frame, algorithm="rs")["share"] == 0


def test_combinations_of_exactly_four() -> None:
    tables = {name: CharacteristicTable(unit="-", original=1, lower=0.5, upper=2) for name in "abcdef"}
    study = made_up_study()
    study = msgspec.structs.replace(study, vehicle=msgspec.structs.replace(study.vehicle, characteristics=tables))

    def changed(names: str) -> dict[str, Any]:
        return {**{name: one for name, one in row().items() if name not in CHARACTERISTICS},
                **{name: 2.0 if name in names else 1.0 for name in tables}}

    case = made_up(study=study, finished=[("nsga2", 0)])
    solutions = pd.DataFrame([changed(names) for names in ("abcd", "bcde", "abcd", "cdef", "abcf", "abcde", "abc")])
    result = frequent_combinations(dataclasses.replace(case, solutions=solutions))
    assert result["characteristics"].tolist() == [list("abcd"), list("abcf"), list("bcde")]
    assert result["percent"].tolist() == [40, 20, 20]
    assert result["rank"].tolist() == [1, 2, 2]


def test_weather_compares_cases_that_differ_in_it_alone() -> None:
    clear = made_up(row(values=HEAVY), row(values=GRIPLESS))
    wet = made_up(row(values=BOTH), study=made_up_study(name="wet", weather="hard_rain"))
    other = made_up(row(values=BOTH), study=made_up_study(name="other", weather="hard_rain", metrics=made_up_study().metrics.__class__(
        ttc_threshold=9)))
    assert [(one.name, two.name) for one, two in find_weather_pairs([wet, other, clear])] == [("made-up", "wet")]
    result = only(compare_weathers(clear, wet), characteristic="mass")
    assert (result["percent"], result["percent_other"], result["difference"]) == (50, 100, 50)
    assert (result["increase"], result["increase_other"], result["decrease"]) == (100, 200, None)
    assert (result["rank"], result["rank_other"]) == (1, 1)
    with pytest.raises(InputError, match=r"differ in the weather alone; these two also differ in metrics\.ttc_threshold"):
        answer_questions([clear, other], "weather")
    with pytest.raises(InputError, match="these two have equally clear weather"):
        find_weather_pairs([clear, clear])


def test_the_reaction_in_rain_that_was_fitted_apart_belongs_to_the_weather() -> None:
    sun, rain = (made_up(row(values=HEAVY), study=load_study(name)) for name in ("sun", "rain"))
    assert sun.study.ads.parameters["brake_place"] != rain.study.ads.parameters["brake_place"]
    assert [(clearer.name, other.name) for clearer, other in find_weather_pairs([rain, sun])] == [("sun", "rain")]


def test_every_question_at_once_tells_what_is_lacking() -> None:
    result = {one.name: one for one in answer_questions([made_up(row(values=HEAVY))])}
    assert not result["rq1"].frame.empty
    assert result["rq2"].frame.empty
    assert "only nsga2" in result["rq2"].notes[0]
    assert result["weather"].frame.empty
    with pytest.raises(InputError, match="no finished run"):
        answer_questions([made_up()])
    with pytest.raises(InputError, match="rq9"):
        answer_questions([made_up(row())], "rq9")


def test_several_cases_stand_in_one_frame_and_the_refused_in_the_notes() -> None:
    good = made_up(row(), row("rs"))
    alone = made_up(row(), study=made_up_study(name="alone"))
    result = answer_questions([good, alone], "rq2")[0]
    assert set(result.frame["setting"]) == {"made-up"}
    assert any(note.startswith("alone: ") for note in result.notes)


def test_the_brief_lines_say_what_the_data_allows() -> None:
    five = made_up(*(row(name, run=run, sd=sd + run / 10) for name, sd in (("nsga2", 1.0), ("rs", 2.5)) for run in range(5)))
    lines = summary_lines(five)
    assert any("A12 of NSGA-II against the original vehicle: SD 0.00, " in line
               and line.endswith("too few runs for a test (8 are needed)") for line in lines)
    assert any("A12 of NSGA-II against RS: IGD " in line and "too few" not in line for line in lines), "five runs can differ significantly"
    assert any("RQ2 over runs: only nsga2 has finished runs" in line for line in summary_lines(made_up(row())))
    (rq1_answer,), (rq2_answer,) = (answer_questions([five], name) for name in ("rq1-runs", "rq2-runs"))
    assert any("too few runs for all 8 tests of RQ1 (8 are needed)" in note for note in rq1_answer.notes)
    assert not any("too few runs" in note for note in rq2_answer.notes)
    two = answer_questions([made_up(*(row(name, run=run) for name in ("nsga2", "rs") for run in range(2)))], "rq2-runs")[0].notes
    assert any("too few runs for all 7 tests of RQ2 (5 are needed)" in note for note in two)
    assert not any("pooled" in note for note in two), "no test can be significant"


def test_holms_correction_of_a_worked_example() -> None:
    corrected = correct_by_holm([0.01, None, 0.04, 0.03, 0.005])
    assert [p and round(p, 12) for p in corrected] == [0.03, None, 0.06, 0.06, 0.02]


def test_solutions_of_one_run_are_not_taken_for_independent() -> None:
    """Runs of 40 copies each: pooled, rank tests see 320 against 320 values; over runs they see the 8 against 8 that there are."""
    ours, theirs = [1.0, 1.1, 1.2, 1.3, 1.4, 1.6, 1.7, 2.2], [1.5, 1.8, 1.9, 2.3, 2.4, 2.5, 2.6, 2.7]
    rows = [row(name, run=run, sd=sd, values=(1100.0 + run, 2.0, 0.1))
            for name, degrees in (("nsga2", ours), ("rs", theirs)) for run, sd in enumerate(degrees) for _ in range(40)]
    case = made_up(*rows)
    (paper,), (runs,) = (frame[frame["metric"] == "safety_degree"].to_dict("records") for frame in (rq2(case), rq2_runs(case)))
    assert paper["p_value"] < 1e-30
    assert (runs["n1"], runs["n2"]) == (8, 8)
    assert runs["effect_size"] == 1 - (0 + 0 + 0 + 0 + 0 + 1 + 1 + 3) / 64
    assert runs["p_value"] == scipy.stats.mannwhitneyu(ours, theirs, method="exact").pvalue > ALPHA / 10
    line = significance_change_line(case)
    assert re.search(r"\d+ of \d+ tests are no longer significant: .*; RQ2 RS .*SD", line)
    assert line.count("significant") == 1
    notes = {answer.name: "".join(answer.notes) for answer in answer_questions([case]) if answer.name.endswith("-runs")}
    assert (line in notes["rq1-runs"], line in notes["rq2-runs"]) == (True, False), "once, not below both tables"
    assert line in "".join(answer_questions([case], "rq2-runs")[0].notes)
    (original,) = (one for one in rq1_runs(case).to_dict("records") if (one["algorithm"], one["metric"]) == ("nsga2", "safety_degree"))
    assert original["p_value"] == 2 * 2 / 2**8, "signed ranks of which all but the smallest are negative: the second of 2^8 orders"
    assert original["effect_size"] == 1 / 8
    assert original["p_holm"] >= original["p_value"] * 2


def test_a_question_with_too_few_runs_for_significance_loses_none() -> None:
    rows = [row(name, run=run, sd=sd + run / 100, values=(1100.0 + run, 2.0, 0.1)) for name, sd in (("nsga2", 1.0), ("rs", 2.0))
            for run in range(5) for _ in range(40)]
    line = significance_change_line(made_up(*rows))
    assert "RQ1" not in line, "5 runs are too few for its tests, not for RQ2's"
    assert "of 7 tests" in line


HEAVIER = (1200.0, 2.0, 0.1)


def test_no_share_of_an_original_that_is_zero() -> None:
    result = rq33_safety(made_up(row(values=HEAVIER, tet=1.5, tit=0.5), original={**ORIGINAL, "tet": 0.0, "tit": 0.25}))
    quantities = {one["quantity"]: one for one in result[result["j"] == "any"].to_dict("records")}
    assert quantities["TET"]["value"] == 1.5
    assert quantities["TET"]["percent"] is None
    assert quantities["TIT"]["percent"] == 100


@pytest.mark.parametrize(("clear", "wet"), [("clear", "wet"), ("wet", "fog"), ("clear", "night")])
def test_the_clearer_weather_comes_first(clear: str, wet: str) -> None:
    friction_first = [made_up(row(values=HEAVIER), study=made_up_study(name=name, weather=name)) for name in (wet, clear)]
    pair, = find_weather_pairs(friction_first)
    expected = sorted((clear, wet), key=lambda name: {"clear": (1, 1), "fog": (0.9, 0.6), "wet": (0.71, 1), "night": (1, 0.75)}[name])
    assert [one.name for one in pair] == expected[::-1]
