"""Subjects of the checks: classes, functions and records by name, with their kind and a study to try them in."""

from __future__ import annotations

import inspect
import os
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, get_args

import msgspec

from safevar_sumo.ads import ADS, ADS_CONTRACT, SCALAR_ADS_CONTRACT, FmuAds, ScalarAds
from safevar_sumo.errors import InputError, SafevarError, refuse_other_than_file, unknown_name
from safevar_sumo.fmu import file_of
from safevar_sumo.metrics import METRIC_OF_OBJECTIVE, METRICS, OPTIONAL_METRICS, Metric
from safevar_sumo.plugins import Contract, Guard, Lookup, Member
from safevar_sumo.scenarios import SCENARIO_CONTRACT, SCENARIOS
from safevar_sumo.search import ALGORITHM_CONTRACT, ALGORITHMS
from safevar_sumo.study import CharacteristicTable, ModelTable, Study, fmus_of, load_study, study_names
from safevar_sumo.sumo.traci_module import substitute_traci
from safevar_sumo.vehicles import CHANGES, VEHICLE_CONTRACT, VEHICLES, Change, FmuVehicle

KINDS: Mapping[str, Mapping[str, Any]] = {
    "ads": ADS, "vehicle": VEHICLES, "scenario": SCENARIOS, "metric": {**METRICS, **OPTIONAL_METRICS}, "objective": CHANGES,
    "algorithm": ALGORITHMS, "traci": {}, "constraint": {}}
"""Kinds of subjects, each with its shipped subjects by name."""
METHODS: Mapping[str, tuple[str, ...]] = {
    "ads": ("start", "drive"), "vehicle": ("prepare", "sumo_type", "at_rest", "sense", "advance"),
    "scenario": ("begin", "observe", "encounter"), "algorithm": ("search",), "traci": ("step",)}
"""Methods by which `kind_of` recognises a class, by kind."""
KEYS = {"metric": "metrics.also", "objective": "search.objectives", "algorithm": "search.algorithms", "traci": "ads.model",
        "constraint": "constraints.function"}
"""Key of a study that names subjects of a kind; `KIND.model` for all other kinds."""
DEFAULT_STUDIES = {"traci": "native"}
"""Study to try a subject of a kind in if no study names the subject; `smoke` for all other kinds."""
MAX_FILES = 50
"""Maximum number of study files that are read in a directory."""
DOMAINS_BY_UNIT = {
    "kg": (1500.0, 1000.0, 2500.0), "m/s^2": (5.0, 3.0, 8.0), "m/s": (30.0, 20.0, 40.0), "s": (0.1, 0.05, 0.3), "m": (1.0, 0.5, 2.0),
    "Nm": (400.0, 200.0, 600.0), "N": (4000.0, 2000.0, 6000.0)}
"""Original, lower and upper value by unit, for a characteristic that no study names; 1, 0.8 and 1.2 for all other units."""


class Subject(NamedTuple):
    """A class, function or record to check. `name` is its name on the command line or in `study`; `remarks` state assumptions.

    `in_any_study` is true if no study names an ADS: `study` may then start it from rest although it holds its initial speed.
    """

    name: str
    kind: str
    member: Member
    study: Study
    parameters: Mapping[str, Any] = {}
    remarks: tuple[str, ...] = ()
    in_any_study: bool = False

    @property
    def key(self) -> str:
        """The key and name of the subject, as in errors about a study."""
        return f"{KEYS.get(self.kind, f'{self.kind}.model')} = {self.name!r}"

    @property
    def is_user_code(self) -> bool:
        return self.member.guard is not None


