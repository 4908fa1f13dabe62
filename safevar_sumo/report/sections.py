"""The sections of a page: the verdict and its causes, with second opinions and replays; what was tested; and how far
the findings hold and agree with published data.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from safevar_sumo.ads import ADS
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.explain.robustness import MIN_ROBUST_SHARE, robustness_in_words
from safevar_sumo.questions.model_spread import compute_model_spreads
from safevar_sumo.questions.opinion import assemble_both_systems, judge_causes
from safevar_sumo.questions.words import number_of, points_in_words, question_command
from safevar_sumo.records import JsonObject, Outcome
from safevar_sumo.reference.agreement import shipped_agreement
from safevar_sumo.replay.comparison import format_number, list_differences
from safevar_sumo.report.input import ReportInput
from safevar_sumo.scenarios import SCENARIOS, equals_clear, pre_crash_sentence
from safevar_sumo.study import SAFETY_DEGREE, Study, unit_text
from safevar_sumo.sumo.matrix import vehicle_remarks
from safevar_sumo.terminal import Progress
from safevar_sumo.vehicles import VEHICLES

MAX_CAUSES = 6
"""Maximum number of minimal causes in a report."""
FIRST_CHOICES = ("fewest", "smallest", "most_severe")
"""Choices that select the first solutions on the page, as the flags of `simulate` do."""


def table_data(frame: pd.DataFrame, title: str, notes: Iterable[str] = ()) -> JsonObject:
    """A frame as the template's table: its index as labels, and the outer level of its columns, if there are two, as
    headings over several columns.
    """
    columns, labels = frame.columns, frame.index.nlevels
    blocks = Counter(columns.get_level_values(0)) if columns.nlevels > 1 else {}
    return {
        "title": title,
        "heads": [] if frame.empty else [*frame.index.names, *columns.get_level_values(-1)],
        "rows": [[*map(_cell_text, row)] for row in frame.reset_index().to_numpy(dtype=object).tolist()],
        "labels": labels,
        "spans": [("", labels), *blocks.items()] if blocks else [],
        "notes": list(notes),
    }


def _cell_text(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(f"{format_number(low)} to {format_number(high)}" for low, high in value)
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return format_number(value) if isinstance(value, float) else str(value)


def make_verdict(data: ReportInput, explained: Answer | None) -> JsonObject:
    """The verdict: the sentences of `explain`, and the commands that repeat the study and the failure."""
    commands = [question_command(name, str(data.directory), data.point) for name in ("explain", "tolerance")]
    if explained is None:
        return {"sentences": ["No solution was found."], "is_bad": False, "commands": commands}
    for handle in explained.tables["solutions"]["solution"].head(1):
        simulate = question_command("simulate", str(data.directory), data.point)
        commands.append(f"{simulate} --solution {handle} --plot it.png")
    return {"sentences": [explained.verdict], "is_bad": explained.numbers["failures"] > 0, "commands": commands}


def describe_failure(data: ReportInput, failure: JsonObject) -> JsonObject:
    """A failure of the table `solutions` of `explain`: its size and changes."""
    setting, matrix = data.setting_of(failure["solution"]), data.system.matrix
    return {
        "failure": failure,
        "size": f"{failure['changed']} of {len(setting)} characteristics changed, by at most "
        f"{100 * failure['largest_change']:.0f} %",
        "robust": robustness_in_words(failure["robust_share"]),
        "anchor": data.anchor("replay", failure["solution"]),
        "changes": data.list_changes(setting),
        "points": points_in_words(failure["points"], len(matrix)) if matrix and not data.point else "",
    }


def make_cause_sections(data: ReportInput, explained: Answer) -> list[JsonObject]:
    """A section for one minimal cause of each set of characteristics; the first is the one that the verdict names."""
    causes = explained.tables["causes"]
    causes = causes[causes["size"] > 0]
    selection = causes[~causes["changes"].map(tuple).duplicated()].head(MAX_CAUSES).reset_index(drop=True)
    opinions: list[Any] = [None] * len(selection)
    if len(selection) and not reason_without_opinion(data):
        unsafe = Unsafe.parse(explained.numbers["unsafe"])
        opinions = [*judge_causes(data.case.study, selection, unsafe)[0].itertuples()]
    ends = dict(explained.tables["solutions"][["solution", "ends"]].to_numpy())
    return [
        _make_cause_section(data, rank, cause, ends[cause["solution"]], opinion)
        for rank, (cause, opinion) in enumerate(zip(selection.to_dict("records"), opinions, strict=True), 1)
    ]


def _make_cause_section(data: ReportInput, rank: int, cause: Mapping[Any, Any], ends: str, opinion: Any) -> JsonObject:
    comparison, player = data.play(data.case.characteristics.setting(cause["changes"], "cause", beyond=True))
    title, rows = f"Cause {rank}: {', '.join(cause['changes'])}", {}
    for item in data.case.characteristics:
        if item.name in cause["changes"]:
            values = (item.original, cause["changes"][item.name], cause["boundary"][item.name])
            rows[f"{item.name} ({item.short_name})"] = [f"{format_number(value)}{item.suffix}" for value in values]
    frame = pd.DataFrame.from_dict(rows, "index", columns=["original", "here", "limit (all scaled)"])
    return {
        "title": title,
        "anchor": data.anchor("cause", rank),
        "cause": cause,
        "robust": robustness_in_words(cause["robust_share"]),
        "table": table_data(frame.rename_axis("characteristic"), f"Changes of {title}"),
        "end": comparison.verdict(comparison.rows[-1]),
        "opinion": opinion,
        "reason": ends,
        "player_data": player,
        "replay_anchor": data.anchor("replay", cause["solution"]),
    }


def reason_without_opinion(data: ReportInput) -> str:
    """Why there is no second opinion on causes, in a sentence; empty if there is one."""
    try:
        assemble_both_systems(data.case.study)
    except InputError as error:
        return f"No second opinion on these causes: {error.problem}; expected: {error.legal}."
    return ""


def replay_solutions(data: ReportInput, explained: Answer | None, progress: Progress) -> list[JsonObject]:
    """Replay the solutions that `FIRST_CHOICES` select and the explained ones."""
    failures = explained.tables["solutions"]["solution"].tolist() if explained else []
    handles, entries = list(dict.fromkeys([*data.select_handles(*FIRST_CHOICES), *failures])), []
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
                "is_open": not failures and index == 0,
            }
        )
    return sorted(entries, key=lambda entry: (entry["f_safe"], entry["handle"]))


NO_RESULT = {
    Outcome.SIMULATOR_ERROR: "could not be simulated; no result contains them",
    Outcome.INVALID_TEST: "left the tolerance of a test's speed before the driving system acted: they are neither "
    "failures nor successes",
}
"""Outcomes of settings about which nothing is known."""
GENERAL_LIMITS = (
    "A search that finds no failure proves nothing about the settings that it did not try.",
    "One vehicle in its lane: no steering beyond lane keeping, no separate wheels and axles, no suspension, no wind, "
    "no sensor noise, no traffic beyond the scenario's own, unless the study says otherwise.",
    "Driving system and vehicle are models: how far they agree with published data is told where there is any.",
)


def describe_tested_system(data: ReportInput) -> JsonObject:
    """Describe the tested vehicle, driving system and scenario, and the search, in sentences."""
    case, study = data.case, data.case.study
    heads = ["characteristic", "unit", "original", "from", "to", "filter threshold", "meaning"]
    rows = pd.DataFrame(
        [
            (item.name, unit_text(item.unit, "{}"), item.original, item.lower, item.upper, item.threshold, item.words)
            for item in case.characteristics
        ],
        columns=heads,
    )
    return {
        "subject": f"Vehicle: {_name_and_sentence(VEHICLES, study.vehicle.model)}, "
        f"{number_of(len(case.characteristics), 'varied characteristic')}. "
        f"Driving system: {_name_and_sentence(ADS, study.ads.model)}. "
        f"Scenario: {_name_and_sentence(SCENARIOS, study.scenario.model)}; {describe_conditions(data)}.",
        "tags": pre_crash_sentence(data.system.points),
        "search": _describe_search(data),
        "characteristics": table_data(rows.set_index("characteristic"), f"Characteristics of {case.name}"),
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
    versions = ", ".join(f"{name} {value}" for name, value in data.versions.items())
    if not case.has_runs:
        return f"The {len(case.solutions)} solutions are imported ({versions})."
    runs = Counter(algorithm for algorithm, _ in case.finished_runs)
    names = [f"{case.title_of(name)} ({number_of(count, 'run')})" for name, count in runs.items()]
    return (
        f"Searched by {', '.join(names) or 'no finished run'} of at most {search.evaluations} simulations each, "
        f"{len(case.evaluations)} different vehicles in all, from seed {search.seed}, with {versions}."
    )


def _name_and_sentence(models: Mapping[str, type], name: str) -> str:
    """A model's name with the first sentence of its description; user code has the name alone."""
    if name not in models:
        return name
    first_line = (models[name].__doc__ or "").strip().partition("\n")[0]
    return f"{name} ({first_line.rstrip('.')})"


