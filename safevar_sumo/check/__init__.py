"""The check of user code, which runs before the first batch of a study and as the command `check`.
The check asks whether a result depends on its setting alone, and whether every call keeps its
contract. No module below `sumo` or `search` imports this package.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from typing import Any

import numpy as np

from safevar_sumo.ads import ADS
from safevar_sumo.check.oversights import find_oversights
from safevar_sumo.check.trials import (
    Finding,
    try_algorithm,
    try_simulations,
)
from safevar_sumo.errors import UserCodeError, about
from safevar_sumo.plugins import Lookup
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.shipped import PROGRAM_COMMAND
from safevar_sumo.study import WHOLE, Study, keys_with, user_code, without_skipping
from safevar_sumo.study.encounters import Parameters
from safevar_sumo.sumo.empty_road import Reason, find_problems, sentence_on
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble
from safevar_sumo.sumo.traci_controller import substitute_traci

STUDY_OF_AN_ADS = "smoke"
"""The study in which `check` lets a driving system drive that the user gives by its name."""
CHECKS: Mapping[str, str] = {
    "contract": (
        "return what the documentation of the method says, leave arguments as they are, and guard"
        " divisions and roots where the domain ends"
    ),
    "repetition": (
        "draw nothing at random (an algorithm: from `rng` alone), read no clock, and keep nothing"
        " in a class or a module"
    ),
    "order": (
        "compute element i of a result from element i of the arguments alone, whatever its place"
    ),
    "alone": (
        "compute element i of a result from element i of the arguments alone: no mean, sum or"
        " maximum over the vehicles; keep what a vehicle remembers in its memory or its own"
        " instance, not in a class or a module"
    ),
    "reaction": (
        "command enough throttle while nobody is in sight, where `gap` is infinite; check that the"
        " code reads the quantity that it should react to, with the right sign and unit"
    ),
    "meeting": (
        "choose values of the scenario's parameters at which the vehicle meets the others before"
        " they have left, and check the signs of places and speeds: the others come into its way"
    ),
    "undefined": (
        "let runs have what the metric reads, its `needs`, or return a number where the metric is"
        " defined; else leave out its name"
    ),
    "constant": "compute the metric from the runs or settings that it gets, or leave out its name",
    "unread": (
        "read each value of the setting by its name, spelled as in `UNITS`, or leave out the"
        " characteristic"
    ),
    "modified": "change a copy, such as `dict(setting)`, and not the setting itself",
    "shift": "read speed, gap and position at the same moment of each step, and then append them",
    "step": (
        "multiply each change of the state by the time step [s], the argument `step` of `prepare`"
    ),
    "duplicates": "return each solution once, such as the best ones after `np.unique`",
    "standing": (
        "find out with `simulate` why a changed vehicle never moves: read each value of the setting"
        " in its unit, compare numbers by `<` instead of `==`, and start with any of them"
    ),
    "original": (
        "find out with `simulate` why the original vehicle fails: check signs and units of what the"
        " code reads and commands; changes of a vehicle that is unsafe as it is explain nothing"
    ),
}
"""The checks by name, with advice after a failure. Failures of the first four checks also prevent a
study from starting.
"""
ADVICE_FOR_SIMULATORS: Mapping[str, str] = {
    "order": "keep nothing of a run for the next run in a class, a module or an engine",
    "alone": (
        "keep nothing of a run for the next run in a class, a module or an engine, and let a metric"
        " compute number i from run i alone"
    ),
    "undefined": (
        "return what the metric needs, such as `gap` and `obstacle_speed`, or the metric itself"
        " without a trace; else leave out its name"
    ),
}
"""Other advice for studies with a simulator of the user's own, by the names of checks."""


def advice_for(finding: Finding, study: Study) -> str:
    """What to do about a finding in the user code of a study."""
    is_simulated = not study.ads.model
    if is_simulated and finding.check in ADVICE_FOR_SIMULATORS:
        return ADVICE_FOR_SIMULATORS[finding.check]
    return CHECKS[finding.check]


