"""The commands `list` and `check`: `list` shows everything that a study can name, and `check` tests
whether the user's own code keeps the rules on which results rest.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from inspect import getdoc
from operator import attrgetter
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np
import pandas as pd

from safevar_sumo.ads import ADS
from safevar_sumo.errors import InputError, check_name, hint
from safevar_sumo.metrics import METRICS, OBJECTIVES, OPTIONAL_METRICS, UNSAFE_SHARE
from safevar_sumo.plugins import Lookup
from safevar_sumo.questions.answer import Answer, contents, tabulate
from safevar_sumo.questions.options import Range
from safevar_sumo.questions.sentence import Sentences, Verdict, answer, evidence
from safevar_sumo.questions.tables import shipped_columns
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
    from safevar_sumo.check.trials import Extent, Finding

NO_STUDY: Any = None
LISTED = shipped_columns("list")
VEHICLES, CHARACTERISTICS = LISTED["vehicles"], LISTED["characteristics"]
TITLES = {
    "studies": "Studies",
    "vehicles": "Characteristics of vehicles",
    "ads": "Driving systems",
    "scenarios": "Scenarios",
    "weathers": "Weathers",
    "algorithms": "Algorithms",
    "metrics": (
        "Safety metrics (TET and TIT use TTC = L_s / v_L; ttc_min and drac use"
        " TTC_p = gap / (v - u))"
    ),
    "objectives": "Objectives of a search (every metric can be an objective, too)",
}
FURTHER_OBJECTIVES = {
    name: f"{objective.title.capitalize()} [{objective.unit}]."
    for name, objective in OBJECTIVES.items()
    if name not in METRICS
}
FURTHER_OBJECTIVES[UNSAFE_SHARE.name] = (
    f"Only with [scenario] repeats: {UNSAFE_SHARE.description}"
)
BLOCK, FINDINGS = shipped_columns("check").values()


@contents(
    "passed",
    **LISTED,
)
def list_models(kind: str | None = None, study: str | None = None) -> Answer:
    """List what the package contains: studies, vehicles, driving systems, scenarios, weathers,
    algorithms, metrics and objectives. `list studies` prints the studies alone.
    `list characteristics STUDY` lists the characteristics that a study changes, and how a workshop
    measures each one. `list cache` prints the folder with earlier simulations.

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

    # A kind with a colon is a scenario of the user: then only this scenario is listed.
    scenarios = SCENARIOS
    if kind is not None and ":" in kind:
        named = Lookup().class_of(SCENARIOS, kind, "KIND", TrackScenario, WorldScenario)
        scenarios = {kind: named.target}
        kind = "scenarios"
    weathers = pd.DataFrame(map(msgspec.to_builtins, WEATHERS.values()))
    are_clear = list(map(equals_clear, WEATHERS.values()))
    weathers["effect"] = np.where(are_clear, "none", "yes")
    metrics = {**METRICS, **OPTIONAL_METRICS}.items()
    described_metrics = [(name, metric.description) for name, metric in metrics]

    rows: dict[str, Any] = {
        "studies": _studies(),
        "vehicles": _characteristics(),
        "ads": _described(ADS),
        "scenarios": _scenarios(scenarios),
        "weathers": weathers,
        "algorithms": DESCRIPTIONS.items(),
        "metrics": described_metrics,
        "objectives": FURTHER_OBJECTIVES.items(),
    }
    tables = {
        name: tabulate(TITLES[name], LISTED[name], listed)
        for name, listed in rows.items()
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
        f"{table.frame.iloc[:, 0].nunique()} {name}" for name, table in tables.items()
    )
    verdict = f"The package has {counts}."
    if scenarios is not SCENARIOS:
        verdict = f"A study can name {', '.join(scenarios)}."
    return Answer(
        question="list",
        study=NO_STUDY,
        verdict=verdict,
        numbers={"passed": True},
        tables=tables,
        is_whole=True,
    )


def _list_characteristics(name: str | None) -> Answer:
    """The answer with the characteristics of the study `name`, and how a workshop measures them."""
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
        verdict=(
            f"The study {study.name} changes {number_of(len(rows), 'characteristic')} of the"
            " vehicle."
        ),
        numbers={"passed": True},
        tables={"characteristics": tabulate(title, CHARACTERISTICS, rows)},
    )


def _list_cache() -> Answer:
    """The answer with the folder of earlier simulations, and its size."""
    # SUMO takes long to load.
    from safevar_sumo.campaign import cache as simulations

    folder = simulations.cache_folder()
    variable = simulations.FOLDER_VARIABLE
    limit = simulations.SIZE_LIMIT / 1e6
    verdict = (
        f"Simulations are not kept, because the environment variable {variable} is"
        f" {simulations.OFF}."
    )
    rows = []
    if folder is not None:
        entries = size = 0
        if folder.is_dir():
            entries, size = simulations.Cache(folder).extent()
        rows = [(str(folder), entries, size / 1e6, limit)]
        verdict = (
            f"Earlier simulations are kept in {folder}: {size / 1e6:.1f} MB of at most"
            f" {limit:,.0f} MB. You may delete this folder. The environment variable {variable}"
            " names another one."
        )
    return Answer(
        question="list",
        is_whole=True,
        study=NO_STUDY,
        verdict=verdict,
        numbers={"passed": True},
        tables={"cache": tabulate("Cache of simulations", LISTED["cache"], rows)},
    )


