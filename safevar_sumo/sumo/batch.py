"""Simulates and scores many settings at once, in recorded scenes or in copies of a network in SUMO."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import fields
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from safevar_sumo.ads import Ads, FullBrake
from safevar_sumo.ads.varied import with_tau
from safevar_sumo.errors import InputError
from safevar_sumo.plugins import check_open_runs, open_rows, user_errors
from safevar_sumo.plugins.time_limit import end_if_longer
from safevar_sumo.protocol.driving_robot import DrivingRobot
from safevar_sumo.records import (
    STANDSTILL,
    TIME_DECIMALS,
    BoolArray,
    Command,
    Evaluations,
    FloatArray,
    Observation,
    Outcome,
    Quantity,
    SimulationRuns,
    Trace,
)
from safevar_sumo.scenarios import VUT, WEATHER_PARAMETERS, Point, Scenario, Scene, TrackScenario, WorldScenario
from safevar_sumo.sumo.bodies import Contacts, Motion, SceneWorld, World
from safevar_sumo.sumo.encounters import encounter, scenes_of_encounters
from safevar_sumo.sumo.engine import Engine, Start, open_in_process, open_varied_world, open_world
from safevar_sumo.sumo.network import copied_network, stage_networks
from safevar_sumo.sumo.perception import Observer, Perception, SceneObserver, per_vehicle
from safevar_sumo.sumo.recorded_world import RecordedWorld
from safevar_sumo.sumo.recording import Recording
from safevar_sumo.sumo.stage import LaneWorld, Stage
from safevar_sumo.sumo.stage_world import StageWorld, start_frame
from safevar_sumo.sumo.system import System
from safevar_sumo.sumo.traci_controller import TraciController
from safevar_sumo.sumo.world import Api, SumoWorld
from safevar_sumo.vehicles import LEVEL, CharacteristicSet, Sensors, slope_of
from safevar_sumo.vehicles.base import Prepared

Listener = Callable[[Observation], None]
"""A function that is called with what the ADS observes at every sample."""
OF_ALL_RUNS = ("step", "vehicle_length", "vehicle_width", "time", "position")
"""Fields of a trace that are no columns of a log."""
TRUTHS = ("active", "visible")


@np.errstate(all="ignore")
def score(system: System, settings: FloatArray, runs: SimulationRuns) -> Evaluations:
    """The metrics and objectives of settings that have been simulated in `runs`."""
    is_invalid = runs.outcome == Outcome.INVALID_TEST
    metrics = dict[str, FloatArray]()
    with user_errors(system.source):
        for name, measure in system.measuring.measures.items():
            if measure.of == "settings":
                metrics[name] = measure.function(settings, system.characteristics)
            else:
                metrics[name] = np.where(is_invalid, np.nan, measure.function(runs, system.metrics_table))
    return Evaluations(
        settings=settings,
        outcome=runs.outcome,
        collision_speed=runs.collision_speed,
        metrics=metrics,
        f_diff=system.characteristics.largest_change(settings),
        f_num_diff=system.characteristics.number_changed(settings),
    )


def reason_for_sumo(system: System) -> str:
    """Why SUMO must simulate a system, in a copy of the network for each vehicle; "" if recorded scenes suffice."""
    if isinstance(system.ads, TraciController):
        return "a controller written for TraCI reads the running simulation"
    searched = {*system.characteristics.scenario.names} - WEATHER_PARAMETERS.keys()
    played = (one.scenario for one in system.points if isinstance(one.scenario, WorldScenario))
    if searched and any(type(scenario).layout is WorldScenario.layout for scenario in played):
        return f"each encounter has traffic of its own, by {', '.join(sorted(searched))}"
    return system.scenes.reason_for_sumo(system.points)


def is_recorded(system: System, engine: Engine = Engine.RECORDED) -> bool:
    """Whether the vehicles drive in recorded scenes instead of SUMO."""
    return engine is Engine.RECORDED and not reason_for_sumo(system)


def drive_all(
    system: System, settings: FloatArray, engine: Engine = Engine.RECORDED, listen: Listener | None = None
) -> SimulationRuns:
    """Simulate N settings of n characteristics, shape (N, n), at every point.

    The result holds the runs at the first point, then the runs at the second point, and so on. Several points must have
    scenarios of tracks; SUMO simulates only one point at once. `listen` is called with what the ADS observes
    at every sample.

    Raises
    ------
    SimulationError
        If SUMO fails.
    InputError
        If a user's ADS fails, or takes longer than the time limit.
    """
    points = system.points
    n = len(settings)
    fleet, vehicles = system.at_encounters(settings)
    system.vehicle.compile()  # outside the time limit
    with user_errors(system.source), end_if_longer(system.time_limit):
        stage = stage_of(system, settings)
        if not is_recorded(system, engine):
            with open_points_world(system, settings, stage) as sumo_world:
                observer = observer_of(fleet.points[0].scenario, sumo_world, stage)
                return drive(fleet, vehicles, sumo_world, observer, listen)
        if stage is not None:
            lane = LaneWorld(stage, _start_speeds(fleet.points, n), stage.step)
            return drive(fleet, np.tile(vehicles, (len(points), 1)), lane, stage, listen)
        (scenario,) = (point.scenario for point in points if isinstance(point.scenario, WorldScenario))
        scene = system.scenes.of(scenario)
        assert isinstance(scene, Recording)
        size = n
        if fleet.points[0].scenario is not scenario:  # each encounter has a scene of its own
            size = _vehicles_per_encounter(settings[:, ~system.characteristics.of_vehicle])
            encounters = system.at_encounters(settings[::size])[0].scenario
            assert isinstance(encounters, WorldScenario)
            scene = scenes_of_encounters(scene, encounters, n // size)
        world = RecordedWorld(scene, size)
        return drive(fleet, vehicles, world, observer_of(fleet.points[0].scenario, world, None), listen)


def observer_of(scenario: Scenario, world: SceneWorld, stage: Stage | None) -> Observer:
    """Who observes for the vehicles: the stage of tracks, or else the scenario itself."""
    if stage is not None:
        return stage
    assert isinstance(scenario, WorldScenario)
    return SceneObserver(scenario, world)


def stage_of(system: System, settings: FloatArray) -> Stage | None:
    """The bodies around N settings, shape (N, n), at every point; None if the scenario observes a world itself."""
    scenarios = [point.scenario for point in system.points if isinstance(point.scenario, TrackScenario)]
    if len(scenarios) < len(system.points):
        return None
    group = np.repeat(np.arange(len(scenarios)), len(settings))
    if len(system.characteristics.scenario):  # an encounter that several vehicles meet is there once
        encounters = settings[:, ~system.characteristics.of_vehicle]
        _, first, group = np.unique(encounters, axis=0, return_index=True, return_inverse=True)
        if len(first) == len(settings):
            first = group = np.arange(len(settings))
        scenario = system.at_encounters(settings[first])[0].scenario
        assert isinstance(scenario, TrackScenario)
        scenarios = [scenario]
    step = system.scenes.step_of(scenarios[0])
    duration = max(float(np.max(scenario.duration)) for scenario in scenarios)
    n_samples = round(duration / step) + 1
    return Stage(scenarios, np.reshape(group, -1), n_samples=n_samples, step=step)


def _start_speeds(points: Sequence[Point], n: int) -> FloatArray:
    """The speeds at the start of n vehicles at each point."""
    scenarios = (point.scenario for point in points)
    return np.concatenate([np.zeros(n) + one.start_speed for one in scenarios if isinstance(one, TrackScenario)])


def _vehicles_per_encounter(encounters: FloatArray) -> int:
    """How many vehicles in a row meet the same encounter: 2 if a variant and the original take turns, else 1."""
    is_paired = len(encounters) % 2 == 0 and np.array_equal(encounters[::2], encounters[1::2])
    return 2 if is_paired else 1


def open_points_world(
    system: System, settings: FloatArray, stage: Stage | None, start: Start = open_in_process
) -> AbstractContextManager[SumoWorld]:
    """Start SUMO on a copy of the network of the system's only point for each of N settings, shape (N, n)."""
    (point,) = system.points
    step = system.scenes.step
    n = len(settings)
    encounters = system.characteristics.scenario
    scenarios = [point.scenario]
    if len(encounters):
        rows = settings[:, ~system.characteristics.of_vehicle].tolist()
        scenarios = [encounter(point, dict(zip(encounters.names, row, strict=True))).scenario for row in rows]
    networks = stage_networks(scenarios)
    create: Callable[[Api, int], SumoWorld] = SumoWorld
    if stage is not None:
        speeds = _start_speeds(system.at_encounters(settings)[0].points, n)
        create = partial(StageWorld, stage=stage, start_speeds=speeds, start=start_frame(networks[0], step))
    if len(encounters):
        return open_varied_world(networks, step, create, start)
    return open_world(copied_network(networks[0], n), n, step, create, start)


