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
from safevar_sumo.report.input import ReportInput, stored_answer
from safevar_sumo.report.svg import Bar, rows
from safevar_sumo.results import SolutionId, chosen_handle

Failures = list[dict[str, Any]]
"""The failures of `explain --json`, with their explanations."""
CAUSES = 6
"""Maximum number of minimal causes in a report."""
REPLAYS = 10
"""Maximum number of solutions with a replay in a report, unless explained failures are more."""
FIRST = ("fewest", "smallest", "most_severe")
"""Choices that are shown first."""
OBJECTIVES = ["f_safe", "f_diff", "f_num_diff"]


def explanations(data: ReportInput, jobs: int | None, progress: Progress) -> Failures:
    """The failures that matter with their explanations, computed once for these results."""
    return list(stored_answer(data, "explain", lambda: explain(
        data.case, data.options["explain"], jobs=jobs, progress=progress).to_dict()))


def necessity_chart(failures: Failures, data: ReportInput) -> Markup | None:
    """A chart of how often failures change each characteristic, and how often they need the change."""
    shares: dict[str, dict[str, Any]] = next((one["summary"] for one in failures if "summary" in one), {})
    names = [name for name in shares.get("necessary", {}) if shares["changed"].get(name)]
    if not names:
        return None
    ordered = sorted(names, key=lambda name: (-shares["necessary"][name], -shares["changed"][name], name))
    bars = [[Bar(0, shares["changed"][name], "weak", f"{name}: changed in {shares['changed'][name]:.0%} of the failures"),
             Bar(0, shares["necessary"][name], "hit", f"{name}: needed in {shares['necessary'][name]:.0%} of the failures")]
            for name in ordered]
    ends = [("", f"needed {shares['necessary'][name]:.0%}{_interval(*shares['necessary_interval'][name])}, "
                 f"changed {shares['changed'][name]:.0%}") for name in ordered]
    description = f"{data.case.name}: how often a characteristic is needed for a failure, beside how often it is changed"
    return rows(description, ordered, bars, [None] * len(ordered), ends)


def _interval(low: float, high: float) -> str:
    """A sample's 95 % interval; empty if all failures were analysed."""
    return f" ({low:.0%} to {high:.0%})" if low < high else ""


def causes(failures: Failures, data: ReportInput) -> list[dict[str, Any]]:
    """The distinct minimal causes with replays, in the order of the number and size of their changes."""
    distinct: dict[tuple[str, ...], dict[str, Any]] = {}
    for failure in failures:
        for cause in _causes_of(failure):
            key = tuple(cause["changes"])
            if key not in distinct or _size(data, cause) < _size(data, distinct[key]["cause"]):
                distinct[key] = {"cause": cause, "because": raised(failure["because"]), "robustness": failure["robustness"],
                                 "handle": handle_of(failure)}
    ordered = sorted(distinct.values(), key=lambda entry: _size(data, entry["cause"]))[:CAUSES]
    if ordered:
        data.simulate_again([data.setting_with(entry["cause"]["changes"]) for entry in ordered])
    opinions = _opinions(data, ordered) if ordered and not no_opinion(data) else [None] * len(ordered)
    return [{**_cause(data, number, entry), "opinion": opinions[number - 1]} for number, entry in enumerate(ordered, 1)]


def no_opinion(data: ReportInput) -> str:
    """Why there is no second opinion on causes, in a sentence; empty if there is one."""
    try:
        second_system(data.case.study)
    except InputError as error:
        return f"No second opinion on these causes: {error.problem}; expected: {error.legal}."
    return ""


