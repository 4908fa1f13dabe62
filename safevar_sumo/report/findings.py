"""Minimal causes of failures, and selected solutions, each with its replay."""

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
from safevar_sumo.analysis.opinion.compute import JudgedCause, opinions_of, second_system
from safevar_sumo.analysis.research_questions.indicators import nondominated
from safevar_sumo.errors import InputError
from safevar_sumo.replay.comparison import differences, number, raised, spaced
from safevar_sumo.report.input import ChangeRow, FailingPlaces, ReportInput, stored_answer
from safevar_sumo.report.svg import Bar, rows

CAUSES = 6
"""Maximum number of minimal causes in a report."""
REPLAYS = 10
"""Maximum number of solutions with a replay in a report, unless explained failures are more."""
FIRST = ("fewest", "smallest", "most_severe")
"""Choices that are shown first."""
OBJECTIVES = ["f_safe", "f_diff", "f_num_diff"]


class Explanations(NamedTuple):
    """The answer of `explain`: the failures that matter, and the shares of all analysed failures."""

    failures: list[FailureEntry]
    summary: SummaryEntry


class CauseRow(NamedTuple):
    """A change of a cause: characteristic, its short and long description, and its values with their unit."""

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

    `end` tells how its run ends; scaled to `fraction` all changes are still unsafe, `below` is the state just below. `handle` is that of a
    failure with this cause, `whole` the anchor of its replay; `because` and `robustness` describe the whole failure, `alone` is the
    robustness of the cause by itself, empty if it is not known.
    """

    title: str
    anchor: str
    rows: list[CauseRow]
    end: str
    fraction: float
    below: str
    where: FailingPlaces | None
    replay: dict[str, Any]
    handle: str
    whole: str
    because: str
    robustness: str
    alone: str
    opinion: SecondOpinion | None


class Replay(NamedTuple):
    """A solution on the page, with its `replay` if the study can be simulated; `differences` are those from the results."""

    handle: str
    anchor: str
    outcome: str
    f_safe: float
    f_diff: float
    f_num_diff: int
    changes: list[ChangeRow]
    open: bool
    where: FailingPlaces | None = None
    replay: dict[str, Any] | None = None
    differences: Sequence[str] = ()


def explanations(data: ReportInput, jobs: int | None, progress: Progress) -> Explanations:
    """The failures that matter with their explanations, computed once for these results."""
    *failures, last = stored_answer(data, "explain", lambda: explain(
        data.case, data.options["explain"], jobs=jobs, progress=progress).to_dict())
    return Explanations(msgspec.convert(failures, list[FailureEntry]), msgspec.convert(last["summary"], SummaryEntry))


def necessity_chart(summary: SummaryEntry, data: ReportInput) -> Markup | None:
    """A chart of how often failures change each characteristic, and how often they need the change."""
    changed, necessary = summary.changed, summary.necessary
    names = sorted((name for name in necessary if changed.get(name)), key=lambda name: (-necessary[name], -changed[name], name))
    if not names:
        return None
    bars = [[Bar(0, changed[name], "weak", f"{name}: changed in {changed[name]:.0%} of the failures"),
             Bar(0, necessary[name], "hit", f"{name}: needed in {necessary[name]:.0%} of the failures")] for name in names]
    ends = [("", f"needed {necessary[name]:.0%}{_interval(*summary.necessary_interval[name])}, changed {changed[name]:.0%}")
            for name in names]
    description = f"{data.case.name}: how often a characteristic is needed for a failure, beside how often it is changed"
    return rows(description, names, bars, [None] * len(names), ends)


def _interval(low: float, high: float) -> str:
    """A sample's 95 % interval; empty if all failures were analysed."""
    return f" ({low:.0%} to {high:.0%})" if low < high else ""


def causes(failures: Sequence[FailureEntry], data: ReportInput) -> list[CauseSection]:
    """The distinct minimal causes with replays, in the order of the number and size of their changes."""
    distinct: dict[tuple[str, ...], tuple[CauseEntry, FailureEntry]] = {}
    for failure in failures:
        for cause in failure.minimal_causes:
            key = tuple(cause.changes)
            if key and (key not in distinct or _size(data, cause) < _size(data, distinct[key][0])):
                distinct[key] = cause, failure
    ordered = sorted(distinct.values(), key=lambda entry: _size(data, entry[0]))[:CAUSES]
    if not ordered:
        return []
    data.simulate_again([data.setting_with(cause.changes) for cause, _ in ordered])
    opinions = [None] * len(ordered) if no_opinion(data) else _opinions(data, ordered)
    return [_section(data, number, *entry, opinion) for number, (entry, opinion) in enumerate(zip(ordered, opinions, strict=True), 1)]


