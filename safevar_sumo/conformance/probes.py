"""What a subject is given to do: situations for N vehicles, whose results must not depend on how they are grouped."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from safevar_sumo.ads import Ads, GuardedAds
from safevar_sumo.ads.aeb import Aeb
from safevar_sumo.conformance.finding import crowd
from safevar_sumo.conformance.subject import Subject
from safevar_sumo.metrics import METRICS, foreign_metric
from safevar_sumo.plugins import Guard, Lookup, forget_foreign, instance_of
from safevar_sumo.records import Command, Evaluations, FloatArray, Nominal, Observation, SimulationRuns
from safevar_sumo.search import ALGORITHMS, GuardedAlgorithm, Problem
from safevar_sumo.study import Study
from safevar_sumo.sumo import Engine, reason_for_sumo
from safevar_sumo.sumo.batch import drive_all
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.sumo.traci_module import importable
from safevar_sumo.vehicles import LEVEL, CharacteristicSet, GuardedVehicle, foreign_change, slope_of
from safevar_sumo.vehicles.sumo import SumoVehicle

Rows = npt.NDArray[np.intp]
Outputs = Mapping[str, np.ndarray]
"""Results by name; the last axis is that of the vehicles."""
STEP = 0.05  # s
STEPS = 100
POINTS = 2
"""Points of a matrix that a study is tried at."""


class Reaction(NamedTuple):
    """What a subject should have reacted to and did not; `methods` are where that belongs."""

    methods: tuple[str, ...]
    expected: str
    got: str


class Probe(ABC):
    """Situations for `number` vehicles. `methods` are those of the subject that are called."""

    methods: tuple[str, ...] = ()
    number: int

    def __init__(self, subject: Subject) -> None:
        self.subject = subject

    def system(self) -> System:
        """The subject's study put together, with everybody's modules loaded anew."""
        forget_foreign()
        system = assemble(self.subject.study)
        return replace(system, matrix=system.matrix[::max(len(system.matrix) // POINTS, 1)])

    @abstractmethod
    def fresh(self) -> Any:
        """The subject, loaded anew."""

    @abstractmethod
    def run(self, model: Any, rows: Rows) -> Outputs:
        """Results of some of the vehicles, in that order."""

    def again(self, model: Any, rows: Rows) -> Outputs:
        """The same results once more, from a subject that has been used."""
        return self.run(model, rows)

    def reactions(self, model: Any, outputs: Outputs) -> Iterator[Reaction]:
        """What the subject does not react to."""
        yield from ()

    def cost(self, model: Any, seconds: float) -> tuple[float, str]:
        """Time per vehicle and step [s] of a run that took so long, and a sentence on it."""
        return 0.0, ""


def loaded_again(subject: Subject) -> Any:
    """The class, function or record, from its module as it is loaded now."""
    if subject.is_ours:
        return subject.member.what
    with importable():
        return Lookup("check", subject.study.origin.places).find({}, subject.name, subject.key).what


def _guard(subject: Subject) -> Guard:
    return subject.member.guard or Guard("check", subject.key)


def timed(run: Callable[[], Any]) -> float:
    """Time that a call takes [s], as it would if nothing else ran on this machine."""
    start = time.perf_counter()
    run()
    return (time.perf_counter() - start) / crowd()


def _cost(mine: float, ours: float, whose: str, vehicles: int, steps: int) -> tuple[float, str]:
    """Time per vehicle and step [s], and a sentence that compares it."""
    mine, ours = mine / (vehicles * steps), ours / (vehicles * steps)
    return mine, f"{mine * 1e6:.2g} microseconds per vehicle and step, {vehicles} at once; ours ({whose}) takes {ours * 1e6:.2g}"


class _Traffic(NamedTuple):
    """How vehicles come upon somebody: shape (T, N)."""

    speed: FloatArray
    gap: FloatArray
    closing_speed: FloatArray
    lateral: FloatArray
    lateral_speed: FloatArray
    obstacle_speed: FloatArray


# Speed [m/s], gap [m], lateral offset [m], lateral speed [m/s], obstacle's speed [m/s], and since when it is detected [s].
ENCOUNTERS = np.array([
    *((speed, 3.0 * speed, 0.0, 0.0, 0.0, 0.0) for speed in (5.0, 10.0, 15.0, 20.0, 25.0, 8.0)),
    (5.0, 15.0, -4.0, 1.5, 0.0, 0.0), (10.0, 25.0, -6.0, 2.2, 0.0, 0.3),
    (10.0, 30.0, 0.0, 0.0, 0.0, 99.0), (0.0, 30.0, 0.0, 0.0, 0.0, 99.0), (0.0, 30.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.5, 0.0, 0.0, 0.0, 0.0),
    (15.0, 30.0, 0.0, 0.0, 10.0, 0.0), (10.0, 40.0, 0.0, 0.0, -5.0, 0.0), (10.0, 30.0, 10.0, 0.0, 0.0, 0.0),
    (12.0, 30.0, 0.0, 0.0, 0.0, 1.5)])
COURSE, FREE = slice(0, 6), 8
"""Encounters on a collision course; and one without anybody, which else is the second of those."""


def _traffic() -> _Traffic:
    """Vehicles that hold their speed for half of the time and then brake with 4 m/s^2."""
    speed0, gap0, lateral0, lateral_speed, obstacle, since = (column[np.newaxis] for column in ENCOUNTERS.T)
    times = np.arange(STEPS)[:, np.newaxis] * STEP
    speed = np.maximum(speed0 - 4.0 * np.maximum(times - STEPS * STEP / 2, 0.0), 0.0)
    driven = np.vstack([np.zeros((1, len(ENCOUNTERS))), np.cumsum(speed[:-1] * STEP, axis=0)])
    detected = times >= since
    shape = speed.shape
    return _Traffic(speed, np.where(detected, gap0 + obstacle * times - driven, np.inf), np.where(detected, speed - obstacle, 0.0),
                    np.where(detected, lateral0 + lateral_speed * times, np.inf), np.where(detected, lateral_speed, 0.0) + np.zeros(shape),
                    np.where(detected, obstacle, 0.0) + np.zeros(shape))


class AdsProbe(Probe):
    """An ADS comes upon somebody in many ways."""

    methods = ("drive", "start")
    number = len(ENCOUNTERS)

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        self._nominal: Nominal
        self._traffic = _traffic()

    def fresh(self) -> Ads:
        system = self.system()
        self._nominal = system.nominal
        self._nominal.tables()
        return GuardedAds(system.ads, _guard(self.subject)) if self.subject.is_ours else system.ads

    def run(self, model: Ads, rows: Rows) -> Outputs:
        n, nothing = len(rows), np.zeros(len(rows))
        memory, command = model.start(n, self._nominal, STEP), Command(nothing, nothing)
        pedals = np.zeros((2, STEPS, n))
        for step in range(STEPS):
            speed, gap, closing, lateral, lateral_speed, obstacle = (column[step, rows] for column in self._traffic)
            seen = Observation(step * STEP, speed, gap, closing, lateral, lateral_speed, 0.9, obstacle, command.throttle, command.brake)
            command, memory = model.drive(seen, memory)
            pedals[:, step] = command.throttle, command.brake
        return {"throttle": pedals[0], "brake": pedals[1]}

    def reactions(self, model: Ads, outputs: Outputs) -> Iterator[Reaction]:
        brake, throttle = outputs["brake"], outputs["throttle"]
        if not brake[:, COURSE].any():
            yield Reaction(("drive",), "a brake pedal above 0 at some time before an obstacle that stands in its way",
                           f"never brakes, at 5 to 25 m/s with {STEPS * STEP:g} s to look on")
        elif np.ptp(brake[:, 1]) == 0 and all(np.array_equal(pedal[:, 1], pedal[:, FREE]) for pedal in (throttle, brake)):
            yield Reaction(("drive",), "other pedals before an obstacle than on a free road", "the same with an obstacle and without")

    def cost(self, model: Ads, seconds: float) -> tuple[float, str]:
        return _cost(seconds, timed(lambda: self.run(Aeb(), np.arange(self.number))), "aeb", self.number, STEPS)


class VehicleProbe(Probe):
    """A vehicle accelerates, coasts and brakes, with the corners of every characteristic's domain."""

    methods = ("advance", "sense", "prepare", "at_rest", "sumo_type", "at_speed")
    PHASES = ((1.0, 0.0, 40), (0.3, 0.0, 5), (0.0, 0.0, 5), (0.0, 0.2, 5), (0.5, 0.5, 5), (0.0, 1.0, 30), (0.0, 0.0, 2))
    """Throttle, brake, and for how many steps."""
    STEP = 0.1  # s

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        self._members = CharacteristicSet.of(subject.study.vehicle.characteristics)
        self.settings = corners(self._members)
        self.number = len(self.settings)

    def fresh(self) -> Any:
        vehicle = self.system().vehicle
        return GuardedVehicle(vehicle, _guard(self.subject)) if self.subject.is_ours else vehicle

    def run(self, model: Any, rows: Rows) -> Outputs:
        n, outputs = len(rows), dict[str, list[np.ndarray]]()
        values = dict(zip(self._members.names, np.ascontiguousarray(self.settings[rows].T), strict=True))
        slope = slope_of(np.full(n, 5.0)) if model.takes_slope else LEVEL
        for surface in ((1.0, self.STEP), (0.5, self.STEP, slope, np.ones(n, dtype=bool))):  # dry and level; wet and, if it can be, steep
            prepared = model.prepare(values, *surface)
            for name, column in zip(model.sumo_type(prepared)._fields, model.sumo_type(prepared), strict=True):
                outputs.setdefault(f"{name} of sumo_type", []).append(column)
            state, sample = model.at_rest(prepared), 0
            if model.can_start_moving:
                self._drive(model, prepared, model.at_speed(prepared, np.full(n, 5.0)), 5, 0.0, 0.5, outputs)
            for throttle, brake, steps in self.PHASES:
                state = self._drive(model, prepared, state, steps, throttle, brake, outputs, sample)
                sample += steps
        return {name: np.stack(columns) for name, columns in outputs.items()}

    def _drive(self, model: Any, prepared: Any, state: Any, steps: int, throttle: float, brake: float,
               outputs: dict[str, list[np.ndarray]], sample: int = 0) -> Any:
        n = len(state.speed)
        nothing = np.zeros(n)
        for step in range(sample, sample + steps):
            gap = 100.0 - step + nothing
            seen = Observation(step * self.STEP, state.speed, gap, state.speed, nothing + 2 - 0.02 * step, nothing - 0.2, 0.9, nothing,
                               state.throttle, state.brake)
            sensed, state = model.sense(prepared, state, seen)
            state = model.advance(prepared, state, Command(nothing + throttle, nothing + brake))
            for name in ("speed", "throttle", "brake", "gear"):
                outputs.setdefault(name, []).append(getattr(state, name))
            for name in ("gap", "closing_speed", "lateral"):
                outputs.setdefault(f"{name} sensed", []).append(getattr(sensed, name))
        return state

    def reactions(self, model: Any, outputs: Outputs) -> Iterator[Reaction]:
        start = 5 if model.can_start_moving else 0
        speed, braked = outputs["speed"][start:, 0], start + sum(steps for *_, steps in self.PHASES[:5])
        fastest = outputs["speed"][start + self.PHASES[0][2] - 1, 0]
        if not fastest > 0:
            yield Reaction(("advance",), "a speed above 0 after 4 s of full throttle", f"the original vehicle goes {fastest:g} m/s")
        elif not speed[braked - start + self.PHASES[5][2] - 1] < speed[braked - start - 1]:
            yield Reaction(("advance",), "a lower speed after 3 s of full brake", "the original vehicle does not slow down")
        for column, name in enumerate(self._members.names):
            lower, upper = 5 + 2 * column, 6 + 2 * column
            if all(np.array_equal(values[..., lower], values[..., upper]) for values in outputs.values()):
                yield Reaction(("prepare", "advance"), f"another drive, type or observation at the two ends of {name}",
                               f"{name} = {self.settings[lower, column]:g} and {self.settings[upper, column]:g} are the same to the bit")

    def cost(self, model: Any, seconds: float) -> tuple[float, str]:
        steps = 2 * sum(phase[-1] for phase in self.PHASES) + 10 * model.can_start_moving
        return _cost(seconds, timed(lambda: _drive_ours(self.number, steps)), "sumo", self.number, steps)


