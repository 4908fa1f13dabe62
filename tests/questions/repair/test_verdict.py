"""Answers of `repair` from facts that are written by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from safevar_sumo.api.simulation import load_study
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.box import Proof
from safevar_sumo.questions.repair.found import Found, Price, Repair
from safevar_sumo.questions.repair.problem import Promise, parameters_of
from safevar_sumo.questions.repair.tell import tell
from safevar_sumo.vehicles import region_of

STUDY = load_study("wear")
PROOF = Proof(samples=2995, failures=0, at_most=0.001, not_simulated=0)
CHEAP = Repair(
    {"braking_share": 0.6, "response_time": 0.45},
    size=0.2,
    proof=PROOF,
    price=Price(7.0, 40, 1, 0, metres_earlier=1.5, seconds_earlier=0.25, most_at="a"),
)
SMALL = Repair({"response_time": 0.4}, 0.1, PROOF._replace(samples=8), Price(6.0, 0))
FOUND = Found(
    study=STUDY,
    unsafe=Unsafe(keep=0.3),
    promise=Promise.of(STUDY, region_of(STUDY), ["treadDepth >= 2"]),
    parameters=parameters_of(STUDY, ["braking_share", "response_time"]),
    repairs=[CHEAP, SMALL],
    proof_today=None,
    worst_today=-1.25,
    not_repairable=[],
    sets=1,
    sets_holding=1,
    broken_sets=[],
    simulations=12,
    is_rough=False,
    phases="",
)
NOTHING: dict[str, Any] = {"repairs": [], "sets_holding": 0}
KEPT: dict[str, Any] = {"repairs": [], "proof_today": PROOF, "worst_today": 0.876}
DAY = {"sensorRange": 21.44}
WORN = {"treadDepth": 2.5, "payload": 300.0}
TOLD: list[tuple[dict[str, Any], list[str]]] = [
    (
        {},
        [
            "The cheapest repair that was found changes 2 parameters of the driving system: share"
            " of a new car's braking with which it plans (braking_share) from 0.75 to 0.6 and"
            " response time that it plans with (response_time) from 0.3 to 0.45 s.",
            "With this repair, all tested vehicles that wear no further than promised keep 0.3 m of"
            " clearance.",
            "With the repair, the original vehicle brakes up to 1.50 m earlier.",
            "the original vehicle brakes needlessly in 1 of 40 benign scenes (nobody needs to brake"
            " in them), and without the repair in 0.",
            "Required wear: treadDepth >= 2 mm; all others as in the original: brakeTorque 1,",
            "None of 2,995 worn vehicles that were sampled afterwards is unsafe",
            "Only the study's own parameter set (calibration) of the vehicle model was driven",
        ],
    ),
    (
        {"repairs": [SMALL, CHEAP]},
        [
            "The smallest repair that was found changes 1 parameter of the driving system:",
            "The original vehicle brakes in none of the test cases, so its braking cannot come",
            "Needless braking was not measured, because the study has no benign scenes.",
            "None of 8 worn vehicles",
        ],
    ),
    (
        NOTHING,
        [
            "No repair was found among the changes of one or two parameters. The parameters that"
            " may change are braking_share and response_time.",
        ],
    ),
    (
        KEPT,
        [
            "No repair is necessary. With the present driving system, all tested vehicles within"
            " the required wear keep 0.3 m of clearance.",
            "The worst vehicle has a safety degree of 0.88 m.",
            "None of 2,995 worn vehicles",
        ],
    ),
    (
        {**KEPT, "unsafe": Unsafe.parse("drac > 6"), "not_repairable": [DAY]},
        [
            "within the required wear that any driving system can keep safe stay safe.",
            "The worst vehicle has drac 0.876.",
            "Unsafe means: drac > 6, or a collision.",
        ],
    ),
    (
        {**NOTHING, "not_repairable": [WORN, DAY]},
        [
            "Remark: with sensorRange below 21.4 m or treadDepth below 2.50 mm with payload above"
            " 300 kg, the vehicle is unsafe even with full braking at the first possible moment.",
        ],
    ),
    (
        {"not_repairable": [DAY] * 5},
        ["The option --json prints 2 more such limits (not_repairable)."],
    ),
    (
        {"sets": 12, "sets_holding": 10, "broken_sets": [3, 7], "phases": "At once."},
        [
            "The answer holds in 10 of 12 parameter sets of the vehicle model",
            "In parameter sets 3 and 7, a vehicle within the required wear collides.",
            "At once.",
        ],
    ),
]


@pytest.mark.parametrize(("facts", "sentences"), TOLD)
def test_the_sentences_say_what_was_found(
    facts: dict[str, Any], sentences: list[str]
) -> None:
    answer = tell(replace(FOUND, **facts))
    text = f"{answer.verdict} {answer.tested}"
    for sentence in sentences:
        assert sentence in text


def test_nothing_is_said_of_tests_that_were_not_made() -> None:
    assert not tell(replace(FOUND, **NOTHING)).tested
    assert "parameter set" not in tell(replace(FOUND, is_rough=True)).tested
