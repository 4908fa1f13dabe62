"""A study's names turned into objects: the vehicle, the ADS and the scenario that are simulated together."""

from __future__ import annotations

import importlib
import inspect
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec

from safevar_sumo.ads import ADS, Ads, Checked, PerVehicle, ScalarAds
from safevar_sumo.errors import InputError, SafevarError, one_of, told
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Nominal
from safevar_sumo.scenarios import SCENARIOS, Scenario, weather_of
from safevar_sumo.study import MetricsTable, ModelTable, Study, VehicleTable, Weather, invalid
from safevar_sumo.vehicles import VEHICLES, CharacteristicSet, Vehicle, calibration_drive


@dataclass(frozen=True, kw_only=True)
class System:
    """What a simulation is made of; `step_length` [s] is None where the network's own counts."""

    characteristics: CharacteristicSet
    vehicle: Vehicle
    ads: Ads
    scenario: Scenario
    weather: Weather
    metrics: MetricsTable
    nominal: Nominal
    step_length: float | None = None


def assemble(study: Study, source: str = "") -> System:
    """Look the study's models up and give them their parameters; `source` is how errors call the study.

    Raises
    ------
    InputError
        Naming the study, the key, the value and what is legal.
    """
    source = source or f"study {study.name!r}"
    vehicle, ads, scenario, weather = models_of(study, source)
    _check_units(study, vehicle, source)
    for name in study.published:
        if name not in METRICS:
            raise InputError(source, f"published.{name} is no metric", one_of(METRICS))
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    return System(
        characteristics=characteristics, vehicle=vehicle, ads=ads, scenario=scenario, weather=weather, metrics=study.metrics,
        nominal=calibration_drive(vehicle, characteristics), step_length=study.step_length)


def models_of(study: Study, source: str) -> tuple[Any, Ads, Scenario, Weather]:
    """The study's models with their parameters; raises as `assemble`."""
    return (_model(VEHICLES, study.vehicle, "vehicle", source), _ads(study.ads, source),
            _model(SCENARIOS, study.scenario, "scenario", source), weather_of(study.weather, source))


def _check_units(study: Study, vehicle: Vehicle, source: str) -> None:
    given, known = study.vehicle.characteristics, vehicle.UNITS
    for name in given:
        if name not in known:
            raise InputError(source, f"vehicle.characteristics.{name}: {study.vehicle.model} has no such characteristic", one_of(known))
        if given[name].unit != known[name]:
            raise InputError(source, f"vehicle.characteristics.{name}.unit = {given[name].unit!r}", repr(known[name]))
        if type(vehicle) in VEHICLES.values() and given[name].lower <= 0:
            raise InputError(source, f"vehicle.characteristics.{name}.lower = {given[name].lower}", "a value above 0")
    for name in known:
        if name not in given:
            raise InputError(source, f"vehicle.characteristics.{name} is missing", f"all of {', '.join(known)}")


def _model(models: Mapping[str, Any], choice: ModelTable | VehicleTable, key: str, source: str) -> Any:
    """An instance of one of our models or of a user's `package.module:Name`."""
    cls = _class(models, choice.model, f"{key}.model", source)
    if cls in models.values():
        try:
            return msgspec.convert(choice.parameters, cls)
        except msgspec.ValidationError as error:
            raise invalid(source, choice.parameters, error, f"{key}.parameters") from None
    return _Guarded(_called(cls, choice, key, source), f"{key}.model = {choice.model!r}", source)


class _Guarded:
    """A model from outside the package: whatever it lacks or does wrong is told with its name."""

    def __init__(self, inner: Any, name: str, source: str) -> None:
        self._inner, self._name, self._source = inner, name, source

    def __getattr__(self, attribute: str) -> Any:
        try:
            value = getattr(self._inner, attribute)
        except AttributeError as error:
            raise InputError(self._source, f"{self._name} lacks {attribute!r}: {error}") from error
        return partial(self._call, attribute, value) if callable(value) else value

    def _call(self, attribute: str, method: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return method(*arguments)
        except SafevarError:
            raise
        except (Exception, SystemExit, GeneratorExit) as error:
            raise InputError(self._source, f"{self._name} raised in {attribute}: {told(error)}") from error


def _ads(choice: ModelTable, source: str) -> Ads:
    cls = _class(ADS, choice.model, "ads.model", source)
    if inspect.isclass(cls) and issubclass(cls, ScalarAds):
        _called(cls, choice, "ads", source)
        return Checked(PerVehicle(partial(cls, **choice.parameters)), source, choice.model)
    ads = _model(ADS, choice, "ads", source)
    return ads if cls in ADS.values() else Checked(ads, source, choice.model)


def _called(cls: Any, choice: ModelTable | VehicleTable, key: str, source: str) -> Any:
    try:
        return cls(**choice.parameters)
    except (Exception, SystemExit, GeneratorExit) as error:
        problem = f"{key}.model = {choice.model!r} does not take parameters {choice.parameters}: {told(error)}"
        raise InputError(source, problem) from error


def _class(models: Mapping[str, Any], name: str, key: str, source: str) -> Any:
    if name in models:
        return models[name]
    legal = f"{one_of(models)}, or package.module:Name"
    module_name, colon, attribute = name.partition(":")
    if not colon:
        raise InputError(source, f"{key} = {name!r}", legal)
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        return getattr(importlib.import_module(module_name), attribute)
    except (Exception, SystemExit, GeneratorExit) as error:
        raise InputError(source, f"{key} = {name!r} cannot be imported: {told(error)}", legal) from error
