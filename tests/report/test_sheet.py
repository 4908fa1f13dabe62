"""The sheet of a workshop: for each part what to measure, the limit, and what to do; a line to sign
only under limits that hold.
"""

from __future__ import annotations

import re
from dataclasses import replace
from hashlib import sha256
from typing import Any

import pytest
from msgspec.structs import replace as replace_in

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer
from safevar_sumo.report.sheet import speed_values
from safevar_sumo.scenarios.declared import read_study, with_ranges
from safevar_sumo.vehicles import CharacteristicSet
from tests.support.report_pages import words_of
from tests.support.sheets import (
    COMMAND,
    LIMITS,
    STUDY,
    VERDICT,
    answer_of,
    html_of,
    reported,
    speed_of,
    with_table,
)

CHARACTERISTICS = CharacteristicSet.of(STUDY)


def sheet_with(*answers: Answer, **options: Any) -> str:
    """The words of the sheet; empty without a sheet."""
    return words_of(html_of(reported(*answers, **options)))


def test_a_foreman_reads_for_each_part_what_to_measure_the_limit_and_what_to_do() -> (
    None
):
    answer = answer_of()
    sheet = sheet_with(answer)
    for item, (*_, limit) in zip(CHARACTERISTICS, LIMITS, strict=True):
        blank = f"________{item.suffix}"
        part = "".join((item.meaning[1:], item.measurement, limit, blank, item.remedy))
        assert (part in sheet) is item.workshop
    for words in (
        "Valid only for the vehicle that the study wear simulates, and for no other car.",
        "do what the last column says, measure this item again and enter the new value.",
        "every simulated vehicle within them keeps at least 0.3 m of clearance in the tests",
        "which a workshop cannot measure, have these values: brake actuator delay at most 0.132 s;"
        " detection range of the sensors at least 80 m; perception latency 0.05 s, as in the",
        "The driving system must stay off as long as a value is missing or beyond its limit.",
        "The workshop enters every value except those marked “operator”,",
        "Tests and speedsan adult crosses from the far side and a child crosses from the"
        " near side, hidden by parked cars; this vehicle drives at 10 to 40 km/h;"
        "the scenario lead vehicle stopped at 50 km/h;the test full (scenario stop) at 80 km/h",
        "Weather and lightweather wet (71 % of the grip of a dry road, 1 mm of water), by day",
        "Original vehicleThe original vehicle keeps at least 0.3 m of clearance in all of these",
        "Vehicle checked: licence plate VIN odometer km",
        "The signature does not cover an item without a value. Date: Name and signature:",
        "Simulated vehicleworn (A car with two axles",
        "; study wear",
        "Driving systemaeb (Holds its speed; brakes in part, then fully,",
        "Scope of the limitsthe tests CPFA and CPNCO (scenario crossing) at 10 to 40 km/h;",
        "Tested rangestread depth 1.6 to 8 mm; relative brake torque 0.5 to 1; brake",
        "sensors 15 to 80 mVersionslibsumo 1.28",
        f"{sha256(answer.render('json').encode()).hexdigest()[:16]} (first digits of: {COMMAND}",
    ):
        assert words in sheet
    for_workshop = sheet.partition("For the manufacturer's engineer")[0]
    assert not re.search("21,?234|confidence|0.30? %", sheet), "no statistics"
    assert not re.search(r"worn \(|CPFA|1.28|sha256", for_workshop), (
        "no words of the engineer"
    )


def test_a_limit_has_one_side_if_the_original_is_at_an_end_of_the_domain() -> None:
    sheet = sheet_with(
        answer_of(rows=[("treadDepth", 1.6, 8.0, ""), ("payloadCentre", 1.2, 3.2, "")])
    )
    assert "at least 1.6 mm, the smallest tested value" in sheet
    assert "1.2 to 3.2 m, as tested" in sheet


def test_a_clearance_is_claimed_only_with_one_parameter_set() -> None:
    assert "within them avoids a collision in the" in sheet_with(answer_of(fits=12))


@pytest.mark.parametrize(
    ("numbers", "changes", "reason", "has_table"),
    [
        ({"rough": True}, (), "sheet: its limits are rough.", True),
        (
            {},
            ("libsumo",),
            "sheet: files or versions have changed since the results.",
            True,
        ),
        (
            {"box": False},
            (),
            "sheet. No limits were found that hold at the same time.",
            False,
        ),
        ({"kept": False}, (), "sheet. The specified limits do not hold.", False),
        (
            {"driven": False},
            (),
            "sheet. The simulated vehicle does not drive with its",
            False,
        ),
    ],
)
def test_limits_that_do_not_hold_have_no_line_to_sign_and_say_so(
    numbers: dict[str, Any], changes: tuple[str, ...], reason: str, has_table: bool
) -> None:
    sheet = sheet_with(answer_of(**numbers), changes=changes)
    assert f"Do not use this {reason}" in sheet
    assert "signature" not in sheet
    assert ("at least 3 mm" in sheet) is has_table
    assert (
        f"Reason{VERDICT} limit of brakeTorque 0.5: the car hits" in sheet
    ) is not has_table


def test_limits_by_a_criterion_relative_to_the_original_are_not_signed() -> None:
    """The default where nothing collides is a share of the original's safety degree."""
    half = "safety_degree < 1.4"
    screening = answer_of(unsafe=half)
    sheet = sheet_with(screening, unsafe=half)
    assert "Do not use this sheet: its limits are for screening." in sheet
    assert "with the option --unsafe collision" in sheet
    assert "signature" not in sheet
    # A user's own limit, for the whole page or this question, is a decision.
    own = sheet_with(screening, unsafe=half, stated=Unsafe.parse(half))
    for signed in (own, sheet_with(screening)):
        assert "screening" not in signed
        assert "Name and signature" in signed


