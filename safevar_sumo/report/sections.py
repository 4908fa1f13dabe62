"""The sections of a page: the verdict and its causes, with second opinions and replays; what was tested; and how far
the findings hold and agree with published data.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from safevar_sumo.ads import ADS
from safevar_sumo.analysis.explain.answer import Explained
from safevar_sumo.analysis.explain.causes import Cause
from safevar_sumo.analysis.explain.failure import ROBUST, Explanation
from safevar_sumo.analysis.explain.robustness import MIN_ROBUST_SHARE
from safevar_sumo.analysis.model_spread import compute_model_spreads
from safevar_sumo.analysis.opinion.compute import Opinion, assemble_both_systems, judge_causes
from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES
from safevar_sumo.analysis.tolerance.answer import Tolerance
from safevar_sumo.analysis.words import number_of, points_in_words, question_command
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import KMH_PER_MS, JsonObject, Outcome
from safevar_sumo.reference import Totals, shipped_totals_of
from safevar_sumo.replay.comparison import format_number, list_differences, quantity_text, superscript_powers
from safevar_sumo.report.input import ReportInput
from safevar_sumo.results import read_manifest
from safevar_sumo.scenarios import SCENARIOS, distance_in_words, equals_clear, pre_crash_sentence
from safevar_sumo.study import SAFETY_DEGREE, Study, unit_text
from safevar_sumo.sumo.matrix import vehicle_remarks
from safevar_sumo.terminal import Progress
from safevar_sumo.vehicles import VEHICLES

MAX_CAUSES = 6
"""Maximum number of minimal causes in a report."""
FIRST_CHOICES = ("fewest", "smallest", "most_severe")
"""Choices that select the first solutions on the page, as the flags of `simulate` do."""
NO_VALUE = "–"  # noqa: RUF001


def make_verdict(data: ReportInput, explained: Explained | None, tolerance: Tolerance | None) -> JsonObject:
    """The verdict: the sentences of `explain`, key figures, and the commands that repeat the study and the failure."""
    commands = [question_command(name, str(data.directory), data.point) for name in ("explain", "tolerance")]
    if explained is None:
        return {"sentences": ["No solution was found."], "is_bad": False, "key_figures": [], "commands": commands}
    sentences = [explained.no_verdict] if explained.no_verdict else explained.verdict
    if explained.choices and explained.choices[0].handle:
        simulate = question_command("simulate", str(data.directory), data.point)
        commands.append(f"{simulate} --solution {explained.choices[0].name} --plot it.png")
    return {
        "sentences": [*sentences, explained.counts],
        "is_bad": explained.failures > 0,
        "key_figures": _key_figures(data, explained, tolerance),
        "commands": commands,
    }


def describe_failure(data: ReportInput, failure: Explanation) -> JsonObject:
    """A failure that the verdict names: its effect, size and changes."""
    setting, matrix = np.array(list(failure.setting.values())), data.system.matrix
    largest = float(data.case.characteristics.largest_change(setting[np.newaxis])[0])
    return {
        "failure": failure,
        "effect": failure.effect,
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
        "reason": superscript_powers(str(failure.because)),
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


GENERAL_LIMITS = (
    "A search that finds no failure proves nothing about the settings that it did not try.",
    "One vehicle in its lane: no steering beyond lane keeping, no separate wheels and axles, no suspension, no wind, "
    "no sensor noise, no traffic beyond the scenario's own, unless the study says otherwise.",
    "Driving system and vehicle are models: how far they agree with published data is told where there is any.",
)


def describe_tested_system(data: ReportInput) -> JsonObject:
    """Describe the tested vehicle, driving system and scenario, and the search, in sentences.

    `characteristics` holds name, unit, original, lower, upper, threshold and meaning of each.
    """
    case, study = data.case, data.case.study
    return {
        "subject": f"Vehicle: {_name_and_sentence(VEHICLES, study.vehicle.model)}, "
        f"{number_of(len(case.characteristics), 'varied characteristic')}. "
        f"Driving system: {_name_and_sentence(ADS, study.ads.model)}. "
        f"Scenario: {_name_and_sentence(SCENARIOS, study.scenario.model)}; {describe_conditions(data)}.",
        "tags": pre_crash_sentence(data.system.points),
        "search": _describe_search(data),
        "characteristics": [
            (
                item.name,
                superscript_powers(unit_text(item.unit, "{}")),
                *map(format_number, (item.original, item.lower, item.upper, item.threshold)),
                item.words,
            )
            for item in case.characteristics
        ],
        "remarks": [*case.remarks, *vehicle_remarks(data.system)],
    }


def describe_conditions(data: ReportInput) -> str:
    """Describe the weather or, by test, the points of the matrix."""
    points = data.system.matrix
    if data.point:
        return f"only at the point {data.point} of its matrix, at which all solutions are simulated again"
    if not points:
        no_effect = " (no effect on road and sensors; a driving system may have other parameters in it)"
        return f"weather: {data.case.weather.name}{no_effect if equals_clear(data.case.weather) else ''}"
    tests = Counter(f"{dict(point.parameters)['test']}, {point.weather.name}" for point in points)
    described = "; ".join(f"{test}: {number_of(count, 'point')}" for test, count in tests.items())
    return f"every vehicle at all {len(points)} points of a matrix ({described})"


def _describe_search(data: ReportInput) -> str:
    case, search = data.case, data.case.study.search
    versions = ", ".join(f"{name} {value}" for name, value in read_manifest(data.directory)["versions"].items())
    if not case.has_runs:
        return f"The {len(case.solutions)} solutions are imported ({versions})."
    runs = Counter(algorithm for algorithm, _ in case.finished_runs)
    names = [f"{ALGORITHM_TITLES.get(name, name)} ({number_of(count, 'run')})" for name, count in runs.items()]
    return (
        f"Searched by {', '.join(names) or 'no finished run'} of at most {search.evaluations} simulations each, "
        f"{len(case.evaluations)} different vehicles in all, from seed {search.seed}, with {versions}."
    )


def _name_and_sentence(models: Mapping[str, Any], name: str) -> str:
    """A model's name with the first sentence of its description; user code has the name alone."""
    if name not in models:
        return name
    first_line = (models[name].__doc__ or "").strip().partition("\n")[0]
    return f"{name} ({first_line.rstrip('.')})"


