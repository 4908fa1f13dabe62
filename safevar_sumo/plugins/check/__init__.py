"""The command `check`: does user code keep the promises that results rest on? A result depends on its setting alone,
and every call keeps its contract. Nothing below `sumo` and `search` imports this package.
"""

from __future__ import annotations

import inspect
import shlex
import time
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace

from safevar_sumo.ads import ADS, Ads, ScalarAds
from safevar_sumo.errors import InputError, SafevarError, UserCodeError, unknown_name
from safevar_sumo.metrics import METRIC_OF_OBJECTIVE, METRICS, OPTIONAL_METRICS, Metric
from safevar_sumo.plugins import Lookup, Member, abstract_methods, unload_user_modules
from safevar_sumo.plugins.check.trials import Failure, try_algorithm, try_constraint, try_simulations
from safevar_sumo.scenarios import SCENARIOS, Scenario
from safevar_sumo.search import ALGORITHMS
from safevar_sumo.shipped import PROGRAM_COMMAND
from safevar_sumo.study import ModelTable, Study, load_study, study_names
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.system import assemble
from safevar_sumo.sumo.traci_controller import substitute_traci
from safevar_sumo.vehicles import CHANGES, VEHICLES, Change, Vehicle


class Kind(NamedTuple):
    """A kind of subjects of `check`, such as driving systems.

    Attributes
    ----------
    key
        The key of a study that names such subjects.
    names_in
        The names that a study gives there.
    members
        The shipped subjects by name.
    methods
        The methods by which a class of this kind is recognised.
    """

    key: str
    names_in: Callable[[Study], Iterable[str]]
    members: Mapping[str, Any]
    methods: Collection[str] = ()


def _scenarios_in(study: Study) -> list[str]:
    return [study.scenario.model, *(test.model for test in (study.matrix.tests if study.matrix else ()) if test.model)]


KINDS: Mapping[str, Kind] = {
    "traci": Kind("ads.model", lambda study: [study.ads.model] if study.ads.kind == "traci" else [], {}, ("step",)),
    "ads": Kind(
        "ads.model", lambda study: [study.ads.model] if study.ads.kind != "traci" else [], ADS, abstract_methods(Ads)
    ),
    "vehicle": Kind("vehicle.model", lambda study: [study.vehicle.model], VEHICLES, abstract_methods(Vehicle)),
    "scenario": Kind("scenario.model", _scenarios_in, SCENARIOS, abstract_methods(Scenario)),
    "metric": Kind("metrics.also", lambda study: study.metrics.also, {**METRICS, **OPTIONAL_METRICS}),
    "objective": Kind("search.objectives", lambda study: study.search.objectives, CHANGES),
    "algorithm": Kind("search.algorithms", lambda study: study.search.algorithms, ALGORITHMS, ("search",)),
    "constraint": Kind(
        "constraints.function",
        lambda study: filter(None, (constraint.function for constraint in study.constraints)),
        {},
    ),
}
"""Kinds of subjects by name."""
DEFAULT_STUDIES = {"traci": "native"}
"""Study to try a subject of a kind in if no study names it; `smoke` for all other kinds."""
MAX_FILES = 50
"""Maximum number of study files that are read in a directory."""


class Subject(NamedTuple):
    """A subject and the study in which it is tried; `remark` says how the study was found, `is_guest` whether the study
    names the subject only for the trial.
    """

    name: str
    kind: str
    study: Study
    remark: str = ""
    is_guest: bool = False

    @property
    def key(self) -> str:
        """The key and name of the subject, as in errors about a study."""
        return f"{KINDS[self.kind].key} = {self.name!r}"

    @property
    def is_user_code(self) -> bool:
        return ":" in self.name or self.name.endswith(".fmu")

    @property
    def definition(self) -> str:
        """File and line at which user code is defined; "" for anything else."""
        member = _look_up(self.name, self.study)
        return member.guard.definition("") if member.guard else ""


