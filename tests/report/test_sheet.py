"""The sheet of a workshop: for each part what to measure, the limit, and what to do; a line to sign
only under limits that hold.
"""

from __future__ import annotations

import re
from hashlib import sha256
from html import unescape
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safevar_sumo.questions.answer import Answer, Column, tabulate
from safevar_sumo.questions.tolerance.wider import WIDER
from safevar_sumo.replay.animation import template_environment
from safevar_sumo.report.page import TEMPLATE_FOLDER
from safevar_sumo.report.sections import ReportedStudy
from safevar_sumo.report.sheet import sheet_of
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.vehicles import CharacteristicSet

STUDY = read_study("wear")
CHARACTERISTICS = CharacteristicSet.of(STUDY)
BOX = [
    ("treadDepth", 3.0, 8.0),
    ("brakeTorque", 0.85, 1.0),
    ("brakeResponse", 0.05, 0.132),
    ("payload", 75.0, 525.0),
    ("payloadCentre", 1.3, 2.0),
    ("sensorRange", 80.0, 80.0),
]
"""Joint limits; those of the sensors' latency were not asked for."""
LIMIT = {
    "treadDepth": "at least 3 mm",
    "brakeTorque": "at least 0.85",
    "brakeResponse": "at most 0.132 s",
    "payload": "any tested value: 75 to 525 kg",
    "payloadCentre": "at least 1.3 m and at most 2 m",
    "sensorRange": "80 m, as in the original vehicle",
    "sensorLatency": "0.05 s, as in the original vehicle",
}
COMMAND = "python -m safevar_sumo tolerance results/wear"
COLUMNS = dict.fromkeys(("characteristic", "together_low", "together_high"), "")
BY_SPEED = {"by_speed": Column("km/h", "value up to which they hold")}
VERDICT = "The worst of 21,234 is safe. At most 0.30 % are unsafe, with 95 % confidence."


def answer_of(columns: Any = COLUMNS, rows: Any = BOX, **numbers: Any) -> Answer:
    holding = {
        **{"driven": True, "unsafe": "collision", "margin": 0.3, "kept": True, "rough": False},
        **{"scope": "crossing (CPFA) at 10 to 40 km/h; road wet, by day", "box": True},
        **{"contacts_left_out": None, "attacked": 21234, "at_most": 0.0030},
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


def sheet_with(*answers: Answer, changes: tuple[str, ...] = ()) -> str:
    """The words of the sheet, with ` | ` in place of each tag; empty without a sheet."""
    case: Any = SimpleNamespace(study=STUDY, characteristics=CHARACTERISTICS)
    study = ReportedStudy(
        directory=Path("wear"), case=case, versions={}, answers=answers, later_changes=changes
    )
    parts = {"name": "wear", "title": "A worn car", "anchor": "a", "versions": {"libsumo": "1.28"}}
    template = template_environment(TEMPLATE_FOLDER).get_template("sheet.html.j2")
    sheet = sheet_of(study)
    if sheet is None:
        return ""
    page = template.module.sheet_section({**parts, "tables": STUDY, "sheet": sheet})  # type: ignore[attr-defined]
    return unescape(re.sub(r"\s*<[^>]*>\s*", " | ", page)).replace("|  |", "| |")


def test_a_foreman_reads_for_each_part_what_to_measure_the_limit_and_what_to_do() -> None:
    answer = answer_of()
    sheet = sheet_with(answer)
    for item in CHARACTERISTICS:
        cells = item.short_name[1:], item.measurement, LIMIT[item.name], item.remedy
        assert " | | ".join(cells) in sheet
    for line in (
        "vehicle worn, driving system aeb, study wear |",
        "| crossing (CPFA) at 10 to 40 km/h |",
        "| road wet, by day |",
        "| The original vehicle keeps at least 0.3 m in all of these tests. |",
        "| libsumo 1.28 |",
        "| Values outside the tested ranges: tread depth 1.6 to 8 mm; brake torque 0.5 to 1;",
        "Name and signature:",
        f"| {sha256(answer.render('json').encode()).hexdigest()[:16]} (first digits of: {COMMAND}",
    ):
        assert line in sheet
    assert not re.search("21,?234|confidence|0.30? %", sheet), "no statistics"


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


def test_without_an_answer_the_sheet_has_the_reason_and_nobody_who_asked_has_none() -> None:
    refused = Answer(question="tolerance", study=STUDY, verdict="No box.", numbers={}, tables={})
    assert "Do not use this sheet. No box." in sheet_with(refused)
    assert sheet_with() == ""


@pytest.mark.parametrize(
    ("keeps", "words"),
    [
        (40.0, "It keeps 0.3 m up to speed 40 km/h, the greatest that was tested."),
        (39.2, "It keeps 0.3 m only up to speed 39.2 km/h, and touches nobody up to 39.6 km/h."),
        (None, "It keeps 0.3 m at no speed that was tested."),
    ],
)
@pytest.mark.parametrize("box", [True, False])
def test_the_limit_of_the_original_vehicle_itself_stands_on_the_sheet(
    keeps: float | None, words: str, box: bool
) -> None:
    numbers = {"up_to": None, "original_keeps_up_to": keeps, "original_safe_up_to": 39.6}
    by_speed = answer_of(BY_SPEED, [(20.0,), (40.0,)], **numbers)
    assert words in sheet_with(answer_of(box=box), by_speed)


@pytest.mark.parametrize("kept", [True, False])
def test_the_sheet_says_whether_its_limits_hold_in_wider_tests(kept: bool) -> None:
    answer = answer_of()
    row = ("wear_joint", "up to 60 km/h", kept, "they do not hold: a child is hit.", None)
    answer.tables["wider"] = tabulate("Wider", WIDER, [row])
    found = "no failure of these limits was found." if kept else row[3]
    assert f"In the study wear_joint (up to 60 km/h), {found}" in sheet_with(answer)
