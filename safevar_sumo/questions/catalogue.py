"""What can be named in a study, and whether the user's own code keeps the promises that results
rest on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from inspect import getdoc
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import pandas as pd

from safevar_sumo.ads import ADS
from safevar_sumo.errors import InputError, check_name, warn
from safevar_sumo.metrics import METRICS, OBJECTIVES, OPTIONAL_METRICS, UNSAFE_SHARE
from safevar_sumo.plugins import Lookup
from safevar_sumo.questions.answer import Answer, Column, Columns, contents, tabulate
from safevar_sumo.questions.options import Range
from safevar_sumo.questions.words import number_of
from safevar_sumo.scenarios import (
    SCENARIOS,
    WEATHER_PARAMETERS,
    WEATHERS,
    Scenario,
    TrackScenario,
    WorldScenario,
    equals_clear,
)
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.search import DESCRIPTIONS
from safevar_sumo.study import free_parameters, study_names, unit_text
from safevar_sumo.terminal import open_progress
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

if TYPE_CHECKING:
    from safevar_sumo.check.trials import Extent

NAME: Columns = {"name": "name in a study"}
DESCRIBED: Columns = NAME | {"description": "what it is"}
SCENARIO: Columns = DESCRIBED | {
    "search": "axes of its encounters, and their widest ranges"
}
STUDIES: Columns = NAME | {
    key: f"its {key}" for key in ("title", "vehicle", "ads", "scenario", "weather")
}
DOMAINS: Columns = {
    "unit": "its unit",
    "original": Column("as unit", "value of the original vehicle", "g"),
    "lower": Column("as unit", "lower end of its domain", "g"),
    "upper": Column("as unit", "upper end of its domain", "g"),
}
VEHICLES: Columns = {
    "vehicle": "vehicle",
    "name": "characteristic",
    **DOMAINS,
    "threshold": Column("as unit", "smallest change that the filter keeps", "g"),
    "meaning": Column("", "what it is", is_shown=False),
    "counterpart": Column("", "what it is in other models", is_shown=False),
}
CHARACTERISTICS: Columns = {
    **NAME,
    "short_name": Column("", "its name in sentences", is_detail=True),
    **DOMAINS,
    "measurement": Column("", "how a workshop measures it", is_shown=False),
    "remedy": Column("", "what to do with a vehicle beyond its limit", is_shown=False),
    "workshop": "how a workshop measures it, and what to do with a vehicle beyond its limit",
}
METRICS_TITLE = (
    "Metrics; TET and TIT use TTC = L_s / v_L, ttc_min and drac TTC_p = gap / (v - u)"
)
WEATHER: Columns = NAME | {
    "road_friction": "factor on the tyres' friction",
    "visibility": "factor on the distance at which sensors detect an obstacle",
    "recognition_delay": Column("s", "additional time to recognise somebody"),
    "light": "day or night",
    "water": Column("mm", "depth of the water on the road"),
    "effect": "none: an ADS drives as in clear weather, unless its parameters differ",
}
FURTHER_OBJECTIVES: Mapping[str, object] = {
    **{
        name: f"{objective.title.capitalize()} [{objective.unit}]."
        for name, objective in OBJECTIVES.items()
        if name not in METRICS
    },
    UNSAFE_SHARE.name: f"Only with [scenario] repeats: {UNSAFE_SHARE.description}",
}
FINDINGS: Columns = {
    "finding": "what is wrong",
    "where": "place in the user's code",
    "input": "input that shows it",
    "expected": "what is expected",
    "check": "name of the check",
    "advice": "what to do",
}
BLOCK: Columns = {
    "part": "where, found, expected, what to do",
    "text": "this part of a finding",
}


CACHE: Columns = {
    "folder": "where simulations are kept",
    "entries": "number of entries, each with up to some thousand simulations",
    "size": Column("MB", "size on disk", ".1f"),
    "limit": Column("MB", "size from which on the oldest simulations make room", ".0f"),
}


@contents(
    "passed",
    studies=STUDIES,
    vehicles=VEHICLES,
    ads=DESCRIBED,
    scenarios=SCENARIO,
    weathers=WEATHER,
    algorithms=DESCRIBED,
    metrics=DESCRIBED,
    objectives=DESCRIBED,
    characteristics=CHARACTERISTICS,
    cache=CACHE,
)
def list_models(kind: str | None = None, study: str | None = None) -> Answer:
    """List what the package contains: studies, vehicles, driving systems, scenarios, weathers,
    algorithms, metrics and objectives. KIND lists only one of these kinds. `list characteristics
    STUDY` lists the characteristics that a study changes, and how a workshop measures each one.
    `list cache` prints the folder with earlier simulations.

    Example: python -m safevar_sumo list studies
    """
    if kind == "characteristics":
        return _list_characteristics(study)
    if kind == "cache" and study is None:
        return _list_cache()
    if study is not None:
        raise InputError(
            "study", f"{kind} of {study!r}", "a study after characteristics alone"
        )

    # The user's own scenario, or everything.
    own = {}
    if kind is not None and ":" in kind:
        own[kind] = (
            Lookup()
            .class_of(SCENARIOS, kind, "KIND", TrackScenario, WorldScenario)
            .target
        )
        kind = "scenarios"
    effects = [
        "none" if equals_clear(weather) else "yes" for weather in WEATHERS.values()
    ]
    weathers = pd.DataFrame(map(msgspec.to_builtins, WEATHERS.values())).assign(
        effect=effects
    )
    metrics = (
        (name, metric.description)
        for name, metric in {**METRICS, **OPTIONAL_METRICS}.items()
    )

    # A table for each kind.
    tables = {
        "studies": tabulate("Studies", STUDIES, _studies()),
        "vehicles": tabulate(
            "Characteristics of vehicles", VEHICLES, _characteristics()
        ),
        "ads": tabulate("ADSs", DESCRIBED, _described(ADS)),
        "scenarios": tabulate("Scenarios", SCENARIO, _scenarios(own or SCENARIOS)),
        "weathers": tabulate("Weathers", WEATHER, weathers),
        "algorithms": tabulate("Algorithms", DESCRIBED, DESCRIPTIONS.items()),
        "metrics": tabulate(METRICS_TITLE, DESCRIBED, metrics),
        "objectives": tabulate(
            "Objectives; every metric can be one, too",
            DESCRIBED,
            FURTHER_OBJECTIVES.items(),
        ),
    }
    if kind is not None:
        check_name(
            "kind",
            f"there is no {kind!r} to list",
            kind,
            [*tables, "characteristics", "cache"],
        )
        tables = {kind: tables[kind]}
    counts = ", ".join(
        f"{frame.iloc[:, 0].nunique()} {name}" for name, frame in tables.items()
    )
    verdict = f"A study can name {', '.join(own) or counts}."
    no_study: Any = None
    return Answer(
        question="list",
        study=no_study,
        verdict=verdict,
        numbers={"passed": True},
        tables=tables,
        is_whole=True,
    )


def _list_characteristics(name: str | None) -> Answer:
    """The characteristics of a study, with how a workshop measures them."""
    if name is None:
        raise InputError(
            "study", "no study", "its name or file, as in list characteristics wear"
        )
    study = read_study(name)
    items = CharacteristicSet.of(study).vehicle
    rows = [
        (*(getattr(item, key) for key in [*CHARACTERISTICS][:-1]), _in_a_workshop(item))
        for item in items
    ]
    title = f"Characteristics of {study.name}"
    return Answer(
        question="list",
        study=study,
        verdict=f"{study.name} varies {number_of(len(rows), 'characteristic')}.",
        numbers={"passed": True},
        tables={"characteristics": tabulate(title, CHARACTERISTICS, rows)},
    )


def _list_cache() -> Answer:
    """Where simulations are kept, and how large they are."""
    from safevar_sumo.campaign import cache as simulations  # SUMO takes long to load

    folder = simulations.cache_folder()
    variable = simulations.FOLDER_VARIABLE
    limit = simulations.SIZE_LIMIT / 1e6
    verdict = f"Simulations are not kept: {variable} is {simulations.OFF}."
    rows = []
    if folder is not None:
        entries, size = (
            simulations.Cache(folder).extent() if folder.is_dir() else (0, 0)
        )
        rows = [(str(folder), entries, size / 1e6, limit)]
        verdict = (
            f"The folder {folder} keeps earlier simulations ({size / 1e6:.1f} MB of at most"
            f" {limit:,.0f} MB). You may delete it, and {variable} names another folder."
        )
    no_study: Any = None
    return Answer(
        question="list",
        is_whole=True,
        study=no_study,
        verdict=verdict,
        numbers={"passed": True},
        tables={"cache": tabulate("Cache of simulations", CACHE, rows)},
    )


def _in_a_workshop(item: Characteristic) -> str | None:
    """How a workshop measures a characteristic, and what it does beyond the limit; None if the
    study says neither.
    """
    remedy = f"beyond its limit: {item.remedy}" if item.remedy else ""
    place = "" if item.workshop else "not in a workshop: "
    measurement = f"{place}{item.measurement}" if item.measurement else ""
    return "; ".join(filter(None, (measurement, remedy))) or None


def _studies() -> Iterator[tuple[str, ...]]:
    for study in map(read_study, study_names()):
        weather = (
            study.weather if isinstance(study.weather, str) else study.weather.name
        )
        yield (
            study.name,
            study.title,
            study.vehicle.model,
            study.ads.model,
            study.scenario.model,
            weather,
        )


def _characteristics() -> Iterator[tuple[float | str, ...]]:
    studies = {
        study.vehicle.model or study.scenario.model: study
        for study in reversed([*map(read_study, study_names())])
    }
    for vehicle, study in sorted(studies.items()):
        for row in CharacteristicSet.of(study).vehicle:
            yield vehicle, *(getattr(row, name) for name in list(VEHICLES)[1:])


def _described(models: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    return ((name, description_of(model)) for name, model in models.items())


def description_of(model: Any) -> str:
    """The first paragraph of a model's docstring."""
    return " ".join((getdoc(model) or "").partition("\n\n")[0].split())


