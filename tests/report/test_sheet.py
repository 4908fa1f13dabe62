"""The sheet of a workshop: for each part what to measure, the limit, and what to do; a line to sign
only under limits that hold.
"""

from __future__ import annotations

from collections.abc import Mapping
from hashlib import sha256
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest

from safevar_sumo.questions.answer import Answer, Column, tabulate
from safevar_sumo.questions.tolerance.rows import LIMITS
from safevar_sumo.questions.tolerance.wider import WIDER
from safevar_sumo.records import JsonObject
from safevar_sumo.report.sections import ReportedStudy
from safevar_sumo.report.sheet import sheet_of
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.vehicles import CharacteristicSet

STUDY = read_study("wear")
CHARACTERISTICS = CharacteristicSet.of(STUDY)
BOX = {
    "treadDepth": (3.0, 8.0),
    "brakeTorque": (0.85, 1.0),
    "brakeResponse": (0.05, 0.132),
    "payload": (75.0, 525.0),
    "payloadCentre": (1.3, 2.0),
    "sensorRange": (80.0, 80.0),
}
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
NUMBERS: Mapping[str, Any] = {
    **{"driven": True, "unsafe": "collision", "margin": 0.3, "kept": True, "rough": False},
    **{"scope": "crossing (CPFA) at 10 to 40 km/h; along at 10 to 60 km/h; road wet, by day"},
    **{"contacts_left_out": None, "box": True, "samples": 1228, "at_most": 0.0030},
    **{"attacked": 21234, "least_attacked": 0.3456},
}
VERDICT = "21,234 aimed at them; at most 0.30 % are, with 95 % confidence."


def limits_table(columns: Mapping[str, Any], rows: list[dict[str, Any]]) -> pd.DataFrame:
    names = [*columns]
    return tabulate("Limits", columns, [[row.get(name) for name in names] for row in rows])


def answer_of(**numbers: Any) -> Answer:
    rows = [
        {"characteristic": name, "together_low": low, "together_high": high}
        for name, (low, high) in BOX.items()
    ]
    return Answer(
        question="tolerance",
        study=STUDY,
        verdict=VERDICT,
        numbers={**NUMBERS, **numbers},
        tables={"limits": limits_table(LIMITS, rows)},
        failures=("limit of brakeTorque 0.5: the car hits a child",)
        * (numbers.get("kept") is False),
        command="python -m safevar_sumo tolerance results/wear",
    )


def by_speed(keeps: float | None, safe: float | None) -> Answer:
    columns = {**LIMITS, "by_speed": Column("km/h", "value up to which they hold")}
    numbers = {"up_to": None, "original_keeps_up_to": keeps, "original_safe_up_to": safe}
    return Answer(
        question="tolerance",
        study=STUDY,
        verdict="",
        numbers={"margin": 0.3, **numbers},
        tables={"limits": limits_table(columns, [{"by_speed": 20.0}, {"by_speed": 40.0}])},
    )


def sheet_with(*answers: Answer, later_changes: tuple[str, ...] = ()) -> JsonObject | None:
    case: Any = SimpleNamespace(study=STUDY, characteristics=CHARACTERISTICS)
    return sheet_of(
        ReportedStudy(
            directory=Path("results/wear"),
            case=case,
            versions={"safevar_sumo": "0.4.0", "libsumo": "1.28.0"},
            answers=answers,
            later_changes=later_changes,
        )
    )


def test_a_foreman_reads_for_each_part_what_to_measure_the_limit_and_what_to_do() -> None:
    answer = answer_of()
    sheet = sheet_with(answer)
    assert sheet is not None
    rows = pd.read_html(StringIO(str(sheet["parts"])))[0].to_numpy().tolist()
    assert rows == [
        [
            f"{item.short_name[:1].upper()}{item.short_name[1:]}",
            item.measurement,
            LIMIT[item.name],
            item.remedy,
        ]
        for item in CHARACTERISTICS
    ]
    facts = dict(sheet["facts"])
    assert facts["Tests and speeds"] == "crossing (CPFA) at 10 to 40 km/h; along at 10 to 60 km/h"
    assert facts["Road and light"] == "road wet, by day"
    assert facts["Original vehicle"] == "It keeps at least 0.3 m in all of these tests."
    assert facts["Versions"] == "safevar_sumo 0.4.0, libsumo 1.28.0"
    digest = sha256(answer.render("json").encode()).hexdigest()
    assert digest.startswith(facts["Digest"].split()[0])
    assert any("tread depth 1.6 to 8 mm" in sentence for sentence in sheet["not_tested"])
    assert sheet["is_signed"]
    for statistic in ("21,234", "21234", "1228", "0.3456", "confidence", "0.30 %"):
        assert statistic not in str(sheet)


@pytest.mark.parametrize(
    ("numbers", "reason", "has_table"),
    [
        ({"rough": True}, "its limits are rough", True),
        ({"box": False}, "No limits were found that hold at the same time", False),
        ({"kept": False}, "Limit of brakeTorque 0.5: the car hits a child", False),
        ({"driven": False}, "Do not use this sheet. 21,234 aimed", False),
    ],
)
def test_limits_that_do_not_hold_have_no_line_to_sign_and_say_so(
    numbers: dict[str, Any], reason: str, has_table: bool
) -> None:
    sheet = sheet_with(answer_of(**numbers))
    assert sheet is not None
    assert not sheet["is_signed"]
    (sentence,) = sheet["sentences"]
    assert sentence.startswith("Do not use this sheet")
    assert reason in sentence
    assert bool(sheet["parts"]) is has_table


def test_limits_of_other_files_are_not_signed_and_without_an_answer_the_reason_stands() -> None:
    sheet = sheet_with(answer_of(), later_changes=("libsumo",))
    assert sheet is not None
    assert not sheet["is_signed"]
    refused = Answer(question="tolerance", study=STUDY, verdict="No box.", numbers={}, tables={})
    sheet = sheet_with(refused)
    assert sheet is not None
    assert sheet["sentences"] == ["Do not use this sheet. No box."]
    assert not sheet["is_signed"]
    assert sheet_with() is None, "nobody asked for limits"


@pytest.mark.parametrize(
    ("keeps", "safe", "words"),
    [
        (40.0, 40.0, "It keeps 0.3 m up to speed 40 km/h, the highest tested."),
        (
            39.2,
            39.6,
            "It keeps 0.3 m only up to speed 39.2 km/h, and touches nobody up to 39.6 km/h.",
        ),
        (None, 15.0, "It keeps 0.3 m at no speed that was tested."),
    ],
)
def test_the_limit_of_the_original_vehicle_itself_stands_on_the_sheet(
    keeps: float | None, safe: float | None, words: str
) -> None:
    sheet = sheet_with(answer_of(), by_speed(keeps, safe))
    assert sheet is not None
    assert dict(sheet["facts"])["Original vehicle"].endswith(words)


@pytest.mark.parametrize(
    ("kept", "words"),
    [(False, "they do not hold: a child is hit."), (True, "no failure of these limits was found.")],
)
def test_the_sheet_says_whether_its_limits_hold_in_wider_tests(kept: bool, words: str) -> None:
    answer = answer_of()
    row = ("wear_joint", "up to 60 km/h", kept, "they do not hold: a child is hit.", None)
    answer.tables["wider"] = tabulate("Wider", WIDER, [row])
    sheet = sheet_with(answer)
    assert sheet is not None
    said = dict(sheet["facts"])["Wider tests"]
    assert said == f"In the study wear_joint (up to 60 km/h), {words}"
