"""Smallest changes of a made-up driving system, which brakes at a gap: repairs, their order, their
proof and what nobody repairs are formulas.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from safevar_sumo.api.simulation import load_study
from safevar_sumo.campaign.evaluation import evaluate_settings
from safevar_sumo.questions import repair as question
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.between import AT_ONE_PHASE
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.repair import answer as answers
from safevar_sumo.records import FloatArray, JsonObject, NamedValues
from safevar_sumo.study import CharacteristicTable, FreeParameter, Study
from tests.support.in_process import InlinePool
from tests.support.made_up import made_up_evaluations

pytestmark = pytest.mark.usefixtures("made_up_studies")

SPEED, SEEN_FROM, MARGIN = 20.0, 60.0, 0.25
"""Speed [m/s] of the vehicle, the gap [m] from which it sees the obstacle, and the clearance [m] to
keep.
"""
WEAR = [1.0, 0.9, 1.1]
"""Shares of the grip in the parameter sets."""
SHARE = 0.01
"""Share of unsafe vehicles that a proof excludes."""
CHANGEABLE = {
    "gap": FreeParameter(lower=4.0, upper=64.0, unit="m", meaning="gap to brake at"),
    "more": FreeParameter(lower=0.0, upper=60.0, unit="m", meaning="further gap"),
    "always": FreeParameter(lower=0.0, upper=1.0, unit="-", meaning="brakes at once"),
}


def braking_way(grip: Any) -> Any:
    """The way [m] on which a vehicle brakes to a standstill."""
    return SPEED**2 / (2 * grip)


class Brakes(InlinePool):
    """Simulates vehicles that brake at the gap `gap` + `more`, or at once if `always` is at least
    0.5. Full braking begins at once.
    """

    def compute(self, function: Any, *arguments: Any) -> Any:
        if function is not evaluate_settings:
            return ""
        task, rows = arguments
        study = task.study
        values: NamedValues = dict(study.ads.parameters)
        values |= dict(zip(task.selection.parameters, rows[:, 2:].T, strict=True))
        grip = study.vehicle.parameters["wear"] * rows[:, 0]
        gap: Any = SEEN_FROM
        if study.ads.model != "full_braking":
            gap = np.minimum(values["gap"] + values["more"], SEEN_FROM)
            gap = np.where(values["always"] >= 0.5, SEEN_FROM, gap)
        rest = gap - braking_way(grip)
        impact = np.minimum(SPEED, np.sqrt(2 * grip * np.abs(rest)))
        return made_up_evaluations(np.where(rest < 0, -impact, rest), settings=rows)


def planted(gap: float = 12.0, most: float = 64.0) -> Study:
    """The study of these vehicles: the present gap, and the largest one to which it may change."""
    smoke = load_study("smoke", scenario={"over": False, "margin": 0.3})
    changeable = {**CHANGEABLE, "gap": replace(CHANGEABLE["gap"], upper=most)}
    return replace(
        smoke,
        name="made-up",
        spread={"vehicle.parameters.wear": WEAR},
        vehicle=replace(
            smoke.vehicle,
            parameters={"wear": WEAR[0]},
            characteristics={
                "grip": CharacteristicTable(
                    unit="m/s^2", original=8.0, lower=3.0, upper=9.0
                ),
                "paint": CharacteristicTable(
                    unit="-", original=1.0, lower=0.5, upper=2.0
                ),
            },
        ),
        ads=replace(smoke.ads, parameters={"gap": gap, "more": 0.0, "always": 0.0}),
        repair=replace(smoke.repair, parameters=changeable),
    )


def price_of(study: Study, values: NamedValues, encounters: FloatArray) -> JsonObject:
    """A price: `more` costs less than `gap`, and who always brakes does so needlessly."""
    today = study.ads.parameters
    earlier = values.get("gap", today["gap"]) - today["gap"]
    earlier += 0.5 * values.get("more", 0.0)
    needless = 4 if values.get("always", 0.0) >= 0.5 else 0
    return {
        "metres_earlier": earlier,
        "metres_earlier_mean": earlier,
        "seconds_earlier": earlier / SPEED,
        "most_at": None,
        "largest_deceleration": 8.0,
        "needless_braking": needless,
        "needless_braking_today": 0,
        "benign_scenes": 4,
    }


@pytest.fixture(autouse=True)
def _made_up_price(quick_repairs: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answers, "price_of", price_of)


def repaired(study: Study, **options: Any) -> Answer:
    evaluator = Evaluator(study, Brakes())
    return question.repair.compute(study, evaluator, margin=MARGIN, **options)


def rows_of(answer: Answer) -> list[JsonObject]:
    return answer.tables["repairs"].to_dict("records")


GRIP = ["grip >= 5"]
NEEDED = MARGIN + braking_way(5)
"""Gap [m] at which the weakest promised vehicle has to brake, with the study's own set."""
NEEDED_IN_SETS = braking_way(min(WEAR) * 5)
"""The same in all parameter sets: with another set than its own, the vehicle may just not
collide.
"""


