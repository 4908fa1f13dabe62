"""Probes of driving systems, vehicles and whole studies. The result of a vehicle must not depend on the grouping of vehicles."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.ads import Ads, GuardedAds
from safevar_sumo.ads.aeb import Aeb
from safevar_sumo.conformance.probe import Indices, MissingReaction, Outputs, Probe, corners_of, cost_of, guard_of, measure_time
from safevar_sumo.conformance.subject import Subject
from safevar_sumo.records import Command, FloatArray, Nominal, Observation
from safevar_sumo.sumo import Engine, reason_for_sumo
from safevar_sumo.sumo.batch import drive_all
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import System
from safevar_sumo.vehicles import LEVEL, CharacteristicSet, GuardedVehicle, slope_of
from safevar_sumo.vehicles.sumo import SumoVehicle

STEP = 0.05  # s
STEPS = 100
STEPS_FROM_SPEED = 5  # that a vehicle that can start moving drives before it starts from rest


class _Traffic(NamedTuple):
    """Encounters of N vehicles with an obstacle in T steps, arrays of shape (T, N)."""

    speed: FloatArray
    gap: FloatArray
    closing_speed: FloatArray
    lateral: FloatArray
    lateral_speed: FloatArray
    obstacle_speed: FloatArray


# Speed [m/s], gap [m], lateral offset [m], lateral speed [m/s], speed of the obstacle [m/s], and start of its detection [s].
ENCOUNTERS = np.array([
    *((speed, 3.0 * speed, 0.0, 0.0, 0.0, 0.0) for speed in (5.0, 10.0, 15.0, 20.0, 25.0, 8.0)),
    (5.0, 15.0, -4.0, 1.5, 0.0, 0.0), (10.0, 25.0, -6.0, 2.2, 0.0, 0.3),
    (10.0, 30.0, 0.0, 0.0, 0.0, 99.0), (0.0, 30.0, 0.0, 0.0, 0.0, 99.0), (0.0, 30.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.5, 0.0, 0.0, 0.0, 0.0),
    (15.0, 30.0, 0.0, 0.0, 10.0, 0.0), (10.0, 40.0, 0.0, 0.0, -5.0, 0.0), (10.0, 30.0, 10.0, 0.0, 0.0, 0.0),
    (12.0, 30.0, 0.0, 0.0, 0.0, 1.5)])
COLLISION_COURSE, FREE_ROAD = slice(0, 6), 8
"""Indices of encounters on a collision course, and of a free road with the speed of the second encounter."""


def _build_traffic() -> _Traffic:
    """Vehicles that hold their speed for half of the time and then brake with 4 m/s^2."""
    speed0, gap0, lateral0, lateral_speed, obstacle, start = (column[np.newaxis] for column in ENCOUNTERS.T)
    times = np.arange(STEPS)[:, np.newaxis] * STEP
    speed = np.maximum(speed0 - 4.0 * np.maximum(times - STEPS * STEP / 2, 0.0), 0.0)
    distance = np.vstack([np.zeros((1, len(ENCOUNTERS))), np.cumsum(speed[:-1] * STEP, axis=0)])
    is_detected = times >= start
    shape = speed.shape
    return _Traffic(speed, np.where(is_detected, gap0 + obstacle * times - distance, np.inf), np.where(is_detected, speed - obstacle, 0.0),
                    np.where(is_detected, lateral0 + lateral_speed * times, np.inf),
                    np.where(is_detected, lateral_speed, 0.0) + np.zeros(shape),
                    np.where(is_detected, obstacle, 0.0) + np.zeros(shape))


class AdsProbe(Probe):
    """Drives with an ADS in many encounters."""

    methods = ("drive", "start")
    vehicle_count = len(ENCOUNTERS)

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        self._nominal: Nominal
        self._traffic = _build_traffic()

    def load(self) -> Ads:
        system = self.reload_system()
        self._nominal = system.nominal
        self._nominal.tables()
        return system.ads if self.subject.is_user_code else GuardedAds(system.ads, guard_of(self.subject))

    def run(self, model: Ads, vehicles: Indices) -> Outputs:
        n, zeros = len(vehicles), np.zeros(len(vehicles))
        memory, command = model.start(n, self._nominal, STEP), Command(zeros, zeros)
        pedals = np.zeros((2, STEPS, n))
        for step in range(STEPS):
            speed, gap, closing, lateral, lateral_speed, obstacle = (column[step, vehicles] for column in self._traffic)
            seen = Observation(step * STEP, speed, gap, closing, lateral, lateral_speed, visibility=0.9, obstacle_speed=obstacle,
                               throttle=command.throttle, brake=command.brake)
            command, memory = model.drive(seen, memory)
            pedals[:, step] = command.throttle, command.brake
        return {"throttle": pedals[0], "brake": pedals[1]}

    def missing_reactions(self, model: Ads, outputs: Outputs) -> Iterator[MissingReaction]:
        brake, throttle = outputs["brake"], outputs["throttle"]
        if not brake[:, COLLISION_COURSE].any():
            yield MissingReaction(("drive",), "a brake pedal above 0 at some time before an obstacle that stands in its way",
                                  f"never brakes, at 5 to 25 m/s with {STEPS * STEP:g} s to look on")
        elif np.ptp(brake[:, 1]) == 0 and all(np.array_equal(pedal[:, 1], pedal[:, FREE_ROAD]) for pedal in (throttle, brake)):
            yield MissingReaction(("drive",), "other pedals before an obstacle than on a free road",
                                  "the same with an obstacle and without")

    def cost(self, model: Ads, seconds: float) -> tuple[float, str]:
        return cost_of(seconds, measure_time(lambda: self.run(Aeb(), np.arange(self.vehicle_count))), "aeb", self.vehicle_count, STEPS)


class VehicleProbe(Probe):
    """Accelerates, coasts and brakes with a vehicle, at the corners of the domains."""

    methods = ("advance", "sense", "prepare", "at_rest", "sumo_type", "at_speed")
    PHASES = ((1.0, 0.0, 40), (0.3, 0.0, 5), (0.0, 0.0, 5), (0.0, 0.2, 5), (0.5, 0.5, 5), (0.0, 1.0, 30), (0.0, 0.0, 2))
    """Throttle, brake, and number of steps of each phase."""
    STEP = 0.1  # s

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        self._characteristics = CharacteristicSet.of(subject.study.vehicle.characteristics)
        self.settings = corners_of(self._characteristics)
        self.vehicle_count = len(self.settings)

    def load(self) -> Any:
        vehicle = self.reload_system().vehicle
        return vehicle if self.subject.is_user_code else GuardedVehicle(vehicle, guard_of(self.subject))

    def run(self, model: Any, vehicles: Indices) -> Outputs:
        n, outputs = len(vehicles), dict[str, list[np.ndarray]]()
        values = dict(zip(self._characteristics.names, np.ascontiguousarray(self.settings[vehicles].T), strict=True))
        slope = slope_of(np.full(n, 5.0)) if model.takes_slope else LEVEL
        dry_level_road, wet_steep_road = (1.0, self.STEP), (0.5, self.STEP, slope, np.ones(n, dtype=bool))  # steep if the model can
        for road in (dry_level_road, wet_steep_road):
            prepared = model.prepare(values, *road)
            for name, column in zip(model.sumo_type(prepared)._fields, model.sumo_type(prepared), strict=True):
                outputs.setdefault(f"{name} of sumo_type", []).append(column)
            state, first_step = model.at_rest(prepared), 0
            if model.can_start_moving:
                self._drive(model, prepared, model.at_speed(prepared, np.full(n, 5.0)), outputs, STEPS_FROM_SPEED,
                            throttle=0.0, brake=0.5)
            for throttle, brake, steps in self.PHASES:
                state = self._drive(model, prepared, state, outputs, steps, throttle, brake, first_step)
                first_step += steps
        return {name: np.stack(columns) for name, columns in outputs.items()}

    def _drive(self, model: Any, prepared: Any, state: Any, outputs: dict[str, list[np.ndarray]], steps: int, throttle: float,
               brake: float, first_step: int = 0) -> Any:
        """The state after steps with constant pedals; adds the state and the observation in every step to `outputs`."""
        zeros = np.zeros(len(state.speed))
        for step in range(first_step, first_step + steps):
            gap = 100.0 - step + zeros
            seen = Observation(step * self.STEP, state.speed, gap, closing_speed=state.speed, lateral=zeros + 2 - 0.02 * step,
                               lateral_speed=zeros - 0.2, visibility=0.9, obstacle_speed=zeros, throttle=state.throttle, brake=state.brake)
            sensed, state = model.sense(prepared, state, seen)
            state = model.advance(prepared, state, Command(zeros + throttle, zeros + brake))
            for name in ("speed", "throttle", "brake", "gear"):
                outputs.setdefault(name, []).append(getattr(state, name))
            for name in ("gap", "closing_speed", "lateral"):
                outputs.setdefault(f"{name} sensed", []).append(getattr(sensed, name))
        return state

    def missing_reactions(self, model: Any, outputs: Outputs) -> Iterator[MissingReaction]:
        start = STEPS_FROM_SPEED if model.can_start_moving else 0
        speed, braking_start = outputs["speed"][start:, 0], sum(steps for *_, steps in self.PHASES[:5])
        throttle_steps, braking_steps = self.PHASES[0][-1], self.PHASES[5][-1]
        top_speed = speed[throttle_steps - 1]
        if not top_speed > 0:
            yield MissingReaction(("advance",), "a speed above 0 after 4 s of full throttle",
                                  f"the original vehicle goes {top_speed:g} m/s")
        elif not speed[braking_start + braking_steps - 1] < speed[braking_start - 1]:
            yield MissingReaction(("advance",), "a lower speed after 3 s of full brake", "the original vehicle does not slow down")
        for column, name in enumerate(self._characteristics.names):
            at_lower, at_upper = 5 + 2 * column, 6 + 2 * column  # vehicles with this characteristic at an end of its domain
            if all(np.array_equal(values[..., at_lower], values[..., at_upper]) for values in outputs.values()):
                yield MissingReaction(("prepare", "advance"), f"another drive, type or observation at the two ends of {name}",
                                      f"{name} = {self.settings[at_lower, column]:g} and {self.settings[at_upper, column]:g} "
                                      "are the same to the bit")

    def cost(self, model: Any, seconds: float) -> tuple[float, str]:
        steps = 2 * (sum(phase[-1] for phase in self.PHASES) + STEPS_FROM_SPEED * model.can_start_moving)  # on two roads
        return cost_of(seconds, measure_time(lambda: _drive_example(self.vehicle_count, steps)), "sumo", self.vehicle_count, steps)


def _drive_example(n: int, steps: int) -> None:
    """Drive n vehicles of the simplest shipped model."""
    values = {"mass": 1500.0, "accel": 3.0, "decel": 8.0, "maxSpeed": 40.0, "tau": 0.1, "sensorRange": 100.0, "reactionTime": 0.1,
              "brakeDelay": 0.1, "brakeGain": 1.0}
    vehicle = SumoVehicle()
    prepared = vehicle.prepare({name: np.full(n, value) for name, value in values.items()}, road_friction=1.0, step=STEP)
    state, command = vehicle.at_rest(prepared), Command(np.full(n, 0.5), np.zeros(n))
    ten = np.full(n, 10.0)
    seen = Observation(time=0.0, speed=ten, gap=ten, closing_speed=ten, lateral=ten, lateral_speed=ten, visibility=1.0)
    for _ in range(steps):
        _, state = vehicle.sense(prepared, state, seen)
        state = vehicle.advance(prepared, state, command)


class StudyProbe(Probe):
    """Simulates the subject's study with the original vehicle and with corners of the domains."""

    methods = ("observe", "encounter", "begin", "step", "drive", "advance")
    vehicle_count = 5

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        characteristics = CharacteristicSet.of(subject.study.vehicle.characteristics)
        self.settings = characteristics.filter(corners_of(characteristics)[:5])

    def load(self) -> System:
        return self.reload_system()

    def run(self, model: System, vehicles: Indices) -> Outputs:
        evaluations = evaluate(model, self.settings[vehicles])
        return {"outcome": evaluations.outcome, "collision_speed": evaluations.collision_speed, **evaluations.metrics}

    def missing_reactions(self, model: System, outputs: Outputs) -> Iterator[MissingReaction]:
        is_driver = self.subject.kind in ("ads", "traci") and not self.subject.in_any_study
        if is_driver and (reason := why_no_verdict(model)):
            yield MissingReaction(("drive", "step"), "a drive to the encounter, with no braking while nobody is in sight", reason)
            return
        if self.subject.kind not in ("scenario", "traci"):
            return
        runs = drive_all(replace(model, matrix=()), self.settings[:1])
        gap, speed = runs.trace.gap[:, 0], runs.trace.speed[:, 0]
        is_detected = np.isfinite(gap)
        if self.subject.kind == "traci":
            if outputs["outcome"][0] == "collision" and not runs.trace.brake.any():
                yield MissingReaction(("step",), "a brake pedal above 0 at some time before somebody in its way",
                                      "never brakes, and collides")
            return
        if not is_detected.any():
            yield MissingReaction(("observe",), "a finite gap to somebody at some time", "a gap that is infinite all the time")
        elif speed.max() > 1 and np.ptp(gap[is_detected]) == 0:
            yield MissingReaction(("observe",), "a gap that shrinks as the vehicle drives",
                                  f"a gap of {gap[is_detected][0]:g} m all the time")
        elif not (runs.encounter.in_conflict & runs.trace.active).any():
            yield MissingReaction(("encounter",), "in_conflict true at some time, so that metrics are defined",
                                  "in_conflict is always false")
        if not reason_for_sumo(model) and self.subject.is_user_code:
            yield from self._undeclared_reactive_actors(model, outputs)

    def _undeclared_reactive_actors(self, model: System, outputs: Outputs) -> Iterator[MissingReaction]:
        """Actors that react, since SUMO gives other results than the recorded scene, although the scenario does not declare it."""
        in_sumo = evaluate(model, self.settings, Engine.LIBSUMO)
        for name, values in {"outcome": in_sumo.outcome, **in_sumo.metrics}.items():
            recorded = outputs[name]
            is_same = recorded == values if values.dtype.kind == "U" else np.isclose(recorded, values, rtol=0, atol=1e-9, equal_nan=True)
            for i in np.flatnonzero(~is_same)[:1]:
                pairs = zip(model.characteristics.names, self.settings[i], strict=True)
                setting = ", ".join(f"{characteristic} = {value:g}" for characteristic, value in pairs)
                yield MissingReaction(("observe",), "reactive_actors = True where somebody reacts to the vehicle under test",
                                      f"{name} is {recorded[i]} in the recorded scene and {values[i]} in SUMO with {setting}", "contract")
                return

    def cost(self, model: System, seconds: float) -> tuple[float, str]:
        if self.subject.kind != "traci":
            return 0.0, ""
        cost = seconds / self.vehicle_count / len(drive_all(model, self.settings).trace.time)
        return cost, f"{cost * 1e6:.2g} microseconds per vehicle and step, SUMO's own included"