def find_subject(name: str, study: str | None = None) -> Subject:
    """Find a subject by its name.

    Parameters
    ----------
    name
        The name of a shipped subject, or `package.module:Name`.
    study
        A study to try the subject in; by default a study file beside the subject that names it, or else a shipped study.

    Raises
    ------
    InputError
        If nothing has this name, or the subject cannot be checked.
    """
    given_study = None if study is None else load_study(study)
    name = METRIC_OF_OBJECTIVE[name].name if name in METRIC_OF_OBJECTIVE else name
    kinds = [kind for kind, members in KINDS.items() if name in members]
    if kinds:
        shipped_studies = (shipped for shipped in map(load_study, study_names()) if _is_named(shipped, kinds[0], name))
        trial_study = given_study or next(shipped_studies, None)
        member = Member(KINDS[kinds[0]][name])
        return _put_in_study(Subject(name, kinds[0], member, trial_study or load_study("smoke"), in_any_study=not trial_study))
    if name.endswith(".fmu"):
        return _find_fmu(name, given_study)
    if ":" not in name:
        names = [*study_names(), *METRIC_OF_OBJECTIVE, *(member for members in KINDS.values() for member in members)]
        raise unknown_name("check", f"there is nothing called {name!r}", name, names, ", package.module:Name, or the path of a study file")
    folders = () if given_study is None else given_study.origin.places
    with substitute_traci():
        member = Lookup("check", folders).find({}, name, "SUBJECT")
    nearby_study = None if given_study else next(_studies_beside(name, member.folder), None)
    naming_study = given_study or nearby_study
    kind = next((kind for kind in KINDS if naming_study and _is_named(naming_study, kind, name)), "") or kind_of(member.target)
    if not kind:
        legal = "a class with the methods of an ADS, a vehicle, a scenario, an algorithm or a TraCI controller; a Metric; a Change"
        raise InputError("check", f"{name!r} is {_type_name(member.target)}, which is nothing that a study can name", legal)
    remarks = (f"tried in {nearby_study.origin.called}, which names it",) if nearby_study else ()
    trial_study = naming_study or load_study(DEFAULT_STUDIES.get(kind, "smoke"))
    in_any_study = kind == "ads" and naming_study is None
    return _put_in_study(Subject(name, kind, member, trial_study, {}, remarks, in_any_study))


def _find_fmu(name: str, given_study: Study | None) -> Subject:
    """An FMU in a study that maps its variables."""
    refuse_other_than_file(Path(name))
    for study in [given_study] if given_study else _studies_beside(Path(name).name, str(Path(name).absolute().parent)):
        for key, model in fmus_of(study):
            if file_of(model, study.origin.places) == str(Path(name).absolute()):
                remarks = () if given_study else (f"tried in {study.origin.called}, which names it",)
                return _subject_of_fmu(study, key.partition(".")[0], model)._replace(remarks=remarks)
    problem = f"no study says what the variables of {name!r} stand for" if Path(name).exists() else f"there is no file {name!r}"
    raise InputError("check", problem, '`study=STUDY`, whose [ads] or [vehicle] has kind = "fmu" and that model')


def subjects_of(study: Study) -> Iterator[Subject]:
    """Each subject that a study names, once."""
    lookup = Lookup(study.source, study.origin.places)
    tests = study.matrix.tests if study.matrix else []
    names_by_kind = {"vehicle": [study.vehicle.model], "traci" if study.ads.kind == "traci" else "ads": [study.ads.model],
                     "scenario": [study.scenario.model, *(test.model for test in tests if test.model)],
                     "metric": study.metrics.also, "objective": study.search.objectives, "algorithm": study.search.algorithms,
                     "constraint": [constraint.function for constraint in study.constraints if constraint.function]}
    names_done = set[str]()
    for kind, names in names_by_kind.items():
        for name in dict.fromkeys(names):
            if (f"{kind}.model", name) in fmus_of(study):
                yield _subject_of_fmu(study, kind, name)
                continue
            is_metric_name = kind == "objective" and ":" not in name and name not in CHANGES  # not a change
            if name in names_done or is_metric_name:
                continue
            names_done.add(name)
            with substitute_traci():
                member = lookup.find(CHANGES if kind == "objective" else KINDS[kind], name, KEYS.get(kind, f"{kind}.model"))
            subject_kind = "metric" if isinstance(member.target, Metric) else kind
            yield Subject(name, subject_kind, member, study, _stated_parameters(study, subject_kind, name))


def _subject_of_fmu(study: Study, kind: str, name: str) -> Subject:
    guard, file = Guard(study.source, f"{kind}.model = {name!r}"), file_of(name, study.origin.places)
    member = Member(FmuAds if kind == "ads" else FmuVehicle, guard, file=file)
    return Subject(name, kind, member, study, _stated_parameters(study, kind, name))