def _drive_ours(n: int, steps: int) -> None:
    """Drive so many of our plainest vehicle."""
    values = {"mass": 1500.0, "accel": 3.0, "decel": 8.0, "maxSpeed": 40.0, "tau": 0.1, "sensorRange": 100.0, "reactionTime": 0.1,
              "brakeDelay": 0.1, "brakeGain": 1.0}
    vehicle = SumoVehicle()
    prepared = vehicle.prepare({name: np.full(n, value) for name, value in values.items()}, 1.0, STEP)
    state, command = vehicle.at_rest(prepared), Command(np.full(n, 0.5), np.zeros(n))
    ten = np.full(n, 10.0)
    seen = Observation(0.0, ten, ten, ten, ten, ten, 1.0)
    for _ in range(steps):
        _, state = vehicle.sense(prepared, state, seen)
        state = vehicle.advance(prepared, state, command)


def corners(members: CharacteristicSet) -> FloatArray:
    """The original, the corners of all domains together, both ends of every domain alone, and corners drawn at random."""
    lower, upper, number = members.lower, members.upper, np.arange(len(members))
    together = [members.original, lower, upper, np.where(number % 2, lower, upper), np.where(number % 2, upper, lower)]
    alone = [np.where(number == i, end, members.original) for i in number for end in (lower, upper)]
    drawn = np.where(np.random.default_rng(0).random((24, len(members))) < 0.5, lower, upper)
    return np.array([*together, *alone, *drawn])


