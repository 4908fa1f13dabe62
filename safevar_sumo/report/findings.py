"""The section on causes: minimal causes of failures and selected solutions, with their replays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from markupsafe import Markup

from safevar_sumo.analysis.evaluator import Progress
from safevar_sumo.analysis.explain.compute import explain_failures as explain
from safevar_sumo.analysis.explain.necessity import in_words
from safevar_sumo.analysis.explain.result import CauseEntry, FailureEntry, SummaryEntry
from safevar_sumo.analysis.opinion.compute import CauseToJudge, assemble_both_systems, judge_causes
from safevar_sumo.analysis.research_questions.indicators import nondominated_points
from safevar_sumo.errors import InputError
from safevar_sumo.replay.comparison import differences, number, raised, spaced
from safevar_sumo.report.input import ChangeRow, FailingPoints, ReportInput, stored_answer
from safevar_sumo.report.svg import Bar, bar_chart

MAX_CAUSES = 6
"""Maximum number of minimal causes in a report."""
MAX_REPLAYS = 10
"""Maximum number of solutions with a replay in a report, unless there are more explained failures."""
FIRST_CHOICES = ("fewest", "smallest", "most_severe")
"""Choices of the first solutions on the page."""
OBJECTIVES = ["f_safe", "f_diff", "f_num_diff"]


class Explanations(NamedTuple):
    """The answer of `explain`: the most important failures, and a summary of all analysed failures."""

    failures: list[FailureEntry]
    summary: SummaryEntry


class CauseRow(NamedTuple):
    """A change in a cause: the characteristic, its short and long description, and three values with their unit."""

    name: str
    short: str
    words: str
    original: str
    value: str
    boundary: str


class SecondOpinion(msgspec.Struct, frozen=True):
    """The second vehicle model's opinion on a cause: a verdict, and its reason in a sentence."""

    opinion: str
    because: str


class CauseSection(NamedTuple):
    """A cause on the page.

    `end` says how the vehicle with this cause ends. All changes scaled to `fraction` are still unsafe; `state_below` is the state just
    below. `handle` names a failure with this cause, `replay_anchor` its replay; `reason` and `robustness` describe this failure.
    `cause_robustness` is the robustness of the cause by itself, empty if unknown.
    """

    title: str
    anchor: str
    rows: list[CauseRow]
    end: str
    fraction: float
    state_below: str
    failing: FailingPoints | None
    replay: dict[str, Any]
    handle: str
    replay_anchor: str
    reason: str
    robustness: str
    cause_robustness: str
    opinion: SecondOpinion | None


class Replay(NamedTuple):
    """A solution on the page, with its `replay` if the study can be simulated; `differences` separate a new simulation from the results."""

    handle: str
    anchor: str
    outcome: str
    f_safe: float
    f_diff: float
    f_num_diff: int
    changes: list[ChangeRow]
    is_open: bool
    failing: FailingPoints | None = None
    replay: dict[str, Any] | None = None
    differences: Sequence[str] = ()


def explanations_of(data: ReportInput, jobs: int | None, progress: Progress) -> Explanations:
    """Explain the most important failures, once for these results."""
    *failures, summary = stored_answer(data, "explain", lambda: explain(
        data.case, data.options["explain"], jobs=jobs, progress=progress).to_dict())
    return Explanations(msgspec.convert(failures, list[FailureEntry]), msgspec.convert(summary["summary"], SummaryEntry))


def necessity_chart(summary: SummaryEntry, data: ReportInput) -> Markup | None:
    """A chart of how often failures change each characteristic, and how often they need this change."""
    changed, necessary = summary.changed, summary.necessary
    names = sorted((name for name in necessary if changed.get(name)), key=lambda name: (-necessary[name], -changed[name], name))
    if not names:
        return None
    bars = [[Bar(0, changed[name], "weak", f"{name}: changed in {changed[name]:.0%} of the failures"),
             Bar(0, necessary[name], "hit", f"{name}: needed in {necessary[name]:.0%} of the failures")] for name in names]
    ends = [("", f"needed {necessary[name]:.0%}{_interval(*summary.necessary_interval[name])}, changed {changed[name]:.0%}")
            for name in names]
    description = f"{data.case.name}: how often a characteristic is needed for a failure, beside how often it is changed"
    return bar_chart(description, names, bars, [None] * len(names), ends)


def _interval(low: float, high: float) -> str:
    """The 95 % interval of a share, in a text; empty if all failures were analysed."""
    return f" ({low:.0%} to {high:.0%})" if low < high else ""


def causes(failures: Sequence[FailureEntry], data: ReportInput) -> list[CauseSection]:
    """Minimal causes with replays, one for each set of characteristics, ordered by number and size of their changes."""
    smallest: dict[tuple[str, ...], tuple[CauseEntry, FailureEntry]] = {}
    for failure in failures:
        for cause in failure.minimal_causes:
            key = tuple(cause.changes)
            if key and (key not in smallest or _size(data, cause) < _size(data, smallest[key][0])):
                smallest[key] = cause, failure
    selection = sorted(smallest.values(), key=lambda entry: _size(data, entry[0]))[:MAX_CAUSES]
    if not selection:
        return []
    data.simulate_again([data.setting_with(cause.changes) for cause, _ in selection])
    opinions = [None] * len(selection) if no_opinion(data) else _opinions(data, selection)
    return [_section(data, number, *entry, opinion) for number, (entry, opinion) in enumerate(zip(selection, opinions, strict=True), 1)]