def study_to_check(name: str) -> Study:
    """Read the study to check. `name` is the name or path of a study, or the name of an ADS, which
    then drives in `STUDY_OF_AN_ADS`.

    Raises
    ------
    InputError
        If the study or the ADS cannot be loaded.
    """
    is_ads = name in ADS or (":" in name and not name.endswith(".toml"))
    if not is_ads:
        return read_study(name)
    # The study has data about another ADS, which would be wrong for this ADS.
    no_data: Parameters = {key: {} for key in keys_with(WHOLE, Study)}
    return read_study(STUDY_OF_AN_ADS, ads={"model": name}, **no_data)


def check_study(study: Study, **options: Any) -> list[Finding]:
    """Check the user code of a study. Failures of simulations are not skipped, even if the study
    says so. The `options` are those of `try_simulations`.
    """
    study = without_skipping(study)
    findings = list(find_defects(study, **options))
    if findings:
        return findings
    with np.errstate(all="ignore"):
        for names, oversights in find_oversights(study):
            findings += _first_defect(study, names, oversights)
    if findings:
        return findings
    system = assemble(study)
    problems = find_problems(system)
    place = _definition(study, "ads.model", study.ads.model)
    if problems:
        words = sentence_on(problems, len(system.points))
        first_problem, *_ = problems.values()
        if first_problem.reason is Reason.LATE:
            place = _definition(study, "scenario.model", study.scenario.model)
            expected = "an encounter while the others are there"
            return [Finding("meeting", words, expected, where=place)]
        expected = "a drive to the encounter, without braking for nobody"
        return [Finding("reaction", words, expected, where=place)]

    unsafe = system.with_contact(system.criterion)
    original = drive_and_score(system, system.characteristics.original_settings)
    if not unsafe.of(original)[0]:
        return []
    words = f"the original vehicle itself {unsafe.breach_in_words(original)}"
    point = system.points[original.points[0]].name
    expected = "an original vehicle that is safe"
    return [Finding("original", words, expected, where=place, input=point)]


def refuse_defects(study: Study, limit: int | None = None) -> None:
    """Check the user code of a study with at most `limit` simulations.

    Raises
    ------
    UserCodeError
        With the first defect, the input that shows it, file and line, and advice.
    """
    for finding in find_defects(study, limit=limit):
        command = (
            f"{PROGRAM_COMMAND} check {shlex.quote(study.origin.called or study.name)}"
        )
        raise UserCodeError(
            study.source,
            f"{finding}; to reproduce it: {command}",
            f"{finding.expected}; {advice_for(finding, study)}",
            finding.where,
        )


def find_defects(study: Study, **options: Any) -> Iterator[Finding]:
    """Find the first defect of all simulated user code, and the first defect of each user's
    algorithm. The `options` are those of `try_simulations`.
    """
    names = user_code(study)
    simulated = {key: name for key, name in names if key != "search.algorithms"}
    yield from _first_defect(study, simulated, try_simulations(study, **options))
    for key, name in names:
        if key == "search.algorithms" and options.get("limit") is None:
            yield from _first_defect(study, {key: name}, try_algorithm(study, name))


def _first_defect(
    study: Study, names: Mapping[str, str], findings: Iterator[Finding]
) -> Iterator[Finding]:
    """Yield the first of the findings with the place of the user code, or the error that the user
    code raises. `names` has the names of the user code by their keys.
    """
    places = [_definition(study, key, name) for key, name in names.items()]
    place = " or ".join(places) or study.source
    try:
        with about(study.source), np.errstate(all="ignore"):
            finding = next(findings, None)
        if finding is not None:
            yield finding._replace(where=place)
    except UserCodeError as error:
        yield Finding(
            "contract",
            error.problem,
            error.legal or "no exception",
            where=error.place or place,
        )


def _definition(study: Study, key: str, name: str) -> str:
    """The file and line at which user code is defined. Without a known line: its key and name."""
    if ":" not in name:
        return f"{key} = {name!r}"
    with substitute_traci() if study.ads.kind == "traci" else nullcontext():
        code = Lookup.of(study).find({}, name, key).code
    # A name with a colon always is a name of user code.
    assert code is not None
    return code.definition() or code.name