def describe_agreement(study: Study) -> str:
    """How well a study agrees with each file of published data, in sentences."""
    totals = shipped_totals_of(study)
    if not totals:
        return (
            "This study was not compared with published data: whether another simulator or a real vehicle behaves in "
            "the same way is unknown."
        )
    by_collisions = sorted(totals.items(), key=lambda item: (-item[1].collisions["reference"], -item[1].rows))
    sentences = (_agreement_sentence(file, entry) for file, entry in by_collisions)
    return f"Agreement with published data. {' '.join(sentences)}"


def _agreement_sentence(file: str, totals: Totals) -> str:
    counts, parts = totals.collisions, [f"{file}, {totals.rows} vehicles simulated again"]
    if (rho := totals.spearman.get(SAFETY_DEGREE)) is not None:
        parts.append(f"the rank correlation of the safety degrees is {rho:.2f} (1: the same order, 0: none)")
    if (error := totals.mean_absolute_error.get(SAFETY_DEGREE)) is not None:
        parts.append(f"their mean error is {error:.2f} m")
    if totals.recall is not None:
        published = f"{counts['both']} of the {counts['reference']} published collisions collide here too"
        parts.append(f"{published} (recall {totals.recall:.2f})")
    if totals.precision is not None:
        here = f"{counts['both']} of the {counts['here']} collisions here are published ones"
        parts.append(f"{here} (precision {totals.precision:.2f})")
    return f"{'; '.join(parts)}."


def describe_limits(data: ReportInput, explained: Explained | None) -> JsonObject:
    """Describe how far the findings of one study hold, and how well it agrees with published data.

    `published` lists metrics of the original vehicle: name, published value, value here. `spread` lists vehicles: name,
    safety degree here, safety degrees with the study's other parameter sets.
    """
    case, failures = data.case, explained.explanations if explained else ()
    published = [
        (name, case.study.published[name], case.original[name])
        for name in METRICS
        if name in case.study.published and not math.isnan(case.original[name])
    ]
    remarks = []
    for outcome, words in (
        (Outcome.SIMULATOR_ERROR, "could not be simulated; no result contains them"),
        (
            Outcome.INVALID_TEST,
            "left the tolerance of a test's speed before the driving system acted: they are neither failures nor "
            "successes",
        ),
    ):
        if count := int((case.evaluations["outcome"] == str(outcome)).sum()):
            remarks.append(f"{count} of {len(case.evaluations)} settings {words}.")
    if failures:
        borderline = sum(failure.robustness.borderline for failure in failures)
        remarks.append(
            f"{borderline} of {len(failures)} failures analysed are borderline: fewer than "
            f"{100 * MIN_ROBUST_SHARE:.0f} % of their neighbours are unsafe too."
        )
    if not published:
        remarks.append("There are no published values of the original vehicle to compare the study with.")
    spread = []
    if case.study.spread:
        handles = data.select_handles(*FIRST_CHOICES) if data.any_unsafe else []
        settings = [case.characteristics.original, *map(data.setting_of, handles)]
        degrees = [case.original[SAFETY_DEGREE], *(data.solutions[handle]["f_safe"] for handle in handles)]
        spreads = compute_model_spreads(case.study, np.stack(settings), data.point)
        spread = list(zip(("original vehicle", *handles), degrees, spreads, strict=True))
    return {"remarks": remarks, "published": published, "spread": spread}
