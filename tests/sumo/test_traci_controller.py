"""A script for TraCI drives the vehicle under test: it reads SUMO, and the vehicle model carries
out its commands.
"""

from __future__ import annotations

import sys
from types import ModuleType

import numpy as np
import pytest

from safevar_sumo.records import Outcome
from safevar_sumo.sumo.matrix import drive_worst
from safevar_sumo.sumo.traci_commands import CommandedSpeed
from tests.support.in_process import SLOW, write
from tests.support.made_up import changed, original_of
from tests.support.user_code import controlled_by

pytestmark = pytest.mark.usefixtures("in_tmp")

HELPER = """
import libsumo as ls
import traci
import traci.constants as tc
from traci import vehicle
from traci.exceptions import TraCIException

get_speed, looked = traci.vehicle.getSpeed, []


def cruise(vehicle_id):
    looked.append(traci.simulation.getTime())
    assert len(looked) == round(traci.simulation.getTime() / 0.1), "one call a step: nobody else's"
    speed_of_libsumo = ls.vehicle.getSpeed(vehID=vehicle_id)
    assert get_speed(vehicle_id) == speed_of_libsumo == vehicle.getSpeed(vehicle_id)
    try:
        traci.person.getPosition("nobody")
    except TraCIException as error:
        assert "nobody" in str(error)
    traci.vehicle.slowDown(vehicle_id, duration=1.0, speed=5.0)
"""
USES_HELPER = """
def step(traci, vehicle_id):
    import helper
    helper.cruise(vehicle_id)
"""


@SLOW
def test_a_module_that_imports_traci_reads_the_simulation() -> None:
    write("helper.py", HELPER)
    runs = controlled_by("step", USES_HELPER)
    assert drive_worst(runs, changed(runs)).trace.speed.max() == pytest.approx(
        5, abs=0.7
    )
    assert {type(sys.modules[name]) for name in ("traci", "libsumo")} == {ModuleType}, (
        "the import is for controllers alone"
    )


LOOKS = """
from pathlib import Path


def step(traci, vehicle_id):
    traci.vehicle.setSpeedMode(vehicle_id, 0)
    traci.vehicle.setSpeed(vehicle_id, 12)
    leader = traci.vehicle.getLeader(vehicle_id, dist=200)
    x = traci.vehicle.getPosition("parked_ahead")[0]
    is_parked = "parked_ahead" in traci.vehicle.getIDList()
    row = (leader[1] if leader else -1, x, traci.vehicle.getIDCount(), is_parked)
    with Path("looks.csv").open("a") as file:
        print(*map(float, row), sep=",", file=file)
"""


def test_a_controller_reads_other_actors_through_the_sensors() -> None:
    """The gap to the leader is the trace's gap one reaction time and one recognition delay ago,
    linear between two steps.
    """
    weather = {
        "name": "haze",
        "road_friction": 1.0,
        "visibility": 0.5,
        "recognition_delay": 0.1,
        "light": "day",
    }
    runs = controlled_by("step", LOOKS, weather=weather)
    trace = drive_worst(runs, changed(runs, reactionTime=0.25, sensorRange=80)).trace
    leader, x, number, listed = np.loadtxt("looks.csv", delimiter=",")[
        : len(trace.time)
    ].T
    gap = np.concatenate([np.repeat(trace.gap[0, :], 4), trace.gap[:, 0]])
    late = gap[: len(leader)]  # 3.5 steps, rounded to 4
    near = (
        late <= 40
    )  # also the leader, whose gap is that of the bumpers without minGap
    assert 0 < near.sum() < len(near)
    assert leader[near] == pytest.approx(late[near] - 2.5, abs=1e-6)  # without minGap
    assert np.all(leader[~near] == -1)
    assert np.all((x == 85)[near])
    assert np.all((x == -1073741824)[~near])
    assert np.array_equal(listed.astype(bool), near)
    assert set(number[near]) <= {2, 3}


SUBSCRIBES = """
import traci.constants as tc


class Reads:
    def start(self, traci, vehicle_id):
        variables = [tc.VAR_LANE_ID, tc.VAR_LEADER]
        traci.vehicle.subscribe(vehicle_id, variables, parameters={tc.VAR_LEADER: ("d", 200.0)})

    def step(self, traci, vehicle_id):
        found = traci.vehicle.getAllSubscriptionResults()
        assert found == {vehicle_id: traci.vehicle.getSubscriptionResults(vehicle_id)}, found
        assert found[vehicle_id][tc.VAR_LANE_ID] == "road_0"
        assert found[vehicle_id][tc.VAR_LEADER][0] == "parked_ahead"
        assert traci.simulation.convertRoad(10.0, 0.0) == ("road", 10.0, 1)
        assert traci.vehicle.getIDCount() == 3
        assert traci.edge.getIDCount() == 1 and traci.vehicle.getRoute(vehicle_id) == ("road",)
        assert "0." not in traci.vehicle.getRouteID(vehicle_id)
"""


def test_no_function_returns_ids_or_actors_of_other_copies() -> None:
    runs = controlled_by("Reads", SUBSCRIBES)
    drive_worst(
        runs, np.repeat(changed(runs, sensorRange=120, reactionTime=0.1), 3, axis=0)
    )


@pytest.mark.parametrize(
    ("mode", "acceleration"), [(0, 20.0), (1, 16.0), (2, 2.0), (4, 20.0)]
)
def test_each_bit_of_a_speed_mode_is_one_limit(mode: int, acceleration: float) -> None:
    commands = CommandedSpeed(step=0.5)
    commands.command("setSpeedMode", 0.0, 10.0, (mode,))
    commands.command("setSpeed", 0.0, 10.0, (20,))
    assert commands.mode == mode
    assert (
        commands.acceleration(10.0, 0.0, sumo_speed=18.0, accel=2.0, decel=5.0)
        == acceleration
    )


def test_the_vehicle_model_limits_a_commanded_acceleration() -> None:
    runs = controlled_by("Harsh")
    run = drive_worst(runs, original_of(runs))
    hardest = -np.diff(run.trace.speed[:, 0]).min() / run.trace.step
    assert 7 < hardest < 9.0  # more than SUMO's driver, who plans with 4.5 m/s^2
    assert run.outcome[0] == Outcome.STOPPED
