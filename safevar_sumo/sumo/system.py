"""A study assembled: its models looked up by name and given their parameters."""

from __future__ import annotations

import inspect
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from safevar_sumo.ads import ADS, ADS_CONTRACT, REACTIONS, SCALAR_ADS_CONTRACT, Ads, FmuAds, GuardedAds, PerVehicle, ScalarAds
from safevar_sumo.errors import InputError, one_of, unknown
from safevar_sumo.fmu import LONGEST, description_of
from safevar_sumo.metrics import FURTHER, METRICS, RATING_POINTS, Metric, Objective, Scoring, foreign_metric
from safevar_sumo.metrics import OBJECTIVES as BY_OBJECTIVE
from safevar_sumo.plugins import Guard, Lookup, Member, OwnModules, check_parameters, guard_process_state, instance_of
from safevar_sumo.protocol.rater import Rater, is_rated, rated, rater_of
from safevar_sumo.records import FloatArray, Nominal
from safevar_sumo.scenarios import SCENARIO_CONTRACT, SCENARIOS, WEATHERS, GuardedScenario, Point, Scenario, weather_of
from safevar_sumo.study import MatrixTest, MetricsTable, ModelTable, Study, VehicleTable, Weather, foreign_names
from safevar_sumo.sumo.network import check_network, network_remarks
from safevar_sumo.sumo.sources import is_network, is_shipped
from safevar_sumo.sumo.traci_controller import TraciController
from safevar_sumo.sumo.traci_module import importable
from safevar_sumo.vehicles import (
    CHANGES,
    VEHICLE_CONTRACT,
    VEHICLES,
    Change,
    CharacteristicSet,
    FeasibleRegion,
    FmuVehicle,
    GuardedVehicle,
    Vehicle,
    calibration_drive,
    foreign_change,
    region_of,
)

TAKEN = ("algorithm", "run", "evaluation", "outcome", "handle", "collision", "collision_speed", "setting", "f_safe", "f_diff", "f_num_diff")
"""Columns of results that no characteristic and no metric may be called."""
OBJECTIVES = "search.objectives"


class Measuring(NamedTuple):
    """The metrics and further measures of change by their columns, the objectives, and what of it comes from outside."""

    metrics: Mapping[str, Metric]
    changes: Mapping[str, Change]
    scoring: Scoring
    members: tuple[Member, ...]


def measuring_of(study: Study, lookup: Lookup) -> Measuring:
    """Look up the metrics and objectives that a study names.

    Raises
    ------
    InputError
        If there is no such record, it is wrong, or its name is taken.
    """
    metrics, members = {**METRICS, **({RATING_POINTS.name: RATING_POINTS} if is_rated(study) else {})}, list[Member]()
    known = dict(metrics)
    changes = {name: change for name, change in CHANGES.items() if name not in TAKEN}
    by_name: dict[str, Metric | Change] = {}

    def taken_in(name: str, key: str) -> Metric | Change:
        if name in by_name:
            return by_name[name]
        own = {**known, **FURTHER, **({**CHANGES, **BY_OBJECTIVE} if key == OBJECTIVES else {})}
        member = lookup.find(own, name, key)
        if member.guard is None:
            if name in FURTHER:
                metrics[name] = member.what
            return member.what  # type: ignore[no-any-return]
        members.append(member)
        foreign = isinstance(member.what, Change) and key == OBJECTIVES
        record = foreign_change(member.what, member.guard) if foreign else foreign_metric(member.what, member.guard)
        if record.name in (*TAKEN, *metrics, *FURTHER, *changes, *study.vehicle.characteristics):
            raise InputError(lookup.source, f"{key} = {name!r}: the name {record.name!r} is taken", "a name of its own")
        if isinstance(record, Change):
            changes[record.name] = record
        else:
            metrics[record.name] = record
        by_name[name] = by_name[record.name] = record
        return record

    for name in study.metrics.also:
        taken_in(name, "metrics.also")
    names = [BY_OBJECTIVE[name].name if name in BY_OBJECTIVE else name for name in study.search.objectives]
    objectives = [_objective(taken_in(name, OBJECTIVES)) for name in names]
    _refuse_twice(objectives, lookup.source)
    scoring = Scoring(metrics=tuple(metric.facts for metric in metrics.values()), objectives=tuple(objectives))
    return Measuring(metrics, changes, scoring, tuple(members))


def _objective(record: Metric | Change) -> Objective:
    if isinstance(record, Metric):
        return Objective.of(record)
    return Objective(name=record.name, title=record.title, unit=record.unit)


