"""The sheet of a page, which can be printed alone: limits for a workshop and an operator, without
statistics. Its sentences stand in `web/sheet.html.j2`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from hashlib import sha256
from typing import Any

import pandas as pd
from markupsafe import Markup

from safevar_sumo.ads import ADS
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer, Columns, tabulate
from safevar_sumo.questions.ask import QUICK, find_question
from safevar_sumo.questions.case import Results
from safevar_sumo.questions.permit.encounters import Span, span_of
from safevar_sumo.questions.tables import html_table
from safevar_sumo.questions.words import join_phrases, undecidable_in_words
from safevar_sumo.records import JsonObject
from safevar_sumo.report.budget import SPEED
from safevar_sumo.report.sections import ReportedStudy, name_and_sentence
from safevar_sumo.scenarios import SPEED_DIMENSION
from safevar_sumo.scenarios.euro_ncap import TESTS
from safevar_sumo.study import Interval
from safevar_sumo.vehicles import VEHICLES, Characteristic

SHEET_PARTS: Columns = {
    "item": "characteristic of the vehicle",
    "how to measure": "how a workshop measures it",
    "limit": "values that are allowed, all limits at the same time",
    "measured": "to be filled in: the value of the vehicle that is checked",
    "beyond the limit": "what to do with a vehicle beyond the limit",
}
UNSAID = "the study does not say"
BLANK = "_" * 8
"""The place for a value that somebody fills in by hand."""
DIGEST_DIGITS = 16
"""Number of hexadecimal digits to which the printed digest is cut."""


def sheet_of(study: ReportedStudy) -> JsonObject | None:
    """The values of the sheet for the template; None if the page does not answer `tolerance`.

    A sheet without joint limits that hold has no table. A sheet has no line to sign if its limits
    are rough, are only for screening (the criterion compares with the original vehicle), or if
    files or versions have changed since.
    """
    limits = _limits_of(study)
    if limits is None:
        return None

    numbers = limits.numbers
    unsafe = Unsafe.parse(numbers.get("unsafe", "collision"))
    is_screening = _is_relative(study.case, unsafe)
    problem = _why_no_limits(study, limits)
    ranges = []
    if not problem and "ranges" in limits.tables:
        ranges = _records(limits.tables["ranges"])
    claim = limits
    up_to = ""
    reasons = [limits.verdict, *limits.failures]
    if study.speed is not None:
        claim = study.speed
        up_to, problem = _greatest_speed(study, claim, ranges)
        reasons = [claim.verdict]

    *tests, road = claim.numbers.get("scope", "").split("; ")
    rows = {}
    if not problem:
        rows = _rows_of(limits)
    items = study.case.characteristics.vehicle
    parts = [
        _row_of_part(item, rows.get(item.name))
        for item in items
        if item.is_for_workshop and not problem
    ]
    # The greatest speed is computed with stated values of characteristics that no workshop
    # measures: the sheet prints these values instead of limits.
    stated = {}
    if up_to:
        stated = study.case.study.unmeasured_values
    unmeasured = [
        f"{item.short_name} {_limit_in_words(item, rows.get(item.name), stated.get(item.name))}"
        for item in items
        if not item.is_for_workshop
    ]
    domains = [
        f"{item.short_name} {_domain_in_words(item)}"
        for item in items
        if item.name in rows
    ]
    return {
        "missing": problem,
        "up_to": up_to,
        "is_screening": is_screening,
        "is_signed": not (
            problem or numbers["rough"] or study.later_changes or is_screening
        ),
        "unsafe": unsafe,
        "parts": Markup(
            html_table(tabulate("Items and their limits", SHEET_PARTS, parts))
        ),
        "others": unmeasured,
        "numbers": numbers,
        "claim": claim,
        "reasons": reasons,
        "vehicle": name_and_sentence(VEHICLES, limits.study.vehicle.model),
        "ads": name_and_sentence(ADS, limits.study.ads.model),
        "tests": [_tests_in_words(test) for test in tests],
        "road": road,
        "in_ranges": ranges,
        "command": limits.command,
        "digest": sha256(limits.render("json").encode()).hexdigest()[:DIGEST_DIGITS],
        "ranges": domains,
    }


def _row_of_part(item: Characteristic, row: JsonObject | None) -> dict[str, str]:
    """The row of `SHEET_PARTS` about one item. `row` is its row in the table of limits, if it has
    one.
    """
    name = item.meaning or item.short_name
    return {
        "item": name[:1].upper() + name[1:],
        "how to measure": item.measurement,
        "limit": _limit_in_words(item, row),
        "measured": f"{BLANK}{item.suffix}",
        "beyond the limit": item.remedy or UNSAID,
    }


def speed_values(study: ReportedStudy) -> JsonObject:
    """The options of the question `permit` about the greatest speed of vehicles within the limits
    of the sheet. Empty if nobody may work by the sheet, or if the study varies no speed.
    """
    limits = _limits_of(study)
    if (
        limits is None
        or study.point
        or _why_no_limits(study, limits)
        or not speeds_of(study.case)
    ):
        return {}
    unsafe = Unsafe.parse(limits.numbers["unsafe"])
    margin = limits.numbers["margin"]
    if _is_relative(study.case, unsafe):
        return {}

    # A characteristic that no workshop measures has the value that the study states for it.
    texts = []
    rows = _rows_of(limits)
    for item in study.case.characteristics.vehicle:
        if item.is_for_workshop or item.name not in study.case.study.unmeasured:
            low, high = _together(item, rows.get(item.name))
            texts += [f"{item.name} >= {low!r}", f"{item.name} <= {high!r}"]
    is_contact = unsafe.is_collision and margin
    criterion = {"margin": margin} if is_contact else {"unsafe": unsafe}
    rough = {}
    if limits.numbers["rough"]:
        rough = {QUICK: True}
    return {"others": "new", "limits": tuple(texts), **criterion, **rough}


def with_answers(
    study: ReportedStudy, questions: Sequence[str], ask: Callable[..., Answer]
) -> ReportedStudy:
    """The study with the answers to `questions`. If it has a sheet with limits, the last answer is
    about the greatest speed of vehicles within these limits, because the sheet states this speed
    even if nobody asked for it.
    """
    study = replace(study, answers=[ask(question) for question in questions])
    values = speed_values(study)
    if not values:
        return study
    speed = ask(SPEED, (find_question("permit"), values))
    return replace(study, answers=[*study.answers, speed], speed=speed)


def _limits_of(study: ReportedStudy) -> Answer | None:
    for answer in study.answers:
        if answer.question == "tolerance":
            return answer
    return None


def _rows_of(limits: Answer) -> dict[str, JsonObject]:
    return {row["characteristic"]: row for row in _records(limits.table())}


def _records(frame: pd.DataFrame) -> list[dict[Any, Any]]:
    return frame.to_dict("records")


def speeds_of(case: Results) -> Span | None:
    """The range of speeds of a study; None if the study varies no speed."""
    try:
        return span_of(case.study, None)
    except InputError:
        return None


def _greatest_speed(
    study: ReportedStudy, speed: Answer, ranges: Sequence[JsonObject]
) -> tuple[str, str]:
    """The greatest speed of vehicles within the limits, in words, and "". If there is no such
    speed, "" and a sentence that says why.

    The greatest speed is below the least speed at which such a vehicle fails in the `ranges` of the
    study.
    """
    if not speed.tables:
        return "", "The question about the greatest speed has no answer."
    span = speeds_of(study.case)
    assert span is not None
    speeds = speed.tables["cars"]["up_to"].astype(float).tolist()
    for row in ranges:
        place = row["fails_at"] or {}
        if not row["kept"] and SPEED_DIMENSION in place:
            speeds.append(math.ceil(place[SPEED_DIMENSION]) - 1)
    greatest = min(speeds)
    if greatest >= span.low:
        return (
            f"{greatest:g} {span.unit} (simulated from {span.low:g} {span.unit} on)",
            "",
        )
    return (
        "",
        f"Vehicles within its limits are not safe even at {span.low:g} {span.unit}.",
    )


def _is_relative(case: Results, unsafe: Unsafe) -> bool:
    """Whether a criterion compares vehicles with the original vehicle: the default criterion does
    so if no vehicle collides.
    """
    is_default = case.stated is None and not case.study.unsafe.criterion
    return is_default and not unsafe.is_collision and unsafe == case.unsafe


def _why_no_limits(study: ReportedStudy, limits: Answer) -> str:
    """The reason why nobody may work by this sheet, as a sentence; "" if somebody may."""
    reason = _why_no_joint_limits(limits)
    if reason:
        return reason
    items = study.case.characteristics.vehicle
    rows = _rows_of(limits)
    measured = [item for item in items if item.is_for_workshop]
    vague = [
        item
        for item in measured
        if not item.is_decidable(*_together(item, rows.get(item.name)))
    ]
    if vague:
        return undecidable_in_words(vague)
    if measured:
        return ""
    return "The study names no item that a workshop can measure."


def _why_no_joint_limits(limits: Answer) -> str:
    """The reason why the answer about limits has no joint limits; "" if it has."""
    numbers = limits.numbers
    if "limits" not in limits.tables:
        return "The question about limits has no answer."
    if not numbers["driven"]:
        return "The simulated vehicle does not drive with its driving system."
    if numbers["kept"] is False:
        return "The specified limits do not hold."
    if not numbers["box"]:
        return "No limits were found that hold at the same time."
    return ""


def _together(item: Characteristic, row: JsonObject | None) -> Interval:
    """The joint limits of an item. Both are its original value if nobody asked for its limits, or
    if the joint limits leave no room for a change.
    """
    if row is None or pd.isna(row["together_low"]):
        return item.original, item.original
    return float(row["together_low"]), float(row["together_high"])


def _limit_in_words(
    item: Characteristic, row: JsonObject | None, value: float | None = None
) -> str:
    """The limit of an item in words, such as `at least 3 mm`, or the `value` that the study states.

    An end of the domain is no limit. If both limits are ends of the domain, the words state the
    domain; but if the original value is one of its ends, only the other end.
    """
    if value is not None:
        return f"{value:.10g}{item.suffix}"
    domain = (item.lower, item.upper)
    low, high = _together(item, row)
    if row is None or (low == high and low not in domain):
        return f"{item.original:.10g}{item.suffix}, as in the original vehicle"

    # A number without a unit that is 1 in the original vehicle is a share of the original value.
    is_share = not item.suffix and item.original == 1
    unit = " of the original vehicle's"
    if not is_share:
        unit = item.suffix
    sides = zip(("at least", "at most"), (low, high), domain, strict=True)
    ends = [f"{word} {end:.10g}{unit}" for word, end, bound in sides if end != bound]
    if not ends and item.original == item.upper:
        return f"at least {item.lower:.10g}{unit}, the smallest tested value"
    if not ends and item.original == item.lower:
        return f"at most {item.upper:.10g}{unit}, the greatest tested value"
    return " and ".join(ends) or f"{_domain_in_words(item)}, as tested"


def _domain_in_words(item: Characteristic) -> str:
    return f"{item.lower:.10g} to {item.upper:.10g}{item.suffix}"


def _tests_in_words(phrase: str) -> str:
    """Words for what happens in tests by Euro NCAP, from a phrase of a scope: `an adult crosses
    from the far side; this vehicle drives at 10 to 40 km/h`. Other phrases stay as they are.
    """
    # A phrase has the names of tests, then their scenario in brackets, then their speeds.
    tests, _, scenario = phrase.partition(" (scenario ")
    speeds = scenario.partition(")")[2]
    names = re.split(", | and ", re.sub("^the tests? ", "", tests))
    if not TESTS.keys() >= set(names):
        return phrase
    words = join_phrases(TESTS[name].words for name in names)
    return words + speeds.replace(" at ", "; this vehicle drives at ")
