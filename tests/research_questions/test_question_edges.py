"""Questions where there is nothing to divide by, nothing to rank, or nothing to compare with."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from safevar_sumo.analysis.research_questions.answer import answer
from safevar_sumo.analysis.research_questions.case import Unanswerable
from safevar_sumo.analysis.research_questions.changes import combinations, rq33_safety, weather, weather_pairs
from safevar_sumo.analysis.research_questions.comparisons import ASYMPTOTIC, EXACT, compare, rq1
from safevar_sumo.analysis.research_questions.indicators import indicators
from tests.research_questions.made_up import ORIGINAL, UNCHANGED, made_up, made_up_study, row

HEAVY = (1200.0, 2.0, 0.1)


def test_no_share_of_an_original_that_is_zero() -> None:
    told = rq33_safety(made_up(row(values=HEAVY, tet=1.5, tit=0.5), original={**ORIGINAL, "tet": 0.0, "tit": 0.25}))
    quantities = {one["quantity"]: one for one in told[told["j"] == "any"].to_dict("records")}
    assert quantities["TET"]["value"] == 1.5
    assert quantities["TET"]["percent"] is None
    assert quantities["TIT"]["percent"] == 100


def test_the_footer_of_collisions_alone_has_their_speed_and_deceleration_only() -> None:
    told = rq33_safety(made_up(row(values=HEAVY, sd=-2.0, ave_dece=4.0), row(values=HEAVY, sd=-4.0, ave_dece=5.0)))
    overall = {one["quantity"]: (one["value"], one["n"]) for one in told[told["j"] == "any"].to_dict("records")}
    assert overall == {"avgSD_mD": (None, 0), "avgSD_cS": (3.0, 2), "TET": (None, 0), "TIT": (None, 0), "aveDece": (1.5, 2)}


def test_what_a_table_tells_of_exposure_in_collisions_does_not_count() -> None:
    """Published rows have a TET and a TIT for collisions too."""
    crash = {**row(values=HEAVY, sd=-2.0), "tet": 9.0, "tit": 9.0}
    told = rq33_safety(made_up(row(values=HEAVY, tet=1.5, tit=0.75), crash))
    overall = {one["quantity"]: (one["value"], one["n"]) for one in told[told["j"] == "any"].to_dict("records")}
    assert (overall["TET"], overall["TIT"]) == ((0.5, 1), (0.25, 1))


def test_a_case_that_is_refused_first_does_not_take_the_others_answers() -> None:
    """Whatever the order, the case that has what a question asks for is answered."""
    alone, whole = made_up(row(), study=made_up_study(name="alone")), made_up(row(), row("rs"))
    for cases in ([alone, whole], [whole, alone]):
        told = answer(cases, "rq2")[0]
        assert set(told.frame["setting"]) == {"made-up"}
        assert any(note.startswith("alone: ") for note in told.notes)
        assert not any(note.startswith("made-up: has") for note in told.notes)


def test_the_same_weather_twice_is_no_pair() -> None:
    one, other = (made_up(row(values=HEAVY), study=made_up_study(name=name, weather="wet")) for name in ("one", "other"))
    with pytest.raises(Unanswerable, match="differ in the weather alone"):
        weather_pairs([one, other])


@pytest.mark.parametrize(("clear", "wet"), [("clear", "wet"), ("wet", "fog"), ("clear", "night")])
def test_the_clearer_weather_comes_first(clear: str, wet: str) -> None:
    friction_first = [made_up(row(values=HEAVY), study=made_up_study(name=name, weather=name)) for name in (wet, clear)]
    pair, = weather_pairs(friction_first)
    expected = sorted((clear, wet), key=lambda name: {"clear": (1, 1), "fog": (0.9, 0.6), "wet": (0.71, 1), "night": (1, 0.75)}[name])
    assert [one.name for one in pair] == expected[::-1]


def test_other_parameters_are_no_other_weather() -> None:
    study = made_up_study(name="wet", weather="wet")
    other = msgspec.structs.replace(study, name="other", weather="clear", metrics=msgspec.structs.replace(study.metrics, ttc_threshold=9.0))
    with pytest.raises(Unanswerable):
        weather_pairs([made_up(row(values=HEAVY), study=study), made_up(row(values=HEAVY), study=other)])


def test_weather_without_critical_solutions_on_one_side_has_no_difference() -> None:
    clear, wet = (made_up(row(values=HEAVY, sd=sd), study=made_up_study(name=name, weather=name))
                  for name, sd in (("clear", 9), ("wet", 1)))
    told = weather(clear, wet).set_index("characteristic").loc["mass"]
    assert told["percent"] is None
    assert told["percent_other"] == 100
    assert told["difference"] is None


def test_combinations_are_of_four_exactly() -> None:
    assert combinations(made_up(row(values=HEAVY), row(values=(1200.0, 1.0, 0.2)))).empty


def test_ties_in_small_samples_forbid_the_exact_p() -> None:
    assert compare([1.0, 1.0, 2.0], [3.0, 4.0, 5.0]).method == ASYMPTOTIC
    assert compare([1.0, 2.0, 3.0], [3.0, 4.0, 5.0]).method == ASYMPTOTIC
    assert compare([0.0, 1.0, 2.0], [3.0, 4.0, 5.0]).method == EXACT
    assert compare(np.arange(8.0), np.arange(100.0, 120)).method == EXACT
    assert compare(np.arange(9.0), np.arange(100.0, 120)).method == ASYMPTOTIC


def test_an_objective_that_is_the_same_everywhere_leaves_the_indicators_finite() -> None:
    told = indicators(made_up(row(f_diff=0.5, sd=1.0), row(run=1, f_diff=0.5, sd=2.0), row("rs", f_diff=0.5, sd=1.5)))
    assert np.isfinite(told[["igd", "igd_plus", "hypervolume"]].to_numpy(dtype=float)).all()
    best = told[(told["algorithm"] == "nsga2") & (told["run"] == 0)].iloc[0]
    assert best["igd"] == 0
    assert best["hypervolume"] == pytest.approx(1.1**3)


def test_a_mean_leaves_undefined_values_out() -> None:
    told = rq1(made_up(row(ave_dece=None), row(ave_dece=4.0)))
    found = told[told["metric"] == "ave_dece"].iloc[0]
    assert (found["mean"], found["n1"]) == (4.0, 1)
    assert not math.isnan(found["effect_size"])


def test_unchanged_vehicles_change_nothing_in_any_share() -> None:
    told = answer([made_up(row(values=UNCHANGED))], "rq3.2")[0]
    assert set(told.frame[told.frame["j"] == "any"]["percent"]) == {0.0}
