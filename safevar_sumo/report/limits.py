"""The sections on tolerances, the probability of a failure, and the regions of failures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from markupsafe import Markup

from safevar_sumo.analysis.evaluator import Progress
from safevar_sumo.analysis.risk.compute import FLEET_VEHICLES, estimate_risk, fleet_probability
from safevar_sumo.analysis.rules.compute import find_rules, rule_in_words
from safevar_sumo.analysis.tolerance.compute import find_tolerances
from safevar_sumo.analysis.words import number_of
from safevar_sumo.replay.comparison import number, raised, spaced
from safevar_sumo.report.input import ReportInput, stored_answer
from safevar_sumo.report.svg import Bar, bar_chart
from safevar_sumo.vehicles import Characteristic

Section = dict[str, Any]


def tolerance(data: ReportInput, jobs: int | None, progress: Progress) -> Section:
    """The safe interval of each characteristic alone, as bars over its domain, and the safe factor of all characteristics together."""
    def compute() -> Section:
        tolerances = find_tolerances(data.case.study, data.options["tolerance"], jobs=jobs, progress=progress)
        return {**tolerances.to_dict(), "verdict": tolerances.verdict}

    result = stored_answer(data, "tolerance", compute)
    return {"verdict": result["verdict"], "unsafe": result["unsafe"], "joint": result["joint"], "chart": _bars(data, result["alone"])}


def risk(data: ReportInput, jobs: int | None, progress: Progress) -> Section:
    """The probability of a failure with its interval, and as bars the characteristics that decide whether a vehicle fails."""
    def compute() -> Section:
        return estimate_risk(data.case.study, data.options["risk"], jobs=jobs, progress=progress).to_dict()

    result = stored_answer(data, "risk", compute)
    study = data.case.study
    fleet = {} if not study.variation else {
        "fleet": {"vehicles": FLEET_VEHICLES, "probability": fleet_probability(result["probability"], FLEET_VEHICLES)}}
    return {**result, **fleet, "of_domain": not study.variation, "correlated": bool(study.correlations),
            "chart": _sensitivity(data, result["sensitivity"])}


def rules(data: ReportInput, jobs: int | None, progress: Progress) -> Section:
    """Rules in words, with their density and coverage among vehicles that were not used to find the rules."""
    def compute() -> Section:
        regions = find_rules(data.case.study, data.options["rules"], jobs=jobs, progress=progress)
        significant = [rule for rule in regions.rules if rule.is_denser_than(regions.unsafe_share)]
        words = [raised(rule_in_words(rule, data.case.characteristics, regions.unsafe)) for rule in significant]
        omitted_rules = number_of(len(regions.rules) - len(significant), "rule")
        remark = regions.remark if len(significant) == len(regions.rules) else (
            f"Left out: {omitted_rules} that may be chance with so few vehicles; the command rules simulates more.")
        return {"words": words, "samples": regions.samples, "share": regions.unsafe_share, "remark": remark, "unsafe": str(regions.unsafe)}

    result: Section = stored_answer(data, "rules", compute)
    return result


INDICES = {"first_order": "alone", "total": "with others"}
"""Sobol indices, and their names beside a bar."""
LIMITS: Mapping[str, Callable[[ReportInput, int | None, Progress], Section]] = {"tolerance": tolerance, "risk": risk, "rules": rules}
"""Functions that compute the sections about the whole domain, by name."""


def _bars(data: ReportInput, scans: list[Section]) -> Markup:
    members = {member.name: member for member in data.case.characteristics}
    names, bars, marks, ends = [], [], [], []
    for scan in scans:
        member = members[scan["characteristic"]]
        safe, unsafe = scan["safe"], scan["unsafe"]
        safe_bars = [] if safe is None else [_bar(member, safe, "safe")]
        names.append(member.name)
        bars.append([*safe_bars, *(_bar(member, interval, "unsafe") for interval in unsafe),
                     *(_bar(member, interval, "weak", "could not be simulated") for interval in scan["not_simulated"])])
        marks.append(_position(member, member.original))
        ends.append((f"{number(member.lower)}{spaced(member.unit)}", f"{number(member.upper)}{spaced(member.unit)}"))
    description = f"{data.case.name}: where each characteristic alone is safe and where it is unsafe; a mark at the original"
    return bar_chart(description, names, bars, marks, ends)


def _bar(member: Characteristic, interval: Sequence[float], css_class: str, state: str = "") -> Bar:
    low, high = interval
    words = f"{member.name} from {number(low)} to {number(high)}{spaced(member.unit)}: {state or css_class}"
    return Bar(_position(member, low), _position(member, high), css_class, words)


def _index_bar(name: str, index: float, css_class: str, kind: str) -> Bar:
    return Bar(0, min(max(index, 0.0), 1.0), css_class, f"{name}: {index:.0%} {kind}")


def _percent(share: float | None, interval: Sequence[float | None]) -> str:
    """An estimated share with half the width of its interval, such as `41 % ± 7`; an estimate just below 0 is shown as 0."""
    if share is None:
        return "-"
    low, high = interval
    error = "" if low is None or high is None else f" ± {50 * (high - low):.0f}"
    return f"{100 * (round(share, 2) + 0.0):.0f} %{error}"


def _position(member: Characteristic, value: float) -> float:
    """The position of a value in its domain, from 0 to 1."""
    return (value - member.lower) / (member.upper - member.lower)


def _sensitivity(data: ReportInput, sensitivity: list[Section]) -> Markup | None:
    entries = sorted((entry for entry in sensitivity if entry["total"] is not None),
                     key=lambda entry: (-entry["total"], entry["characteristic"]))
    if not entries:
        return None
    bars = [[_index_bar(entry["characteristic"], entry["total"], "weak", "together with others"),
             _index_bar(entry["characteristic"], entry["first_order"] or 0.0, "safe", "alone")] for entry in entries]
    return bar_chart(f"{data.case.name}: share of the safety degree's variance that each characteristic explains",
                [entry["characteristic"] for entry in entries], bars, [None] * len(entries),
                [("", ", ".join(f"{words} {_percent(entry[index], entry[f'{index}_interval'])}" for index, words in INDICES.items()))
                 for entry in entries])
