"""What can be named in a study, and whether the user's own code keeps the promises that results
rest on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from inspect import getdoc
from operator import attrgetter
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np
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
    weather_of,
)
from safevar_sumo.scenarios.declared import read_study
from safevar_sumo.search import DESCRIPTIONS
from safevar_sumo.study import Study, free_parameters, study_names, unit_text
from safevar_sumo.terminal import open_progress
from safevar_sumo.vehicles import Characteristic, CharacteristicSet

if TYPE_CHECKING:
    from safevar_sumo.check.trials import Extent

NO_STUDY: Any = None
NAME: Columns = {"name": "name in a study"}
DESCRIBED: Columns = NAME | {"description": "what it is"}
SCENARIO: Columns = DESCRIBED | {
    "search": "axes of its encounters, and their widest ranges"
}
STUDIES: Columns = {
    **NAME,
    "title": "its title",
    "vehicle": "its vehicle",
    "ads": "its ads",
    "scenario": "its scenario",
    "weather": "its weather",
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
FURTHER_OBJECTIVES = {
    name: f"{objective.title.capitalize()} [{objective.unit}]."
    for name, objective in OBJECTIVES.items()
    if name not in METRICS
}
FURTHER_OBJECTIVES[UNSAFE_SHARE.name] = (
    f"Only with [scenario] repeats: {UNSAFE_SHARE.description}"
)
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
    scenarios = SCENARIOS
    if kind is not None and ":" in kind:
        named = Lookup().class_of(SCENARIOS, kind, "KIND", TrackScenario, WorldScenario)
        scenarios = {kind: named.target}
        kind = "scenarios"
    weathers = pd.DataFrame(map(msgspec.to_builtins, WEATHERS.values()))
    has_effect = ~np.array(list(map(equals_clear, WEATHERS.values())))
    weathers["effect"] = np.where(has_effect, "yes", "none")
    metrics = {**METRICS, **OPTIONAL_METRICS}.items()
    described_metrics = [(name, metric.description) for name, metric in metrics]

    # A table for each kind.
    tables = {
        "studies": tabulate("Studies", STUDIES, _studies()),
        "vehicles": tabulate(
            "Characteristics of vehicles", VEHICLES, _characteristics()
        ),
        "ads": tabulate("ADSs", DESCRIBED, _described(ADS)),
        "scenarios": tabulate("Scenarios", SCENARIO, _scenarios(scenarios)),
        "weathers": tabulate("Weathers", WEATHER, weathers),
        "algorithms": tabulate("Algorithms", DESCRIBED, DESCRIPTIONS.items()),
        "metrics": tabulate(METRICS_TITLE, DESCRIBED, described_metrics),
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
    texts = [f"{frame.iloc[:, 0].nunique()} {name}" for name, frame in tables.items()]
    if scenarios is not SCENARIOS:
        texts = list(scenarios)
    verdict = f"A study can name {', '.join(texts)}."
    return Answer(
        question="list",
        study=NO_STUDY,
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
    facts_of = attrgetter(*list(CHARACTERISTICS)[:-1])
    rows = [(*facts_of(item), _in_a_workshop(item)) for item in items]
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
        entries = size = 0
        if folder.is_dir():
            entries, size = simulations.Cache(folder).extent()
        rows = [(str(folder), entries, size / 1e6, limit)]
        verdict = (
            f"The folder {folder} keeps earlier simulations ({size / 1e6:.1f} MB of at most"
            f" {limit:,.0f} MB). You may delete it, and {variable} names another folder."
        )
    return Answer(
        question="list",
        is_whole=True,
        study=NO_STUDY,
        verdict=verdict,
        numbers={"passed": True},
        tables={"cache": tabulate("Cache of simulations", CACHE, rows)},
    )


def _in_a_workshop(item: Characteristic) -> str | None:
    """How a workshop measures a characteristic, and what it does beyond the limit; None if the
    study says neither.
    """
    texts = []
    if item.measurement:
        place = "" if item.workshop else "not in a workshop: "
        texts.append(f"{place}{item.measurement}")
    if item.remedy:
        texts.append(f"beyond its limit: {item.remedy}")
    return "; ".join(texts) or None


def _studies() -> Iterator[tuple[str, ...]]:
    for study in map(read_study, study_names()):
        yield (
            study.name,
            study.title,
            study.vehicle.model,
            study.ads.model,
            study.scenario.model,
            weather_of(study.weather).name,
        )


def _characteristics() -> Iterator[tuple[float | str, ...]]:
    studies = dict[str, Study]()
    for study in map(read_study, study_names()):
        studies.setdefault(study.vehicle.model or study.scenario.model, study)
    facts_of = attrgetter(*list(VEHICLES)[1:])
    for vehicle, study in sorted(studies.items()):
        for item in CharacteristicSet.of(study).vehicle:
            yield vehicle, *facts_of(item)


def _described(models: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    return ((name, description_of(model)) for name, model in models.items())


def description_of(model: Any) -> str:
    """The first paragraph of a model's docstring."""
    return " ".join((getdoc(model) or "").partition("\n\n")[0].split())


def _scenarios(models: Mapping[str, type[Scenario]]) -> Iterator[tuple[str, ...]]:
    for name, description in _described(models):
        model = models[name]
        parameters = dict[str, Any]()
        if not model.brakes_fully:
            parameters |= free_parameters(model)
            if model.mover.has("weather"):
                parameters |= WEATHER_PARAMETERS
        domains = []
        for key, parameter in parameters.items():
            unit = unit_text(parameter.unit)
            domains.append(f"{key} {parameter.lower:g} to {parameter.upper:g}{unit}")
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
    extents = []

    def tell(extent: Extent) -> None:
        """How long it takes, if it takes long."""
        extents.append(extent)
        if extent.seconds > LONG:
            warn(
                f"{number_of(extent.vehicles, 'vehicle')}, about {extent.seconds:.0f} s"
            )

    # First, as a simulator may end its process.
    in_new_process = find_in_new_process(study)
    with open_progress(True) as progress:
        findings = check_study(study, vehicles=vehicles, progress=progress, tell=tell)
    if not findings:
        # What the command `study` would refuse.
        check_algorithms(study, assemble(study))
        findings = in_new_process
    rows = []
    blocks = []
    for item in findings:
        advice = CHECKS[item.check]
        rows.append({**item._asdict(), "advice": advice})
        text = f"{item.finding}, with {item.input}" if item.input else item.finding
        blocks += [
            ("where", item.where),
            ("found", text),
            ("expected", item.expected),
            ("what to do", advice),
        ]
    number = "passed"
    if findings:
        number = number_of(len(findings), "finding")
    return Answer(
        question="check",
        study=study,
        verdict=f"{name}: {number}.{''.join(map(_extent_in_words, extents))}",
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
    remainders = []
    if extent.points < extent.all_points:
        remainders.append(f"the other {extent.all_points - extent.points} points")
    if extent.vehicles < extent.all_vehicles:
        remainders.append(f"more vehicles (--vehicles {extent.all_vehicles})")
    if remainders:
        text += f" Not tried: {' and '.join(remainders)}."
    return text