def no_opinion(data: ReportInput) -> str:
    """Why there is no second opinion on causes, in a sentence; empty if there is one."""
    try:
        second_system(data.case.study)
    except InputError as error:
        return f"No second opinion on these causes: {error.problem}; expected: {error.legal}."
    return ""


def _opinions(data: ReportInput, ordered: Sequence[tuple[CauseEntry, FailureEntry]]) -> list[SecondOpinion]:
    """The second vehicle model's opinion on each cause, computed once for these results."""
    causes = [JudgedCause(failure.handle or None, cause.changes, cause.fraction) for cause, failure in ordered]
    opinions = stored_answer(data, "opinion", lambda: opinions_of(data.case.study, causes, data.case.unsafe).to_dict())
    return msgspec.convert(opinions, list[SecondOpinion])


def _size(data: ReportInput, cause: CauseEntry) -> tuple[int, float]:
    setting = data.setting_with(cause.boundary)
    return len(cause.changes), float(data.case.characteristics.largest_change(setting[np.newaxis])[0])


def _section(data: ReportInput, place: int, cause: CauseEntry, failure: FailureEntry, opinion: SecondOpinion | None) -> CauseSection:
    """A cause on the page; `place` is its number, from 1."""
    setting = data.setting_with(cause.changes)
    members = {member.name: member for member in data.case.characteristics}
    table = [CauseRow(name, members[name].short_name, members[name].words, *(
        f"{number(shown)}{spaced(members[name].unit)}" for shown in (members[name].original, value, cause.boundary[name])))
        for name, value in cause.changes.items()]
    comparison = data.compared(setting)
    return CauseSection(
        title=f"Cause {place}: {', '.join(cause.changes)}", anchor=data.anchor("cause", place), rows=table,
        end=comparison.verdict(comparison.rows[-1]), fraction=cause.fraction, below=cause.end, where=data.where(setting),
        replay=data.replay(setting), handle=failure.handle, whole=data.anchor("replay", failure.handle), because=raised(failure.because),
        robustness=in_words(failure.robustness), alone="" if cause.robustness is None else in_words(cause.robustness), opinion=opinion)


def replays(data: ReportInput, explained: Explanations | None) -> list[Replay]:
    """The solutions with a replay: the choices of `FIRST`, explained ones, and non-dominated unsafe ones."""
    entries, handles = [], _chosen(data, explained.failures if explained else [])
    if data.system is not None and handles:
        data.simulate_again([data.setting_of(handle) for handle in handles])
    for place, handle in enumerate(handles):
        row, setting = data.solutions[handle], data.setting_of(handle)
        entry = Replay(handle, data.anchor("replay", handle), row["outcome"], row["f_safe"], row["f_diff"], row["f_num_diff"],
                       data.changes(setting), open=place == 0 and not (explained and explained.failures))
        entries.append(entry if data.system is None else entry._replace(
            replay=data.replay(setting), where=data.where(setting),
            differences=differences(data.simulate_again([setting])[0].evaluation, row)))
    return sorted(entries, key=lambda entry: (entry.f_safe, entry.handle))


def _chosen(data: ReportInput, failures: Sequence[FailureEntry]) -> list[str]:
    """Handles of the solutions with a replay, each once."""
    if data.case.solutions.empty:
        return []
    choices = FIRST if any(data.unsafe_solutions) else FIRST[-1:]
    chosen = [*map(data.chosen, choices), *(failure.handle for failure in failures if failure.handle)]
    best = best_of([row for row, is_unsafe in zip(data.solutions.values(), data.unsafe_solutions, strict=True) if is_unsafe])
    chosen += [best[index]["handle"] for index in evenly_spaced(len(best), REPLAYS)]
    return list(dict.fromkeys(chosen))[:max(REPLAYS, len(choices) + len(failures))]


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