class StudyProbe(Probe):
    """The subject's study simulated: the original vehicle and corners of the domains."""

    methods = ("observe", "encounter", "begin", "step", "drive", "advance")
    number = 5

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        members = CharacteristicSet.of(subject.study.vehicle.characteristics)
        self.settings = members.filter(corners(members)[:5])

    def fresh(self) -> System:
        return self.system()

    def run(self, model: System, rows: Rows) -> Outputs:
        found = evaluate(model, self.settings[rows])
        return {"outcome": found.outcome, "collision_speed": found.collision_speed, **found.metrics}

    def reactions(self, model: System, outputs: Outputs) -> Iterator[Reaction]:
        if self.subject.kind not in ("scenario", "traci"):
            return
        runs = drive_all(replace(model, matrix=()), self.settings[:1])
        gap, speed = runs.trace.gap[:, 0], runs.trace.speed[:, 0]
        near = np.isfinite(gap)
        if self.subject.kind == "traci":
            if outputs["outcome"][0] == "never-moved":
                yield Reaction(("step",), "a wish that moves the vehicle: setSpeed, slowDown, setAcceleration", "the vehicle never moves")
            elif outputs["outcome"][0] == "collision" and not runs.trace.brake.any():
                yield Reaction(("step",), "a brake pedal above 0 at some time before somebody in its way", "never brakes, and collides")
            return
        if not near.any():
            yield Reaction(("observe",), "a finite gap to somebody at some time", "a gap that is infinite all the time")
        elif speed.max() > 1 and np.ptp(gap[near]) == 0:
            yield Reaction(("observe",), "a gap that shrinks as the vehicle drives", f"a gap of {gap[near][0]:g} m all the time")
        elif not (runs.encounter.in_conflict & runs.trace.active).any():
            yield Reaction(("encounter",), "in_conflict true at some time, so that metrics are defined", "in_conflict is always false")
        if not reason_for_sumo(model) and not self.subject.is_ours:
            yield from self._reacting_actors(model, outputs)

    def _reacting_actors(self, model: System, outputs: Outputs) -> Iterator[Reaction]:
        """Actors that react although the scenario says that they do not: SUMO itself then gives other results."""
        in_sumo = evaluate(model, self.settings, Engine.LIBSUMO)
        for name, values in {"outcome": in_sumo.outcome, **in_sumo.metrics}.items():
            if not (np.array_equal(outputs[name], values) if values.dtype.kind == "U" else
                    np.allclose(outputs[name], values, rtol=0, atol=1e-9, equal_nan=True)):
                yield Reaction(("observe",), "reactive_actors = True where somebody reacts to the vehicle under test",
                               f"{name} is {outputs[name][0]} in the recorded scene and {values[0]} in SUMO")
                return

    def cost(self, model: System, seconds: float) -> tuple[float, str]:
        if self.subject.kind != "traci":
            return 0.0, ""
        mine = seconds / self.number / len(drive_all(model, self.settings).trace.time)
        return mine, f"{mine * 1e6:.2g} microseconds per vehicle and step, SUMO's own included"


