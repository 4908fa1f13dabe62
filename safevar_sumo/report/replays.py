"""The replays of a page, and the commands that compute its numbers again."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from itertools import islice
from typing import Any

from safevar_sumo.api.simulation import simulate_with_original
from safevar_sumo.errors import warn
from safevar_sumo.questions.counterexamples import (
    fewest_changes,
    solution_with_fewest_changes,
)
from safevar_sumo.questions.words import change_texts, replay_command
from safevar_sumo.records import FloatArray, JsonObject, NamedValues
from safevar_sumo.replay.animation import player_of
from safevar_sumo.replay.comparison import (
    comparison_of,
    list_differences,
    why_different,
)
from safevar_sumo.report.sections import ReportedStudy
from safevar_sumo.sumo.simulators import simulations_of_setting
from safevar_sumo.terminal import Progress

MAX_CAUSES = 6
"""Largest number of replays of settings that stand in tables of answers."""
CHANGES = "changes"
"""A table's column of settings to replay: values by characteristic, all others as in the original
vehicle.
"""
ENCOUNTER = "encounter"
"""A table's column of the encounters of these settings, where encounters are ranges."""


def replays(
    study: ReportedStudy, progress: Progress, start: int = 0
) -> Iterator[JsonObject]:
    """Yield the values of replays for the template. Their players have numbers from `start` on."""
    characteristics = study.case.characteristics
    settings = _settings_to_replay(study)
    different = []
    for number, (name, setting) in enumerate(settings.items()):
        progress("replays", number, len(settings))
        comparison = comparison_of(
            simulate_with_original(
                study.case.study, study.system, setting, filtered=False
            )
        )
        # A user's simulator that states no positions gives nothing to show.
        if not comparison.has_position:
            return
        row = comparison.rows[-1]
        title = name
        differences = []
        if name in study.choices:
            title += f" ({study.choices[name]})"
            recorded: dict[Any, Any] = study.chosen_solutions.loc[name].to_dict()
            differences = list_differences(comparison.evaluations.take([row]), recorded)
        if differences:
            different.append(name)
        yield {
            "title": f"{title}: {comparison.verdict(row)}",
            "point": comparison.point.name,
            "changes": change_texts(characteristics, characteristics.named(setting)),
            "differences": differences,
            "player": player_of(comparison, start + number),
        }
    if different:
        reason = why_different(is_imported=not study.case.has_runs)
        warn(
            f"{study.directory}: simulated again with different results: {', '.join(different)};"
            f" {reason}"
        )


def _settings_to_replay(study: ReportedStudy) -> dict[str, FloatArray]:
    """The settings that a page replays, by name: of the failure with the fewest changes, of chosen
    solutions, and in tables of answers. In a simulator that takes long, only as many as the largest
    number of simulations allows.
    """
    limit = study.simulations if study.system.mover.takes_long else None
    settings = {}
    fewest = _setting_with_fewest_changes(study, may_simulate=limit is None)
    if fewest is not None:
        settings["Fewest changes"] = fewest
    settings.update(zip(study.choices, study.chosen_settings, strict=True))
    settings |= _settings_in_answers(study)
    if limit is None:
        return settings

    # A replay simulates all points of a matrix to find the worst one, then the setting and the
    # original vehicle at this point.
    simulations = simulations_of_setting(study.system) + 2 * study.system.repeats
    return dict(islice(settings.items(), limit // simulations))


def _setting_with_fewest_changes(
    study: ReportedStudy, *, may_simulate: bool
) -> FloatArray | None:
    """The failure with the fewest changes; None without a failure. Only simulations can undo
    changes that the failure does not need.
    """
    if not may_simulate:
        return solution_with_fewest_changes(study.case)
    fewest = fewest_changes(study.case, jobs=1)
    return None if fewest is None else fewest.settings[0]


def _settings_in_answers(study: ReportedStudy) -> dict[str, FloatArray]:
    """Settings in tables of answers (column `CHANGES`), by name: the first `MAX_CAUSES` that change
    different characteristics.
    """
    # Many settings change the same characteristics: only the first of them is replayed.
    first: dict[tuple[str, ...], tuple[NamedValues, NamedValues]] = {}
    for changes, encounter in _changes_in_answers(study):
        first.setdefault(tuple(sorted(changes)), (changes, encounter))
    # A failure without a change has no cause.
    first.pop((), None)

    settings = {}
    characteristics = study.case.characteristics
    for changes, encounter in islice(first.values(), MAX_CAUSES):
        name = f"Only {', '.join(changes)}"
        if encounter:
            name += ", in its encounter"
        values = {**changes, **encounter}
        settings[name] = characteristics.setting(values, beyond=True)
    return settings


def _changes_in_answers(
    study: ReportedStudy,
) -> Iterator[tuple[NamedValues, NamedValues]]:
    """Yield the changes in each row of the answers' tables, and their encounter ({} for the one of
    the study).
    """
    for answer in study.answers:
        for frame in answer.tables.values():
            if CHANGES in frame:
                encounters = frame.get(ENCOUNTER, [{}] * len(frame))
                yield from zip(frame[CHANGES], encounters, strict=True)


def page_commands(study: ReportedStudy) -> Iterator[tuple[str, str]]:
    """Yield the commands that compute the numbers of the page again: the purpose of each command,
    and the command.
    """
    directory = str(study.directory)
    flag = " --as-it-is-now" if study.later_changes else ""
    if study.case.has_runs:
        out = json.dumps(f"{directory}-again")
        script = (
            f"import safevar_sumo as sv; sv.run(sv.load({json.dumps(directory)}).study, out={out},"
            " progress=True)"
        )
        purpose = (
            f"The study {study.case.study.name}, as its manifest.json records it, into another"
            " directory"
        )
        yield purpose, f"python -c {shlex.quote(script)}"

    for answer in study.answers:
        if answer.command:
            yield f"The answer {answer.question}", answer.command + flag
    for handle in study.choices:
        simulate = f"{replay_command(directory, study.point)} --solution {handle}"
        yield (
            f"The replay of {handle}",
            f"{simulate} --plot it.png --animate it.html{flag}",
        )
