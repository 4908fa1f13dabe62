"""Subjects of the checks: a class, function or record by name, its kind, and the study that it is tried in."""

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
from safevar_sumo.errors import InputError, SafevarError, refuse_other_than_file, unknown
from safevar_sumo.fmu import file_of
from safevar_sumo.metrics import FURTHER, METRICS, OBJECTIVES, Metric
from safevar_sumo.plugins import Contract, Guard, Lookup, Member
from safevar_sumo.scenarios import SCENARIO_CONTRACT, SCENARIOS
from safevar_sumo.search import ALGORITHM_CONTRACT, ALGORITHMS
from safevar_sumo.study import CharacteristicTable, MatrixTest, ModelTable, Study, fmus_of, load_study, study_names
from safevar_sumo.sumo.traci_module import importable
from safevar_sumo.vehicles import CHANGES, VEHICLE_CONTRACT, VEHICLES, Change, FmuVehicle

KINDS: Mapping[str, Mapping[str, Any]] = {
    "ads": ADS, "vehicle": VEHICLES, "scenario": SCENARIOS, "metric": {**METRICS, **FURTHER}, "objective": CHANGES,
    "algorithm": ALGORITHMS, "traci": {}}
"""Kinds of subjects, and the shipped ones by name."""
METHODS: Mapping[str, tuple[str, ...]] = {
    "ads": ("start", "drive"), "vehicle": ("prepare", "sumo_type", "at_rest", "sense", "advance"),
    "scenario": ("begin", "observe", "encounter"), "algorithm": ("search",), "traci": ("step",)}
KEYS = {"metric": "metrics.also", "objective": "search.objectives", "algorithm": "search.algorithms", "traci": "ads.model"}
"""Keys of a study that name subjects of a kind; `KIND.model` for the other kinds."""
DEFAULT_STUDIES = {"traci": "native"}
"""Studies in which a kind is tried if no study names the subject; `smoke` for the other kinds."""
MOST_FILES = 50
"""Maximum number of study files beside a subject that are read."""
BY_UNIT = {"kg": (1500.0, 1000.0, 2500.0), "m/s^2": (5.0, 3.0, 8.0), "m/s": (30.0, 20.0, 40.0), "s": (0.1, 0.05, 0.3), "m": (1.0, 0.5, 2.0),
           "Nm": (400.0, 200.0, 600.0), "N": (4000.0, 2000.0, 6000.0)}
"""Original and domain of a characteristic that no study names, by its unit; 0.8 to 1.2 around 1 for other units."""


class Subject(NamedTuple):
    """A class, function or record to check, by its `name` on the command line or in `study`; `remarks` tell what was assumed."""

    name: str
    kind: str
    member: Member
    study: Study
    parameters: Mapping[str, Any] = {}
    remarks: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """The subject's key and name, as in errors about a study."""
        return f"{KEYS.get(self.kind, f'{self.kind}.model')} = {self.name!r}"

    @property
    def is_ours(self) -> bool:
        return self.member.guard is None


def subject_of(name: str, study: str | None = None) -> Subject:
    """Find a subject by its name.

    Parameters
    ----------
    name
        The name of a shipped subject, or `package.module:Name`.
    study
        A study to try it in; by default one beside it that names it, else a shipped one.

    Raises
    ------
    InputError
        If nothing has that name, or it cannot be checked.
    """
    chosen = None if study is None else load_study(study)
    name = OBJECTIVES[name].name if name in OBJECTIVES else name
    kinds = [kind for kind, members in KINDS.items() if name in members]
    if kinds:
        study_to_try = chosen or next((one for one in map(load_study, study_names()) if _named(one, kinds[0], name)), load_study("smoke"))
        return _in_study(Subject(name, kinds[0], Member(KINDS[kinds[0]][name]), study_to_try))
    if name.endswith(".fmu"):
        return _fmu_of(name, chosen)
    if ":" not in name:
        names = [*study_names(), *OBJECTIVES, *(one for members in KINDS.values() for one in members)]
        raise unknown("check", f"there is nothing called {name!r}", name, names, ", package.module:Name, or the path of a study file")
    places = () if chosen is None else chosen.origin.places
    with importable():
        member = Lookup("check", places).find({}, name, "SUBJECT")
    beside = [] if chosen else list(_studies_beside(name, member.folder))
    study_of = chosen or (beside[0] if beside else None)
    kind = next((kind for kind in KINDS if study_of is not None and _named(study_of, kind, name)), "") or kind_of(member.target)
    if not kind:
        legal = "a class with the methods of an ADS, a vehicle, a scenario, an algorithm or a TraCI controller; a Metric; a Change"
        raise InputError("check", f"{name!r} is {_short(member.target)}, which is nothing that a study can name", legal)
    remarks = (f"tried in {beside[0].origin.called}, which names it",) if beside else ()
    return _in_study(Subject(name, kind, member, study_of or load_study(DEFAULT_STUDIES.get(kind, "smoke")), {}, remarks))