def subjects_of(study: Study) -> list[Subject]:
    """Every subject that a study names."""
    return [
        Subject(name, kind, study) for kind, facts in KINDS.items() for name in dict.fromkeys(facts.names_in(study))
    ]


def find_subject(name: str, study: str | None) -> Subject:
    """Find a subject by its name.

    Parameters
    ----------
    name
        The name of a shipped subject, `package.module:Name`, or the path of an FMU.
    study
        A study to try the subject in; by default a study file beside it that names it, or else a shipped study.

    Raises
    ------
    InputError
        If nothing has this name, or no study can try the subject.
    """
    given_study = None if study is None else load_study(study)
    name = METRIC_OF_OBJECTIVE[name].name if name in METRIC_OF_OBJECTIVE else name
    shipped_kind = next((kind for kind, facts in KINDS.items() if name in facts.members), "")
    kind, folder, member = shipped_kind, Path(name).absolute().parent, _look_up(name, given_study)
    if member.guard:
        kind, folder = _kind_of(member.target), Path(member.guard.folder).absolute()
    elif not shipped_kind and not name.endswith(".fmu"):
        names = {
            *study_names(),
            *METRIC_OF_OBJECTIVE,
            *(shipped for facts in KINDS.values() for shipped in facts.members),
        }
        otherwise = ", package.module:Name, or the path of a study file"
        raise unknown_name("check", f"there is nothing called {name!r}", name, names, otherwise)
    candidates: Iterable[Study] = map(load_study, study_names())
    if given_study or not shipped_kind:
        candidates = [given_study] if given_study else _studies_beside(Path(name).name, folder)
    for candidate in candidates:
        for subject in subjects_of(candidate):
            if Path(subject.name).name == Path(name).name:
                remark = "" if given_study or shipped_kind else f"tried in {candidate.origin.called}, which names it"
                return subject._replace(kind=kind if subject.kind == "objective" else subject.kind, remark=remark)
    if not kind:
        problem = f"no study names {name!r}" if member.guard or Path(name).exists() else f"there is no file {name!r}"
        expected = "a model, metric, algorithm or controller that a study can name, or `study=STUDY` that names it"
        raise InputError("check", problem, expected)
    study_of_kind = given_study or load_study(DEFAULT_STUDIES.get(kind, "smoke"))
    return Subject(name, kind, _put_in(study_of_kind, kind, name), is_guest=True)


def _look_up(name: str, study: Study | None) -> Member:
    """A user's class, function or record by its name; a `Member` without any for other names."""
    if ":" not in name:
        return Member(None)
    unload_user_modules()
    with substitute_traci():
        return Lookup("check", study.origin.places if study else ()).find({}, name, "SUBJECT")


def _kind_of(target: Any) -> str:
    """The kind of an object: of a class, the kind of whose methods it has the largest share; "" if it is of no kind."""
    if isinstance(target, Metric | Change):
        return "metric" if isinstance(target, Metric) else "objective"
    if not inspect.isclass(target):
        return "traci" if inspect.isfunction(target) else ""
    if issubclass(target, ScalarAds):
        return "ads"
    shares = {
        kind: sum(hasattr(target, name) for name in facts.methods) / len(facts.methods)
        for kind, facts in KINDS.items()
        if facts.methods
    }
    likeliest_kind = max(shares, key=lambda kind: shares[kind])
    return likeliest_kind if shares[likeliest_kind] else ""


def _put_in(study: Study, kind: str, name: str) -> Study:
    """A study that names a subject without parameters; raises an `InputError` for a vehicle, whose characteristics only
    a study knows.
    """
    if kind in ("ads", "traci"):
        return replace(study, ads=ModelTable(model=name, kind="traci" if kind == "traci" else ""))
    if kind == "scenario":
        return replace(study, scenario=ModelTable(model=name), matrix=None)
    if kind == "algorithm":
        return replace(study, search=replace(study.search, algorithms=[name], parameters={}))
    if kind == "metric":
        return replace(study, metrics=replace(study.metrics, also=[] if name in METRICS else [name]))
    if kind == "objective":
        return replace(study, search=replace(study.search, objectives=["safety_degree", name]))
    raise InputError(
        "check",
        f"no study gives the characteristics of {name!r}",
        "`study=STUDY`, or a study file beside it that names it",
    )


