"""RQ3 and the discussion on made-up solutions with values that one can count by hand."""

from __future__ import annotations

import dataclasses
import math

import pandas as pd
import pytest

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
from safevar_sumo.errors import InputError
from safevar_sumo.study import CharacteristicTable, MetricsTable, load_study
from tests.research_questions.made_up import ORIGINAL, made_up, made_up_study, only, row

HEAVY, GRIPLESS, BOTH = (1100.0, 2.0, 0.1), (1000.0, 1.0, 0.1), (1200.0, 1.5, 0.1)


def test_critical_solutions_are_strictly_below_the_original() -> None:
    case = made_up(row(sd=2.0), row(sd=1.999), row(sd=-1), row("rs", sd=1), row(sd=math.nan))
    assert critical_solutions(case)["safety_degree"].tolist() == [1.999, -1]
    with pytest.raises(UnanswerableError, match="safety degree"):
        critical_solutions(made_up(row(), original={}))


def test_rq31_counts_runs_without_any() -> None:
    case = made_up(row(values=HEAVY), row(values=GRIPLESS), row(values=BOTH), finished=[("nsga2", 0), ("nsga2", 1)])
    assert rq31(case)[["run", "j", "count"]].to_numpy().tolist() == [
        [0, "1", 2],
        [0, "2", 1],
        [0, "3", 0],
        [1, "1", 0],
        [1, "2", 0],
        [1, "3", 0],
    ]


def test_rq32_shares_and_ranks() -> None:
    frame = rq32(made_up(row(values=HEAVY), row(values=GRIPLESS), row(values=BOTH), row(values=HEAVY)))
    percents = {(one["characteristic"], one["j"]): one["percent"] for one in frame.to_dict("records")}
    assert [percents["mass", j] for j in ("1", "2", "3", "any")] == [pytest.approx(200 / 3), 100, None, 75]
    assert percents["lag", "any"] == 0
    assert frame[frame["j"] == "any"]["rank"].tolist() == [1, 2, 3]


def test_rq33_tells_increases_from_decreases() -> None:
    frame = rq33(made_up(row(values=HEAVY), row(values=(1300, 2, 0.1)), row(values=(900, 2, 0.1)), row(values=BOTH)))
    cells = {
        (one["characteristic"], one["direction"], one["j"]): (one["pc"], one["delta"], one["n"])
        for one in frame.to_dict("records")
    }
    assert cells["mass", "increase", "1"] == (pytest.approx(0.2), 200, 2)
    assert cells["mass", "decrease", "any"] == (pytest.approx(0.1), -100, 1)
    assert cells["mass", "increase", "any"][1] == 200
    assert cells["grip", "decrease", "2"][0] == 0.25
    assert cells["lag", "increase", "any"] == (None, None, 0)


def test_the_footer_of_rq33() -> None:
    """A TET that stands at a collision is not counted, and nothing is a share of an original value of zero."""
    rows = [
        row(values=HEAVY, sd=1.5, tet=1.5, tit=0.6, ave_dece=5),
        row(values=HEAVY, sd=0.5, tet=2, tit=1, ave_dece=4),
        {**row(values=HEAVY, sd=-3, ave_dece=3), "tet": 0.0, "tit": 0.0},
    ]
    expected = {
        "avgSD_mD": (1, 50, 2),
        "avgSD_cS": (3, None, 1),
        "TET": (0.75, 75, 2),
        "TIT": (0.3, 60, 2),
        "aveDece": (2, 100 / 3, 3),
    }
    frame = rq33_safety(made_up(*rows))
    for quantity, (value, percent, n) in expected.items():
        result = only(frame, quantity=quantity, j="1")
        assert (result["value"], result["n"]) == (pytest.approx(value), n)
        assert result["percent"] == (None if percent is None else pytest.approx(percent))
    assert only(frame, quantity="avgSD_cS", j="2")["value"] is None
    zero = only(rq33_safety(made_up(*rows, original={**ORIGINAL, "tet": 0.0})), quantity="TET", j="any")
    assert (zero["value"], zero["percent"]) == (1.75, None)


def test_collisions_and_their_share() -> None:
    frame = count_collisions(made_up(row(sd=-1), row(sd=0), row(sd=1), row("rs")))
    assert frame.to_numpy().tolist() == [["made-up", "nsga2", 3, 2, pytest.approx(2 / 3)], ["made-up", "rs", 1, 0, 0]]


def test_combinations_of_exactly_four() -> None:
    tables = {name: CharacteristicTable(unit="-", original=1, lower=0.5, upper=2) for name in "abcdef"}
    case = made_up(study=made_up_study(characteristics=tables), finished=[("nsga2", 0)])
    solutions = pd.DataFrame(
        [
            {**row(), **{name: 2.0 if name in changed else 1.0 for name in tables}}
            for changed in ("abcd", "bcde", "abcd", "cdef", "abcf", "abcde", "abc")
        ]
    )
    result = frequent_combinations(dataclasses.replace(case, solutions=solutions))
    assert result["characteristics"].tolist() == [list("abcd"), list("abcf"), list("bcde")]
    assert (result["percent"].tolist(), result["rank"].tolist()) == ([40, 20, 20], [1, 2, 2])


def test_weather_compares_cases_that_differ_in_it_alone() -> None:
    clear = made_up(row(values=HEAVY), row(values=GRIPLESS))
    wet = made_up(row(values=BOTH), study=made_up_study(name="wet", weather="hard_rain"))
    other = made_up(
        row(values=BOTH), study=made_up_study(name="other", weather="hard_rain", metrics=MetricsTable(ttc_threshold=9))
    )
    assert [(one.name, two.name) for one, two in find_weather_pairs([wet, other, clear])] == [("made-up", "wet")]
    result = only(compare_weathers(clear, wet), characteristic="mass")
    assert (result["percent"], result["percent_other"], result["difference"]) == (50, 100, 50)
    assert (result["increase"], result["increase_other"], result["decrease"]) == (100, 200, None)
    assert (result["rank"], result["rank_other"]) == (1, 1)
    with pytest.raises(
        InputError, match=r"differ in the weather alone; these two also differ in metrics\.ttc_threshold"
    ):
        answer_questions([clear, other], "weather")
    with pytest.raises(InputError, match="these two have equally clear weather"):
        find_weather_pairs([clear, clear])


@pytest.mark.parametrize(("clearer", "other"), [("clear", "hard_rain"), ("fog", "wet"), ("clear", "night")])
def test_the_clearer_weather_comes_first(clearer: str, other: str) -> None:
    (pair,) = find_weather_pairs(
        [made_up(row(), study=made_up_study(name=name, weather=name)) for name in (other, clearer)]
    )
    assert [one.name for one in pair] == [clearer, other]


def test_the_reaction_in_rain_that_was_fitted_apart_belongs_to_the_weather() -> None:
    sun, rain = (made_up(row(values=HEAVY), study=load_study(name)) for name in ("sun", "rain"))
    assert sun.study.ads.parameters["brake_place"] != rain.study.ads.parameters["brake_place"]
    assert [(clearer.name, other.name) for clearer, other in find_weather_pairs([rain, sun])] == [("sun", "rain")]