def kind_of(target: Any) -> str:
    """The kind of an object; "" if the object is of no kind."""
    if isinstance(target, Metric | Change):
        return "metric" if isinstance(target, Metric) else "objective"
    if inspect.isclass(target):
        if issubclass(target, ScalarAds):
            return "ads"
        shares = {kind: sum(hasattr(target, name) for name in names) / len(names) for kind, names in METHODS.items()}
        likeliest_kind = max(shares, key=lambda kind: shares[kind])
        return likeliest_kind if shares[likeliest_kind] > 0 else ""
    if not callable(target) or inspect.ismodule(target):
        return ""
    with suppress(TypeError, ValueError):
        names = list(inspect.signature(target).parameters)
        if names[1:2] in (["thresholds"], ["characteristics"]):
            return "metric" if names[1] == "thresholds" else "objective"
    return "traci"


def contract_violation(subject: Subject) -> tuple[str, str]:
    """A subject's violation of its contract, found by inspection only ("" without one), and what the contract expects."""
    target, kind = subject.member.target, subject.kind
    if kind == "constraint":
        return "", ""  # `region_of` refuses what is no function
    if kind in ("metric", "objective"):
        record = Metric if kind == "metric" else Change
        fields = "name=..., title=..., unit=..., " + ("more_is_unsafe=..., " if kind == "metric" else "") + "function=..."
        expected = f"a record safevar_sumo.{'metrics.Metric' if kind == 'metric' else 'vehicles.Change'}({fields})"
        return ("", "") if isinstance(target, record) else (f"is {_type_name(target)}", expected)
    if kind == "traci":
        function = getattr(target, "step", None) if inspect.isclass(target) else target
        expected = "a function step(traci, vehicle_id), or a class with that method"
        if not callable(function):
            return "has no step", expected
        return _step_violation(function, positional_count=2 + inspect.isclass(target), keyword_count=len(subject.parameters)), expected
    contracts: Mapping[str, tuple[Contract, ...]] = {
        "ads": (SCALAR_ADS_CONTRACT, ADS_CONTRACT), "vehicle": (VEHICLE_CONTRACT,), "scenario": (SCENARIO_CONTRACT,),
        "algorithm": (ALGORITHM_CONTRACT,)}
    contract = next(contract for contract in contracts[kind] if contract.applies_to(target))
    return contract.violation(target), str(contract)


def _step_violation(function: Callable[..., Any], positional_count: int, keyword_count: int) -> str:
    """Why the function cannot be called with so many positional and keyword arguments; "" if it can."""
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return ""
    takes_any_number = any(parameter.kind is parameter.VAR_POSITIONAL for parameter in parameters)
    positional = [parameter for parameter in parameters if parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)]
    names = ", ".join(parameter.name for parameter in parameters)
    required = [parameter for parameter in positional if parameter.default is parameter.empty]
    if takes_any_number or len(positional) >= positional_count >= len(required) - keyword_count:
        return ""
    return f"has a step that takes ({names}), not (traci, vehicle_id)"


def _put_in_study(subject: Subject) -> Subject:
    """The subject in a study that names it, with parameters from the study, or else with guessed parameters."""
    study, kind, name = subject.study, subject.kind, subject.name
    if _is_named(study, kind, name):
        return subject._replace(parameters=_stated_parameters(study, kind, name))
    parameters, guess = _guess_parameters(subject.member.target) if kind in METHODS else ({}, "")
    remarks = [*subject.remarks, *([guess] if guess else [])]
    tables: dict[str, Any] = {}
    if kind in ("ads", "traci"):
        tables["ads"] = ModelTable(model=name, parameters=parameters, kind="traci" if kind == "traci" else "")
    elif kind == "scenario":
        tables["scenario"], tables["matrix"] = ModelTable(model=name, parameters=parameters), None
    elif kind == "vehicle":
        units = getattr(subject.member.target, "UNITS", None)
        rows, note = _guess_characteristics(units if isinstance(units, Mapping) else {}, study)
        remarks += [note] if note else []
        tables["vehicle"] = msgspec.structs.replace(study.vehicle, model=name, parameters=parameters, characteristics=rows)
        tables |= {"variation": {}, "correlations": [], "calibration": {}}
    elif kind == "algorithm":
        tables["search"] = msgspec.structs.replace(study.search, algorithms=[name], parameters={name.rpartition(":")[2]: parameters})
    elif kind == "metric":
        tables["metrics"] = msgspec.structs.replace(study.metrics, also=[] if name in METRICS else [name])
    else:
        tables["search"] = msgspec.structs.replace(study.search, objectives=["safety_degree", name])
    return subject._replace(study=msgspec.structs.replace(study, **tables), parameters=parameters, remarks=tuple(remarks))


