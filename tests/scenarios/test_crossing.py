"""The shipped scenarios in an artificial world, crossing pedestrians above all: position over time,
point of impact, occlusion by parked cars, gaps, ends of encounters, and agreement with SUMO.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from safevar_sumo.api.simulation import load_study
from safevar_sumo.records import Trace
from safevar_sumo.scenarios import Lane
from safevar_sumo.scenarios.crossing import Crossing
from safevar_sumo.scenarios.euro_ncap import TargetProfile
from safevar_sumo.scenarios.published import LeadVehicleStopped, PedestrianCrossing
from safevar_sumo.sumo.matrix import drive_worst
from safevar_sumo.sumo.system import assemble
from tests.support.in_process import SLOW, own_network
from tests.support.made_up import made_up_runs, system_of


@settings(max_examples=40)
@given(
    speed=st.floats(1, 5),
    run_up=st.just(0.0) | st.floats(0.1, 3),
    rest=st.floats(0.01, 8),
    time=st.floats(20, 60),
)
def test_a_target_arrives_in_time_with_any_speed_profile(
    speed: float, run_up: float, rest: float, time: float
) -> None:
    profile = TargetProfile.with_arrival(run_up + rest, time, speed, run_up)
    assert profile.travelled(time) == pytest.approx(run_up + rest)
    assert profile.travelled(profile.begin) == 0
    if run_up:
        assert profile.travelled(profile.begin + 2 * run_up / speed) == pytest.approx(
            run_up, abs=1e-9
        )


TURNS = {"north": (0.0, 1.0), "north-west": (-0.6, 0.8)}
"""Direction of a rotated road that led east before."""


def moved(folder: Path, network: str, forth: tuple[float, float]) -> str:
    """A rotated copy of a network."""

    def place(match: re.Match[str]) -> str:
        x = float(match[1])
        y = float(match[2])
        return f'x="{x * forth[0] - y * forth[1]}" y="{x * forth[1] + y * forth[0]}"'

    mine = own_network(folder / "mine", network)
    nodes = mine / "network.nod.xml"
    nodes.write_text(re.sub(r'x="([-\d.]+)" y="([-\d.]+)"', place, nodes.read_text()))
    return str(mine)


@pytest.mark.parametrize("forth", TURNS.values(), ids=TURNS)
@pytest.mark.parametrize("study", ["rain", pytest.param("native", marks=SLOW)])
def test_a_turned_road_changes_nothing(
    study: str, forth: tuple[float, float], tmp_path: Path
) -> None:
    ours = load_study(study)
    mine = system_of(
        study,
        scenario={
            "parameters": {"network": moved(tmp_path, ours.scenario.model, forth)}
        },
    )
    system = assemble(ours)
    settings = np.vstack(
        [system.characteristics.original, system.characteristics.lower]
    )
    here = drive_worst(system, settings)
    there = drive_worst(mine, settings)
    assert here.outcome.tolist() == there.outcome.tolist()
    for name in ("gap", "lateral", "speed"):
        assert np.allclose(
            getattr(here.trace, name), getattr(there.trace, name), atol=0.02
        ), name
    way, same = (
        run.trace.position[-1] - run.trace.position[0] for run in (here, there)
    )
    assert np.allclose(way, same, atol=0.02), "a position is along the way"


STEP, LENGTH, LANE, PATH, WIDTH = 0.05, 5.0, 14.0, 40.0, 0.5


class ArtificialWorld:
    """One vehicle and one pedestrian at positions that the test sets; the constants define lengths
    and widths.
    """

    def __init__(self, front: float, lateral: float) -> None:
        self.front = front
        self.lateral = lateral
        self.turned_at: float | None = None

    def vehicle_positions(self, actor: str) -> np.ndarray:
        return np.array([[self.front if actor == "vut" else 100.0, LANE]])

    def person_positions(self, actor: str) -> np.ndarray:
        return np.array([[PATH, LANE + self.lateral]])

    def vehicle_length(self, actor: str) -> float:
        return LENGTH if actor == "vut" else 7.0

    def lane(self, lane: str) -> Lane:
        return Lane((PATH, 20.0), (PATH, 10.0))

    def lane_of(self, vehicle: str) -> Lane:
        return Lane((0.0, LANE), (90.0, LANE))

    def person_width(self, actor: str) -> float:
        return WIDTH

    def turn_back(self, person: str, copies: object = None) -> None:
        self.turned_at = self.lateral


def test_the_gap_to_a_parked_vehicle_ends_at_its_rear() -> None:
    scenario = LeadVehicleStopped()
    world = ArtificialWorld(60.0, 0.0)
    scene, _ = scenario.observe(world, STEP, scenario.begin(world))
    assert scene.gap[0] == 100.0 - 7.0 - 60.0
    assert not scene.over[0]


def test_the_gap_to_a_pedestrian_ends_at_the_strip_that_he_walks_on() -> None:
    scenario = PedestrianCrossing()
    world = ArtificialWorld(30.0, -5.0)
    memory = scenario.begin(world)
    world.lateral = -4.91
    scene, _ = scenario.observe(world, STEP, memory)
    assert scene.gap[0] == pytest.approx(PATH - WIDTH / 2 - 30.0)
    assert scene.lateral[0] == pytest.approx(-4.91)
    assert scene.lateral_speed[0] == pytest.approx(1.8)


@pytest.mark.parametrize(
    ("front", "over"),
    [
        (PATH + WIDTH / 2 + LENGTH - 0.01, False),
        (PATH + WIDTH / 2 + LENGTH + 0.01, True),
    ],
)
def test_the_vehicle_has_passed_once_its_rear_has_left_the_strip(
    front: float, over: bool
) -> None:
    scenario = PedestrianCrossing()
    world = ArtificialWorld(front, 0.0)
    scene, _ = scenario.observe(world, STEP, scenario.begin(world))
    assert scene.over[0] == over


@pytest.mark.parametrize(
    ("before", "now", "over"),
    [
        (1.70, 1.79, True),
        (1.60, 1.74, False),
        (1.90, 1.81, False),
        (-1.90, -1.80, False),
        (-1.70, -1.79, True),
    ],
)
def test_the_pedestrian_has_left_the_lane_when_he_walks_away_beyond_its_edge(
    before: float, now: float, over: bool
) -> None:
    scenario = PedestrianCrossing(turns_after=None, lane_width=3.5)
    world = ArtificialWorld(0.0, before)
    memory = scenario.begin(world)
    world.lateral = now
    assert scenario.observe(world, STEP, memory)[0].over[0] == over


def test_the_pedestrian_turns_in_the_last_step_that_keeps_him_within_the_distance() -> (
    None
):
    """At 1.8 m/s (0.09 m a step) the pedestrian turns, once only, in the step after which the next
    would lead beyond 0.7 m.
    """
    scenario = PedestrianCrossing()
    world = ArtificialWorld(0.0, 0.0)
    memory = scenario.begin(world)
    turns = []
    for k in range(1, 12):
        world.lateral = 0.09 * k
        _, memory = scenario.observe(world, STEP, memory)
        if world.turned_at is not None:
            turns.append(k)
            world.turned_at = None
    assert turns == [7], "0.63 m; 0.72 m would be beyond"


def trace(
    gap: list[float],
    speed: list[float],
    lateral: list[float],
    lateral_speed: list[float],
) -> Trace:
    columns = (
        np.array(values)[:, np.newaxis]
        for values in (speed, gap, lateral, lateral_speed)
    )
    v, gaps, across, across_speed = columns
    return made_up_runs(STEP, v, gaps, lateral=across, lateral_speed=across_speed).trace


def test_closing_speed_of_a_pedestrian_has_both_speeds_along_the_line_of_sight() -> (
    None
):
    """Vehicle's centre at (0, 0), pedestrian at (4, -3): distance 5, cos(theta) = 0.8; v cos +
    v_ped sin = 0.8 * 6 +
    0.6 * 1.5.
    """
    encounter = PedestrianCrossing().encounter(
        trace([4.0 - LENGTH / 2], [6.0], [-3.0], [1.5])
    )
    assert encounter.distance[0, 0] == pytest.approx(5.0 - LENGTH / 2)
    assert encounter.closing_speed[0, 0] == pytest.approx(0.8 * 6 + 0.6 * 1.5)
    assert encounter.separation[0, 0] == pytest.approx(4.0 - LENGTH / 2)


PARKED = 12.0


def test_a_parked_vehicle_is_separated_by_centres_and_closed_in_on_by_bumpers() -> None:
    run = trace([3.0, -0.1], [2.0, 2.0], [0.0, 0.0], [0.0, 0.0])
    encounter = LeadVehicleStopped().encounter(
        dataclasses.replace(run, obstacle_length=np.array(PARKED))
    )
    assert encounter.separation[:, 0].tolist() == [
        3.0 + (LENGTH + PARKED) / 2,
        -0.1 + (LENGTH + PARKED) / 2,
    ]
    assert encounter.distance[:, 0].tolist() == [3.0, -0.1]
    assert encounter.closing_speed[:, 0].tolist() == [2.0, 2.0]
    assert encounter.in_conflict[:, 0].tolist() == [True, False]


@pytest.mark.parametrize("walking_speed", [None, 0.5, 1.2, 2.5])
def test_benign_scenes_have_the_walking_speed_of_the_study(
    walking_speed: float | None,
) -> None:
    """A pedestrian who leaves the path in time reaches this speed; a slow one gets time for it."""
    expected = walking_speed or 1.8
    names = []
    for name, scene in PedestrianCrossing(walking_speed=walking_speed).benign():
        if not isinstance(scene, Crossing):
            continue  # a car stands in the next lane
        assert scene.target_speed == pytest.approx(3.6 * expected)
        if "leaves" in name:
            names.append(name)
            times = np.arange(0.0, scene.duration, 0.1)[:, None]
            target = scene.tracks(times)[0]
            assert np.max(target.speed) == pytest.approx(expected)
    assert len(names) == 12
