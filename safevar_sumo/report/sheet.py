"""The first sheet of a page: limits for a workshop and an operator, without statistics, which can
be printed alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from hashlib import sha256
from typing import Any

from markupsafe import Markup

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import SENTENCE_END, Answer, Columns, tabulate
from safevar_sumo.questions.tables import columns_of, html_table
from safevar_sumo.records import JsonObject
from safevar_sumo.report.sections import ReportedStudy
from safevar_sumo.study import unit_text
from safevar_sumo.vehicles import Characteristic

PARTS: Columns = {
    "part": "characteristic of the vehicle",
    "how to measure": "how a workshop measures it",
    "limit": "values that are allowed, all limits at the same time",
    "beyond the limit": "what to do with a vehicle beyond the limit",
}
UNSAID = "the study does not say"
DIGITS = 16
"""Number of hexadecimal digits of the digest."""
NEXT_STEP = (
    "If a part is beyond its limit, do what the last column says before the driving system drives"
    " again."
)
NOT_TESTED = (
    "Speeds, roads, weather and traffic other than those above.",
    "Parts that the table does not name, such as steering, suspension and single wheels.",
    "A real vehicle: all of these tests are simulations of a model.",
)


def sheet_of(study: ReportedStudy) -> JsonObject | None:
    """The sheet for the template; None if nobody asked for joint limits.

    A sheet without joint limits that hold has no table; one whose limits are only rough, or that
    other files and versions gave, has no line to sign.
    """
    # The answer with joint limits, and the one with limits up to values of a parameter.
    of_limits = [answer for answer in study.answers if answer.question == "tolerance"]
    limits = next((one for one in of_limits if "up_to" not in one.numbers), None)
    by_value = next((one for one in of_limits if "up_to" in one.numbers), None)
    if limits is None:
        return None

    # What decides, the table, and what it is about.
    missing = _why_no_limits(limits)
    doubt = "" if missing else _why_unsigned(study, limits)
    rows = [] if missing else list(_parts(study, limits))
    original = [] if missing else list(_original_in_words(study, limits))
    if by_value is not None:
        original.append(_own_limit_in_words(study, by_value))
    return {
        "sentences": [missing or doubt] if missing or doubt else list(_conclusion(limits)),
        "parts": Markup(html_table(tabulate("Parts and their limits", PARTS, rows))),
        "facts": list(_facts(study, limits, original)),
        "not_tested": [] if missing else list(_not_tested(study, limits)),
        "is_signed": not (missing or doubt),
    }


def _why_no_limits(limits: Answer) -> str:
    """Why nobody may work by this sheet, in sentences; empty if there are joint limits."""
    why = ""
    if "limits" not in limits.tables:
        why = limits.verdict
    elif not limits.numbers["driven"]:
        why = SENTENCE_END.split(limits.verdict)[0]
    elif limits.numbers["kept"] is False:
        why = f"{'; '.join(limits.failures)}."
    elif not limits.numbers["box"]:
        why = (
            "No limits were found that hold at the same time. The next sheet has limits of single"
            " parts, which hold only if all other parts are as in the original vehicle."
        )
    return f"Do not use this sheet. {why[:1].upper()}{why[1:]}" if why else ""


def _why_unsigned(study: ReportedStudy, limits: Answer) -> str:
    """Why limits are not to be signed, in sentences; empty if they may be."""
    if limits.numbers["rough"]:
        return (
            "Do not use this sheet: its limits are rough. Ask tolerance again without --attack for"
            " limits that can be signed."
        )
    if study.later_changes:
        return (
            "Do not use this sheet: files or versions have changed since the results. Run the study"
            " again for limits that can be signed."
        )
    return ""


def _conclusion(limits: Answer) -> Iterator[str]:
    unsafe = Unsafe.parse(limits.numbers["unsafe"])
    is_safe = f"is safe (unsafe: {unsafe.description})"
    avoids = "avoids a collision" if unsafe.is_collision else is_safe
    yield (
        "All of these limits hold at the same time: every simulated vehicle within them"
        f" {avoids} in the tests named below."
    )
    yield NEXT_STEP


def _parts(study: ReportedStudy, limits: Answer) -> Iterator[tuple[str, ...]]:
    """A row of `PARTS` for each characteristic of the vehicle; one whose limits were not asked for
    stays as in the original.
    """
    rows = {row["characteristic"]: row for row in limits.tables["limits"].to_dict("records")}
    for item in study.case.characteristics.vehicle:
        yield (
            f"{item.short_name[:1].upper()}{item.short_name[1:]}",
            item.measurement or UNSAID,
            _limit_in_words(item, rows.get(item.name)),
            item.remedy or UNSAID,
        )


def _limit_in_words(item: Characteristic, row: Mapping[Any, Any] | None) -> str:
    """A limit: `at least 3 mm`. An end of the domain is none, unless both are."""
    low, high = (
        (item.original, item.original)
        if row is None
        else (row["together_low"], row["together_high"])
    )
    if low == high:
        return f"{low:.10g}{item.suffix}, as in the original vehicle"
    sides = (("at least", low, item.lower), ("at most", high, item.upper))
    ends = [f"{word} {end:.10g}{item.suffix}" for word, end, last in sides if end != last]
    return " and ".join(ends) or f"any tested value: {_domain_in_words(item)}"


def _domain_in_words(item: Characteristic) -> str:
    return f"{item.lower:.10g} to {item.upper:.10g}{item.suffix}"


def _facts(
    study: ReportedStudy, limits: Answer, original: Sequence[str]
) -> Iterator[tuple[str, str]]:
    """What the limits are about, and how the sheet is told from others, each with its name."""
    own = study.case.study
    yield (
        "Vehicle and study",
        (f"vehicle {own.vehicle.model}, driving system {own.ads.model}, study {own.name}"),
    )
    if scope := limits.numbers.get("scope"):
        *tests, road = scope.split("; ")
        yield "Tests and speeds", "; ".join(tests)
        yield "Road and light", road
    if "wider" in limits.tables and not _why_no_limits(limits):
        for row in limits.tables["wider"].to_dict("records"):
            found = "no failure of these limits was found." if row["kept"] else row["verdict"]
            yield "Wider tests", f"In the study {row['study']} ({row['scope']}), {found}"
    if original:
        yield "Original vehicle", " ".join(original)
    yield "Versions", ", ".join(f"{name} {value}" for name, value in study.versions.items())
    if limits.command:
        digest = sha256(limits.render("json").encode()).hexdigest()[:DIGITS]
        yield "Digest", f"{digest} (first digits of: {limits.command} --json | sha256sum)"


def _original_in_words(study: ReportedStudy, limits: Answer) -> Iterator[str]:
    """How far the original vehicle itself is safe, and which encounters count."""
    scenario = study.case.study.scenario
    if scenario.search:
        yield (
            "Only encounters count in which the original vehicle itself keeps at least"
            f" {scenario.margin:g} m. In all others the limits promise nothing."
        )
    elif limits.numbers["margin"]:
        yield f"It keeps at least {limits.numbers['margin']:g} m in all of these tests."
    else:
        yield "It is safe in all of these tests."


def _own_limit_in_words(study: ReportedStudy, by_value: Answer) -> str:
    """Up to which value of a parameter the original vehicle keeps its margin."""
    scenario = study.case.study.scenario
    margin = scenario.margin if scenario.search else by_value.numbers["margin"]
    frame = by_value.table("limits")
    column = next(name for name in map(str, frame) if name.startswith("by_"))
    parameter = column.removeprefix("by_").replace("_", " ")
    unit = unit_text(columns_of(frame)[column].unit)
    keeps = by_value.numbers["original_keeps_up_to"]
    safe = by_value.numbers["original_safe_up_to"]
    if keeps is None:
        return f"It keeps {margin:g} m at no {parameter} that was tested."
    if keeps == frame[column].max():
        return f"It keeps {margin:g} m up to {parameter} {keeps:.10g}{unit}, the highest tested."
    touches = "" if safe in (None, keeps) else f", and touches nobody up to {safe:.10g}{unit}"
    return f"It keeps {margin:g} m only up to {parameter} {keeps:.10g}{unit}{touches}."


def _not_tested(study: ReportedStudy, limits: Answer) -> Iterator[str]:
    """What the limits say nothing about, in sentences."""
    if limits.numbers["contacts_left_out"]:
        yield "Encounters in which the original vehicle keeps too little: contacts occur there."
    yield from NOT_TESTED
    ranges = "; ".join(
        f"{item.short_name} {_domain_in_words(item)}" for item in study.case.characteristics.vehicle
    )
    yield f"Values outside the tested ranges: {ranges}."
