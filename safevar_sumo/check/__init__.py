"""The check of user code, which runs before the first batch of a study and as the command `check`.
The check asks whether a result depends on its setting alone, and whether every call keeps its
contract. No module below `sumo` or `search` imports this package.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from typing import Any

import numpy as np

from safevar_sumo.ads import ADS
from safevar_sumo.check.findings import Code, Finding, Findings, pieces_of_code
from safevar_sumo.check.oversights import find_oversights
from safevar_sumo.check.trials import try_algorithm, try_simulations
from safevar_sumo.errors import UserCodeError, about
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.shipped import PROGRAM_COMMAND
from safevar_sumo.study import WHOLE, Study, keys_with, without_skipping
from safevar_sumo.study.encounters import Parameters
from safevar_sumo.sumo.empty_road import Reason, find_problems, sentence_on
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble

STUDY_OF_AN_ADS = "smoke"
"""The study in which `check` lets a driving system drive that the user gives by its name."""


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


def check_study(study: Study, **how: Any) -> list[Finding]:
    """Check the user code of a study. Failures of simulations are not skipped, even if the study
    says so. For `how` see `try_simulations`.
    """
    study = without_skipping(study)
    findings = list(find_defects(study, **how))
    if findings:
        return findings
    try:
        with about(study.source), np.errstate(all="ignore"):
            for code, oversight in find_oversights(study):
                findings += _first_defect(study, code, oversight)
    except UserCodeError as error:
        findings.append(_finding_of(error, study, pieces_of_code(study)))
    return findings or _find_in_original(study)


def _find_in_original(study: Study) -> list[Finding]:
    """Find that the original vehicle does not get to its encounter, or is unsafe there."""
    system = assemble(study)
    problems = find_problems(system)
    driver = [Code("ads.model", study.ads.model)]
    if not study.ads.model:
        driver = [Code("scenario.model", study.scenario.model)]
    if problems:
        words = sentence_on(problems, len(system.points))
        expected = "a drive to the encounter, without braking for nobody"
        check = "reaction"
        if next(iter(problems.values())).reason is Reason.LATE:
            driver = [Code("scenario.model", study.scenario.model)]
            expected = "an encounter while the others are there"
            check = "meeting"
        return [Finding(check, words, "", "", expected).in_code(study, driver)]

    unsafe = system.with_contact(system.criterion)
    original = drive_and_score(system, system.characteristics.original_settings)
    if not unsafe.of(original)[0]:
        return []
    words = f"the original vehicle itself {unsafe.breach_in_words(original)}"
    point = system.points[original.points[0]].name
    finding = Finding("original", words, "", point, "an original vehicle that is safe")
    return [finding.in_code(study, driver)]


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
            f"{finding.expected}; {finding.advice}",
            finding.where,
        )


def find_defects(study: Study, **how: Any) -> Findings:
    """Find the first defect of all simulated user code, and the first defect of each user's
    algorithm. For `how` see `try_simulations`.
    """
    code = pieces_of_code(study)
    simulated = [piece for piece in code if piece.key != "search.algorithms"]
    yield from _first_defect(study, simulated, try_simulations(study, **how))
    for piece in code:
        if piece.key == "search.algorithms" and how.get("limit") is None:
            yield from _first_defect(study, [piece], try_algorithm(study, piece.name))


def _first_defect(study: Study, code: Sequence[Code], findings: Findings) -> Findings:
    """Yield the first of the findings with its place in the user code, or the error that the user
    code raises.
    """
    try:
        with about(study.source), np.errstate(all="ignore"):
            finding = next(findings, None)
        if finding is not None:
            yield finding.in_code(study, code)
    except UserCodeError as error:
        yield _finding_of(error, study, code)


def _finding_of(error: UserCodeError, study: Study, code: Sequence[Code]) -> Finding:
    """The finding that tells of an error of user code. If the error names one piece of the code,
    the finding is in this piece.
    """
    named = [piece for piece in code if piece.name in error.problem]
    expected = error.legal or "no exception"
    finding = Finding("contract", error.problem, error.place, "", expected)
    return finding.in_code(study, named or code)