def describe_agreement(study: Study) -> JsonObject | None:
    """How well a study agrees with each file of published data, as a table; None if there is no data."""
    frame = shipped_agreement(study).drop(columns="study").set_index("file")
    if frame.empty:
        return None
    frame = frame.sort_values("collisions_reference", ascending=False, kind="stable").round(2)
    return table_data(
        frame.rename(columns=lambda name: name.replace("_", " ")).rename_axis("published data"),
        "Agreement with published data: safety degrees [m]",
    )


def describe_limits(data: ReportInput, explained: Answer | None) -> JsonObject:
    """How far the findings of one study hold: remarks, the vehicle model's own uncertainty, and the original vehicle's
    published metrics beside those here.
    """
    case, tables, shares = data.case, [], explained.tables["solutions"]["robust_share"] if explained else pd.Series()
    remarks = [
        f"{count} of {len(case.evaluations)} settings {words}."
        for outcome, words in NO_RESULT.items()
        if (count := int((case.evaluations["outcome"] == str(outcome)).sum()))
    ]
    if len(shares):
        remarks.append(
            f"{(shares < MIN_ROBUST_SHARE).sum()} of {len(shares)} failures analysed are borderline: fewer than "
            f"{100 * MIN_ROBUST_SHARE:.0f} % of their neighbours are unsafe too."
        )
    if case.study.spread:
        handles = data.select_handles(*FIRST_CHOICES) if data.any_unsafe else []
        settings = [case.characteristics.original, *map(data.setting_of, handles)]
        spreads = compute_model_spreads(case.study, np.stack(settings), data.point)
        frame = pd.DataFrame(spreads, ["original vehicle", *handles]).rename_axis("vehicle")
        degrees = [case.original[SAFETY_DEGREE], *(data.solutions[handle]["f_safe"] for handle in handles)]
        frame.insert(0, "safety degree here", degrees)
        note = (
            "Parameter sets that fit the published data as well, repeats of one simulation, and the model's error on "
            "the rows of the fit; from lower to upper are 90 %. The band does not cover other data."
        )
        tables.append(table_data(frame, "The vehicle model's own uncertainty", [note]))
    published = pd.DataFrame({"published": dict(case.study.published), "here": dict(case.original)}).dropna()
    if published.empty:
        remarks.append("There are no published values of the original vehicle to compare the study with.")
    else:
        published["difference [%]"] = (100 * (published["here"] / published["published"] - 1)).round(1)
        tables.append(table_data(published.rename_axis("metric"), "The original vehicle, published and here"))
    return {"remarks": remarks, "tables": tables}
