"""Probes of metrics, objectives and search algorithms; and the probes for every kind of subject."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from safevar_sumo.ads import Ads
from safevar_sumo.conformance.models import AdsProbe, StudyProbe, VehicleProbe
from safevar_sumo.conformance.probe import Indices, MissingReaction, Outputs, Probe, corners_of, cost_of, guard_of, measure_time, target_of
from safevar_sumo.conformance.subject import Subject
from safevar_sumo.metrics import F_DIFF, METRICS, guard_metric
from safevar_sumo.plugins import Lookup, instance_of, unload_user_modules
from safevar_sumo.records import Command, Evaluations, FloatArray, Nominal, Observation, SimulationRuns
from safevar_sumo.search import ALGORITHMS, GuardedAlgorithm, Problem
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.sumo.batch import drive_all
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet, guard_change, region_of


class MetricProbe(Probe):
    """Applies a metric to runs with and without collisions."""

    methods = ("function",)
    vehicle_count = 24

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        self._runs = _simulate_runs(subject.study)

    def load(self) -> Any:
        unload_user_modules()
        return guard_metric(target_of(self.subject), guard_of(self.subject))

    def run(self, model: Any, vehicles: Indices) -> Outputs:
        runs = self._runs.of(slice(0, self.vehicle_count))
        if not np.array_equal(vehicles, np.arange(self.vehicle_count)):
            first, last, step = int(vehicles[0]), int(vehicles[-1]), 1 if len(vehicles) == 1 or vehicles[1] > vehicles[0] else -1
            runs = self._runs.of(slice(first, last + step if last + step >= 0 else None, step))
        with np.errstate(all="ignore"):
            return {"values": model(runs, self.subject.study.metrics)}

    def missing_reactions(self, model: Any, outputs: Outputs) -> Iterator[MissingReaction]:
        values = outputs["values"]
        if np.isnan(values).all():
            yield MissingReaction((), "a number for some drive", f"NaN for all of {self.vehicle_count} drives")
        elif not np.isnan(values).any() and np.ptp(values) == 0 and values[0] != 0:
            yield MissingReaction((), "other values for other drives", f"{values[0]:g} for all of {self.vehicle_count} drives")

    def cost(self, model: Any, seconds: float) -> tuple[float, str]:
        reference = measure_time(lambda: METRICS["tet"](self._runs, self.subject.study.metrics))
        return cost_of(seconds, reference, "tet", self.vehicle_count, len(self._runs.trace.time))


def _simulate_runs(study: Study) -> SimulationRuns:
    """Simulate 24 vehicles in a study; every fourth vehicle gives full throttle all the time."""
    plain_study = msgspec.structs.replace(study, metrics=msgspec.structs.replace(study.metrics, also=[]),
                                          search=msgspec.structs.replace(study.search, objectives=[SAFETY_DEGREE, F_DIFF.name]))
    system = assemble(plain_study)
    lower, upper = system.characteristics.lower, system.characteristics.upper
    settings = lower + np.random.default_rng(0).random((MetricProbe.vehicle_count, len(lower))) * (upper - lower)
    settings[0] = system.characteristics.original
    return drive_all(replace(system, ads=_RecklessAds(system.ads), matrix=()), settings)


class _RecklessAds:
    """An ADS whose commands are replaced by full throttle in every fourth vehicle."""

    def __init__(self, ads: Ads) -> None:
        self._ads = ads

    def start(self, n: int, nominal: Nominal, step: float) -> Any:
        return self._ads.start(n, nominal, step)

    def drive(self, seen: Observation, memory: Any) -> tuple[Command, Any]:
        command, memory = self._ads.drive(seen, memory)
        is_reckless = np.arange(len(seen.speed)) % 4 == 1
        return Command(np.where(is_reckless, 1.0, command.throttle), np.where(is_reckless, 0.0, command.brake)), memory


class ObjectiveProbe(Probe):
    """Applies a measure of change to the original setting and to the corners of the domains."""

    methods = ("function",)

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        self._characteristics = CharacteristicSet.of(subject.study.vehicle.characteristics)
        self._settings = self._characteristics.filter(corners_of(self._characteristics))
        self.vehicle_count = len(self._settings)

    def load(self) -> Any:
        unload_user_modules()
        return guard_change(target_of(self.subject), guard_of(self.subject))

    def run(self, model: Any, vehicles: Indices) -> Outputs:
        return {"values": model.function(self._settings[vehicles], self._characteristics)}

    def missing_reactions(self, model: Any, outputs: Outputs) -> Iterator[MissingReaction]:
        values = outputs["values"]
        if np.ptp(values) == 0:
            yield MissingReaction((), "other values at the corners of the domains than at the original", f"{values[0]:g} everywhere")


class ConstraintProbe(Probe):
    """Applies a constraint's function to the original setting, to the corners of the domains and to random settings."""

    methods = ("function",)
    RANDOM_SETTINGS = 200

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        characteristics = CharacteristicSet.of(subject.study.vehicle.characteristics)
        shares = np.random.default_rng(0).random((self.RANDOM_SETTINGS, len(characteristics)))
        inner = characteristics.lower + shares * (characteristics.upper - characteristics.lower)
        self._settings = np.concatenate([corners_of(characteristics), inner])
        self.vehicle_count = len(self._settings)

    def load(self) -> Any:
        unload_user_modules()
        bounds = region_of(self.subject.study).bounds
        return next(bound.quantity for bound in bounds if bound.constraint.function == self.subject.name)

    def run(self, model: Any, vehicles: Indices) -> Outputs:
        return {"the value": model(self._settings[vehicles])}