def _scenarios(models: Mapping[str, type[Scenario]]) -> Iterator[tuple[str, ...]]:
    for name, description in _described(models):
        own = (
            {}
            if models[name].brakes_fully
            else {
                **free_parameters(models[name]),
                **(WEATHER_PARAMETERS if models[name].mover.has("weather") else {}),
            }
        )
        domains = (
            f"{key} {parameter.lower:g} to {parameter.upper:g}{unit_text(parameter.unit)}"
            for key, parameter in own.items()
        )
        yield name, description, "; ".join(domains)


LONG = 10.0
"""Time from which on `check` says first how long it takes [s]."""


@contents("passed", "vehicles", "points", lead="block", block=BLOCK, findings=FINDINGS)
def check(
    name: str, *, vehicles: Annotated[int | None, Range(1, 10_000)] = None
) -> Answer:
    """Check whether your own code (a driving system, vehicle, scenario, metric, objective or
    algorithm) keeps the rules on which results rest. NAME is a study, or a driving system such as
    my_ads:Careful. The exit code is 0 without findings, 1 with findings, and 2 if NAME cannot be
    loaded.

    Example: python -m safevar_sumo check mine.toml

    Parameters
    ----------
    vehicles
        Number of vehicles that are simulated. Default: up to 100, as many as take 60 s.
    """
    # What loads SUMO is imported where it is needed.
    from safevar_sumo.campaign import check_algorithms
    from safevar_sumo.campaign.user_checks import find_in_new_process
    from safevar_sumo.check import CHECKS, check_study, study_to_check
    from safevar_sumo.sumo.system import assemble

    study = study_to_check(name)
    extents: list[Extent] = []

    def tell(extent: Extent) -> None:
        """How long it takes, if it takes long."""
        extents.append(extent)
        if extent.seconds > LONG:
            warn(
                f"{number_of(extent.vehicles, 'vehicle')}, about {extent.seconds:.0f} s"
            )

    in_new_process = find_in_new_process(
        study
    )  # first, as a simulator may end its process
    with open_progress(True) as progress:
        findings = check_study(study, vehicles=vehicles, progress=progress, tell=tell)
    if not findings:
        check_algorithms(
            study, assemble(study)
        )  # what the command `study` would refuse
        findings = in_new_process
    rows = [
        (
            item.finding,
            item.where,
            item.input,
            item.expected,
            item.check,
            CHECKS[item.check],
        )
        for item in findings
    ]
    blocks = [
        part
        for finding, where, shown, expected, _, advice in rows
        for part in (
            ("where", where),
            ("found", f"{finding}, with {shown}" if shown else finding),
            ("expected", expected),
            ("what to do", advice),
        )
    ]
    return Answer(
        question="check",
        study=study,
        verdict=(
            f"{name}: {number_of(len(findings), 'finding') if findings else 'passed'}."
            f"{''.join(map(_extent_in_words, extents))}"
        ),
        numbers={
            "passed": not findings,
            "vehicles": sum(extent.vehicles for extent in extents),
            "points": sum(extent.points for extent in extents),
        },
        tables={
            "block": tabulate("Findings", BLOCK, blocks),
            "findings": tabulate("Findings", FINDINGS, rows),
        },
        folded=("findings",),
    )


def _extent_in_words(extent: Extent) -> str:
    """What was simulated, and what was not tried."""
    points = number_of(extent.points, "point")
    text = f" {number_of(extent.vehicles, 'vehicle')} at {points} of the study."
    left = []
    if extent.points < extent.all_points:
        left.append(f"the other {extent.all_points - extent.points} points")
    if extent.vehicles < extent.all_vehicles:
        left.append(f"more vehicles (--vehicles {extent.all_vehicles})")
    return f"{text} Not tried: {' and '.join(left)}." if left else text
