"""The section on causes: minimal causes of failures and selected solutions, with their replays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from markupsafe import Markup

from safevar_sumo.analysis.explain.compute import explain_failures
from safevar_sumo.analysis.explain.result import CauseEntry, FailureEntry, SummaryEntry, most_robust
from safevar_sumo.analysis.explain.robustness import robustness_in_words
from safevar_sumo.analysis.opinion.compute import CauseToJudge, assemble_both_systems, judge_causes
from safevar_sumo.analysis.opinion.result import Opinion
from safevar_sumo.analysis.research_questions.indicators import nondominated_points
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import PUBLISHED_SCORING
from safevar_sumo.progress import Progress
from safevar_sumo.replay.comparison import list_differences, quantity_text, superscript_powers
from safevar_sumo.report.input import ChangeRow, FailingPointsTable, ReportInput, load_or_compute
from safevar_sumo.report.svg import Bar, draw_bars

MAX_CAUSES = 6
"""Maximum number of minimal causes in a report."""
MAX_REPLAYS = 10
"""Maximum number of solutions with a replay in a report, unless there are more explained failures."""
SIMULATIONS_PER_REPLAY = 500
"""Number of simulations that take as long as a replay."""
FIRST_CHOICES = ("fewest", "smallest", "most_severe")
"""Choices that select the first solutions on the page, as the flags of `simulate` do."""
OBJECTIVES = [objective.name for objective in PUBLISHED_SCORING.objectives]


class Explanations(NamedTuple):
    """The answer of `explain`: the most important failures, and a summary of all analysed failures."""

    failures: list[FailureEntry]
    summary: SummaryEntry


class CauseRow(NamedTuple):
    """A change in a cause: the characteristic, its short name, its description, and three values with their unit."""

    name: str
    short_name: str
    description: str
    original: str
    value: str
    boundary: str


class CauseSection(NamedTuple):
    """A cause on the page.

    `end` says how a simulation with this cause alone ends. All changes scaled to `fraction` are still unsafe; `state_below` says what
    slightly smaller changes are. `handle` names a failure that contains the cause; `replay_anchor`, `reason` and `robustness` belong
    to this failure. `cause_robustness` is the robustness of the cause by itself, empty if unknown.
    """

    title: str
    anchor: str
    rows: list[CauseRow]
    end: str
    fraction: float
    state_below: str
    failing_points: FailingPointsTable | None
    player_data: dict[str, Any]
    handle: str
    replay_anchor: str
    reason: str
    robustness: str
    cause_robustness: str
    opinion: Opinion | None


class ReplayedSolution(NamedTuple):
    """A solution on the page, with its animation if the study can be simulated; `differences` of a new simulation from the results."""

    handle: str
    anchor: str
    outcome: str
    f_safe: float
    f_diff: float
    f_num_diff: int
    changes: list[ChangeRow]
    is_open: bool
    failing_points: FailingPointsTable | None = None
    player_data: dict[str, Any] | None = None
    differences: Sequence[str] = ()


def explain_main_failures(data: ReportInput, jobs: int | None, progress: Progress) -> Explanations:
    """Explain the most important failures, once for these results."""
    *failures, summary = load_or_compute(data, "explain", lambda: explain_failures(
        data.case, data.options["explain"], jobs=jobs, progress=progress).to_dict())
    return Explanations(msgspec.convert(failures, list[FailureEntry]), msgspec.convert(summary["summary"], SummaryEntry))


def draw_necessity(summary: SummaryEntry, data: ReportInput) -> Markup | None:
    """Draw how often failures change each characteristic, and how often they need this change."""
    changed, necessary = summary.changed, summary.necessary
    names = sorted((name for name in necessary if changed.get(name)), key=lambda name: (-necessary[name], -changed[name], name))
    if not names:
        return None
    bars = [[Bar(0, changed[name], "weak", f"{name}: changed in {100 * changed[name]:.0f} % of the failures"),
             Bar(0, necessary[name], "hit", f"{name}: needed in {100 * necessary[name]:.0f} % of the failures")] for name in names]
    end_labels = [("", f"needed {100 * necessary[name]:.0f} %{_interval_text(*summary.necessary_interval[name])}, "
                       f"changed {100 * changed[name]:.0f} %") for name in names]
    description = f"{data.case.name}: how often a characteristic is needed for a failure, beside how often it is changed"
    return draw_bars(description, names, bars, [None] * len(names), end_labels)


def _interval_text(low: float, high: float) -> str:
    """The 95 % interval of a share, as text; empty if all failures were analysed."""
    return f" ({100 * low:.0f} % to {100 * high:.0f} %)" if low < high else ""


def make_cause_sections(failures: Sequence[FailureEntry], data: ReportInput) -> list[CauseSection]:
    """Make a section for the smallest minimal cause of each set of characteristics.

    The first is the cause that the verdict names; the others follow in order of their robustness, then of the number and size of changes.
    """
    smallest: dict[tuple[str, ...], tuple[CauseEntry, FailureEntry]] = {}
    for failure in failures:
        for cause in failure.minimal_causes:
            key = tuple(cause.changes)
            if key and (key not in smallest or _size_of_changes(data, cause) < _size_of_changes(data, smallest[key][0])):
                smallest[key] = cause, failure
    if not smallest:
        return []
    named = most_robust(failures[0].minimal_causes)
    if named is not None and named.changes:
        smallest[tuple(named.changes)] = named, failures[0]
    selection = sorted(smallest.values(), key=lambda entry: (entry[0] is not named, -(entry[0].robustness or 0.0),
                                                             _size_of_changes(data, entry[0])))[:MAX_CAUSES]
    data.simulate_again([data.setting_with(cause.changes) for cause, _ in selection])
    opinions = [None] * len(selection) if reason_without_opinion(data) else _ask_opinions(data, selection)
    return [_make_cause_section(data, rank, cause, failure, opinion)
            for rank, ((cause, failure), opinion) in enumerate(zip(selection, opinions, strict=True), 1)]


def reason_without_opinion(data: ReportInput) -> str:
    """Why there is no second opinion on causes, in a sentence; empty if there is one."""
    try:
        assemble_both_systems(data.case.study)
    except InputError as error:
        return f"No second opinion on these causes: {error.problem}; expected: {error.legal}."
    return ""


def _ask_opinions(data: ReportInput, selection: Sequence[tuple[CauseEntry, FailureEntry]]) -> list[Opinion]:
    """Ask the second vehicle model for its opinion on each cause, once for these results."""
    judged_causes = [CauseToJudge(failure.handle or None, cause.changes, cause.fraction, cause.robustness) for cause, failure in selection]
    opinions = load_or_compute(data, "opinion", lambda: judge_causes(data.case.study, judged_causes, data.case.unsafe).to_dict())
    return msgspec.convert(opinions, list[Opinion])


def _size_of_changes(data: ReportInput, cause: CauseEntry) -> tuple[int, float]:
    """The number of changes in a cause, and the largest of them."""
    setting = data.setting_with(cause.boundary)
    return len(cause.changes), float(data.case.characteristics.largest_change(setting[np.newaxis])[0])


def _make_cause_section(data: ReportInput, rank: int, cause: CauseEntry, failure: FailureEntry, opinion: Opinion | None
                        ) -> CauseSection:
    """Make the section of one cause; `rank` counts causes from 1."""
    setting = data.setting_with(cause.changes)
    change_rows, characteristics = [], {characteristic.name: characteristic for characteristic in data.case.characteristics}
    for name, value in cause.changes.items():
        characteristic = characteristics[name]
        texts = (quantity_text(quantity, characteristic.unit)
                 for quantity in (characteristic.original, value, cause.boundary[name]))
        change_rows.append(CauseRow(name, characteristic.short_name, characteristic.words, *texts))
    comparison = data.compare_with_original(setting)
    return CauseSection(
        title=f"Cause {rank}: {', '.join(cause.changes)}", anchor=data.anchor("cause", rank), rows=change_rows,
        end=comparison.verdict(comparison.rows[-1]), fraction=cause.fraction, state_below=cause.end,
        failing_points=data.failing_points(setting), player_data=data.player_data_of(setting), handle=failure.handle,
        replay_anchor=data.anchor("replay", failure.handle), reason=superscript_powers(failure.because),
        robustness=robustness_in_words(failure.robustness), opinion=opinion,
        cause_robustness="" if cause.robustness is None else robustness_in_words(cause.robustness))


def replay_solutions(data: ReportInput, explanations: Explanations | None,
                     progress: Progress) -> list[ReplayedSolution]:
    """Replay solutions: `FIRST_CHOICES`, explained solutions, and non-dominated unsafe solutions."""
    entries, handles = [], _select_handles(data, explanations.failures if explanations else [])
    if data.system is not None and handles:
        data.simulate_again([data.setting_of(handle) for handle in handles])
    for index, handle in enumerate(handles):
        progress("replays", index * SIMULATIONS_PER_REPLAY, len(handles) * SIMULATIONS_PER_REPLAY)
        row, setting = data.solutions[handle], data.setting_of(handle)
        entry = ReplayedSolution(handle, data.anchor("replay", handle), row["outcome"], row["f_safe"], row["f_diff"],
                                 row["f_num_diff"], data.list_changes(setting),
                                 is_open=index == 0 and not (explanations and explanations.failures))
        entries.append(entry if data.system is None else entry._replace(
            player_data=data.player_data_of(setting), failing_points=data.failing_points(setting),
            differences=list_differences(data.simulate_again([setting])[0].evaluation, row)))
    return sorted(entries, key=lambda entry: (entry.f_safe, entry.handle))


def _select_handles(data: ReportInput, failures: Sequence[FailureEntry]) -> list[str]:
    """Handles of the solutions with a replay, without repetition."""
    if data.case.solutions.empty:
        return []
    choices = FIRST_CHOICES if any(data.unsafe_solutions) else FIRST_CHOICES[-1:]
    selection = [*map(data.select_handle, choices), *(failure.handle for failure in failures if failure.handle)]
    best = nondominated_rows([row for row, is_unsafe in zip(data.solutions.values(), data.unsafe_solutions, strict=True) if is_unsafe])
    selection += [best[index]["handle"] for index in evenly_spaced_indices(len(best), MAX_REPLAYS)]
    return list(dict.fromkeys(selection))[:max(MAX_REPLAYS, len(choices) + len(failures))]


def nondominated_rows(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The solutions that no other solution dominates in the three objectives; one of solutions with equal objectives."""
    if not rows:
        return []
    objectives = np.array([[row[name] for name in OBJECTIVES] for row in rows], dtype=float)
    best = set(map(tuple, nondominated_points(objectives).tolist()))
    rows_by_objectives = {key: row for key, row in zip(map(tuple, objectives.tolist()), rows, strict=True) if key in best}
    return list(rows_by_objectives.values())


def evenly_spaced_indices(count: int, limit: int) -> list[int]:
    """Evenly spaced indices of `count` items, at most `limit` indices."""
    return sorted({round(index) for index in np.linspace(0, count - 1, min(count, limit)).tolist()})