class MetricProbe(Probe):
    """A metric of drives with and without collisions."""

    methods = ("function",)
    number = 24

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        self._runs = _runs_of(subject.study)

    def fresh(self) -> Any:
        forget_foreign()
        return foreign_metric(loaded_again(self.subject), _guard(self.subject))

    def run(self, model: Any, rows: Rows) -> Outputs:
        runs = self._runs.of(slice(0, self.number))
        if not np.array_equal(rows, np.arange(self.number)):
            first, last, sign = int(rows[0]), int(rows[-1]), 1 if len(rows) == 1 or rows[1] > rows[0] else -1
            runs = self._runs.of(slice(first, last + sign if last + sign >= 0 else None, sign))
        with np.errstate(all="ignore"):
            return {"values": model(runs, self.subject.study.metrics)}

    def reactions(self, model: Any, outputs: Outputs) -> Iterator[Reaction]:
        values = outputs["values"]
        if np.isnan(values).all():
            yield Reaction((), "a number for some drive", f"NaN for all of {self.number} drives")
        elif not np.isnan(values).any() and np.ptp(values) == 0 and values[0] != 0:
            yield Reaction((), "other values for other drives", f"{values[0]:g} for all of {self.number} drives")

    def cost(self, model: Any, seconds: float) -> tuple[float, str]:
        ours = timed(lambda: METRICS["tet"](self._runs, self.subject.study.metrics))
        return _cost(seconds, ours, "tet", self.number, len(self._runs.trace.time))