def _opinions(data: ReportInput, ordered: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The second vehicle model's opinion on each cause, computed once for these results."""
    causes = [Cause(entry["handle"] or None, entry["cause"]["changes"], entry["cause"]["fraction"]) for entry in ordered]
    return list(stored_answer(data, "opinion", lambda: opinions_of(data.case.study, causes, data.case.unsafe).to_dict()))


def _causes_of(failure: dict[str, Any]) -> list[dict[str, Any]]:
    """The minimal causes of a failure; none if the original vehicle itself is unsafe."""
    return [cause for cause in failure.get("minimal_causes", []) if cause["changes"]]


def handle_of(failure: dict[str, Any]) -> str:
    """The handle of an explained failure; empty if it is no solution."""
    return "" if failure["algorithm"] is None else f"{failure['algorithm']}:{failure['run']}:{failure['index']}"


def _size(data: ReportInput, cause: dict[str, Any]) -> tuple[int, float]:
    setting = data.setting_with(cause["boundary"])
    return len(cause["changes"]), float(data.case.characteristics.largest_change(setting[np.newaxis])[0])


def _cause(data: ReportInput, place: int, entry: dict[str, Any]) -> dict[str, Any]:
    """A cause for the template; `place` is its number, from 1."""
    cause = entry["cause"]
    setting = data.setting_with(cause["changes"])
    members = {member.name: member for member in data.case.characteristics}
    table = [{"name": name, "short": members[name].short_name, "words": members[name].words,
              **{column: f"{number(shown)}{spaced(members[name].unit)}" for column, shown in (
                  ("original", members[name].original), ("value", value), ("boundary", cause["boundary"][name]))}}
             for name, value in cause["changes"].items()]
    comparison = data.compared(setting)
    return {"title": f"Cause {place}: {', '.join(cause['changes'])}", "anchor": data.anchor("cause", place), "rows": table,
            "end": comparison.verdict(comparison.rows[-1]), "because": entry["because"], "robustness": entry["robustness"],
            "borderline": entry["robustness"] is not None and is_borderline(entry["robustness"]),
            "handle": entry["handle"], "where": data.where(setting),
            "whole": data.anchor("replay", entry["handle"]),
            "fraction": cause["fraction"], "below": cause["end"], "replay": data.replay(setting)}


def replays(data: ReportInput, failures: Failures | None) -> list[dict[str, Any]]:
    """The solutions with a replay: the choices of `FIRST`, explained ones, and non-dominated unsafe ones."""
    entries, chosen = [], _chosen(data, failures)
    if data.system is not None and chosen:
        data.simulate_again([data.setting_of(SolutionId.parse(handle)) for handle in chosen])
    for place, handle in enumerate(chosen):
        row, setting = data.solutions[handle], data.setting_of(SolutionId.parse(handle))
        entry = {"handle": handle, "anchor": data.anchor("replay", handle), "f_safe": row["f_safe"], "f_diff": row["f_diff"],
                 "f_num_diff": row["f_num_diff"], "outcome": row["outcome"], "open": place == 0 and not failures,
                 "differences": [], "where": None, "changes": data.changes(setting)}
        entries.append(entry if data.system is None else {
            **entry, "replay": data.replay(setting), "where": data.where(setting),
            "differences": differences(data.simulate_again([setting])[0].evaluation, row)})
    return sorted(entries, key=lambda entry: (entry["f_safe"], entry["handle"]))


def _chosen(data: ReportInput, failures: Failures | None) -> list[str]:
    """Handles of the solutions with a replay, each once."""
    solutions, criterion = data.case.solutions, data.case.unsafe
    if solutions.empty:
        return []
    unsafe = criterion.rows(solutions).tolist()
    choices = FIRST if any(unsafe) else FIRST[-1:]
    chosen = [str(chosen_handle(solutions, criterion, choice, data.directory)) for choice in choices]
    chosen += [handle_of(failure) for failure in failures or [] if failure.get("algorithm") is not None]
    best = best_of([row for row, is_unsafe in zip(data.solutions.values(), unsafe, strict=True) if is_unsafe])
    chosen += [best[index]["handle"] for index in evenly_spaced(len(best), REPLAYS)]
    return list(dict.fromkeys(chosen))[:max(REPLAYS, len(choices) + len(failures or []))]


def best_of(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The solutions that no other dominates in the three objectives, each point once."""
    if not rows:
        return []
    points = np.array([[row[name] for name in OBJECTIVES] for row in rows], dtype=float)
    best = {tuple(point) for point in nondominated(points).tolist()}
    by_point = {tuple(point): row for point, row in zip(points.tolist(), rows, strict=True) if tuple(point) in best}
    return list(by_point.values())


def evenly_spaced(number: int, most: int) -> list[int]:
    """At most `most` evenly spaced indices of `number` items."""
    return sorted({round(index) for index in np.linspace(0, number - 1, min(number, most)).tolist()})
