"""SUMO's driver, under a controller written for TraCI and as the ADS `krauss`, beside bare SUMO."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safevar_sumo.records import Outcome, SimulationRuns
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.sumo.engine import open_world
from safevar_sumo.sumo.matrix import drive_and_score, drive_worst
from safevar_sumo.sumo.network import CopiedNetwork
from safevar_sumo.sumo.system import System
from safevar_sumo.sumo.without_effect import without_effect
from tests.support.in_process import SLOW, own_network, rewrite
from tests.support.made_up import changed, original_of, system_of
from tests.support.user_code import controlled_by

pytestmark = pytest.mark.usefixtures("in_tmp")
CONTROLLERS = """
def at(traci, time):
    return abs(traci.simulation.getTime() - time) < 1e-6

def idle(traci, v):
    pass

def too_fast(traci, v):
    traci.vehicle.setSpeed(v, 30.0)

def blind(traci, v):
    traci.vehicle.setSpeedMode(v, 0)
    traci.vehicle.setSpeed(v, min(8.0, 1.5 * traci.simulation.getTime()))

def slows(traci, v):
    if at(traci, 5.0):
        traci.vehicle.slowDown(v, 3.0, 1.234)
    if at(traci, 9.0):
        traci.vehicle.setSpeed(v, -1)

def accelerates(traci, v):
    if at(traci, 2.0):
        traci.vehicle.setAcceleration(v, -1.0, 1.5)
    if at(traci, 6.0):
        traci.vehicle.setAcceleration(v, 1.2, 2.0)

def careful(traci, v):
    traci.vehicle.setTau(v, 2.0)
    traci.vehicle.setMinGap(v, 5.0)
    assert traci.vehicle.getTau(v) == 2.0 and traci.vehicle.getSpeedMode(v) == 31

def weak(traci, v):
    traci.vehicle.setMaxSpeed(v, 9.0)
    traci.vehicle.setAccel(v, 1.5)
    traci.vehicle.setDecel(v, 3.0)

def slow(traci, v):
    traci.vehicle.setSpeedFactor(v, 0.5)
    traci.vehicle.setImperfection(v, 0)
    traci.vehicle.setLaneChangeMode(v, 0)

def returns_late(traci, v):
    is_late = traci.simulation.getTime() > 6.6
    traci.vehicle.setEmergencyDecel(v, 6.0)
    traci.vehicle.setSpeedMode(v, 31 if is_late else 30)
    traci.vehicle.setSpeed(v, -1 if is_late else 13.0)

def obeys_late(traci, v):
    traci.vehicle.setSpeedMode(v, 31 if traci.simulation.getTime() > 6.6 else 30)
    traci.vehicle.setSpeed(v, 13.0)

def follows(traci, v):
    leader, speed = traci.vehicle.getLeader(v, 100), traci.vehicle.getSpeed(v)
    traci.vehicle.setSpeedMode(v, 0)
    if leader and leader[1] < 2 + speed**2 / 6:
        traci.vehicle.slowDown(v, 0, max(speed / 3, 0.1))
    else:
        traci.vehicle.setSpeed(v, min(12, speed + 0.2))