def _fmu_of(name: str, chosen: Study | None) -> Subject:
    """An FMU in a study that maps its variables."""
    refuse_other_than_file(Path(name))
    for study in [chosen] if chosen else _studies_beside(Path(name).name, str(Path(name).absolute().parent)):
        for key, model in fmus_of(study):
            if file_of(model, study.origin.places) == str(Path(name).absolute()):
                remarks = () if chosen else (f"tried in {study.origin.called}, which names it",)
                return _fmu(study, key.partition(".")[0], model)._replace(remarks=remarks)
    problem = f"no study says what the variables of {name!r} stand for" if Path(name).exists() else f"there is no file {name!r}"
    raise InputError("check", problem, '--study STUDY, whose [ads] or [vehicle] has kind = "fmu" and that model')


def subjects_of(study: Study) -> Iterator[Subject]:
    """Every subject that a study names, each once."""
    lookup = Lookup(study.source, study.origin.places)
    named = {"vehicle": [study.vehicle.model], "traci" if study.ads.kind == "traci" else "ads": [study.ads.model],
             "scenario": [study.scenario.model, *(test.model for test in _tests(study) if test.model)],
             "metric": study.metrics.also, "objective": study.search.objectives, "algorithm": study.search.algorithms}
    seen = set[str]()
    for kind, names in named.items():
        for name in dict.fromkeys(names):
            if (f"{kind}.model", name) in fmus_of(study):
                yield _fmu(study, kind, name)
                continue
            of_a_metric = kind == "objective" and ":" not in name and name not in CHANGES  # it names a metric, not a change
            if name in seen or of_a_metric:
                continue
            seen.add(name)
            with importable():
                member = lookup.find(CHANGES if kind == "objective" else KINDS[kind], name, KEYS.get(kind, f"{kind}.model"))
            subject_kind = "metric" if isinstance(member.target, Metric) else kind
            yield Subject(name, subject_kind, member, study, _parameters(study, subject_kind, name))


def _fmu(study: Study, kind: str, name: str) -> Subject:
    guard, file = Guard(study.source, f"{kind}.model = {name!r}"), file_of(name, study.origin.places)
    return Subject(name, kind, Member(FmuAds if kind == "ads" else FmuVehicle, guard, file=file), study, _parameters(study, kind, name))


def kind_of(what: Any) -> str:
    """The kind of an object that a name stands for; "" if it is of no kind."""
    if isinstance(what, Metric | Change):
        return "metric" if isinstance(what, Metric) else "objective"
    if inspect.isclass(what):
        if issubclass(what, ScalarAds):
            return "ads"
        shares = {kind: sum(hasattr(what, name) for name in names) / len(names) for kind, names in METHODS.items()}
        best = max(shares, key=lambda kind: shares[kind])
        return best if shares[best] > 0 else ""
    if not callable(what) or inspect.ismodule(what):
        return ""
    with suppress(TypeError, ValueError):
        names = list(inspect.signature(what).parameters)
        if names[1:2] in (["thresholds"], ["characteristics"]):
            return "metric" if names[1] == "thresholds" else "objective"
    return "traci"


def violation(subject: Subject) -> tuple[str, str]:
    """The reason why a subject does not meet its contract, by inspection alone, and the expectation; empty reason if it does."""
    what, kind = subject.member.target, subject.kind
    if kind in ("metric", "objective"):
        record = Metric if kind == "metric" else Change
        fields = "name=..., title=..., unit=..., " + ("more_is_unsafe=..., " if kind == "metric" else "") + "function=..."
        expected = f"a record safevar_sumo.{'metrics.Metric' if kind == 'metric' else 'vehicles.Change'}({fields})"
        return ("", "") if isinstance(what, record) else (f"is {_short(what)}", expected)
    if kind == "traci":
        function = getattr(what, "step", None) if inspect.isclass(what) else what
        expected = "a function step(traci, vehicle_id), or a class with that method"
        if not callable(function):
            return "has no step", expected
        return _refused_arguments(function, 2 + inspect.isclass(what), len(subject.parameters)), expected
    contracts: Mapping[str, tuple[Contract, ...]] = {
        "ads": (SCALAR_ADS_CONTRACT, ADS_CONTRACT), "vehicle": (VEHICLE_CONTRACT,), "scenario": (SCENARIO_CONTRACT,),
        "algorithm": (ALGORITHM_CONTRACT,)}
    contract = next(one for one in contracts[kind] if one.applies_to(what))
    return contract.violation(what), str(contract)


def _refused_arguments(function: Callable[..., Any], passed: int, named: int) -> str:
    """What is wrong with a step's arguments, of which `passed` come by position and `named` by name; empty if nothing is."""
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return ""
    many = any(one.kind is one.VAR_POSITIONAL for one in parameters)
    positional = [one for one in parameters if one.kind in (one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD)]
    names = ", ".join(one.name for one in parameters)
    required = [one for one in positional if one.default is one.empty]
    if many or len(positional) >= passed >= len(required) - named:
        return ""
    return f"has a step that takes ({names}), not (traci, vehicle_id)"


