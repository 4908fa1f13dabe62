"""The checks: the result of a setting depends on this setting alone, and every call keeps its contract."""

from __future__ import annotations

import shlex
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field

import numpy as np

from safevar_sumo.errors import InputError, UserCodeError
from safevar_sumo.plugins.check.subject import Subject, find_subject, subjects_of
from safevar_sumo.plugins.check.trials import Failure, try_algorithm, try_constraint, try_simulations
from safevar_sumo.shipped import PROGRAM_COMMAND
from safevar_sumo.study import Study, load_study, study_names
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.system import assemble

CHECKS: Mapping[str, str] = {
    "contract": (
        "return what the base class documents, leave arguments as they are, and guard divisions and roots where "
        "the domain ends"
    ),
    "repetition": (
        "draw nothing at random (an algorithm: from `rng` alone), read no clock, and keep nothing in a class or "
        "a module"
    ),
    "order": "compute element i of a result from element i of the arguments alone, whatever its place",
    "alone": "compute element i of a result from element i of the arguments alone: no mean, sum or maximum over the "
    "vehicles; keep what a "
    "vehicle remembers in the memory that is handed on or in its own instance, not in a class or a module",
    "reaction": "check that the code reads the quantity that it should react to, with the right sign and unit",
}
"""The checks, with advice on a failure. All but `reaction`, of which every answer itself warns, also keep a study from
starting.
"""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A failed check: file and line of the user code, the expected result, the actual one with the input that shows it,
    and advice.
    """

    check: str
    file: str
    line: int
    expected: str
    got: str
    advice: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.check}: {self.got}"


@dataclass(kw_only=True)
class Report:
    """The findings on a subject or a study; `remark` says in which study a subject was tried."""

    subject: str
    kind: str
    findings: list[Finding] = field(default_factory=list)
    remark: str = ""
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        return not self.findings

    def to_dict(self) -> dict[str, str | bool | float | list[dict[str, str | int]]]:
        """The JSON output of the command `check`."""
        return {
            "subject": self.subject,
            "kind": self.kind,
            "passed": self.passed,
            "findings": list(map(asdict, self.findings)),
            "seconds": round(self.seconds, 3),
        }


def check(name: str, study: str | None = None) -> Report:
    """Check a subject, or everything that a study names.

    Parameters
    ----------
    name
        `package.module:Name`, the name of a shipped subject, the path of an FMU, or the name or path of a study.
    study
        The study to try a subject in.

    Raises
    ------
    InputError
        If the subject or the study cannot be loaded.
    """
    if ":" in name or not (name in study_names() or name.endswith(".toml")):
        return check_subject(find_subject(name, study))
    if study is not None:
        raise InputError("study", f"{study!r} is given, and {name!r} is itself a study", "one of them")
    start, loaded = time.perf_counter(), load_study(name)
    findings = [finding for _, finding in _findings_in(loaded, subjects_of(loaded))] or _reaction(
        subjects_of(loaded)[0]
    )
    return Report(subject=name, kind="study", findings=findings, seconds=time.perf_counter() - start)


def check_subject(subject: Subject) -> Report:
    """Check one subject. Raises the errors of `check`."""
    start = time.perf_counter()
    findings = [finding for _, finding in _findings_in(subject.study, [subject])]
    if subject.kind in ("ads", "traci") and not subject.is_guest:
        findings = findings or _reaction(subject)
    return Report(
        subject=subject.name,
        kind=subject.kind,
        findings=findings,
        remark=subject.remark,
        seconds=time.perf_counter() - start,
    )


def refuse_defects(study: Study) -> list[str]:
    """Check the user code that a study names; returns remarks on it.

    Raises
    ------
    UserCodeError
        With the first defect, the input that shows it, file and line, and advice.
    """
    for names, finding in _findings_in(study, [subject for subject in subjects_of(study) if subject.is_user_code]):
        place, command = (
            f"{finding.file}:{finding.line}",
            f"{PROGRAM_COMMAND} check {shlex.quote(study.origin.called or study.name)}",
        )
        problem = f"{names} {finding.got}{'' if place in finding.got else f' ({place})'}; to reproduce it: {command}"
        raise UserCodeError(study.source, problem, f"{finding.expected}; {finding.advice}", place)
    return []


def _findings_in(study: Study, subjects: list[Subject]) -> Iterator[tuple[str, Finding]]:
    """The first failure of each trial, and the code on trial; all subjects that are simulated share one trial."""
    simulated = [subject for subject in subjects if subject.kind not in ("algorithm", "constraint")]
    for trial in ([simulated] if simulated else []) + [[subject] for subject in subjects if subject not in simulated]:
        code = [subject for subject in trial if subject.is_user_code] or trial
        try:
            with np.errstate(all="ignore"):
                failure, place = next(_failures(study, trial[0]), None), ""
        except UserCodeError as error:
            problem = next(
                (error.problem.removeprefix(f"{one.key} ") for one in code if error.problem.startswith(one.key)),
                error.problem,
            )
            failure, place = Failure("contract", error.legal or "no exception", problem), error.place
        if failure is not None:
            yield " and ".join(subject.key for subject in code), _finding(code[0], failure, place)


def _reaction(driver: Subject) -> list[Finding]:
    """The finding on a driver who does not drive to the encounter with nobody in sight."""
    reason = why_no_verdict(assemble(driver.study))
    expected = "a drive to the encounter, with no braking while nobody is in sight"
    return [_finding(driver, Failure("reaction", expected, reason))] if reason else []


def _finding(subject: Subject, failure: Failure, place: str = "") -> Finding:
    file, _, line = (place or subject.definition).rpartition(":")
    return Finding(
        check=failure.check,
        file=file or subject.name,
        line=int(line or 1),
        expected=failure.expected,
        got=failure.got,
        advice=CHECKS[failure.check],
    )


def _failures(study: Study, subject: Subject) -> Iterator[Failure]:
    if subject.kind == "algorithm":
        return try_algorithm(study, subject.name)
    return try_constraint(study, subject.name) if subject.kind == "constraint" else try_simulations(study)