def _in_a_workshop(item: Characteristic) -> str | None:
    """How a workshop measures a characteristic, and what it does if the value is beyond the limit;
    None if the study says neither.
    """
    texts = []
    if item.measurement:
        place = "" if item.workshop else "not in a workshop: "
        texts.append(f"{place}{item.measurement}")
    if item.remedy:
        texts.append(f"beyond its limit: {item.remedy}")
    return "; ".join(texts) or None


def _studies() -> Iterator[tuple[str, ...]]:
    """The rows of the table of studies."""
    facts = attrgetter("name", "title", "vehicle.model", "ads.model", "scenario.model")
    for study in map(read_study, study_names()):
        yield *facts(study), weather_of(study.weather).name


def _characteristics() -> Iterator[tuple[float | str, ...]]:
    """The rows of the table of vehicles: the characteristics of each vehicle model, as the first
    study with this model states them.
    """
    studies = dict[str, Study]()
    for study in map(read_study, study_names()):
        studies.setdefault(study.vehicle.model or study.scenario.model, study)
    facts_of = attrgetter(*list(VEHICLES)[1:])
    for vehicle, study in sorted(studies.items()):
        for item in CharacteristicSet.of(study).vehicle:
            yield vehicle, *facts_of(item)


def _described(models: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The name and the description of each model."""
    return ((name, description_of(model)) for name, model in models.items())


def description_of(model: Any) -> str:
    """The first paragraph of a model's docstring, in one line."""
    return " ".join((getdoc(model) or "").partition("\n\n")[0].split())


def _scenarios(models: Mapping[str, type[Scenario]]) -> Iterator[tuple[str, ...]]:
    """The rows of the table of scenarios: name, description, and parameters that may vary."""
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
"""If a check takes longer than this time, `check` first says how long it will take [s]."""


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
    # These modules load SUMO, which takes long: import them only if something is checked.
    from safevar_sumo.campaign import check_algorithms
    from safevar_sumo.campaign.user_checks import find_in_new_process
    from safevar_sumo.check import advice_for, check_study, study_to_check
    from safevar_sumo.sumo.system import assemble

    study = study_to_check(name)
    extents = []

    def tell(extent: Extent) -> None:
        """Say how long a check takes, if it takes long."""
        extents.append(extent)
        if extent.seconds > LONG:
            hint(
                f"the check simulates {number_of(extent.vehicles, 'vehicle')}, which takes about"
                f" {extent.seconds:.0f} s"
            )

    # The check in a new process comes first, because the user's simulator may end its process.
    in_new_process = find_in_new_process(study)
    findings = [item for item in in_new_process if item.check == "contract"]
    if not findings:
        with open_progress(True) as progress:
            findings = check_study(
                study, vehicles=vehicles, progress=progress, tell=tell
            )
    if not findings:
        # Raise the errors with which the command `study` would refuse the study.
        check_algorithms(study, assemble(study))
        findings = in_new_process
    vehicle_count = sum(extent.vehicles for extent in extents)
    point_count = sum(extent.points for extent in extents)
    rows = []
    blocks = []
    for item in findings:
        advice = advice_for(item, study)
        rows.append({**item._asdict(), "advice": advice})
        text = f"{item.finding}, with {item.input}" if item.input else item.finding
        blocks += [
            ("where", item.where),
            ("found", text),
            ("expected", item.expected),
            ("what to do", advice),
        ]
    return Answer(
        question="check",
        study=study,
        verdict=Verdict(_sentences(name, findings, extents)),
        numbers={
            "passed": not findings,
            "vehicles": vehicle_count,
            "points": point_count,
        },
        tables={
            "block": tabulate("Findings", BLOCK, blocks),
            "findings": tabulate("Findings", FINDINGS, rows),
        },
        folded=("findings",),
    )


def _sentences(
    name: str, findings: Sequence[Finding], extents: Iterable[Extent]
) -> Sentences:
    """Yield the sentences of the verdict of `check`: the first finding, then the numbers of
    vehicles and test cases that were simulated and left out.
    """
    if not findings:
        yield answer(f"{name} passed all checks.")
    for finding in findings[:1]:
        number = number_of(len(findings), "finding")
        yield answer(f"{name} failed: {number}. {finding}.")
    for extent in extents:
        points = number_of(extent.points, "test case")
        vehicles = number_of(extent.vehicles, "vehicle")
        further = number_of(extent.all_points - extent.points, "further test case")
        text = f"The check simulated {vehicles} in {points} of the study."
        if extent.points < extent.all_points:
            text += f" The check left out {further}."
        if extent.vehicles < extent.all_vehicles:
            text += (
                f" The option --vehicles {extent.all_vehicles} checks more vehicles."
            )
        yield evidence(text)
