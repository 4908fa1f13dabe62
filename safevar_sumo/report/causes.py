"""The sections on the verdict and its causes: failures and their minimal causes, with second opinions and replays."""

from __future__ import annotations

import numpy as np

from safevar_sumo.analysis.explain.braking_comparison import sentence
from safevar_sumo.analysis.explain.causes import Cause
from safevar_sumo.analysis.explain.result import Explained, Explanation
from safevar_sumo.analysis.explain.sentences import ROBUST, counts_in_words, effect_in_words, verdict_in_words
from safevar_sumo.analysis.opinion.compute import Opinion, assemble_both_systems, judge_causes
from safevar_sumo.analysis.tolerance.answer import Tolerance
from safevar_sumo.analysis.words import number_of, points_in_words
from safevar_sumo.errors import InputError
from safevar_sumo.records import KMH_PER_MS, JsonObject
from safevar_sumo.replay.comparison import list_differences, quantity_text, superscript_powers
from safevar_sumo.report.input import ReportInput
from safevar_sumo.scenarios import distance_in_words
from safevar_sumo.terminal import Progress

MAX_CAUSES = 6
"""Maximum number of minimal causes in a report."""
FIRST_CHOICES = ("fewest", "smallest", "most_severe")
"""Choices that select the first solutions on the page, as the flags of `simulate` do."""
NO_VALUE = "–"  # noqa: RUF001


def make_verdict(data: ReportInput, explained: Explained | None, tolerance: Tolerance | None) -> JsonObject:
    """The verdict: the sentences of `explain`, key figures, and the failures that they name."""
    if explained is None:
        return {"sentences": ["No solution was found."], "is_bad": False, "key_figures": [], "failures": []}
    sentences = [explained.no_verdict] if explained.no_verdict else verdict_in_words(explained)
    return {
        "sentences": [*sentences, counts_in_words(explained)],
        "is_bad": explained.failures > 0,
        "key_figures": _key_figures(data, explained, tolerance),
        "failures": [_describe_failure(data, failure) for failure in explained.choices],
    }


def _describe_failure(data: ReportInput, failure: Explanation) -> JsonObject:
    setting, matrix = np.array(list(failure.setting.values())), data.system.matrix
    largest = float(data.case.characteristics.largest_change(setting[np.newaxis])[0])
    return {
        "failure": failure,
        "effect": effect_in_words(failure),
        "size": f"{len(failure.changed)} of {len(setting)} characteristics changed, by at most {100 * largest:.0f} %",
        "anchor": data.anchor("replay", failure.name),
        "changes": data.list_changes(setting),
        "points": points_in_words(failure.points, len(matrix)) if matrix and not data.point else "",
    }


def _key_figures(data: ReportInput, explained: Explained, tolerance: Tolerance | None) -> list[tuple[str, str, str]]:
    """Title, value and note: robust failure with the fewest changes, severity, preventability, joint tolerance."""
    robust, preventability = explained.by_reason.get(ROBUST), explained.preventability
    degree, factor = float(explained.nearest.f_safe[0]), 0.0 if tolerance is None else tolerance.joint.factor
    severity = f"safety degree {distance_in_words(data.system.points[0].scenario, degree)}", "no collision"
    if explained.nearest.collided[0]:
        severity = f"collision at {-degree:.1f} m/s", f"{-KMH_PER_MS * degree:.0f} km/h"
    return [
        (
            "Robust with the fewest changes",
            number_of(len(robust.changed), "change") if robust else NO_VALUE,
            str(robust.robustness) if robust else "no failure tested is robust",
        ),
        ("Most severe", *severity),
        (
            "A competent driver avoids",
            preventability.range_in_words if preventability.looked_at else NO_VALUE,
            f"in the same vehicle; {number_of(preventability.looked_at, 'collision')} analysed",
        ),
        (
            "Joint tolerance of all characteristics",
            f"{100 * factor:.1f} % of the way" if factor else NO_VALUE,
            "not computed" if tolerance is None else "from the original to the ends of their domains",
        ),
    ]


def make_cause_sections(data: ReportInput, explained: Explained) -> list[JsonObject]:
    """A section for one minimal cause of each set of characteristics.

    The first is the cause that the verdict names; the others follow in order of their robustness, then of their size.
    """
    causes = [(cause, failure) for failure in explained.explanations for cause in failure.causes if cause.changes]
    named = explained.explanations[0].cause if causes else None
    causes.sort(key=lambda pair: (pair[0] is not named, -(pair[0].robustness or 0.0), len(pair[0].changes)))
    distinct: dict[tuple[str, ...], tuple[Cause, Explanation]] = {}
    for cause, failure in causes:
        distinct.setdefault(tuple(cause.changes), (cause, failure))
    selection = list(distinct.values())[:MAX_CAUSES]
    opinions: tuple[Opinion | None, ...] = (None,) * len(selection)
    if selection and not reason_without_opinion(data):
        judged = [(failure.name, cause) for cause, failure in selection]
        opinions = judge_causes(data.case.study, judged, explained.unsafe).opinions
    return [
        _make_cause_section(data, rank, *pair, opinion)
        for rank, (pair, opinion) in enumerate(zip(selection, opinions, strict=True), 1)
    ]


def _make_cause_section(
    data: ReportInput, rank: int, cause: Cause, failure: Explanation, opinion: Opinion | None
) -> JsonObject:
    comparison, player = data.play(data.case.characteristics.setting(cause.changes, "cause", beyond=True))
    rows = [
        (item.name, item.short_name, item.words, *(quantity_text(value, item.unit) for value in values))
        for item in data.case.characteristics
        if item.name in cause.changes
        for values in [(item.original, cause.changes[item.name], cause.boundary[item.name])]
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
        "player_data": player,
        "replay_anchor": data.anchor("replay", failure.name),
    }


def reason_without_opinion(data: ReportInput) -> str:
    """Why there is no second opinion on causes, in a sentence; empty if there is one."""
    try:
        assemble_both_systems(data.case.study)
    except InputError as error:
        return f"No second opinion on these causes: {error.problem}; expected: {error.legal}."
    return ""


def replay_solutions(data: ReportInput, explained: Explained | None, progress: Progress) -> list[JsonObject]:
    """Replay the solutions that `FIRST_CHOICES` select and the explained ones."""
    failures = [failure.name for failure in explained.explanations if failure.handle] if explained else []
    handles, entries = list(dict.fromkeys([*data.select_handles(*FIRST_CHOICES), *failures])), list[JsonObject]()
    for index, handle in enumerate(handles):
        progress("replays", index, len(handles))
        row, setting = data.solutions[handle], data.setting_of(handle)
        comparison, player = data.play(setting)
        entries.append(
            {
                **row,
                "anchor": data.anchor("replay", handle),
                "changes": data.list_changes(setting),
                "player_data": player,
                "differences": list_differences(comparison.evaluations.take([-1]), row),
                "is_open": not failures and not entries,
            }
        )
    return sorted(entries, key=lambda entry: (entry["f_safe"], entry["handle"]))