@pytest.mark.parametrize(("fits", "needed"), [(0, NEEDED), (None, NEEDED_IN_SETS)])
def test_the_smallest_repair_is_the_gap_of_the_weakest_promised_vehicle(
    fits: int | None, needed: float
) -> None:
    answer = repaired(planted(), promise=GRIP, change=["gap"], fits=fits)
    (repair,) = rows_of(answer)
    gap = repair["parameters"]["gap"]
    assert needed <= gap <= needed + 0.1
    assert repair["largest_change"] == pytest.approx((gap - 12) / 60, abs=0.001)
    assert repair["changed"] == 1
    sets = 1 if fits == 0 else len(WEAR)
    assert repair["fits"] == answer.numbers["fits"] == sets
    assert answer.numbers["fits_tried"] == sets
    impact = math.sqrt(2 * 5 * (braking_way(5) - 12))
    assert answer.numbers["worst_today"] == pytest.approx(-impact)
    assert answer.numbers["promise"] == {"grip": [5.0, 9.0]}
    assert not answer.numbers["not_repairable"]
    # The least number of safe vehicles that excludes the share, in the first of all tests.
    samples = math.ceil(math.log(0.025) / math.log(1 - SHARE))
    assert (repair["proof_samples"], repair["proof_failures"]) == (samples, 0)
    assert repair["at_most"] == pytest.approx(1 - 0.05 ** (1 / samples))


def test_the_first_repair_brakes_least_without_need_and_then_least_early() -> None:
    """Always braking is a small change with a price; two parameters share what one cannot."""
    answer = repaired(planted(gap=8.0), promise=GRIP, fits=0)
    two, one = rows_of(answer)
    assert set(one["parameters"]) == {"always"}
    assert one["largest_change"] == pytest.approx(0.5, abs=0.001)
    assert one["needless_braking"] == 4
    assert set(two["parameters"]) == {"gap", "more"}
    further = NEEDED - 8
    together = two["parameters"]["gap"] - 8 + two["parameters"]["more"]
    assert further <= together <= further + 0.2
    assert two["largest_change"] == pytest.approx(further / 2 / 60, abs=0.002)
    assert (two["changed"], two["needless_braking"]) == (2, 0)
    # Today's value of a parameter that does not change stays exactly as it is.
    alone = repaired(planted(gap=8.0), promise=GRIP, fits=0, change=["more"])
    (repair,) = rows_of(alone)
    assert further <= repair["parameters"]["more"] <= further + 0.1


@pytest.mark.parametrize("above", [-0.1, 0.0, 0.1])
def test_a_promise_that_is_kept_today_needs_no_repair(above: float) -> None:
    """Exactly the margin is enough."""
    today = NEEDED + above
    answer = repaired(planted(gap=today), promise=GRIP, change=["gap"], fits=0)
    assert answer.numbers["kept_today"] == (above >= 0)
    assert answer.numbers["repairs"] == len(rows_of(answer)) == (above < 0)
    assert answer.numbers["worst_today"] == pytest.approx(today - braking_way(5))


def test_no_repair_is_found_where_no_value_suffices() -> None:
    study = planted(most=NEEDED - 0.1)
    answer = repaired(study, promise=GRIP, change=["gap"], fits=0)
    assert answer.numbers["repairs"] == len(rows_of(answer)) == 0
    assert (answer.numbers["kept_today"], answer.numbers["fits"]) == (False, 0)


def test_sets_in_which_no_repair_holds_are_named() -> None:
    """The gap suffices with the own set and with more grip, but not with less grip."""
    study = planted(most=NEEDED_IN_SETS - 0.5)
    answer = repaired(study, promise=GRIP, change=["gap"])
    (repair,) = rows_of(answer)
    assert NEEDED <= repair["parameters"]["gap"] <= NEEDED + 0.1
    assert (answer.numbers["fits"], answer.numbers["fits_tried"]) == (2, 3)
    assert "parameter set 1" in answer.tested
    assert AT_ONE_PHASE in answer.tested


def test_wear_that_nobody_can_keep_safe_is_named_and_left_out() -> None:
    """Full braking stops the grip from 400 / 2 / (60 - 0.25) m/s^2 on."""
    answer = repaired(planted(), promise=["grip >= 3"], change=["gap"], fits=0)
    (cause,) = answer.numbers["not_repairable"]
    least = SPEED**2 / 2 / (SEEN_FROM - MARGIN)
    assert cause == {"grip": pytest.approx(least, abs=0.02)}
    (repair,) = rows_of(answer)
    assert SEEN_FROM - 0.5 <= repair["parameters"]["gap"] <= SEEN_FROM + 0.1
    assert answer.verdict.count("grip below") == 1