class AlgorithmProbe(Probe):
    """Lets an algorithm minimise a smooth function in place of simulations."""

    methods = ("search",)
    vehicle_count = 1
    MAX_EVALUATIONS = 57
    MAX_POPULATION = 20

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        study = subject.study
        self._characteristics = CharacteristicSet.of(study.vehicle.characteristics)
        self._scoring = assemble(study).measuring.scoring
        self._problem = Problem(characteristics=self._characteristics, original=self._evaluate(self._characteristics.original[np.newaxis]),
                                evaluations=min(study.search.evaluations, self.MAX_EVALUATIONS),
                                population=min(study.search.population, self.MAX_POPULATION), scoring=self._scoring)

    def load(self) -> Any:
        unload_user_modules()
        return self._instance()

    def _instance(self) -> Any:
        """A new instance, as every run of a study has."""
        subject, study = self.subject, self.subject.study
        lookup = Lookup("check", study.origin.places)
        member = lookup.find(ALGORITHMS, subject.name, subject.key)
        parameters = lookup.with_paths(member, subject.parameters, f"search.{subject.name}")
        return GuardedAlgorithm(instance_of(member, parameters, subject.key, f"search.{subject.name}", "check"), guard_of(subject))

    def run(self, model: Any, vehicles: Indices, seed: int = 1) -> Outputs:
        """All settings that a run requests to be evaluated, and those that it returns."""
        search = model.search(self._problem, np.random.default_rng(seed))
        requested, evaluations = list[FloatArray](), None
        while True:
            try:
                settings = next(search) if evaluations is None else search.send(evaluations)
            except StopIteration as end:
                return {"settings requested": np.concatenate(requested)[..., np.newaxis],
                        "settings returned": end.value.settings[..., np.newaxis]}
            requested.append(settings)
            evaluations = self._evaluate(settings)

    def repeat(self, model: Any, vehicles: Indices) -> Outputs:
        unload_user_modules()
        self.run(self._instance(), vehicles, seed=2)
        return self.run(self._instance(), vehicles)

    def _evaluate(self, settings: FloatArray) -> Evaluations:
        """Evaluate a smooth function: the safety degree falls from 1 at the lower ends of the domains to -0.5 at the upper ends."""
        characteristics = self._characteristics
        share = (settings - characteristics.lower) / (characteristics.upper - characteristics.lower)
        safety_degree = 1.0 - np.add.accumulate(share, axis=1)[:, -1] / len(characteristics) * 1.5
        metrics = {metric.name: safety_degree if metric.name == "safety_degree" else np.abs(safety_degree)
                   for metric in self._scoring.metrics}
        other_objectives = {objective.name: np.abs(safety_degree) for objective in self._scoring.objectives
                            if objective.name not in metrics and not objective.name.startswith("f_")}
        collided = safety_degree < 0
        return Evaluations(
            settings=settings, outcome=np.where(collided, "collision", "stopped").astype("U16"),
            metrics={**metrics, **other_objectives}, collision_speed=np.where(collided, -safety_degree, np.nan),
            f_diff=characteristics.largest_change(settings), f_num_diff=characteristics.number_changed(settings))

    def missing_reactions(self, model: Any, outputs: Outputs) -> Iterator[MissingReaction]:
        other_outputs = self.run(model, np.arange(1), seed=2)
        if np.array_equal(outputs["settings requested"], other_outputs["settings requested"]):
            yield MissingReaction(("search",), "other settings with other random numbers `rng`", "the same settings in every run")
        if not outputs["settings returned"].size:
            yield MissingReaction(("search",), "a result: settings whose evaluations the run received",
                                  f"nothing, after {len(outputs['settings requested'])} evaluations")


PROBES: Mapping[str, tuple[type[Probe], ...]] = {
    "ads": (AdsProbe, StudyProbe), "vehicle": (VehicleProbe, StudyProbe), "scenario": (StudyProbe,), "metric": (MetricProbe,),
    "objective": (ObjectiveProbe,), "algorithm": (AlgorithmProbe,), "traci": (StudyProbe,),
    "constraint": (ConstraintProbe,)}