@np.errstate(all="ignore")
def drive(
    system: System, settings: FloatArray, world: World, observer: Observer, listen: Listener | None = None
) -> SimulationRuns:
    """Simulate vehicles in a world that has not taken its first step; see `drive_all`.

    With K points, `settings` holds K groups of equal size, and group k drives at point k.
    """
    vehicle = system.vehicle
    step = world.step_length
    n = len(settings)
    outcomes = _Outcomes(len(settings))
    prepared, ads, motion = enter(system, settings, world)
    state = vehicle.at_start(prepared, motion.speeds)
    ads_memory = ads.start(n, system.nominal, step)
    size = n // len(system.points)
    perception = Perception([point.weather for point in system.points], step, size)
    last_step = np.round(per_vehicle([point.scenario.duration / step for point in system.points], size)).astype(int)
    log = _Log(world, int(last_step.max()) + 1)
    robot = DrivingRobot(system.points, vehicle, prepared, state, step)
    fronts_only = np.repeat([point.scenario.is_hit_in_front for point in system.points], size)
    contacts = Contacts(n, fronts_only)
    warning_ttc = np.full(n, np.nan)
    with check_open_runs(outcomes.is_checked):
        for sample in range(log.length):
            speed = motion.speeds
            scene = observer.observe(motion, outcomes.is_open)
            if system.sees_nobody:  # the run ends at the place of the encounter
                scene = scene._replace(visible=np.array(False), over=scene.over | (scene.gap <= 0))
            collisions = contacts.count(world, motion.hits, scene)
            if isinstance(observer, SceneObserver):  # bodies on a stage touch wherever they overlap
                contacts.check(observer.world, scene, outcomes.is_open & ~scene.over, sample * step)
            active = outcomes.judge(speed, scene.over, collisions, last=sample >= last_step)
            observation = perception.observe(sample * step, speed, scene)._replace(
                throttle=state.throttle, brake=state.brake
            )
            observation, state = vehicle.sense(prepared, state, observation)
            if listen is not None:
                listen(observation)
            command, ads_memory = ads.drive(observation, ads_memory)
            _note_warnings(warning_ttc, ads.warns(ads_memory), outcomes.is_open, speed, scene)
            command, state = robot.drive(command, state, outcomes.is_open)
            log.write(
                sample, motion.fronts, scene, command, speed=speed, gear=state.gear, active=active, pedal=state.brake
            )
            if not np.count_nonzero(outcomes.is_open):
                break
            np.copyto(outcomes.is_checked, outcomes.is_open)
            state = vehicle.advance(prepared, state, command)
            _check_finite(state.speed, settings, system.characteristics)
            motion = world.step(state.speed, outcomes.is_open)
    trace = log.trace(sample + 1)
    return SimulationRuns(
        trace=trace,
        encounter=observer.encounter(trace),
        outcome=np.where(robot.invalid, Outcome.INVALID_TEST, outcomes.classify()),
        collision_speed=np.where(robot.invalid, np.nan, outcomes.collision_speed),
        contact=contacts.first,
        test_speed_error=robot.error,
        acted_early=robot.acted_early,
        warning_ttc=warning_ttc,
    )


