"""The sheet of a workshop: for each part what to measure, the limit, and what to do; a line to sign
only under limits that hold.
"""

from __future__ import annotations

import re
from dataclasses import replace
from hashlib import sha256
from types import SimpleNamespace
from typing import Any

import pytest

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer, tabulate
from safevar_sumo.questions.tolerance.wider import WIDER
from safevar_sumo.replay.animation import template_environment
from safevar_sumo.report.page import TEMPLATE_FOLDER
from safevar_sumo.report.sheet import sheet_of
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.vehicles import CharacteristicSet
from tests.report.test_report import words_of

STUDY = read_study("wear")
CHARACTERISTICS = CharacteristicSet.of(STUDY)
LIMITS = [
    ("treadDepth", 3.0, 8.0, "at least 3 mm"),
    ("brakeTorque", 0.85, 1.0, "at least 0.85 of the original vehicle's"),
    ("brakeResponse", 0.05, 0.132, "at most 0.132 s"),
    ("payload", 75.0, 525.0, "at most 525 kg, the greatest tested value"),
    ("payloadCentre", 1.3, 2.0, "at least 1.3 m and at most 2 m"),
    ("sensorRange", 80.0, 80.0, "at least 80 m"),
    ("sensorLatency", 0.05, 0.05, "0.05 s, as in the original vehicle"),
]
"""Joint limits and their words; nobody asked for those of the last."""
COMMAND = "python -m safevar_sumo tolerance results/wear"
COLUMNS = dict.fromkeys(("characteristic", "together_low", "together_high", "sentence"), "")
VERDICT = "The worst of 21,234 is safe. At most 0.30 % are unsafe, with 95 % confidence."


def answer_of(columns: Any = COLUMNS, rows: Any = LIMITS[:-1], **numbers: Any) -> Answer:
    holding = {
        "driven": True,
        "unsafe": "collision",
        "margin": 0.3,
        "kept": True,
        "rough": False,
        "scope": (
            "crossing (CPFA and CPNCO) at 10 to 40 km/h; lead vehicle stopped at 50 km/h; stop"
            " (full) at 80 km/h; weather wet (friction 0.71, water 1 mm), by day"
        ),
        "box": True,
        "fits": 1,
    }
    return Answer(
        question="tolerance",
        study=STUDY,
        verdict=VERDICT,
        numbers={**holding, **numbers},
        tables={"limits": tabulate("Limits", columns, rows)},
        failures=("limit of brakeTorque 0.5: the car hits a child",),
        command=COMMAND,
    )


def sheet_with(
    *answers: Answer,
    changes: tuple[str, ...] = (),
    unsafe: str = "collision",
    stated: Unsafe | None = None,
) -> str:
    """The words of the sheet; empty without a sheet."""
    case = SimpleNamespace(
        characteristics=CHARACTERISTICS, study=STUDY, stated=stated, unsafe=Unsafe.parse(unsafe)
    )
    study: Any = SimpleNamespace(case=case, answers=answers, later_changes=changes)
    parts = {"name": "wear", "title": "A car", "anchor": "a", "versions": {"libsumo": "1.28"}}
    template = template_environment(TEMPLATE_FOLDER).get_template("sheet.html.j2")
    sheet = sheet_of(study)
    if sheet is None:
        return ""
    page = template.module.sheet_section({**parts, "tables": STUDY, "sheet": sheet})  # type: ignore[attr-defined]
    return words_of(page)


