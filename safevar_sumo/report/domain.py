"""The sections about the whole domain: tolerances, the probability of a failure, and the regions of failures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from markupsafe import Markup

from safevar_sumo.analysis.risk.answer import FLEET_VEHICLES
from safevar_sumo.analysis.risk.compute import estimate_risk
from safevar_sumo.analysis.rules.compute import RULES_NOTE, find_rules
from safevar_sumo.analysis.tolerance.compute import find_tolerances
from safevar_sumo.analysis.words import number_of
from safevar_sumo.metrics import Unsafe
from safevar_sumo.progress import Progress
from safevar_sumo.replay.comparison import format_number, quantity_text, superscript_powers
from safevar_sumo.report.input import ReportInput, load_or_compute
from safevar_sumo.report.svg import Bar, draw_bars
from safevar_sumo.vehicles import Characteristic

Section = dict[str, Any]


def make_tolerance_section(data: ReportInput, jobs: int | None, progress: Progress) -> Section:
    """Bars of the values at which each characteristic alone is safe, and the safe factor of all characteristics together."""
    def compute() -> Section:
        tolerances = find_tolerances(data.case, data.options["tolerance"], jobs=jobs, progress=progress)
        return {**tolerances.to_dict(), "verdict": tolerances.verdict}

    result = _with_criterion_in_words(load_or_compute(data, "tolerance", compute))
    return {**{name: result[name] for name in ("verdict", "unsafe", "joint")}, "chart": _draw_intervals(data, result["alone"])}


def make_risk_section(data: ReportInput, jobs: int | None, progress: Progress) -> Section:
    """The probability of a failure with its interval, and bars of the characteristics that decide whether a vehicle fails."""
    def compute() -> Section:
        estimate = estimate_risk(data.case, data.options["risk"], jobs=jobs, progress=progress)
        fleet = {"vehicles": FLEET_VEHICLES, "probability": estimate.of_fleet_in_words(FLEET_VEHICLES)}
        return {**estimate.to_dict(), **({} if estimate.is_share_of_domain else {"fleet": fleet})}

    result = _with_criterion_in_words(load_or_compute(data, "risk", compute))
    study = data.case.study
    return {**result, "of_domain": not study.variation, "correlated": bool(study.correlations),
            "chart": _draw_sensitivities(data, result["sensitivity"])}


def make_rules_section(data: ReportInput, jobs: int | None, progress: Progress) -> Section:
    """Rules in words, with their density and coverage among vehicles held back while the rules were found."""
    def compute() -> Section:
        result = find_rules(data.case, data.options["rules"], jobs=jobs, progress=progress)
        significant = [rule for rule in result.rules if rule.is_denser_than(result.unsafe_share)]
        words = [superscript_powers(rule.in_words(data.case.characteristics, result.unsafe)) for rule in significant]
        omitted_rules = number_of(len(result.rules) - len(significant), "rule")
        remark = (result.remark and f"{result.remark}.") if len(significant) == len(result.rules) else (
            f"Left out: {omitted_rules} that may be due to chance, as few vehicles were simulated; the command rules simulates more.")
        return {"words": words, "note": RULES_NOTE, "samples": result.samples, "share": result.unsafe_share, "remark": remark,
                "unsafe": str(result.unsafe)}

    return _with_criterion_in_words(load_or_compute(data, "rules", compute))


def _with_criterion_in_words(section: Section) -> Section:
    return {**section, "unsafe": Unsafe.parse(section["unsafe"]).description}


INDEX_NAMES = {"first_order": "alone", "total": "with others"}
"""Sobol indices, and their names beside a bar."""
DOMAIN_SECTIONS: Mapping[str, Callable[[ReportInput, int | None, Progress], Section]] = {
    "tolerance": make_tolerance_section, "risk": make_risk_section, "rules": make_rules_section}
"""Functions that make the sections about the whole domain, by name."""


def _draw_intervals(data: ReportInput, scans: list[dict[str, Any]]) -> Markup:
    characteristics = {characteristic.name: characteristic for characteristic in data.case.characteristics}
    names, bars, mark_positions, end_labels = [], [], [], []
    for scan in scans:
        characteristic = characteristics[scan["characteristic"]]
        safe, unsafe = scan["safe"], scan["unsafe"]
        safe_bars = [] if safe is None else [_interval_bar(characteristic, safe, "safe")]
        names.append(characteristic.name)
        bars.append([*safe_bars, *(_interval_bar(characteristic, interval, "unsafe") for interval in unsafe),
                     *(_interval_bar(characteristic, interval, "weak", "could not be simulated") for interval in scan["not_simulated"])])
        mark_positions.append(_fraction_of_domain(characteristic, characteristic.original))
        low_label, high_label = (quantity_text(end, characteristic.unit) for end in (characteristic.lower, characteristic.upper))
        end_labels.append((low_label, high_label))
    description = f"{data.case.name}: where each characteristic alone is safe and where it is unsafe; a mark at the original"
    return draw_bars(description, names, bars, mark_positions, end_labels)


def _interval_bar(characteristic: Characteristic, interval: Sequence[float], css_class: str, state: str = "") -> Bar:
    low, high = interval
    tooltip = f"{characteristic.name} from {format_number(low)} to {quantity_text(high, characteristic.unit)}: {state or css_class}"
    return Bar(_fraction_of_domain(characteristic, low), _fraction_of_domain(characteristic, high), css_class, tooltip)


def _index_bar(name: str, index: float, css_class: str, index_name: str) -> Bar:
    return Bar(0, min(max(index, 0.0), 1.0), css_class, f"{name}: {index:.0%} {index_name}")


def _estimate_text(share: float | None, interval: Sequence[float | None]) -> str:
    """An estimated share with half the width of its interval, such as `41 % ± 7`; an estimate just below 0 is shown as 0."""
    if share is None:
        return "-"
    low, high = interval
    error = "" if low is None or high is None else f" ± {50 * (high - low):.0f}"
    return f"{100 * (round(share, 2) + 0.0):.0f} %{error}"


def _fraction_of_domain(characteristic: Characteristic, value: float) -> float:
    """The distance of a value from its domain's lower end, as a fraction of the domain."""
    return (value - characteristic.lower) / (characteristic.upper - characteristic.lower)


def _draw_sensitivities(data: ReportInput, sensitivity: list[dict[str, Any]]) -> Markup | None:
    entries = sorted((entry for entry in sensitivity if entry["total"] is not None),
                     key=lambda entry: (-entry["total"], entry["characteristic"]))
    if not entries:
        return None
    bars = [[_index_bar(entry["characteristic"], entry["total"], "weak", "together with others"),
             _index_bar(entry["characteristic"], entry["first_order"] or 0.0, "safe", "alone")] for entry in entries]
    end_labels = [("", ", ".join(f"{name} {_estimate_text(entry[index], entry[f'{index}_interval'])}"
                                 for index, name in INDEX_NAMES.items())) for entry in entries]
    return draw_bars(f"{data.case.name}: share of the safety degree's variance that each characteristic explains",
                     [entry["characteristic"] for entry in entries], bars, [None] * len(entries), end_labels)