class Fleet(NamedTuple):
    """Vehicles on the road: their constants, their ADS and their first motion."""

    prepared: Prepared
    ads: Ads
    motion: Motion


def enter(system: System, settings: FloatArray, world: World) -> Fleet:
    """Put the vehicles of settings onto the road."""
    vehicle = system.vehicle
    n = len(settings)
    characteristics = dict(zip(system.characteristics.names, np.ascontiguousarray(settings.T), strict=True))
    prepared = vehicle.prepare(characteristics, *_roads(system.points, n, world.step_length))
    types = vehicle.sumo_type(prepared)
    ads = FullBrake() if system.points[0].scenario.brakes_fully else with_tau(system.ads, types.tau)
    if not isinstance(ads, TraciController):
        return Fleet(prepared, ads, world.enter(types))
    motion = world.enter(ads.known_types(system.nominal, types), keeps_drivers=True)
    return Fleet(prepared, ads.in_world(world, _sensors_in_weather(system, prepared, n)), motion)


def _note_warnings(
    warning_ttc: FloatArray, warns: BoolArray | None, is_open: BoolArray, speed: FloatArray, scene: Scene
) -> None:
    """Note the true, not sensed, time to collision of each open run's first warning [s]."""
    if warns is not None:
        closing_speed = speed - scene.obstacle_speed
        is_first = warns & is_open & np.isnan(warning_ttc) & (closing_speed > 0)
        np.copyto(warning_ttc, scene.gap / closing_speed, where=is_first)


def _check_finite(speed: FloatArray, settings: FloatArray, characteristics: CharacteristicSet) -> None:
    """Refuse speeds that are not finite: SUMO would replace them by 0, and a vehicle whose model diverged would appear
    to stand.

    The error replaces numpy's overflow warnings, which name neither a characteristic nor a value.
    """
    is_finite = np.isfinite(speed)
    if is_finite.all():
        return
    for copy in open_rows(~is_finite)[:1]:
        changes = [
            f"{characteristic.name} = {value:g}"
            for characteristic, value in zip(characteristics, settings[copy], strict=True)
            if value != characteristic.original
        ]
        values = ", ".join(changes) or "the original's values"
        raise InputError(
            "vehicle", f"its speed is {speed[copy]} with {values}", "values that the model can compute with"
        )


