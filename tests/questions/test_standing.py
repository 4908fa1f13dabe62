"""Answers about vehicles that never move, although the original vehicle does: such a vehicle keeps
the largest distance, and nobody has tested it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import safevar_sumo as sv
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions import cases
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain import failures
from safevar_sumo.questions.part import with_ranges
from safevar_sumo.records import Evaluations, Outcome
from safevar_sumo.results import load_runs
from tests.support.in_process import InlinePool, json_of, run, write

STALLED = """
from typing import Annotated

import msgspec

from safevar_sumo.study import searched


class Stalled(msgspec.Struct, frozen=True):
    UNITS = {"decel": "m/s^2", "volt": "V"}
    speed: Annotated[float, searched(5.0, 30.0, "m/s", "speed")] = 12.0
    volt: float = 9.0
    decel: float = 0.0
    slow: float = 0.0

    def simulate(self, setting):
        is_weak = setting["volt"] < self.volt or setting["decel"] < self.decel
        if is_weak or self.speed < self.slow:
            return {"outcome": "never-moved", "safety_degree": 90.0}
        rest = 20 - self.speed**2 / 2 / setting["decel"]
        if rest < 0:
            return {"outcome": "collision", "safety_degree": rest}
        return {"outcome": "stopped", "safety_degree": rest}
"""
STUDY = """
name = "stalled"
title = "A car that starts with at least 9 V"

[scenario]
model = "stalled:Stalled"
parameters = { volt = 9.0 }

[vehicle.characteristics]
decel = { unit = "m/s^2", original = 8, lower = 2, upper = 8 }
volt = { unit = "V", original = 12, lower = 6, upper = 12 }

[metrics]
ttc_threshold = 1.5

[search]
algorithms = ["rs"]
population = 8
evaluations = 40
runs = 1
seed = 1
"""
STOPS = 12**2 / 2 / 20
"""The least deceleration with which the car does not collide [m/s^2]."""
REMARK = "never moved, although the original vehicle moves in the same encounter"


@pytest.fixture(autouse=True)
def studies(
    coarse: None, few_simulations: None, in_tmp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The study; one in which only the original car starts; and one in which no car starts."""
    monkeypatch.setattr(cases, "LEAST_SIMULATIONS", 200)
    write("stalled.py", STALLED)
    write("some.toml", STUDY)
    write("none.toml", STUDY.replace("volt = 9.0", "volt = 12.0, decel = 8.0"))
    write("always.toml", STUDY.replace("volt = 9.0", "volt = 99.0"))


@pytest.mark.parametrize("question", [sv.risk, sv.rules])
def test_shares_count_the_vehicles_that_moved(question: sv.Question) -> None:
    """One half has the voltage; of this half, (3.6 - 2) / (8 - 2) collide."""
    answer = question("some.toml", samples=500, pool=InlinePool())
    moved = answer.numbers["samples"]
    assert moved == pytest.approx(250, abs=50)
    low, high = answer.numbers["interval"]
    assert low < (STOPS - 2) / 6 < high
    text = f"{500 - moved} of the 500 sampled vehicles never moved"
    assert text in answer.verdict
    assert REMARK in answer.verdict
    assert answer.numbers["never_moved"] >= 500 - moved


def test_limits_end_where_vehicles_stand() -> None:
    answer = sv.tolerance("some.toml", margin=0.0, quick=True, pool=InlinePool())
    limits = answer.tables["limits"].set_index("characteristic")
    for column in ("alone_low", "together_low"):
        assert limits[column]["volt"] == pytest.approx(9, abs=0.05)
        assert limits[column]["decel"] == pytest.approx(STOPS, abs=0.06)
    alone = next(text for text in answer.verdict.split(". ") if "alone can" in text)
    assert "decel" in alone
    assert "volt" not in alone