def _studies_beside(name: str, folder: Path) -> Iterator[Study]:
    """Studies in the working directory, or in the folder of a subject, that contain its name."""
    for directory in dict.fromkeys((Path.cwd(), folder)):
        for file in sorted(directory.glob("*.toml"))[:MAX_FILES]:
            with suppress(SafevarError, OSError, UnicodeDecodeError, tomllib.TOMLDecodeError):
                if name in file.read_text(encoding="utf-8"):
                    yield load_study(str(file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file))


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


@dataclass(frozen=True)
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
    start, remark = time.perf_counter(), ""
    if ":" not in name and (name in study_names() or name.endswith(".toml")):
        if study is not None:
            raise InputError("study", f"{study!r} is given, and {name!r} is itself a study", "one of them")
        kind, subjects = "study", subjects_of(load_study(name))
    else:
        subject = find_subject(name, study)
        name, kind, remark, subjects = subject.name, subject.kind, subject.remark, [subject]
    findings = [finding for _, finding in _findings_in(subjects[0].study, subjects)]
    driver = subjects[0]
    if not findings and driver.kind in ("ads", "traci") and not driver.is_guest:
        expected = "a drive to the encounter, with no braking while nobody is in sight"
        reason = why_no_verdict(assemble(driver.study))
        findings = [_finding(driver, ("reaction", expected, reason))] if reason else []
    return Report(subject=name, kind=kind, findings=findings, remark=remark, seconds=time.perf_counter() - start)


def refuse_defects(study: Study) -> None:
    """Check the user code that a study names.

    Raises
    ------
    UserCodeError
        With the first defect, the input that shows it, file and line, and advice.
    """
    for names, finding in _findings_in(study, [subject for subject in subjects_of(study) if subject.is_user_code]):
        place = f"{finding.file}:{finding.line}"
        command = f"{PROGRAM_COMMAND} check {shlex.quote(study.origin.called or study.name)}"
        problem = f"{names} {finding.got}{'' if place in finding.got else f' ({place})'}; to reproduce it: {command}"
        raise UserCodeError(study.source, problem, f"{finding.expected}; {finding.advice}", place)


def _findings_in(study: Study, subjects: list[Subject]) -> Iterator[tuple[str, Finding]]:
    """The names of the code on trial, and the first failure, of each trial that fails.

    All subjects that are simulated share one trial.
    """
    simulated = [subject for subject in subjects if subject.kind not in ("algorithm", "constraint")]
    trials = [simulated, *([subject] for subject in subjects if subject not in simulated)]
    for trial in filter(None, trials):
        code = [subject for subject in trial if subject.is_user_code] or trial
        try:
            with np.errstate(all="ignore"):
                failure, place = next(_failures(study, trial[0]), None), ""
        except UserCodeError as error:
            problem = error.problem
            for subject in code:
                problem = problem.removeprefix(f"{subject.key} ")
            failure, place = ("contract", error.legal or "no exception", problem), error.place
        if failure is not None:
            yield " and ".join(subject.key for subject in code), _finding(code[0], failure, place)


def _finding(subject: Subject, failure: Failure, place: str = "") -> Finding:
    file, _, line = (place or subject.definition).rpartition(":")
    check, expected, got = failure
    return Finding(check, file or subject.name, int(line or 1), expected, got, CHECKS[check])


def _failures(study: Study, subject: Subject) -> Iterator[Failure]:
    if subject.kind == "algorithm":
        return try_algorithm(study, subject.name)
    return try_constraint(study, subject.name) if subject.kind == "constraint" else try_simulations(study)
