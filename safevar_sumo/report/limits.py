"""How far characteristics may go, how likely a failure is, and in which region failures lie."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from markupsafe import Markup

from safevar_sumo.analysis.evaluator import Progress
from safevar_sumo.analysis.risk.compute import FLEET, estimate_risk, fleet_probability
from safevar_sumo.analysis.rules.compute import find_rules, rule_in_words
from safevar_sumo.analysis.tolerance.compute import find_tolerances
from safevar_sumo.analysis.words import number_of
from safevar_sumo.replay.comparison import number, raised, spaced
from safevar_sumo.report.input import ReportInput, stored
from safevar_sumo.report.svg import Bar, rows
from safevar_sumo.vehicles import Characteristic

Section = dict[str, Any]


def tolerance(material: ReportInput, jobs: int | None, progress: Progress) -> Section:
    """Every characteristic's safe interval alone, as bars over its domain, and the factor for all together."""
    def compute() -> Section:
        tolerances = find_tolerances(material.case.study, material.options["tolerance"], jobs=jobs, progress=progress)
        return {**tolerances.to_dict(), "verdict": tolerances.verdict}

    result = stored(material, "tolerance", compute)
    return {"verdict": result["verdict"], "unsafe": result["unsafe"], "joint": result["joint"], "chart": _bars(material, result["alone"])}


def risk(material: ReportInput, jobs: int | None, progress: Progress) -> Section:
    """The probability of a failure with its interval, and what decides, as bars."""
    def compute() -> Section:
        return estimate_risk(material.case.study, material.options["risk"], jobs=jobs, progress=progress).to_dict()

    result = stored(material, "risk", compute)
    study = material.case.study
    fleet = {} if not study.variation else {
        "fleet": {"vehicles": FLEET, "probability": fleet_probability(result["probability"], FLEET)}}
    return {**result, **fleet, "of_domain": not study.variation, "correlated": bool(study.correlations),
            "chart": _sensitivity(material, result["sensitivity"])}


def rules(material: ReportInput, jobs: int | None, progress: Progress) -> Section:
    """Rules in words, with density and coverage on vehicles that were not used to find them."""
    def compute() -> Section:
        regions = find_rules(material.case.study, material.options["rules"], jobs=jobs, progress=progress)
        sure = [rule for rule in regions.rules if rule.is_denser_than(regions.unsafe_share)]
        words = [raised(rule_in_words(rule, material.case.characteristics, regions.unsafe)) for rule in sure]
        dropped = number_of(len(regions.rules) - len(sure), "rule")
        remark = regions.remark if len(sure) == len(regions.rules) else (
            f"Left out: {dropped} that so few vehicles do not tell from chance; the command rules looks at more.")
        return {"words": words, "samples": regions.samples, "share": regions.unsafe_share, "remark": remark, "unsafe": str(regions.unsafe)}

    result: Section = stored(material, "rules", compute)
    return result


INDICES = {"first_order": "alone", "total": "with others"}
"""What the Sobol indices are called beside a bar."""
LIMITS: Mapping[str, Callable[[ReportInput, int | None, Progress], Section]] = {"tolerance": tolerance, "risk": risk, "rules": rules}
"""The sections about the whole domain, by name."""


def _bars(material: ReportInput, alone: list[Section]) -> Markup:
    members = {member.name: member for member in material.case.characteristics}
    names, pieces, marks, ends = [], [], [], []
    for one in alone:
        member = members[one["characteristic"]]
        safe, unsafe = one["safe"], one["unsafe"]
        bars = [] if safe is None else [_bar(member, safe, "safe")]
        names.append(member.name)
        pieces.append([*bars, *(_bar(member, interval, "unsafe") for interval in unsafe),
                       *(_bar(member, interval, "weak", "could not be simulated") for interval in one["not_simulated"])])
        marks.append(_share(member, member.original))
        ends.append((f"{number(member.lower)}{spaced(member.unit)}", f"{number(member.upper)}{spaced(member.unit)}"))
    description = f"{material.case.name}: where each characteristic alone is safe and where it is unsafe; a mark at the original"
    return rows(description, names, pieces, marks, ends)


def _bar(member: Characteristic, interval: Sequence[float], look: str, state: str = "") -> Bar:
    low, high = interval
    words = f"{member.name} from {number(low)} to {number(high)}{spaced(member.unit)}: {state or look}"
    return Bar(_share(member, low), _share(member, high), look, words)


def _part(name: str, share: float, look: str, how: str) -> Bar:
    return Bar(0, min(max(share, 0.0), 1.0), look, f"{name}: {share:.0%} {how}")


def _percent(share: float | None, interval: Sequence[float | None]) -> str:
    """An estimated share with half of its interval, such as `41 % ± 7`; an estimate just below 0 is 0."""
    if share is None:
        return "-"
    low, high = interval
    error = "" if low is None or high is None else f" ± {50 * (high - low):.0f}"
    return f"{100 * (round(share, 2) + 0.0):.0f} %{error}"


def _share(member: Characteristic, value: float) -> float:
    return (value - member.lower) / (member.upper - member.lower)


def _sensitivity(material: ReportInput, sensitivity: list[Section]) -> Markup | None:
    defined = [one for one in sensitivity if one["total"] is not None]
    ordered = sorted(defined, key=lambda one: (-one["total"], one["characteristic"]))
    if not ordered:
        return None
    pieces = [[_part(one["characteristic"], one["total"], "weak", "together with others"),
               _part(one["characteristic"], one["first_order"] or 0.0, "safe", "alone")] for one in ordered]
    return rows(f"{material.case.name}: share of the safety degree's variance that each characteristic decides",
                [one["characteristic"] for one in ordered], pieces, [None] * len(ordered),
                [("", ", ".join(f"{words} {_percent(one[index], one[f'{index}_interval'])}" for index, words in INDICES.items()))
                 for one in ordered])