"""
NAMES = re.findall(r"def (\w+)\(traci, v\)", CONTROLLERS)
NET = NETWORKS / "lead_vehicle_stopped"
NO_DELAY = {
    name: {"original": 1e-9, "lower": 1e-9}
    for name in ("actuatorLag", "reactionTime", "brakeDelay")
}
"""Characteristics of a vehicle without delays; with the grip of `NO_DELAYS` it brakes as hard as
anybody asks.
"""
NO_DELAYS = {"characteristics": NO_DELAY, "parameters": {"tyre_friction": 3.0}}


def bare_sumo(traffic: Path, step: Callable[[Any, str], None]) -> np.ndarray:
    """Speed and gap at 161 samples, where SUMO alone drives."""
    rows = []
    with open_world(
        CopiedNetwork(NET / "network.net.xml", traffic, NET / "scenario.sumocfg"), 0
    ) as world:
        for _ in range(161):
            world.api.simulationStep()
            rows.append(
                (
                    world.api.vehicle.getSpeed("vut"),
                    80.3 - world.api.vehicle.getPosition("vut")[0],
                )
            )
            step(world.api, "vut")
    return np.array(rows)


def with_attributes(folder: Path, attributes: str) -> Path:
    """A copy of the network, in which the type of the vehicle under test has attributes of SUMO's
    driver.
    """
    own_network(folder, NET.name)
    traffic = folder / "traffic.rou.xml"
    old = 'speedDev="0" sigma="0" color="0,0.45,0.7"'
    rewrite(traffic, (old, f'speedDev="0" {attributes}'))
    return traffic


def refuse_difference(
    runs: System,
    traffic: Path,
    step: Callable[[Any, str], None],
    speed_error: float = 1e-6,
) -> None:
    """The speeds are SUMO's, and so is the place: SUMO ends its last step at once, ours at its
    end.
    """
    trace = drive_worst(runs, original_of(runs)).trace
    n = np.count_nonzero(trace.active)
    bare = bare_sumo(traffic, step)
    assert n > 70
    assert trace.speed[:n, 0] == pytest.approx(bare[:n, 0], abs=speed_error)
    assert trace.gap[n - 1, 0] == pytest.approx(bare[n - 1, 1], abs=0.1)


@pytest.mark.parametrize("name", NAMES)
def test_a_vehicle_without_delays_drives_as_in_bare_sumo(name: str) -> None:
    space = {}
    exec(CONTROLLERS, space)
    runs = controlled_by(name, CONTROLLERS, vehicle=NO_DELAYS)
    refuse_difference(runs, NET / "traffic.rou.xml", space[name])


@SLOW
@pytest.mark.parametrize(
    "attributes",
    [
        'decel="3" emergencyDecel="5" minGap="1" sigma="0"',
        'speedFactor="0.7" actionStepLength="0.5" sigma="0"',
        'carFollowModel="ACC"',
        'carFollowModel="CACC"',
        'carFollowModel="IDM"',
    ],
)
def test_sumos_driver_has_the_attributes_of_the_traffic_file(
    attributes: str, in_tmp: Path
) -> None:
    """All but tau, which the study varies: without delays it drives as in bare SUMO."""
    traffic = with_attributes(in_tmp / "net", f'mass="900" tau="0.3" {attributes}')
    scenario = {"parameters": {"network": str(traffic.parent)}}
    runs = controlled_by("idle", CONTROLLERS, vehicle=NO_DELAYS, scenario=scenario)
    unused = (
        f"{traffic}: no effect on vehicle 'vut': mass = 900, tau = 0.3; the"
        " study's vehicle and ADS"
    )
    assert any(remark.startswith(unused) for remark in without_effect(runs))
    rewrite(traffic, ('tau="0.3"', 'tau="1" accel="2.6"'))
    refuse_difference(
        runs, traffic, lambda *_: None, 0.02 if "IDM" in attributes else 1e-6
    )


@SLOW
def test_between_two_actions_sumos_driver_asks_for_what_he_decided(
    in_tmp: Path,
) -> None:
    """A lag lets through a part of it in the first step, and more in the next ones."""
    vehicle = {
        **NO_DELAYS,
        "characteristics": {**NO_DELAY, "actuatorLag": {"original": 0.2}},
    }
    for action in ("0.1", "1"):
        traffic = with_attributes(
            in_tmp / action, f'sigma="0" actionStepLength="{action}"'
        )
        scenario = {"parameters": {"network": str(traffic.parent)}}
        runs = controlled_by("idle", CONTROLLERS, vehicle=vehicle, scenario=scenario)
        run = drive_worst(runs, original_of(runs))
        assert run.outcome[0] == Outcome.STOPPED
        assert last_gap(run) == pytest.approx(2.5, abs=0.3), "his minGap"


def test_delays_that_sumos_driver_does_not_know_cost_him_his_gap() -> None:
    runs = controlled_by("idle", CONTROLLERS)
    run = drive_worst(runs, original_of(runs))
    assert run.outcome[0] == Outcome.STOPPED or run.collision_speed[0] < 3
    assert last_gap(run) < 2  # of the 2.5 m that he wants
    assert any(
        "knows neither the delays nor the brakes" in remark
        for remark in without_effect(runs)
    )
    close, far = top_speeds(runs)
    assert close > far + 1  # m/s: the study's headway is his


def last_gap(run: SimulationRuns) -> float:
    return run.trace.gap[run.trace.active][-1]


def top_speeds(system: System) -> Iterator[float]:
    """With a short tau, and with a long one."""
    for tau in (0.5, 2.0):
        yield drive_worst(system, changed(system, tau=tau)).trace.speed.max()


def braking(run: SimulationRuns) -> np.ndarray:
    """The decelerations of a run, of at least 0.1 m/s^2."""
    deceleration = -np.diff(run.trace.speed[:, 0]) / run.trace.step
    return deceleration[deceleration > 0.1]


def test_krauss_brakes_softer_with_a_longer_tau_and_stops_where_sumos_krauss_does(
    tmp_path: Path,
) -> None:
    """Without delays; `braking_share` 0.6 of 9 m/s^2 is SUMO's decel of 5.4 m/s^2."""
    bare_hardest = []
    for tau in (0.5, 1.0, 1.5, 2.0):
        text = (
            (NET / "traffic.rou.xml")
            .read_text()
            .replace('vut" vClass', f'vut" tau="{tau}" decel="5.4" vClass')
        )
        (tmp_path / "traffic.rou.xml").write_text(text)
        bare = bare_sumo(tmp_path / "traffic.rou.xml", lambda *_: None)
        bare_hardest.append(-np.diff(bare[:, 0]).min() / 0.1)
        characteristics = {**NO_DELAY, "tau": {"original": tau}}
        vehicle = {**NO_DELAYS, "characteristics": characteristics}
        system = system_of("native", vehicle=vehicle)
        run = drive_worst(system, original_of(system))
        assert last_gap(run) == pytest.approx(bare[-1, 1], abs=0.1)
        assert braking(run).max() == pytest.approx(bare_hardest[-1], rel=0.2)
    assert np.all(np.diff(bare_hardest) < 0)