def _refuse_twice(objectives: Iterable[Objective], source: str) -> None:
    names = [objective.name for objective in objectives]
    if len(set(names)) < len(names):
        raise InputError(source, f"search.objectives: one of {', '.join(names)} is named twice", one_of([*METRICS, *FURTHER, *CHANGES]))


STEP = "a function step(traci, vehicle_id), or a class with that method"
"""What a controller written for TraCI is."""


class Models(NamedTuple):
    """A study's models with their parameters, and how they were found."""

    vehicle: Vehicle
    ads: Ads
    scenario: Scenario
    weather: Weather
    members: tuple[Member, ...]


@dataclass(frozen=True, kw_only=True)
class System:
    """What a simulation is made of.

    `step_length` [s] is None where the network's own counts; `rater` rates what happens in the matrix of a protocol; `metrics` are
    thresholds, `measuring` is what is computed with them; `members` are how everything was found.
    """

    characteristics: CharacteristicSet
    vehicle: Vehicle
    ads: Ads
    scenario: Scenario
    weather: Weather
    metrics: MetricsTable
    nominal: Nominal
    members: tuple[Member, ...]
    measuring: Measuring
    region: FeasibleRegion
    step_length: float | None = None
    matrix: tuple[Point, ...] = ()
    rater: Rater | None = None

    @property
    def points(self) -> tuple[Point, ...]:
        """Where a setting is simulated: the matrix, or the study's one scenario."""
        return self.matrix or (Point(self.scenario, self.weather),)

    def at(self, point: Point) -> System:
        """The same at one point alone."""
        return replace(self, scenario=point.scenario, weather=point.weather, matrix=(), rater=None)

    def check_feasible(self, settings: FloatArray, source: object, *, filtered: bool, switch: str = "beyond=True") -> None:
        """Refuse settings, shape (M, n), that violate a constraint of the study; raises as `FeasibleRegion.check`."""
        self.region.check(self.characteristics.filter(settings) if filtered else settings, source, otherwise=f", or any with {switch}")

    @property
    def remarks(self) -> list[str]:
        """What of the networks and the weathers is not used, or does nothing."""
        in_traci = isinstance(self.ads, TraciController)
        fmus = [remark for model in (self.vehicle, self.ads) for remark in getattr(model, "remarks", ())]
        networks = dict.fromkeys(point.scenario.network for point in self.points)
        remarks = [remark for network in networks for remark in network_remarks(network, self.nominal.max_speed, sumo_drives=in_traci)]
        remarks += fmus
        hazy = {point.weather.name: point.weather.visibility for point in self.points if point.weather.visibility != 1}
        if in_traci and not self._sees_a_limited_way():
            remarks += [f"weather {name!r}: visibility = {value:g} does nothing: the vehicle has no sensor range, and a controller written "
                      "for TraCI sees as far" for name, value in hazy.items()]
        if not any(getattr(self.ads, name, 0.0) for name in REACTIONS):
            remarks += [f"weather {name!r} changes nothing: its road and its sight are those of clear weather, and nothing under "
                      "[ads.parameters] says that the ADS reacts later in it"
                      for name in dict.fromkeys(point.weather.name for point in self.points if _as_clear(point.weather))]
        return remarks

    def _sees_a_limited_way(self) -> bool:
        sensors = getattr(self.vehicle, "sensors", None)
        original = dict(zip(self.characteristics.names, self.characteristics.original[:, np.newaxis], strict=True))
        own = None if sensors is None else sensors(self.vehicle.prepare(original, 1.0, 0.1))
        return own is not None and bool(np.isfinite(own.reach).all())


def _as_clear(weather: Weather) -> bool:
    """Whether a weather is clear but for its name and light."""
    clear = WEATHERS["clear"]
    return weather.name != clear.name and weather.light == clear.light and msgspec.structs.replace(weather, name=clear.name) == clear


def assemble(study: Study, source: str = "") -> System:
    """Look the study's models up and give them their parameters; `source` is how errors call the study.

    Raises
    ------
    InputError
        Naming the study, the key, the value and what is legal.
    """
    source = source or f"study {study.name!r}"
    with guard_process_state(source, foreign_names(study)):
        return _assembled(study, source)