def _runs_of(study: Study) -> SimulationRuns:
    """Drives of 24 vehicles in a study, of which each fourth or so gives full throttle all the time."""
    plain = msgspec.structs.replace(study, metrics=msgspec.structs.replace(study.metrics, also=[]),
                                    search=msgspec.structs.replace(study.search, objectives=["safety_degree", "f_diff"]))
    system = assemble(plain)
    members = system.characteristics
    settings = members.lower + np.random.default_rng(0).random((MetricProbe.number, len(members))) * (members.upper - members.lower)
    settings[0] = members.original
    return drive_all(replace(system, ads=_Reckless(system.ads), matrix=()), settings)


class _Reckless:
    """An ADS whose every fourth vehicle gives full throttle instead."""

    own_reactions = True

    def __init__(self, ads: Ads) -> None:
        self._ads = ads

    def start(self, n: int, nominal: Nominal, step: float) -> Any:
        return self._ads.start(n, nominal, step)

    def drive(self, seen: Observation, memory: Any) -> tuple[Command, Any]:
        command, memory = self._ads.drive(seen, memory)
        reckless = np.arange(len(seen.speed)) % 4 == 1
        return Command(np.where(reckless, 1.0, command.throttle), np.where(reckless, 0.0, command.brake)), memory


class ObjectiveProbe(Probe):
    """A measure of change at the original and at the corners of the domains."""

    methods = ("function",)

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        self._members = CharacteristicSet.of(subject.study.vehicle.characteristics)
        self._settings = self._members.filter(corners(self._members))
        self.number = len(self._settings)

    def fresh(self) -> Any:
        forget_foreign()
        return foreign_change(loaded_again(self.subject), _guard(self.subject))

    def run(self, model: Any, rows: Rows) -> Outputs:
        return {"values": model.function(self._settings[rows], self._members)}

    def reactions(self, model: Any, outputs: Outputs) -> Iterator[Reaction]:
        values = outputs["values"]
        if np.ptp(values) == 0:
            yield Reaction((), "other values at the corners of the domains than at the original", f"{values[0]:g} everywhere")