def no_opinion(data: ReportInput) -> str:
    """Why there is no second opinion on causes, in a sentence; empty if there is one."""
    try:
        assemble_both_systems(data.case.study)
    except InputError as error:
        return f"No second opinion on these causes: {error.problem}; expected: {error.legal}."
    return ""


def _opinions(data: ReportInput, selection: Sequence[tuple[CauseEntry, FailureEntry]]) -> list[SecondOpinion]:
    """Ask the second vehicle model for its opinion on each cause, once for these results."""
    causes = [CauseToJudge(failure.handle or None, cause.changes, cause.fraction) for cause, failure in selection]
    opinions = stored_answer(data, "opinion", lambda: judge_causes(data.case.study, causes, data.case.unsafe).to_dict())
    return msgspec.convert(opinions, list[SecondOpinion])


def _size(data: ReportInput, cause: CauseEntry) -> tuple[int, float]:
    setting = data.setting_with(cause.boundary)
    return len(cause.changes), float(data.case.characteristics.largest_change(setting[np.newaxis])[0])


def _section(data: ReportInput, rank: int, cause: CauseEntry, failure: FailureEntry, opinion: SecondOpinion | None) -> CauseSection:
    """A cause on the page; `rank` counts causes from 1."""
    setting = data.setting_with(cause.changes)
    members = {member.name: member for member in data.case.characteristics}
    change_rows = [CauseRow(name, members[name].short_name, members[name].words, *(
        f"{number(quantity)}{spaced(members[name].unit)}" for quantity in (members[name].original, value, cause.boundary[name])))
        for name, value in cause.changes.items()]
    comparison = data.compared(setting)
    return CauseSection(
        title=f"Cause {rank}: {', '.join(cause.changes)}", anchor=data.anchor("cause", rank), rows=change_rows,
        end=comparison.verdict(comparison.rows[-1]), fraction=cause.fraction, state_below=cause.end, failing=data.failing_points(setting),
        replay=data.replay(setting), handle=failure.handle, replay_anchor=data.anchor("replay", failure.handle),
        reason=raised(failure.because), robustness=in_words(failure.robustness),
        cause_robustness="" if cause.robustness is None else in_words(cause.robustness), opinion=opinion)


def replays(data: ReportInput, explanations: Explanations | None) -> list[Replay]:
    """The solutions with a replay: `FIRST_CHOICES`, explained solutions, and non-dominated unsafe solutions."""
    entries, handles = [], _select_handles(data, explanations.failures if explanations else [])
    if data.system is not None and handles:
        data.simulate_again([data.setting_of(handle) for handle in handles])
    for rank, handle in enumerate(handles):
        row, setting = data.solutions[handle], data.setting_of(handle)
        entry = Replay(handle, data.anchor("replay", handle), row["outcome"], row["f_safe"], row["f_diff"], row["f_num_diff"],
                       data.changes(setting), is_open=rank == 0 and not (explanations and explanations.failures))
        entries.append(entry if data.system is None else entry._replace(
            replay=data.replay(setting), failing=data.failing_points(setting),
            differences=differences(data.simulate_again([setting])[0].evaluation, row)))
    return sorted(entries, key=lambda entry: (entry.f_safe, entry.handle))


def _select_handles(data: ReportInput, failures: Sequence[FailureEntry]) -> list[str]:
    """Handles of the solutions with a replay, without repetition."""
    if data.case.solutions.empty:
        return []
    choices = FIRST_CHOICES if any(data.unsafe_solutions) else FIRST_CHOICES[-1:]
    selection = [*map(data.chosen, choices), *(failure.handle for failure in failures if failure.handle)]
    best = front_of([row for row, is_unsafe in zip(data.solutions.values(), data.unsafe_solutions, strict=True) if is_unsafe])
    selection += [best[index]["handle"] for index in evenly_spaced(len(best), MAX_REPLAYS)]
    return list(dict.fromkeys(selection))[:max(MAX_REPLAYS, len(choices) + len(failures))]


def front_of(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The solutions that no other solution dominates in the three objectives; one solution for each point."""
    if not rows:
        return []
    points = np.array([[row[name] for name in OBJECTIVES] for row in rows], dtype=float)
    best = {tuple(point) for point in nondominated_points(points).tolist()}
    by_point = {tuple(point): row for point, row in zip(points.tolist(), rows, strict=True) if tuple(point) in best}
    return list(by_point.values())


def evenly_spaced(number: int, limit: int) -> list[int]:
    """Evenly spaced indices of `number` items, at most `limit`."""
    return sorted({round(index) for index in np.linspace(0, number - 1, min(number, limit)).tolist()})