def test_causes_are_among_the_vehicles_that_moved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of two single changes, the voltage is no simulated one, and no cause."""
    monkeypatch.setattr(failures, "SAMPLED_SETTINGS", 200)
    answer = sv.explain("some.toml", pool=InlinePool())
    assert answer.numbers["settings"] == pytest.approx(100, abs=30)
    assert answer.numbers["tried"] == 1
    (cause,) = answer.tables["causes"]["causes"]
    assert set(cause) == {"decel"}
    assert REMARK in answer.verdict


@pytest.mark.parametrize(
    "question", ["risk", "rules", "explain", "tolerance", "compare none.toml"]
)
def test_no_verdict_is_given_if_only_the_original_vehicle_moves(question: str) -> None:
    answer = json_of(f"{question} none.toml --simulations 300", expect=3)
    assert answer["numbers"]["driven"] is False
    assert answer["numbers"]["never_moved"] > 5
    assert answer["verdict"].count("No verdict is possible") == 1
    assert "no changed vehicle moved" in answer["verdict"]
    assert answer["tables"] == {}


def test_two_versions_are_compared_by_the_vehicles_that_moved() -> None:
    """A system does not differ from itself."""
    answer = json_of("compare some.toml some.toml --samples 60")
    assert answer["verdict"].startswith("RELEASE: B does not differ from A in anything")
    names = ("only_a_unsafe", "only_b_unsafe", "p", "a12")
    assert [answer["numbers"][name] for name in names] == [0, 0, 1.0, 0.5]


def test_standing_is_right_where_the_original_vehicle_stands() -> None:
    answer = sv.risk("always.toml", samples=64, unsafe="below=1", pool=InlinePool())
    assert (answer.numbers["samples"], answer.numbers["never_moved"]) == (64, 0)


@pytest.mark.parametrize("slow", [0.0, 8.0])
def test_each_encounter_is_compared_with_the_original_vehicle_in_it(
    slow: float,
) -> None:
    """At less than 8 m/s nobody starts; at 12 m/s only a weak battery does not."""
    over = '[scenario.over]\nspeed = { unit = "m/s", original = 12, lower = 5, upper = 12 }\n'
    text = STUDY.replace("volt = 9.0", f"volt = 9.0, slow = {slow}")
    write("over.toml", text.replace("[vehicle.", f"{over}\n[vehicle."))
    evaluator = Evaluator(with_ranges(sv.load_study("over.toml")), InlinePool())
    settings = np.array([[8, 12, 6.0], [8, 7, 6.0], [8, 7, 12.0], [3, 12, 12.0]])
    evaluations = evaluator.evaluate(settings, "a stage")
    stands = [False, slow == 0, True, False]
    assert evaluations.standing.tolist() == stands
    assert (~evaluations.valid).tolist() == stands
    assert np.isnan(evaluations.f_safe).tolist() == stands
    assert evaluator.tally.standing == {np.array([8, 7.0]).tobytes()}
    assert Unsafe().of(evaluations).tolist() == [False, False, False, True]


def test_a_car_that_stands_in_one_of_its_drives_gets_no_speed() -> None:
    """The weak car drives at 10 m/s and more: below, only the new car starts."""
    code = STALLED.replace(
        "self.speed < self.slow", "self.speed < self.slow < 12 > setting['volt']"
    )
    write("stalled.py", code)
    over = '[scenario.over]\nspeed = { unit = "m/s", original = 12, lower = 8, upper = 16 }\n'
    text = STUDY.replace("volt = 9.0", "volt = 9.0, slow = 10.0")
    write("speeds.toml", text.replace("[vehicle.", f"{over}\n[vehicle."))
    cars = {"weak": {"decel": 8, "volt": 11}, "full": {"decel": 6, "volt": 12}}
    answer = sv.permit("speeds.toml", cars=cars, margin=0.0, pool=InlinePool())
    rows = answer.tables["cars"].set_index("car")
    assert np.isnan(rows["up_to"]["weak"])
    assert rows["verdict"]["weak"] == "stop"
    assert "the vehicle never moves" in rows["because"]["weak"]
    assert rows["up_to"]["full"] == pytest.approx((2 * 6 * 20) ** 0.5, abs=1)
    assert answer.numbers["never_moved"] == 1


def test_check_finds_a_class_whose_changed_vehicles_never_move() -> None:
    text = run("check none.toml", expect=1).stdout
    assert "no changed vehicle moves, although the original vehicle does" in text
    assert "passed all checks" in run("check some.toml").stdout
    assert "moves" not in run("check always.toml", expect=None).stdout


def test_the_headline_of_a_search_says_how_many_vehicles_never_moved() -> None:
    answer = json_of("study some.toml --out results --jobs 1")
    rows = load_runs("results").evaluations
    standing = rows[rows["outcome"] == "never-moved"]
    number = len(standing.drop_duplicates(["decel", "volt"]))
    assert answer["numbers"]["never_moved"] == number > 0
    assert f"{number} simulated vehicles never moved" in answer["verdict"]


def test_rows_of_standing_vehicles_stay_with_their_evaluations() -> None:
    columns = dict.fromkeys(("f_diff", "f_num_diff"), np.zeros(2))
    moving = Evaluations.undefined(np.zeros((2, 1)), Outcome.STOPPED, ["x"], **columns)
    standing = replace(moving, stands=np.array([True, False]))
    joined = Evaluations.concatenate([moving, standing])
    assert joined.standing.tolist() == [False, False, True, False]
    assert joined.take([2, 1]).standing.tolist() == [True, False]
    assert joined.valid.tolist() == [True, True, False, True]
    assert moving.stands is None