def _in_study(subject: Subject) -> Subject:
    """The subject in a study that names it, with the parameters of that study, or guessed ones."""
    study, kind, name = subject.study, subject.kind, subject.name
    if _named(study, kind, name):
        return subject._replace(parameters=_parameters(study, kind, name))
    parameters, guessed = _guess(subject.member.target) if kind in METHODS else ({}, "")
    remarks = [*subject.remarks, *([guessed] if guessed else [])]
    tables: dict[str, Any] = {}
    if kind in ("ads", "traci"):
        tables["ads"] = ModelTable(model=name, parameters=parameters, kind="traci" if kind == "traci" else "")
    elif kind == "scenario":
        tables["scenario"], tables["matrix"] = ModelTable(model=name, parameters=parameters), None
    elif kind == "vehicle":
        units = getattr(subject.member.target, "UNITS", None)
        rows, note = _characteristics(units if isinstance(units, Mapping) else {}, study)
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


def _guess(what: Any) -> tuple[dict[str, Any], str]:
    """Values for parameters without defaults, and a remark on them."""
    try:
        signature = inspect.signature(what, eval_str=False)
    except (TypeError, ValueError):
        return {}, ""
    if not inspect.isclass(what):
        return {}, ""
    given: dict[str, Any] = {}
    for one in signature.parameters.values():
        if one.default is one.empty and one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY):
            kind = one.annotation if isinstance(one.annotation, type) else {"int": int, "str": str, "bool": bool}.get(
                str(one.annotation), next((arg for arg in get_args(one.annotation) if arg in (int, str, bool)), float))
            given[one.name] = {int: 1, str: "", bool: False}.get(kind, 1.0)
    if not given:
        return {}, ""
    values = ", ".join(f"{name} = {value!r}" for name, value in given.items())
    return given, f"no study gives its parameters: tried with {values}; --study STUDY names a study that does"


def _characteristics(units: Mapping[str, str], study: Study) -> tuple[dict[str, CharacteristicTable], str]:
    """A domain for every characteristic, from the study, or a shipped one, if name and unit match, else by unit; and a remark."""
    rows: dict[str, CharacteristicTable] = {}
    guessed = []
    studies = [study, *map(load_study, study_names())]
    for name, unit in units.items():
        row = next((one.vehicle.characteristics[name] for one in studies
                    if name in one.vehicle.characteristics and one.vehicle.characteristics[name].unit == unit), None)
        if row is None:
            original, lower, upper = BY_UNIT.get(str(unit), (1.0, 0.8, 1.2))
            guessed.append(f"{name} {lower:g} to {upper:g} {unit}")
        rows[str(name)] = row or CharacteristicTable(unit=str(unit), original=original, lower=lower, upper=upper)
    note = f"no study gives domains: tried with {', '.join(guessed)}; --study STUDY names a study that does" if guessed else ""
    return rows, note


def _tests(study: Study) -> list[MatrixTest]:
    return [] if study.matrix is None else study.matrix.tests


def _named(study: Study, kind: str, name: str) -> bool:
    """Whether a study names a subject of that kind and name."""
    return name in {
        "ads": [study.ads.model] if study.ads.kind != "traci" else [], "traci": [study.ads.model] if study.ads.kind == "traci" else [],
        "vehicle": [study.vehicle.model], "scenario": [study.scenario.model], "metric": study.metrics.also,
        "objective": [] if name in study.metrics.also else study.search.objectives, "algorithm": study.search.algorithms}[kind]


def _parameters(study: Study, kind: str, name: str) -> Mapping[str, Any]:
    if kind == "algorithm":
        return study.search.parameters.get(name.rpartition(":")[2], {})
    tables = {"ads": study.ads.parameters, "traci": study.ads.parameters, "vehicle": study.vehicle.parameters,
              "scenario": study.scenario.parameters}
    return tables.get(kind, {})


def _studies_beside(name: str, folder: str) -> Iterator[Study]:
    """Studies in the working directory, or beside the subject, that name it."""
    for place in dict.fromkeys((os.getcwd(), folder)):
        for file in sorted(Path(place).glob("*.toml"))[:MOST_FILES]:
            with suppress(SafevarError, OSError, UnicodeDecodeError, tomllib.TOMLDecodeError):
                if f'"{name}"' in (text := file.read_text(encoding="utf-8")) or f"'{name}'" in text:
                    study = load_study(str(file.relative_to(os.getcwd()) if file.is_relative_to(os.getcwd()) else file))
                    if any(_named(study, kind, name) for kind in KINDS):
                        yield study


def _short(what: Any) -> str:
    return f"a {'class' if inspect.isclass(what) else 'module' if inspect.ismodule(what) else type(what).__name__}"

