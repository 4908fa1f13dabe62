"""The sections on the verdict and its causes: failures and their minimal causes, with second opinions and replays."""

from __future__ import annotations

from typing import Any

import numpy as np

from safevar_sumo.analysis.explain.braking_comparison import sentence
from safevar_sumo.analysis.explain.result import Cause, Explained, Explanation
from safevar_sumo.analysis.explain.sentences import ROBUST, counts_in_words, effect_in_words, verdict_in_words
from safevar_sumo.analysis.opinion.compute import CauseToJudge, assemble_both_systems, judge_causes
from safevar_sumo.analysis.opinion.result import Opinion
from safevar_sumo.analysis.research_questions.indicators import nondominated_points
from safevar_sumo.analysis.tolerance.answer import Tolerance
from safevar_sumo.analysis.words import number_of, share_in_words
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import PUBLISHED_SCORING
from safevar_sumo.progress import Progress
from safevar_sumo.replay.comparison import list_differences, quantity_text, superscript_powers
from safevar_sumo.report.input import ReportInput
from safevar_sumo.scenarios import distance_in_words
from safevar_sumo.sumo.system import assemble

MAX_CAUSES = 6
"""Maximum number of minimal causes in a report."""
MAX_REPLAYS = 10
"""Maximum number of solutions with a replay in a report, unless there are more explained failures."""
SIMULATIONS_PER_REPLAY = 500
"""Number of simulations that take as long as a replay."""
FIRST_CHOICES = ("fewest", "smallest", "most_severe")
"""Choices that select the first solutions on the page, as the flags of `simulate` do."""
OBJECTIVES = [objective.name for objective in PUBLISHED_SCORING.objectives]
NO_VALUE = "–"  # noqa: RUF001
Section = dict[str, Any]


def make_verdict(data: ReportInput, explained: Explained | None, tolerance: Tolerance | None) -> Section:
    """The verdict: the sentences of `explain`, key figures, and the failures that they name."""
    if data.case.solutions.empty:
        return {"sentences": ["No solution was found."], "is_bad": False, "key_figures": [], "failures": []}
    if explained is None:
        unsafe = int(data.case.unsafe.rows(data.case.solutions).sum())
        counts = (
            f"{unsafe} of {number_of(len(data.case.solutions), 'solution')} are unsafe: {data.case.unsafe.description}."
        )
        return {"sentences": [counts, data.problem], "is_bad": data.any_unsafe, "key_figures": [], "failures": []}
    sentences = [data.no_verdict] if data.no_verdict else verdict_in_words(explained)
    return {
        "sentences": [*sentences, counts_in_words(explained)],
        "is_bad": explained.failures > 0,
        "key_figures": _key_figures(explained, tolerance),
        "failures": [_describe_failure(data, failure) for failure in explained.choices],
    }


def _describe_failure(data: ReportInput, failure: Explanation) -> Section:
    setting = np.array(list(failure.setting.values()))
    largest = float(data.case.characteristics.largest_change(setting[np.newaxis])[0])
    size = f"{len(failure.changed)} of {len(setting)} characteristics changed, by at most {100 * largest:.0f} %"
    return {
        "title": failure.title,
        "effect": effect_in_words(failure),
        "robustness": failure.robustness,
        "size": size,
        "handle": failure.name,
        "anchor": data.anchor("replay", failure.name),
        "changes": data.list_changes(setting),
        "failing_points": data.failing_points(setting),
    }


def _key_figures(explained: Explained, tolerance: Tolerance | None) -> list[tuple[str, str, str]]:
    """Title, value and note: robust failure with the fewest changes, severity, preventability, joint tolerance."""
    robust, shares, box = (
        explained.by_reason.get(ROBUST),
        explained.preventability.shares,
        None if tolerance is None else tolerance.joint,
    )
    figures = []
    if robust is None:
        found = "no failure tested is robust" if explained.failures else "nothing is unsafe"
        figures.append(("Robust with the fewest changes", NO_VALUE, found))
    else:
        figures.append(
            ("Robust with the fewest changes", number_of(len(robust.changed), "change"), str(robust.robustness))
        )
    degree = float(explained.nearest.f_safe[0]) if len(explained.nearest) else np.nan
    distance = distance_in_words(assemble(explained.study).points[0].scenario, degree)
    collides = bool(explained.nearest.collided.any())
    figures.append(
        (
            "Most severe",
            f"collision at {-degree:.1f} m/s" if collides else f"safety degree {distance}",
            f"{-3.6 * degree:.0f} km/h" if collides else "no collision among the solutions",
        )
    )
    if shares.competent_driver is None or shares.interval_competent_driver is None:
        figures.append(("A competent driver avoids", NO_VALUE, "there is no collision to avoid"))
    else:
        low, high = shares.interval_competent_driver
        sample = "all" if low == high else f"95 % interval {100 * low:.0f} % to {100 * high:.0f} %;"
        figures.append(
            (
                "A competent driver avoids",
                f"{share_in_words(shares.competent_driver)} of the collisions",
                f"{shares.later}, in the same vehicle ({sample} {shares.looked_at} collisions analysed)",
            )
        )
    note = (
        "not computed"
        if box is None
        else "no box around the original is safe"
        if not box.factor
        else (f"from the original to the ends of their domains; none of {box.samples} vehicles sampled there is unsafe")
    )
    value = f"{100 * box.factor:.1f} % of the way" if box and box.factor else NO_VALUE
    return [*figures, ("Joint tolerance of all characteristics", value, note)]