def _assembled(study: Study, source: str) -> System:
    models = models_of(study, source)
    _check_units(study, models.vehicle, models.members[0].guard is None, source)
    measuring = measuring_of(study, Lookup(source, study.origin.places))
    for name in study.published:
        if name not in measuring.metrics:
            raise unknown(source, f"published.{name} is no metric", name, measuring.metrics)
    rater = rater_of(study, source)
    matrix = _matrix(study if rater is None else rated(study, models.weather), source)
    for network in dict.fromkeys(scenario.network for scenario in (models.scenario, *(point.scenario for point in matrix))):
        check_network(network)
    region = region_of(study, source)
    characteristics = region.characteristics
    nominal = calibration_drive(models.vehicle, characteristics)
    if isinstance(models.ads, TraciController) and isinstance(models.vehicle, GuardedVehicle):
        ends = np.stack([characteristics.original, characteristics.lower, characteristics.upper])
        models.vehicle.refuse_unknown_sensors(dict(zip(characteristics.names, np.ascontiguousarray(ends.T), strict=True)))
    if models.members[0].guard is not None:
        nominal.tables()  # what is wrong with a vehicle from outside shows here, whoever drives it
    return System(
        characteristics=characteristics, vehicle=models.vehicle, ads=models.ads, scenario=models.scenario, weather=models.weather,
        metrics=study.metrics, nominal=nominal, members=(*models.members, *measuring.members, *region.members),
        measuring=measuring, region=region,
        step_length=study.step_length, matrix=matrix, rater=rater)


def models_of(study: Study, source: str) -> Models:
    """The study's models with their parameters; raises as `assemble`."""
    lookup, limit = Lookup(source, study.origin.places), min(study.search.time_limit / 2, LONGEST)  # before a pool gives the batch up
    vehicle, ads, scenario = _vehicle(study.vehicle, lookup, limit), _ads(study.ads, lookup, limit), _scenario(study.scenario, lookup)
    return Models(vehicle[0], ads[0], scenario[0], weather_of(study.weather, source), (vehicle[1], ads[1], scenario[1]))


def _traci(choice: ModelTable, lookup: Lookup) -> tuple[Ads, Member]:
    """A function `step(traci, vehicle_id)` or a class with that method, written for SUMO."""
    name = f"ads.model = {choice.model!r}"
    with importable():
        member = lookup.find({}, choice.model, "ads.model")
        what, parameters = member.what, lookup.with_paths(member, choice.parameters, "ads.parameters")
        if not callable(getattr(what, "step", None) if inspect.isclass(what) else what):
            raise InputError(lookup.source, f"{name} has no step", STEP)
        if not inspect.isclass(what):
            check_parameters(what, (None, None), parameters, name, "ads.parameters", lookup.source)

        def controller_of(what: Any) -> Any:
            """A controller for one vehicle, from what the module that it has for itself says."""
            if not inspect.isclass(what):
                return partial(what, **parameters)
            return instance_of(member._replace(what=what), parameters, name, "ads.parameters", lookup.source)

        controller_of(what)
    places, attribute = [*lookup.places, os.getcwd()], choice.model.partition(":")[2]
    modules = partial(OwnModules, member, attribute, places, set())
    return TraciController(modules, controller_of, member.guard or Guard(lookup.source, name)), member


def _matrix(study: Study, source: str) -> tuple[Point, ...]:
    """The points of a study's matrix, each by a name of its own."""
    points = [] if study.matrix is None else [point for test in study.matrix.tests for point in _points_of(test, study, source)]
    named = Counter(point.name for point in points)
    for name, number in named.items():
        if number > 1:
            raise InputError(source, f"matrix.tests: {number} points are {name!r}", "a name of its own for each test, and values once")
    return tuple(points)


def _points_of(test: MatrixTest, study: Study, source: str) -> Iterator[Point]:
    same = test.model in ("", study.scenario.model)
    base = {**(study.scenario.parameters if same else {}), **test.parameters}
    lookup = Lookup(f"{source}: test {test.name!r}", study.origin.places)
    weathers: list[str | Weather] = list(test.weathers) or [study.weather]
    for values in product(*test.over.values()):
        over = dict(zip(test.over, values, strict=True))
        scenario, _ = _scenario(ModelTable(model=test.model or study.scenario.model, parameters={**base, **over}), lookup)
        for choice in weathers:
            weather = weather_of(choice, lookup.source)
            place = {"test": test.name, **over, "weather": weather.name}
            name = ", ".join([test.name, *(f"{key} {value}" for key, value in over.items()), weather.name])
            yield Point(scenario, weather, name, tuple(place.items()))


