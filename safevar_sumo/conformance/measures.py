"""Probes of metrics, objectives and search algorithms; and the probes for every kind of subject."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from safevar_sumo.ads import Ads
from safevar_sumo.conformance.models import AdsProbe, StudyProbe, VehicleProbe
from safevar_sumo.conformance.probe import NoReaction, Outputs, Probe, Rows, corners, cost_of, guard_of, loaded_again, timed
from safevar_sumo.conformance.subject import Subject
from safevar_sumo.metrics import METRICS, guard_metric
from safevar_sumo.plugins import Lookup, forget_foreign, instance_of
from safevar_sumo.records import Command, Evaluations, FloatArray, Nominal, Observation, SimulationRuns
from safevar_sumo.search import ALGORITHMS, GuardedAlgorithm, Problem
from safevar_sumo.study import Study
from safevar_sumo.sumo.batch import drive_all
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet, foreign_change


class MetricProbe(Probe):
    """Applies a metric to runs with and without collisions."""

    methods = ("function",)
    number = 24

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        self._runs = _runs_of(subject.study)

    def load(self) -> Any:
        forget_foreign()
        return guard_metric(loaded_again(self.subject), guard_of(self.subject))

    def run(self, model: Any, rows: Rows) -> Outputs:
        runs = self._runs.of(slice(0, self.number))
        if not np.array_equal(rows, np.arange(self.number)):
            first, last, sign = int(rows[0]), int(rows[-1]), 1 if len(rows) == 1 or rows[1] > rows[0] else -1
            runs = self._runs.of(slice(first, last + sign if last + sign >= 0 else None, sign))
        with np.errstate(all="ignore"):
            return {"values": model(runs, self.subject.study.metrics)}

    def reactions(self, model: Any, outputs: Outputs) -> Iterator[NoReaction]:
        values = outputs["values"]
        if np.isnan(values).all():
            yield NoReaction((), "a number for some drive", f"NaN for all of {self.number} drives")
        elif not np.isnan(values).any() and np.ptp(values) == 0 and values[0] != 0:
            yield NoReaction((), "other values for other drives", f"{values[0]:g} for all of {self.number} drives")

    def cost(self, model: Any, seconds: float) -> tuple[float, str]:
        reference = timed(lambda: METRICS["tet"](self._runs, self.subject.study.metrics))
        return cost_of(seconds, reference, "tet", self.number, len(self._runs.trace.time))


def _runs_of(study: Study) -> SimulationRuns:
    """Runs of 24 vehicles in a study; every fourth vehicle gives full throttle all the time."""
    plain_study = msgspec.structs.replace(study, metrics=msgspec.structs.replace(study.metrics, also=[]),
                                          search=msgspec.structs.replace(study.search, objectives=["safety_degree", "f_diff"]))
    system = assemble(plain_study)
    members = system.characteristics
    settings = members.lower + np.random.default_rng(0).random((MetricProbe.number, len(members))) * (members.upper - members.lower)
    settings[0] = members.original
    return drive_all(replace(system, ads=_RecklessAds(system.ads), matrix=()), settings)


class _RecklessAds:
    """An ADS with full throttle in every fourth vehicle."""

    def __init__(self, ads: Ads) -> None:
        self._ads = ads

    def start(self, n: int, nominal: Nominal, step: float) -> Any:
        return self._ads.start(n, nominal, step)

    def drive(self, seen: Observation, memory: Any) -> tuple[Command, Any]:
        command, memory = self._ads.drive(seen, memory)
        reckless = np.arange(len(seen.speed)) % 4 == 1
        return Command(np.where(reckless, 1.0, command.throttle), np.where(reckless, 0.0, command.brake)), memory


class ObjectiveProbe(Probe):
    """Applies a measure of change to the original setting and to the corners of the domains."""

    methods = ("function",)

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        self._members = CharacteristicSet.of(subject.study.vehicle.characteristics)
        self._settings = self._members.filter(corners(self._members))
        self.number = len(self._settings)

    def load(self) -> Any:
        forget_foreign()
        return foreign_change(loaded_again(self.subject), guard_of(self.subject))

    def run(self, model: Any, rows: Rows) -> Outputs:
        return {"values": model.function(self._settings[rows], self._members)}

    def reactions(self, model: Any, outputs: Outputs) -> Iterator[NoReaction]:
        values = outputs["values"]
        if np.ptp(values) == 0:
            yield NoReaction((), "other values at the corners of the domains than at the original", f"{values[0]:g} everywhere")


class AlgorithmProbe(Probe):
    """Searches a smooth function with an algorithm; the requested settings take the place of vehicles."""

    methods = ("search",)
    number = 1
    EVALUATIONS = 57
    POPULATION = 20

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        study = subject.study
        self._characteristics = CharacteristicSet.of(study.vehicle.characteristics)
        self._scoring = assemble(study).measuring.scoring
        self._problem = Problem(characteristics=self._characteristics, original=self._scored(self._characteristics.original[np.newaxis]),
                                evaluations=min(study.search.evaluations, self.EVALUATIONS),
                                population=min(study.search.population, self.POPULATION), scoring=self._scoring)

    def load(self) -> Any:
        forget_foreign()
        return self._instance()

    def _instance(self) -> Any:
        """A new instance, as every run of a study has."""
        subject, study = self.subject, self.subject.study
        lookup = Lookup("check", study.origin.places)
        member = lookup.find(ALGORITHMS, subject.name, subject.key)
        parameters = lookup.with_paths(member, subject.parameters, f"search.{subject.name}")
        return GuardedAlgorithm(instance_of(member, parameters, subject.key, f"search.{subject.name}", "check"), guard_of(subject))

    def run(self, model: Any, rows: Rows, seed: int = 1) -> Outputs:
        """All settings that a run requests, and the solutions of the run."""
        search = model.search(self._problem, np.random.default_rng(seed))
        requested, answer = list[FloatArray](), None
        while True:
            try:
                settings = next(search) if answer is None else search.send(answer)
            except StopIteration as end:
                return {"settings requested": np.concatenate(requested)[..., np.newaxis],
                        "settings returned": end.value.settings[..., np.newaxis]}
            requested.append(settings)
            answer = self._scored(settings)

    def repeat(self, model: Any, rows: Rows) -> Outputs:
        forget_foreign()
        self.run(self._instance(), rows, seed=2)
        return self.run(self._instance(), rows)

    def _scored(self, settings: FloatArray) -> Evaluations:
        """Evaluations whose safety degree falls towards the upper ends of the domains; below 0 it is a collision."""
        members = self._characteristics
        share = (settings - members.lower) / (members.upper - members.lower)
        degree = 1.0 - np.add.accumulate(share, axis=1)[:, -1] / len(members) * 1.5
        metrics = {metric.name: degree if metric.name == "safety_degree" else np.abs(degree) for metric in self._scoring.metrics}
        extra = {objective.name: np.abs(degree) for objective in self._scoring.objectives
                 if objective.name not in metrics and not objective.name.startswith("f_")}
        collided = degree < 0
        return Evaluations(
            settings=settings, outcome=np.where(collided, "collision", "stopped").astype("U16"), metrics={**metrics, **extra},
            collision_speed=np.where(collided, -degree, np.nan), f_diff=members.largest_change(settings),
            f_num_diff=members.number_changed(settings))

    def reactions(self, model: Any, outputs: Outputs) -> Iterator[NoReaction]:
        other_outputs = self.run(model, np.arange(1), seed=2)
        if np.array_equal(outputs["settings requested"], other_outputs["settings requested"]):
            yield NoReaction(("search",), "other settings with other random numbers `rng`", "the same settings in every run")
        if not outputs["settings returned"].size:
            yield NoReaction(("search",), "a result: settings that the run was sent evaluations of",
                           f"nothing, after {len(outputs['settings requested'])} evaluations")


PROBES: Mapping[str, tuple[type[Probe], ...]] = {
    "ads": (AdsProbe, StudyProbe), "vehicle": (VehicleProbe, StudyProbe), "scenario": (StudyProbe,), "metric": (MetricProbe,),
    "objective": (ObjectiveProbe,), "algorithm": (AlgorithmProbe,), "traci": (StudyProbe,)}