def make_cause_sections(data: ReportInput, explained: Explained) -> list[Section]:
    """A section for the smallest minimal cause of each set of characteristics.

    The first is the cause that the verdict names; the others follow in order of their robustness, then of their size.
    """

    def size(cause: Cause) -> tuple[int, float]:
        setting = data.case.characteristics.setting(cause.boundary, "cause", beyond=True)
        return len(cause.changes), float(data.case.characteristics.largest_change(setting[np.newaxis])[0])

    smallest: dict[tuple[str, ...], tuple[Cause, Explanation]] = {}
    for failure in explained.explanations:
        for cause in failure.causes:
            key = tuple(cause.changes)
            if key and (key not in smallest or size(cause) < size(smallest[key][0])):
                smallest[key] = cause, failure
    named = explained.explanations[0].cause if explained.explanations else None
    if named is not None and named.changes:
        smallest[tuple(named.changes)] = named, explained.explanations[0]
    order = sorted(
        smallest.values(), key=lambda pair: (pair[0] is not named, -(pair[0].robustness or 0.0), size(pair[0]))
    )
    selection = order[:MAX_CAUSES]
    opinions: tuple[Opinion | None, ...] = (None,) * len(selection)
    if selection and not reason_without_opinion(data):
        judged = [
            CauseToJudge(failure.name, cause.changes, cause.fraction, cause.robustness) for cause, failure in selection
        ]
        opinions = judge_causes(data.case.study, judged, explained.unsafe).opinions
    return [
        _make_cause_section(data, rank, *pair, opinion)
        for rank, (pair, opinion) in enumerate(zip(selection, opinions, strict=True), 1)
    ]


def _make_cause_section(
    data: ReportInput, rank: int, cause: Cause, failure: Explanation, opinion: Opinion | None
) -> Section:
    setting = data.case.characteristics.setting(cause.changes, "cause", beyond=True)
    comparison = data.compare_with_original(setting)
    rows = [
        (
            item.name,
            item.short_name,
            item.words,
            *(
                quantity_text(value, item.unit)
                for value in (item.original, cause.changes[item.name], cause.boundary[item.name])
            ),
        )
        for item in data.case.characteristics
        if item.name in cause.changes
    ]
    return {
        "title": f"Cause {rank}: {', '.join(cause.changes)}",
        "anchor": data.anchor("cause", rank),
        "cause": cause,
        "failure": failure,
        "rows": rows,
        "end": comparison.verdict(comparison.rows[-1]),
        "opinion": opinion,
        "reason": superscript_powers(sentence(failure.because)),
        "failing_points": data.failing_points(setting),
        "player_data": data.player_data_of(setting),
        "replay_anchor": data.anchor("replay", failure.name),
    }


def reason_without_opinion(data: ReportInput) -> str:
    """Why there is no second opinion on causes, in a sentence; empty if there is one."""
    try:
        assemble_both_systems(data.case.study)
    except InputError as error:
        return f"No second opinion on these causes: {error.problem}; expected: {error.legal}."
    return ""


def replay_solutions(data: ReportInput, explained: Explained | None, progress: Progress) -> list[Section]:
    """Replay solutions: `FIRST_CHOICES`, explained solutions, and non-dominated unsafe solutions."""
    failures = [failure.name for failure in explained.explanations if failure.handle] if explained else []
    unsafe = data.case.unsafe.rows(data.case.solutions).tolist() if data.any_unsafe else [False] * len(data.solutions)
    best = nondominated_rows([row for row, is_unsafe in zip(data.solutions.values(), unsafe, strict=True) if is_unsafe])
    handles = list(
        dict.fromkeys(
            [
                *data.select_handles(*FIRST_CHOICES),
                *failures,
                *(best[index]["handle"] for index in evenly_spaced_indices(len(best), MAX_REPLAYS)),
            ]
        )
    )
    entries, handles = list[Section](), handles[: max(MAX_REPLAYS, len(FIRST_CHOICES) + len(failures))]
    for index, handle in enumerate(handles):
        progress("replays", index * SIMULATIONS_PER_REPLAY, len(handles) * SIMULATIONS_PER_REPLAY)
        row, setting = data.solutions[handle], data.setting_of(handle)
        again = (
            {}
            if data.system is None
            else {
                "player_data": data.player_data_of(setting),
                "failing_points": data.failing_points(setting),
                "differences": list_differences(data.compare_with_original(setting).evaluations.take([-1]), row),
            }
        )
        entries.append(
            {
                **row,
                "anchor": data.anchor("replay", handle),
                "changes": data.list_changes(setting),
                "player_data": None,
                "failing_points": None,
                "differences": [],
                "is_open": not failures and not entries,
                **again,
            }
        )
    return sorted(entries, key=lambda entry: (entry["f_safe"], entry["handle"]))


def nondominated_rows(rows: list[Section]) -> list[Section]:
    """The solutions that no other solution dominates in the three objectives; one of solutions with equal
    objectives.
    """
    if not rows:
        return []
    objectives = np.array([[row[name] for name in OBJECTIVES] for row in rows], dtype=float)
    best = set(map(tuple, nondominated_points(objectives).tolist()))
    rows_by_objectives = {
        key: row for key, row in zip(map(tuple, objectives.tolist()), rows, strict=True) if key in best
    }
    return list(rows_by_objectives.values())


def evenly_spaced_indices(count: int, limit: int) -> list[int]:
    """Evenly spaced indices of `count` items, at most `limit` indices."""
    return sorted({round(index) for index in np.linspace(0, count - 1, min(count, limit)).tolist()})
