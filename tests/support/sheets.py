"""Sheets of shipped studies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer, tabulate
from safevar_sumo.questions.part import scope_of
from safevar_sumo.questions.permit.rows import CARS
from safevar_sumo.questions.tolerance.tell import IN_RANGES
from safevar_sumo.replay.animation import template_environment
from safevar_sumo.report.page import TEMPLATE_FOLDER
from safevar_sumo.report.sections import ReportedStudy
from safevar_sumo.report.sheet import sheet_of, speed_values
from safevar_sumo.scenarios.declared import read_study, with_ranges
from safevar_sumo.study import Study
from safevar_sumo.vehicles import CharacteristicSet

STUDY = read_study("wear")
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
COLUMNS = dict.fromkeys(
    ("characteristic", "together_low", "together_high", "sentence"), ""
)
VERDICT = (
    "The worst of 21,234 is safe. At most 0.30 % are unsafe, with 95 % confidence."
)


def answer_of(
    columns: Any = COLUMNS, rows: Any = LIMITS[:-1], **numbers: Any
) -> Answer:
    holding = {
        "driven": True,
        "unsafe": "collision",
        "margin": 0.3,
        "kept": True,
        "rough": False,
        "scope": (
            "the tests CPFA and CPNCO (scenario crossing) at 10 to 40 km/h; the scenario lead"
            " vehicle stopped at 50 km/h; the test full (scenario stop) at 80 km/h; weather wet (71"
            " % of the grip of a dry road, 1 mm of water), by day"
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


def with_table(limits: Answer, row: tuple[object, ...]) -> Answer:
    """Limits that were searched in ranges, too."""
    ranges = tabulate("Ranges", IN_RANGES, [row])
    return replace(limits, tables={**limits.tables.records, "ranges": ranges})


def speed_of(up_to: float | None = 40.0, study: Study = STUDY) -> Answer:
    """How fast vehicles within the limits may drive."""
    row = (
        "all cars",
        up_to,
        40.0,
        "km/h",
        "up to",
        "At 41 km/h it hits somebody in CPFA.",
    )
    numbers = {"fits": 12, "attacked": 120000, "scope": scope_of(study)}
    tables = {"cars": tabulate("Cars", dict.fromkeys([*CARS][: len(row)], ""), [row])}
    return Answer(
        question="permit", study=study, verdict="Slow.", numbers=numbers, tables=tables
    )


def reported(
    *answers: Answer,
    changes: tuple[str, ...] = (),
    unsafe: str = "collision",
    stated: Unsafe | None = None,
    speed: Answer | None = None,
) -> ReportedStudy:
    """Answers about the study of the first one, by default `wear`."""
    study = answers[0].study if answers else STUDY
    case: Any = SimpleNamespace(
        characteristics=CharacteristicSet.of(study),
        study=study,
        stated=stated,
        unsafe=Unsafe.parse(unsafe),
    )
    return ReportedStudy(
        directory=Path(study.name),
        case=case,
        versions={
            "libsumo": "1.28",
            "safevar_sumo": "0.5.0",
            "deap": "1.4.4",
            "numpy": "2.4.6",
        },
        answers=answers,
        later_changes=changes,
        speed=speed,
    )


def html_of(study: ReportedStudy) -> str:
    """The sheet; empty if there is none."""
    simulated = study.case.study
    parts = {
        "name": simulated.name,
        "title": simulated.title,
        "anchor": "a",
        "versions": study.versions,
    }
    template = template_environment(TEMPLATE_FOLDER).get_template("sheet.html.j2")
    sheet = sheet_of(study)
    if sheet is None:
        return ""
    section: Any = template.module
    return str(section.sheet_section({**parts, "study": simulated, "sheet": sheet}))


def sheet_of_shipped(name: str) -> str:
    """The sheet of a shipped study in which each characteristic has all limits that it can have;
    empty if a workshop can measure none.
    """
    study = read_study(name)
    items = CharacteristicSet.of(study).vehicle
    ends = [
        item.rounded_inwards(
            ((item.lower + item.original) / 2, (item.original + item.upper) / 2)
        )
        for item in items
    ]
    rows = [(item.name, *end, "") for item, end in zip(items, ends, strict=True)]
    limits = answer_of(
        rows=rows, scope=scope_of(study), unsafe=study.unsafe.criterion or "collision"
    )
    if study.states_ranges and not study.ranges:
        row: Any = (
            scope_of(with_ranges(study)),
            False,
            "A child is hit. " * 20,
            {},
            None,
        )
        limits = with_table(limits, row)
    own = replace(limits, study=study)
    has_speed = speed_values(reported(own))
    return html_of(reported(own, speed=speed_of(study=study) if has_speed else None))