def _guess_parameters(target: Any) -> tuple[dict[str, Any], str]:
    """Guessed values for parameters without defaults, and a remark on these values."""
    try:
        signature = inspect.signature(target, eval_str=False)
    except (TypeError, ValueError):
        return {}, ""
    if not inspect.isclass(target):
        return {}, ""
    guesses: dict[str, Any] = {}
    for parameter in signature.parameters.values():
        if parameter.default is parameter.empty and parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
            kind = parameter.annotation if isinstance(parameter.annotation, type) else {"int": int, "str": str, "bool": bool}.get(
                str(parameter.annotation), next((arg for arg in get_args(parameter.annotation) if arg in (int, str, bool)), float))
            guesses[parameter.name] = {int: 1, str: "", bool: False}.get(kind, 1.0)
    if not guesses:
        return {}, ""
    values = ", ".join(f"{name} = {value!r}" for name, value in guesses.items())
    return guesses, f"no study gives its parameters: tried with {values}; --study STUDY names a study that does"


def _guess_characteristics(units: Mapping[str, str], study: Study) -> tuple[dict[str, CharacteristicTable], str]:
    """A domain for every characteristic, and a remark: from a study with the same name and unit, or else by unit."""
    rows: dict[str, CharacteristicTable] = {}
    guesses = []
    studies = [study, *map(load_study, study_names())]
    for name, unit in units.items():
        row = next((known_study.vehicle.characteristics[name] for known_study in studies
                    if name in known_study.vehicle.characteristics and known_study.vehicle.characteristics[name].unit == unit), None)
        if row is None:
            original, lower, upper = DOMAINS_BY_UNIT.get(str(unit), (1.0, 0.8, 1.2))
            guesses.append(f"{name} {lower:g} to {upper:g} {unit}")
        rows[str(name)] = row or CharacteristicTable(unit=str(unit), original=original, lower=lower, upper=upper)
    note = f"no study gives domains: tried with {', '.join(guesses)}; --study STUDY names a study that does" if guesses else ""
    return rows, note


def _is_named(study: Study, kind: str, name: str) -> bool:
    """Whether a study names the subject `name` of a kind."""
    return name in {
        "ads": [study.ads.model] if study.ads.kind != "traci" else [], "traci": [study.ads.model] if study.ads.kind == "traci" else [],
        "vehicle": [study.vehicle.model], "scenario": [study.scenario.model], "metric": study.metrics.also,
        "objective": [] if name in study.metrics.also else study.search.objectives, "algorithm": study.search.algorithms,
        "constraint": [constraint.function for constraint in study.constraints]}[kind]


def _stated_parameters(study: Study, kind: str, name: str) -> Mapping[str, Any]:
    if kind == "algorithm":
        return study.search.parameters.get(name.rpartition(":")[2], {})
    tables = {"ads": study.ads.parameters, "traci": study.ads.parameters, "vehicle": study.vehicle.parameters,
              "scenario": study.scenario.parameters}
    return tables.get(kind, {})


def _studies_beside(name: str, folder: str) -> Iterator[Study]:
    """Studies in the working directory, or in the folder of a subject, that name the subject."""
    for directory in dict.fromkeys((os.getcwd(), folder)):
        for file in sorted(Path(directory).glob("*.toml"))[:MAX_FILES]:
            with suppress(SafevarError, OSError, UnicodeDecodeError, tomllib.TOMLDecodeError):
                if f'"{name}"' in (text := file.read_text(encoding="utf-8")) or f"'{name}'" in text:
                    study = load_study(str(file.relative_to(os.getcwd()) if file.is_relative_to(os.getcwd()) else file))
                    if any(_is_named(study, kind, name) for kind in KINDS):
                        yield study


def _type_name(target: Any) -> str:
    return f"a {'class' if inspect.isclass(target) else 'module' if inspect.ismodule(target) else type(target).__name__}"