def _with_network(scenario: Any, places: Sequence[str]) -> Any:
    """The scenario on the folder beside the study, if it names one that lies there and is none of ours.

    One with sources comes first: beside a results directory a study's results have its name, as its network may.
    """
    folder = scenario.network
    there = [path for place in places if is_network(path := Path(place, folder))]
    network = str(next((path for path in there if path.is_file() or any(path.glob("*.xml"))), there[0] if there else folder))
    if network == folder or is_shipped(folder):
        return scenario
    if isinstance(scenario, msgspec.Struct):
        return msgspec.structs.replace(scenario, network=network)
    scenario.network = network
    return scenario


def _check_units(study: Study, vehicle: Vehicle, ours: bool, source: str) -> None:
    given, known = study.vehicle.characteristics, vehicle.UNITS
    for name in given:
        if name in TAKEN:
            raise InputError(source, f"vehicle.characteristics.{name}: the name is a column of results", f"none of {', '.join(TAKEN)}")
        if name not in known:
            raise unknown(source, f"vehicle.characteristics.{name}: {study.vehicle.model} has no such characteristic", name, known)
        if given[name].unit != known[name]:
            raise InputError(source, f"vehicle.characteristics.{name}.unit = {given[name].unit!r}", repr(known[name]))
        if ours and given[name].lower <= 0:
            raise InputError(source, f"vehicle.characteristics.{name}.lower = {given[name].lower}", "a value above 0")
    for name in known:
        if name not in given:
            raise InputError(source, f"vehicle.characteristics.{name} is missing", f"all of {', '.join(known)}")


def _vehicle(choice: VehicleTable, lookup: Lookup, limit: float) -> tuple[Vehicle, Member]:
    if choice.kind == "fmu":
        guard = Guard(lookup.source, f"vehicle.model = {choice.model!r}")
        table = {**msgspec.structs.asdict(choice), "parameters": lookup.with_paths(Member(FmuVehicle, guard), choice.parameters,
                                                                                   "vehicle.parameters")}
        units = {name: row.unit for name, row in choice.characteristics.items()}
        description = description_of(choice.model, lookup.places, lookup.source, "vehicle.model")
        return FmuVehicle(description, units, table, guard, limit), Member(FmuVehicle, guard, file=description.path)
    member = lookup.class_of(VEHICLES, choice.model, "vehicle.model", VEHICLE_CONTRACT)
    parameters = lookup.with_paths(member, choice.parameters, "vehicle.parameters")
    vehicle = instance_of(member, parameters, f"vehicle.model = {choice.model!r}", "vehicle.parameters", lookup.source)
    return (vehicle if member.guard is None else GuardedVehicle(vehicle, member.guard)), member


def _scenario(choice: ModelTable, lookup: Lookup) -> tuple[Scenario, Member]:
    member = lookup.class_of(SCENARIOS, choice.model, "scenario.model", SCENARIO_CONTRACT)
    parameters = lookup.with_paths(member, choice.parameters, "scenario.parameters")
    scenario = instance_of(member, parameters, f"scenario.model = {choice.model!r}", "scenario.parameters", lookup.source)
    return _with_network(scenario if member.guard is None else GuardedScenario(scenario, member.guard), lookup.places), member


def _ads(choice: ModelTable, lookup: Lookup, limit: float) -> tuple[Ads, Member]:
    if choice.kind == "traci":
        return _traci(choice, lookup)
    if choice.kind == "fmu":
        guard = Guard(lookup.source, f"ads.model = {choice.model!r}")
        parameters = lookup.with_paths(Member(FmuAds, guard), choice.parameters, "ads.parameters")
        description = description_of(choice.model, lookup.places, lookup.source, "ads.model")
        ads = FmuAds(description, choice.inputs, choice.outputs, parameters, choice.step, guard, limit)
        return ads, Member(FmuAds, guard, file=description.path)
    member = lookup.class_of(ADS, choice.model, "ads.model", SCALAR_ADS_CONTRACT, ADS_CONTRACT,
                             otherwise=f'with ads.kind = "traci" {STEP}')
    name = f"ads.model = {choice.model!r}"
    parameters = lookup.with_paths(member, choice.parameters, "ads.parameters")
    make = partial(instance_of, member, parameters, name, "ads.parameters", lookup.source)
    driver = make()  # of a ScalarAds too: what is wrong with its parameters shows here
    if issubclass(member.what, ScalarAds):
        return PerVehicle(make, member.guard or Guard(lookup.source, name)), member
    return (driver if member.guard is None else GuardedAds(driver, member.guard)), member