def test_a_foreman_reads_for_each_part_what_to_measure_the_limit_and_what_to_do() -> None:
    answer = answer_of()
    sheet = sheet_with(answer)
    for item, (*_, limit) in zip(CHARACTERISTICS, LIMITS, strict=True):
        blank = f"________{item.suffix}"
        assert "".join((item.meaning[1:], item.measurement, limit, blank, item.remedy)) in sheet
    for words in (
        "Valid only for the vehicle that the study wear simulates, and for no other car.",
        "do what the last column says, measure this item again and enter the new value.",
        "every simulated vehicle within them keeps at least 0.3 m of clearance in the tests",
        "The driving system must stay off as long as a value is missing or beyond its limit.",
        "The workshop enters every value except those marked “operator”,",
        "Tests and speedsan adult crosses from the far side and a child crosses from the"
        " near side, hidden by parked cars; this vehicle drives at 10 to 40 km/h;"
        "lead vehicle stopped at 50 km/h;stop (full) at 80 km/h",
        "Weather and lightweather wet (friction 0.71, water 1 mm), by day",
        "Original vehicleThe original vehicle keeps at least 0.3 m of clearance in all of these",
        "Vehicle checked: licence plate VIN odometer km",
        "The signature does not cover an item without a value. Date: Name and signature:",
        "Simulated vehicleworn (A car with two axles",
        "; study wear",
        "Driving systemaeb (Holds its speed; brakes in part, then fully,",
        "Scopecrossing (CPFA and CPNCO) at 10 to 40 km/h;",
        "Tested rangestread depth 1.6 to 8 mm; relative brake torque 0.5 to 1; brake",
        "sensors 15 to 80 mVersionslibsumo 1.28",
        f"{sha256(answer.render('json').encode()).hexdigest()[:16]} (first digits of: {COMMAND}",
    ):
        assert words in sheet
    for_workshop = sheet.partition("For the manufacturer's engineer")[0]
    assert not re.search("21,?234|confidence|0.30? %", sheet), "no statistics"
    assert not re.search("worn|CPFA|1.28|sha256", for_workshop), "no words of the engineer"


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
        ({}, ("libsumo",), "sheet: files or versions have changed since the results.", True),
        ({"box": False}, (), "sheet. No limits were found that hold at the same time.", False),
        ({"kept": False}, (), "sheet. Not kept: limit of brakeTorque 0.5: the car hits", False),
        ({"driven": False}, (), "sheet. The worst of 21,234 is safe.", False),
    ],
)
def test_limits_that_do_not_hold_have_no_line_to_sign_and_say_so(
    numbers: dict[str, Any], changes: tuple[str, ...], reason: str, has_table: bool
) -> None:
    sheet = sheet_with(answer_of(**numbers), changes=changes)
    assert f"Do not use this {reason}" in sheet
    assert "signature" not in sheet
    assert ("at least 3 mm" in sheet) is has_table


def test_limits_by_a_criterion_relative_to_the_original_are_not_signed() -> None:
    """The default where nothing collides is a share of the original's safety degree."""
    screening = answer_of(unsafe="below=1.4")
    sheet = sheet_with(screening, unsafe="below=1.4")
    assert "Do not use this sheet: its limits are for screening." in sheet
    assert "with the option --unsafe collision" in sheet
    assert "signature" not in sheet
    # A user's own limit, for the whole page or this question, is a decision.
    own = sheet_with(screening, unsafe="below=1.4", stated=Unsafe(below=1.4))
    for signed in (own, sheet_with(screening)):
        assert "screening" not in signed
        assert "Name and signature" in signed


def test_a_sheet_has_the_reason_of_no_answer_and_there_is_none_if_nobody_asked() -> None:
    sheet = sheet_with(replace(answer_of(), numbers={}, tables={}))
    assert f"Do not use this sheet. {VERDICT}" in sheet
    assert sheet_with() == ""


@pytest.mark.parametrize(("kept", "found"), [(True, "no failure of these"), (False, "A child")])
def test_wider_tests_stand_on_the_sheet(kept: bool, found: str) -> None:
    answer = answer_of()
    row = ("wear_joint", "up to 60 km/h", kept, "A child is hit.", None)
    answer.tables["wider"] = tabulate("Wider", WIDER, [row])
    assert f"In the study wear_joint (up to 60 km/h), {found}" in sheet_with(answer)
