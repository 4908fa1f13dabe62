"""Failures with their minimal causes, and selected solutions, each with its replay."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup

from safevar_sumo.analysis.evaluator import Progress
from safevar_sumo.analysis.explain.compute import explain_failures as explain
from safevar_sumo.analysis.explain.necessity import is_borderline
from safevar_sumo.analysis.opinion.compute import Cause, opinions_of, second_system
from safevar_sumo.analysis.research_questions.indicators import nondominated
from safevar_sumo.errors import InputError
from safevar_sumo.replay.comparison import differences, number, raised, spaced
from safevar_sumo.report.input import ReportInput, stored
from safevar_sumo.report.svg import Bar, rows
from safevar_sumo.results import SolutionId, chosen_handle

Failures = list[dict[str, Any]]
"""What `explain --json` prints."""
CAUSES = 6
"""Minimal causes that a report shows, at the most."""
REPLAYS = 10
"""Solutions that a report shows, at the most; explained ones come on top."""
FIRST = ("fewest", "smallest", "most_severe")
"""Choices that are shown first."""
OBJECTIVES = ["f_safe", "f_diff", "f_num_diff"]


def explanations(material: ReportInput, jobs: int | None, progress: Progress) -> Failures:
    """The failures that matter, explained; computed once for these results."""
    return list(stored(material, "explain", lambda: explain(
        material.case, material.options["explain"], jobs=jobs, progress=progress).to_dict()))


def necessity_chart(explained: Failures, material: ReportInput) -> Markup | None:
    """How often each characteristic is changed in a failure, and how often it is needed."""
    shares: dict[str, dict[str, Any]] = next((one["summary"] for one in explained if "summary" in one), {})
    names = [name for name in shares.get("necessary", {}) if shares["changed"].get(name)]
    if not names:
        return None
    ordered = sorted(names, key=lambda name: (-shares["necessary"][name], -shares["changed"][name], name))
    pieces = [[Bar(0, shares["changed"][name], "weak", f"{name}: changed in {shares['changed'][name]:.0%} of the failures"),
               Bar(0, shares["necessary"][name], "hit", f"{name}: needed in {shares['necessary'][name]:.0%} of the failures")]
              for name in ordered]
    ends = [("", f"needed {shares['necessary'][name]:.0%}{_interval(*shares['necessary_interval'][name])}, "
                 f"changed {shares['changed'][name]:.0%}") for name in ordered]
    description = f"{material.case.name}: how often a characteristic is needed for a failure, beside how often it is changed"
    return rows(description, ordered, pieces, [None] * len(ordered), ends)


def _interval(low: float, high: float) -> str:
    """A sample's 95 % interval; nothing where all failures were analysed."""
    return f" ({low:.0%} to {high:.0%})" if low < high else ""


def causes(explained: Failures, material: ReportInput) -> list[dict[str, Any]]:
    """The distinct minimal causes, the one of the fewest and smallest changes first, each with its replay at the boundary."""
    distinct: dict[tuple[str, ...], dict[str, Any]] = {}
    for failure in explained:
        for cause in _with_changes(failure):
            key = tuple(cause["changes"])
            if key not in distinct or _size(material, cause) < _size(material, distinct[key]["cause"]):
                distinct[key] = {"cause": cause, "because": raised(failure["because"]), "robustness": failure["robustness"],
                                 "handle": handle_of(failure)}
    ordered = sorted(distinct.values(), key=lambda one: _size(material, one["cause"]))[:CAUSES]
    if ordered:
        material.again([material.setting_with(one["cause"]["changes"]) for one in ordered])
    opinions = _opinions(material, ordered) if ordered and not no_opinion(material) else [None] * len(ordered)
    return [{**_shown(material, place, one), "opinion": opinions[place - 1]} for place, one in enumerate(ordered, 1)]


def no_opinion(material: ReportInput) -> str:
    """Why there is no second opinion on causes, in a sentence; empty if there is one."""
    try:
        second_system(material.case.study)
    except InputError as error:
        return f"No second opinion on these causes: {error.problem}; expected: {error.legal}."
    return ""


