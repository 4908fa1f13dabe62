"""Simulates and scores many settings at once, in recorded scenes or in copies of a network in
SUMO.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np

from safevar_sumo.plugins.time_limit import end_if_longer
from safevar_sumo.records import Evaluations, FloatArray, Outcome, SimulationRuns
from safevar_sumo.scenarios import (
    WEATHER_PARAMETERS,
    Point,
    Scenario,
    WorldScenario,
)
from safevar_sumo.sumo.drive import Listener, drive, last_sample_of
from safevar_sumo.sumo.encounters import encounter, scenes_of_encounters
from safevar_sumo.sumo.engine import (
    Create,
    Start,
    open_in_process,
    open_world,
)
from safevar_sumo.sumo.lane_world import LaneWorld
from safevar_sumo.sumo.network import networks_for, varied_network
from safevar_sumo.sumo.perception import Observer, SceneObserver
from safevar_sumo.sumo.recorded_world import RecordedWorld
from safevar_sumo.sumo.recording import Recording
from safevar_sumo.sumo.simulators import joined, simulate_each
from safevar_sumo.sumo.system import System
from safevar_sumo.sumo.traci_controller import TraciController
from safevar_sumo.sumo.traffic import OVERTIME, Traffic
from safevar_sumo.sumo.traffic_world import TrafficWorld, start_frame
from safevar_sumo.sumo.world import SumoWorld


@np.errstate(all="ignore")
def score(system: System, settings: FloatArray, runs: SimulationRuns) -> Evaluations:
    """The metrics and objectives of settings that have been simulated in `runs`."""
    is_invalid = runs.outcome == Outcome.INVALID_TEST
    settings = np.tile(settings, (system.repeats, 1))

    # In an invalid test the vehicle misses the test's speed: metrics of its run mean nothing.
    metrics = {}
    with system.user_code():
        for name, measure in system.measuring.measures.items():
            if measure.of == "settings":
                metrics[name] = measure.function(settings, system.characteristics)
            else:
                values = measure.of_runs(runs, system.metrics_table)
                metrics[name] = np.where(is_invalid, np.nan, values)
    evaluations = Evaluations(
        settings=settings,
        outcome=runs.outcome,
        collision_speed=runs.collision_speed,
        metrics=metrics,
        **system.characteristics.change_objectives(settings),
    )
    if system.repeats == 1:
        return evaluations
    return joined(evaluations, system.repeats, system.criterion)


def reason_against_scenes(system: System) -> str:
    """The reason why recorded scenes and tracks do not suffice for a system; "" if they suffice.

    With a reason, SUMO simulates the system, in a copy of the network for each vehicle, or the
    user's simulator does.
    """
    if reason := system.mover.lacks.get("recorded scenes"):
        return reason
    if system.in_sumo:
        return "requested"
    if isinstance(system.ads, TraciController):
        return "a controller written for TraCI reads the running simulation"
    searched = {*system.characteristics.scenario.names} - WEATHER_PARAMETERS.keys()
    if searched and any(_has_own_traffic(point) for point in system.points):
        names = ", ".join(sorted(searched))
        return f"each encounter has traffic of its own, by {names}"
    return system.scenes.reason_against_scenes(system.points)


def _has_own_traffic(point: Point) -> bool:
    """Whether only SUMO knows the traffic of a point's encounters: the scenario has no `layout` of
    its own, a method that computes where the actors of each encounter are.
    """
    scenario = point.scenario
    return (
        isinstance(scenario, WorldScenario)
        and type(scenario).layout is WorldScenario.layout
    )


def drive_all(
    system: System, settings: FloatArray, listen: Listener | None = None
) -> SimulationRuns:
    """Simulate N settings of n characteristics, shape (N, n), at every point.

    The result holds the runs at the first point, then the runs at the second point, and so on.
    Several points must have scenarios of tracks; SUMO and other simulators simulate only one point
    at once. `listen` is called at every sample, with the observation that the ADS gets. A study
    that repeats settings has the runs of all settings in the first round, then all of the second.

    Raises
    ------
    SimulationError
        If SUMO fails.
    InputError
        If a user's ADS fails, or takes longer than the time limit.
    """
    if system.mover.takes_long:
        return simulate_each(system, np.tile(settings, (system.repeats, 1)))
    vehicles, encounters = system.split(settings)
    road_system = system.at_encounters(encounters)
    # Compilation may take longer than a simulation: it must not count in the time limit.
    system.vehicle.compile()
    with system.user_code(), end_if_longer(system.time_limit):
        # SUMO is slow. So it simulates only if neither tracks nor a recorded scene suffice; among
        # tracks all points are simulated at once.
        if reason_against_scenes(system):
            with open_points_world(system, encounters) as (sumo_world, observer):
                return drive(road_system, vehicles, sumo_world, observer, listen)
        traffic = traffic_of(system, encounters, 0.0)
        if traffic is not None:
            lane = LaneWorld(traffic, traffic.step)
            vehicles = np.tile(vehicles, (len(system.points), 1))
            return drive(road_system, vehicles, lane, traffic, listen)
        scenario = road_system.points[0].scenario
        assert isinstance(scenario, WorldScenario)
        world = _recorded_world(system, encounters, scenario)
        observer = SceneObserver(scenario, world)
        return drive(road_system, vehicles, world, observer, listen)


def _recorded_world(
    system: System, encounters: FloatArray, scenario_there: Scenario
) -> RecordedWorld:
    """The recorded scene of the system's only point, for N vehicles in `encounters`, shape (N, k).
    If the encounters change the scenario (`scenario_there`), each has a scene of its own.
    """
    (point,) = system.points
    assert isinstance(point.scenario, WorldScenario)
    scene = system.scenes.of(point.scenario)
    assert isinstance(scene, Recording)
    if scenario_there is point.scenario:
        return RecordedWorld(scene, len(encounters))

    # If rows are pairs of a variant and the original in the same encounter, a pair shares a scene.
    size = 1
    if np.array_equal(encounters[::2], encounters[1::2]):
        size = 2
    scenario = system.at_encounters(encounters[::size]).points[0].scenario
    assert isinstance(scenario, WorldScenario)
    scenes = scenes_of_encounters(scene, scenario, len(encounters) // size)
    return RecordedWorld(scenes, size)


def traffic_of(system: System, encounters: FloatArray, longer: float) -> Traffic | None:
    """The bodies around N vehicles in their `encounters`, shape (N, k), at every point; None if the
    scenario observes a world itself. Tracks last `longer` seconds more than their scenarios.
    """
    if not system.has_tracks:
        return None

    # The bodies of an encounter that several vehicles meet are computed only once. In a study that
    # searches none of its parameters, all vehicles meet the same encounter.
    _, distinct, group = np.unique(
        encounters, axis=0, return_index=True, return_inverse=True
    )
    if len(distinct) == len(encounters):
        distinct = group = np.arange(len(encounters))
    points = system.at_encounters(encounters[distinct]).points
    n_encounters = len(distinct)
    starts = n_encounters * np.arange(len(points))
    group = (starts[:, np.newaxis] + np.ravel(group)).ravel()
    step = system.scenes.step_of(points[0].scenario)
    last_sample = max(float(np.max(last_sample_of(point, step))) for point in points)
    n_samples = round(last_sample + longer / step) + 1
    return Traffic(
        points, group, n_encounters=n_encounters, n_samples=n_samples, step=step
    )


@contextmanager
def open_points_world(
    system: System,
    encounters: FloatArray,
    start: Start = open_in_process,
) -> Iterator[tuple[SumoWorld, Observer]]:
    """Start SUMO on a copy of the network of the system's only point for each of N encounters,
    shape (N, k). Yields the world, and the observer of its vehicles: the traffic if bodies move on
    tracks, else an observer that asks the scenario.
    """
    (point,) = system.points
    step = system.scenes.step
    n, n_searched = encounters.shape

    scenarios = [point.scenario]
    if n_searched:
        name_values = system.characteristics.scenario.named
        scenarios = [
            encounter(point, name_values(values)).scenario for values in encounters
        ]
    networks = networks_for(scenarios)

    # SUMO cannot move bodies along tracks: a TrafficWorld puts them at their places.
    create: Create = SumoWorld
    traffic = traffic_of(system, encounters, OVERTIME)
    if traffic is not None:
        start_of_lane = start_frame(networks[0], step)
        create = partial(TrafficWorld, traffic=traffic, start=start_of_lane)
    with (
        varied_network(networks, n) as files,
        open_world(files, n, step, create, start) as world,
    ):
        if traffic is not None:
            yield world, traffic
            return
        scenario = system.at_encounters(encounters).points[0].scenario
        assert isinstance(scenario, WorldScenario)
        yield world, SceneObserver(scenario, world)