def test_a_sheet_has_the_reason_of_no_answer_and_there_is_none_if_nobody_asked() -> (
    None
):
    sheet = sheet_with(replace(answer_of(), numbers={}, tables={}))
    assert "Do not use this sheet. The question about limits has no answer." in sheet
    assert f"Reason{VERDICT}" in sheet
    assert sheet_with() == ""


@pytest.mark.parametrize(
    ("kept", "found"),
    [(True, "No failure of these limits was found"), (False, "limits fails.")],
)
def test_wider_tests_stand_on_the_sheet_and_their_codes_are_the_engineers(
    kept: bool, found: str
) -> None:
    row = ("CPNCO up to 60 km/h", kept, "A child is hit.", None, None)
    answer = with_table(answer_of(), row)
    foreman, _, engineer = sheet_with(answer).partition(
        "For the manufacturer's engineer"
    )
    assert found in foreman
    assert "Ranges of the studyCPNCO up to 60 km/h" in engineer


def test_one_greatest_speed_of_all_vehicles_within_the_limits_in_tests_without_codes() -> (
    None
):
    """Those of the sheet's own limits: an answer about other cars is not theirs."""
    assert "Greatest speed" not in sheet_with(answer_of(), speed_of(30.0))
    sheet = sheet_with(answer_of(), speed_of(30.0), speed=speed_of())
    foreman, _, engineer = sheet.partition("For the manufacturer's engineer")
    assert (
        "Greatest speed: 40 km/h (simulated from 10 km/h on). Up to this speed every"
        in foreman
    )
    assert not re.search("CP[FNL]|parameter set", foreman)
    assert "in CPFA. 12 parameter sets; 120,000 simulations that search" in engineer


def test_a_failure_in_the_ranges_lowers_the_greatest_speed() -> None:
    row = ("up to 60 km/h", False, "A child is hit.", {"speed": 36.2}, None)
    answer = with_table(answer_of(), row)
    sheet = sheet_with(answer, speed=speed_of())
    assert "Greatest speed: 36 km/h (simulated" in sheet
    assert "a vehicle within these limits fails above the greatest speed." in sheet


def test_limits_that_are_safe_at_no_speed_have_no_line_to_sign() -> None:
    sheet = sheet_with(answer_of(), speed=speed_of(None))
    assert (
        "Do not use this sheet. Vehicles within its limits are not safe even at 10 km/h."
        in sheet
    )
    assert "ReasonSlow." in sheet
    assert "signature" not in sheet


def test_a_sheet_whose_speed_has_no_answer_says_so_and_calls_no_speed_unsafe() -> None:
    refused = replace(
        speed_of(), verdict="No answer: it is refused.", numbers={}, tables={}
    )
    sheet = sheet_with(answer_of(), speed=refused)
    assert "The question about the greatest speed has no answer." in sheet
    assert "not safe even at" not in sheet
    assert "No answer: it is refused." in sheet
    assert "signature" not in sheet


def test_the_question_has_the_limits_of_the_sheet_and_stated_values_of_all_others() -> (
    None
):
    values = speed_values(
        reported(replace(answer_of(), study=replace_in(STUDY, unmeasured={})))
    )
    assert (values["margin"], values["others"]) == (0.3, "new")
    assert values["limits"] == (
        *(
            "treadDepth >= 3.0",
            "treadDepth <= 8.0",
            "brakeTorque >= 0.85",
            "brakeTorque <= 1.0",
        ),
        *(
            "brakeResponse >= 0.05",
            "brakeResponse <= 0.132",
            "payload >= 75.0",
            "payload <= 525.0",
        ),
        *("payloadCentre >= 1.3", "payloadCentre <= 2.0"),
        *("sensorRange >= 80.0", "sensorRange <= 80.0"),
        *("sensorLatency >= 0.05", "sensorLatency <= 0.05"),
    )
    # What the study states of a value that nobody measured stands in place of a limit.
    joint = replace(answer_of(unsafe="drac > 6", rough=True), study=with_ranges(STUDY))
    values = speed_values(reported(joint))
    assert not [
        limit for limit in values["limits"] if limit.startswith(("sensor", "brakeResp"))
    ]
    assert (values["unsafe"], values["quick"]) == (Unsafe.parse("drac > 6"), True)
    sheet = sheet_with(joint, speed=speed_of(study=joint.study))
    assert (
        "these values: brake actuator delay 0.2 s; detection range of the sensors 40 m;"
        in sheet
    )
    # Nobody asks where there is no speed, or nothing to work by.
    assert not speed_values(reported(replace(answer_of(), study=read_study("r13h"))))
    assert not speed_values(reported(answer_of(box=False)))


@pytest.mark.parametrize(
    ("name", "leads"), [("wear", True), ("native", True), ("sun", False)]
)
def test_a_workshop_can_measure_most_of_a_worn_car_and_not_an_engines_drag(
    name: str, leads: bool
) -> None:
    assert (
        reported(replace(answer_of(), study=read_study(name))).has_workshop_parts
        is leads
    )


def test_limits_that_a_workshop_cannot_decide_have_no_sheet_to_sign() -> None:
    vague = [
        (name, 0.97, *rest[1:]) if name == "brakeTorque" else (name, *rest)
        for name, *rest in LIMITS
    ]
    sheet = sheet_with(answer_of(rows=vague[:-1]))
    assert "Do not use this sheet. A workshop cannot check the limit" in sheet
    assert "signature" not in sheet