def _roads(points: Sequence[Point], n: int, step: float) -> tuple[Quantity, ...]:
    """What `Vehicle.prepare` gets besides the characteristics of n vehicles: factor on the tyres' friction (a number if
    all points share it), time step and, unless all roads are level and dry, slope and water.
    """
    size = n // len(points)
    friction = per_vehicle([point.weather.road_friction for point in points], size)
    grades = [point.scenario.grade for point in points]
    water = [point.weather.water for point in points]
    slope = slope_of(np.repeat(grades, size)) if any(grades) else LEVEL
    if any(water):
        return friction, step, slope, np.repeat(water, size)
    return (friction, step, slope) if any(grades) else (friction, step)


def _sensors_in_weather(system: System, prepared: Prepared, n: int) -> Sensors:
    """The vehicles' sensors: the weather adds its recognition delay and scales the range by its visibility."""
    (point,) = system.points  # SUMO simulates one point at once
    latency, reach, scale = system.vehicle.sensors(prepared) or Sensors.perfect(n)
    # Nobody is within a negative range.
    reach_in_weather = np.full(n, -1.0) if system.sees_nobody else reach * point.weather.visibility
    return Sensors(latency + point.weather.recognition_delay, reach_in_weather, scale)


class _Log:
    """T samples of N runs in arrays of shape (T, N), and positions of the vehicles on SUMO's plane, shape (T, N, 2)."""

    def __init__(self, world: World, length: int) -> None:
        n = world.n
        self.length = length
        self._frame = world.frame
        self._step = world.step_length
        self._length = world.vehicle_length(VUT)
        self._width = world.vehicle_width
        self._positions = np.zeros((length, n, 2))
        names = (field.name for field in fields(Trace) if field.name not in OF_ALL_RUNS)
        self._columns = {name: np.zeros((length, n), dtype=bool if name in TRUTHS else float) for name in names}

    def write(
        self, sample: int, position: FloatArray, scene: Scene, command: Command, **others: FloatArray | BoolArray
    ) -> None:
        self._positions[sample] = position
        values = {**scene._asdict(), **command._asdict(), **others}
        for name, column in self._columns.items():
            column[sample] = values[name]

    def trace(self, length: int) -> Trace:
        columns = {name: values[:length] for name, values in self._columns.items()}
        columns["position"] = self._frame.along(self._positions[:length].reshape(-1, 2)).reshape(length, -1)
        return Trace(
            step=self._step,
            vehicle_length=self._length,
            vehicle_width=self._width,
            time=np.round(np.arange(length) * self._step, TIME_DECIMALS),
            **columns,
        )


class _Outcomes:
    """Outcomes of N runs (docs/method.md, section 4).

    `is_open` is true where an outcome can change; `is_checked` where user code is checked: in runs that were open when
    their vehicles last advanced.
    """

    def __init__(self, n: int) -> None:
        self.is_open = np.ones(n, dtype=bool)
        self.is_checked = np.ones(n, dtype=bool)
        self.collision_speed = np.full(n, np.nan)
        self._has_moved = np.zeros(n, dtype=bool)
        self._has_stopped = np.zeros(n, dtype=bool)
        self._is_over = np.zeros(n, dtype=bool)

    def judge(
        self, speed: FloatArray, over: BoolArray, collisions: dict[int, float], *, last: BoolArray | bool
    ) -> BoolArray:
        """Process one sample; returns for which vehicles the sample is part of the run."""
        active = self.is_open & ~over
        for copy, collision_speed in collisions.items():
            if self.is_open[copy]:
                self.collision_speed[copy] = collision_speed
                active[copy] = True
                self.is_open[copy] = False
        is_standing = speed <= STANDSTILL
        self._has_stopped |= self.is_open & self._has_moved & is_standing
        self._has_moved |= self.is_open & ~is_standing
        self._is_over |= self.is_open & over
        self.is_open &= ~over & ~np.asarray(last)
        return active

    def classify(self) -> npt.NDArray[np.str_]:
        """The outcomes of all runs, once no run is open."""
        outcome = np.full(len(self.is_open), Outcome.TIMEOUT.value, dtype="U16")
        outcome[self._is_over] = Outcome.PASSED
        outcome[self._has_stopped] = Outcome.STOPPED
        outcome[~self._has_moved] = Outcome.NEVER_MOVED
        outcome[~np.isnan(self.collision_speed)] = Outcome.COLLISION
        return outcome