class AlgorithmProbe(Probe):
    """A search of a smooth function; the vehicles are those that it asks for, one after the other."""

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

    def fresh(self) -> Any:
        forget_foreign()
        return self._instance()

    def _instance(self) -> Any:
        """One for a run of its own, as every run of a study has."""
        subject, study = self.subject, self.subject.study
        lookup = Lookup("check", study.origin.places)
        member = lookup.find(ALGORITHMS, subject.name, subject.key)
        parameters = lookup.with_paths(member, subject.parameters, f"search.{subject.name}")
        return GuardedAlgorithm(instance_of(member, parameters, subject.key, f"search.{subject.name}", "check"), _guard(subject))

    def run(self, model: Any, rows: Rows, seed: int = 1) -> Outputs:
        """All settings that a run asks for, and those that it returns."""
        search = model.search(self._problem, np.random.default_rng(seed))
        asked, answer = list[FloatArray](), None
        while True:
            try:
                settings = next(search) if answer is None else search.send(answer)
            except StopIteration as end:
                return {"settings asked for": np.concatenate(asked)[..., np.newaxis],
                        "settings returned": end.value.settings[..., np.newaxis]}
            asked.append(settings)
            answer = self._scored(settings)

    def again(self, model: Any, rows: Rows) -> Outputs:
        forget_foreign()
        self.run(self._instance(), rows, seed=2)
        return self.run(self._instance(), rows)

    def _scored(self, settings: FloatArray) -> Evaluations:
        """Evaluations with a safety degree that falls towards the upper ends of the domains, and below 0 on a collision."""
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

    def reactions(self, model: Any, outputs: Outputs) -> Iterator[Reaction]:
        other = self.run(model, np.arange(1), seed=2)
        if np.array_equal(outputs["settings asked for"], other["settings asked for"]):
            yield Reaction(("search",), "other settings with other random numbers `rng`", "the same settings in every run")
        if not outputs["settings returned"].size:
            yield Reaction(("search",), "a result: settings that the run was sent evaluations of",
                           f"nothing, after {len(outputs['settings asked for'])} evaluations")


PROBES: Mapping[str, tuple[type[Probe], ...]] = {
    "ads": (AdsProbe, StudyProbe), "vehicle": (VehicleProbe, StudyProbe), "scenario": (StudyProbe,), "metric": (MetricProbe,),
    "objective": (ObjectiveProbe,), "algorithm": (AlgorithmProbe,), "traci": (StudyProbe,)}
