"""The first sheet of a page: limits for a workshop and an operator, without statistics, which can
be printed alone. Its sentences stand in `web/sheet.html.j2`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from hashlib import sha256
from typing import Any

from markupsafe import Markup

from safevar_sumo.ads import ADS
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import SENTENCE_END, Answer, Columns, tabulate
from safevar_sumo.questions.case import Case
from safevar_sumo.questions.tables import html_table
from safevar_sumo.questions.words import join_phrases
from safevar_sumo.records import JsonObject
from safevar_sumo.report.sections import ReportedStudy, name_and_sentence
from safevar_sumo.scenarios.euro_ncap import TESTS
from safevar_sumo.vehicles import VEHICLES, Characteristic

PARTS: Columns = {
    "item": "characteristic of the vehicle",
    "how to measure": "how a workshop measures it",
    "limit": "values that are allowed, all limits at the same time",
    "measured": "to be filled in: the value of the vehicle that is checked",
    "beyond the limit": "what to do with a vehicle beyond the limit",
}
UNSAID = "the study does not say"
BLANK = "_" * 8
"""Place for a value that is filled in by hand."""
DIGITS = 16
"""Number of hexadecimal digits of the digest that are printed."""


def sheet_of(study: ReportedStudy) -> JsonObject | None:
    """The sheet for the template; None if nobody asked for joint limits.

    A sheet without joint limits that hold has no table; one whose limits are only rough or for
    screening, or that other files and versions gave, has no line to sign.
    """
    limits = next((answer for answer in study.answers if answer.question == "tolerance"), None)
    if limits is None:
        return None

    # What decides, the table, and what it is about.
    numbers = limits.numbers
    missing = _why_no_limits(limits)
    rows = () if missing else _parts(study, limits)
    *tests, road = numbers.get("scope", "").split("; ")
    unsafe = Unsafe.parse(numbers.get("unsafe", "collision"))
    is_screening = _is_relative(study.case, unsafe)
    wider = limits.tables.get("wider")
    varied = set(limits.table().get("characteristic", ()))
    return {
        "missing": missing,
        "is_screening": is_screening,
        "is_signed": not (missing or numbers["rough"] or study.later_changes or is_screening),
        "unsafe": unsafe,
        "parts": Markup(html_table(tabulate("Items and their limits", PARTS, rows))),
        "numbers": numbers,
        "vehicle": name_and_sentence(VEHICLES, limits.study.vehicle.model),
        "ads": name_and_sentence(ADS, limits.study.ads.model),
        "tests": [_tests_in_words(phrase) for phrase in tests],
        "road": road,
        "wider": [] if wider is None else wider.to_dict("records"),
        "command": limits.command,
        "digest": sha256(limits.render("json").encode()).hexdigest()[:DIGITS],
        "ranges": [
            f"{item.short_name} {_domain_in_words(item)}"
            for item in study.case.characteristics.vehicle
            if item.name in varied
        ],
    }


def _is_relative(case: Case, unsafe: Unsafe) -> bool:
    """Whether a criterion compares vehicles with the original one: the default where nothing
    collides, and in a rated study.
    """
    is_default = case.stated is None and not case.study.unsafe.criterion
    return is_default and not unsafe.is_collision and unsafe == case.unsafe


def _why_no_limits(limits: Answer) -> str:
    """Why nobody may work by this sheet, in sentences; empty if there are joint limits."""
    numbers = limits.numbers
    if "limits" not in limits.tables:
        return limits.verdict
    if not numbers["driven"]:
        return SENTENCE_END.split(limits.verdict)[0]
    if numbers["kept"] is False:
        return f"Not kept: {'; '.join(limits.failures)}."
    return "" if numbers["box"] else "No limits were found that hold at the same time."


def _parts(study: ReportedStudy, limits: Answer) -> Iterator[tuple[str, ...]]:
    """A row of `PARTS` for each characteristic of the vehicle; one whose limits were not asked for
    stays as in the original.
    """
    rows = {row["characteristic"]: row for row in limits.tables["limits"].to_dict("records")}
    for item in study.case.characteristics.vehicle:
        name = item.meaning or item.short_name
        yield (
            f"{name[:1].upper()}{name[1:]}",
            item.measurement or UNSAID,
            _limit_in_words(item, rows.get(item.name)),
            f"{BLANK}{item.suffix}",
            item.remedy or UNSAID,
        )


def _limit_in_words(item: Characteristic, row: Mapping[Any, Any] | None) -> str:
    """A limit: `at least 3 mm`. An end of the domain is none, unless both are; an item whose
    original is at one end has a limit on the other side all the same.
    """
    # An item without a limit or without room, on either side, stays as it was.
    domain = (item.lower, item.upper)
    low, high = (None, None) if row is None else (row["together_low"], row["together_high"])
    if low == high and low not in domain:
        return f"{item.original:.10g}{item.suffix}, as in the original vehicle"

    # A pure number that is 1 in the original vehicle is a share of its value.
    is_share = not item.suffix and item.original == 1
    unit = " of the original vehicle's" if is_share else item.suffix
    sides = zip(("at least", "at most"), (low, high), domain, strict=True)
    ends = [f"{word} {end:.10g}{unit}" for word, end, last in sides if end != last]
    if not ends and item.original == item.upper:
        return f"at least {item.lower:.10g}{unit}, the smallest tested value"
    if not ends and item.original == item.lower:
        return f"at most {item.upper:.10g}{unit}, the greatest tested value"
    return " and ".join(ends) or f"{_domain_in_words(item)}, as tested"


def _domain_in_words(item: Characteristic) -> str:
    return f"{item.lower:.10g} to {item.upper:.10g}{item.suffix}"


def _tests_in_words(phrase: str) -> str:
    """A phrase of a scope as what happens in Euro NCAP's tests: `an adult crosses from the far
    side; this vehicle drives at 10 to 40 km/h`.
    """
    # The phrase has the scenario, the names of its tests in brackets, and their speeds.
    tests, _, speeds = phrase.partition(" (")[2].partition(")")
    names = re.split(", | and ", tests)
    if not TESTS.keys() >= set(names):
        return phrase
    words = join_phrases(TESTS[name].words for name in names)
    return words + speeds.replace(" at ", "; this vehicle drives at ")