def _opinions(material: ReportInput, ordered: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What the second vehicle model says of each cause; computed once for these results."""
    causes = [Cause(one["handle"] or None, one["cause"]["changes"], one["cause"]["fraction"]) for one in ordered]
    return list(stored(material, "opinion", lambda: opinions_of(material.case.study, causes, material.case.unsafe).to_dict()))


def _with_changes(failure: dict[str, Any]) -> list[dict[str, Any]]:
    """The minimal causes of a failure; none where the original vehicle itself is unsafe, which no change causes."""
    return [cause for cause in failure.get("minimal_causes", []) if cause["changes"]]


def handle_of(failure: dict[str, Any]) -> str:
    """The handle of an explained failure, nothing if it did not come from a solution."""
    return "" if failure["algorithm"] is None else f"{failure['algorithm']}:{failure['run']}:{failure['index']}"


def _size(material: ReportInput, cause: dict[str, Any]) -> tuple[int, float]:
    setting = material.setting_with(cause["boundary"])
    return len(cause["changes"]), float(material.case.characteristics.largest_change(setting[np.newaxis])[0])


def _shown(material: ReportInput, place: int, one: dict[str, Any]) -> dict[str, Any]:
    cause = one["cause"]
    setting = material.setting_with(cause["changes"])
    members = {member.name: member for member in material.case.characteristics}
    table = [{"name": name, "short": members[name].short_name, "words": members[name].words,
              **{what: f"{number(one)}{spaced(members[name].unit)}" for what, one in (
                  ("original", members[name].original), ("value", value), ("boundary", cause["boundary"][name]))}}
             for name, value in cause["changes"].items()]
    comparison = material.compared(setting)
    return {"title": f"Cause {place}: {', '.join(cause['changes'])}", "anchor": material.anchor("cause", place), "rows": table,
            "end": comparison.verdict(comparison.rows[-1]), "because": one["because"], "robustness": one["robustness"],
            "borderline": one["robustness"] is not None and is_borderline(one["robustness"]),
            "handle": one["handle"], "where": material.where(setting),
            "whole": material.anchor("replay", one["handle"]),
            "fraction": cause["fraction"], "below": cause["end"], "replay": material.replay(setting)}


def replays(material: ReportInput, explained: Failures | None) -> list[dict[str, Any]]:
    """The solutions with a replay: the choices of `FIRST`, explained ones, and non-dominated unsafe ones."""
    shown, chosen = [], _chosen(material, explained)
    if material.system is not None and chosen:
        material.again([material.setting_of(SolutionId.parse(handle)) for handle in chosen])
    for place, handle in enumerate(chosen):
        row, setting = material.solutions[handle], material.setting_of(SolutionId.parse(handle))
        one = {"handle": handle, "anchor": material.anchor("replay", handle), "f_safe": row["f_safe"], "f_diff": row["f_diff"],
               "f_num_diff": row["f_num_diff"], "outcome": row["outcome"], "open": place == 0 and not explained,
               "differences": [], "where": None, "changes": material.changes(setting)}
        shown.append(one if material.system is None else {
            **one, "replay": material.replay(setting), "where": material.where(setting),
            "differences": differences(material.again([setting])[0].evaluation, row)})
    return sorted(shown, key=lambda one: (one["f_safe"], one["handle"]))


def _chosen(material: ReportInput, explained: Failures | None) -> list[str]:
    """Their handles, each once."""
    solutions, criterion = material.case.solutions, material.case.unsafe
    if solutions.empty:
        return []
    unsafe = criterion.rows(solutions).tolist()
    choices = FIRST if any(unsafe) else FIRST[-1:]
    chosen = [str(chosen_handle(solutions, criterion, choice, material.place)) for choice in choices]
    chosen += [handle_of(failure) for failure in explained or [] if failure.get("algorithm") is not None]
    best = best_of([row for row, is_unsafe in zip(material.solutions.values(), unsafe, strict=True) if is_unsafe])
    chosen += [best[place]["handle"] for place in evenly(len(best), REPLAYS)]
    return list(dict.fromkeys(chosen))[:max(REPLAYS, len(choices) + len(explained or []))]


def best_of(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The solutions that no other dominates in the three objectives, each point once."""
    if not rows:
        return []
    points = np.array([[row[name] for name in OBJECTIVES] for row in rows], dtype=float)
    best = {tuple(point) for point in nondominated(points).tolist()}
    by_point = {tuple(point): row for point, row in zip(points.tolist(), rows, strict=True) if tuple(point) in best}
    return list(by_point.values())


def evenly(number: int, most: int) -> list[int]:
    """At most `most` of `number` places, evenly spaced."""
    return sorted({round(place) for place in np.linspace(0, number - 1, min(number, most)).tolist()})