def test_tau_drives_idm_and_a_line_says_where_it_or_decel_has_no_effect() -> None:
    def remarks(model: str, **parameters: float) -> list[str]:
        system = system_of("native", ads={"model": model, "parameters": parameters})
        *others, on_decel = without_effect(system)
        assert f"carry at most {0.9 * 9.81:.2f} m/s^2: a decel above" in on_decel
        return others

    stops = system_of(
        {"extends": "native", "name": "stops", "scenario": {"model": "stop"}}
    )
    settings = [changed(stops, decel=decel) for decel in (8.82, 8.83, 9.0, 9.5)]
    hardest = drive_and_score(stops, np.concatenate(settings)).metrics[
        "stopping_distance"
    ]
    assert hardest[0] > hardest[1] == hardest[2] == hardest[3]
    grippy = system_of("native", vehicle={"parameters": {"tyre_friction": 1.0}})
    assert without_effect(grippy) == []

    fast, slow = top_speeds(system_of("native", ads={"model": "idm"}))
    assert fast > slow + 1
    assert remarks("idm") == remarks("krauss") == []
    assert any("tau has no effect" in remark for remark in remarks("acc"))
    assert remarks("krauss", reaction_time=2.0) == [
        "ads.parameters.reaction_time has no effect: the vehicle's tau takes its place"
    ]
