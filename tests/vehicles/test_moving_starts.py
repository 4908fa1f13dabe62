"""Vehicles that the traffic puts onto the road in motion: every part of them starts in a steady state."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pytest

from safevar_sumo.records import Command
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import simulate
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import LEVEL, slope_of
from tests.vehicles.runs import STEP, SYSTEMS, drive, original

SPEEDS = (10, 20, 30, 40, 50, 60)  # km/h, where the original vehicles' gearboxes hold their gear


def moving(model: str, settings: np.ndarray, speed: float, grade: float = 0.0) -> tuple[object, object]:
    system = SYSTEMS[model]
    values = dict(zip(system.characteristics.names, np.ascontiguousarray(settings.T), strict=True))
    prepared = system.vehicle.prepare(values, 1.0, STEP, slope_of(np.full(len(settings), grade)))
    return prepared, system.vehicle.at_start(prepared, np.full(len(settings), speed))


@pytest.mark.parametrize("model", sorted(SYSTEMS))
@pytest.mark.parametrize(("kmh", "grade"), [*((kmh, 0) for kmh in SPEEDS), (20, 6), (40, -3), (40, -12)])
def test_nothing_changes_while_the_pedals_stay(model: str, kmh: float, grade: float) -> None:
    prepared, state = moving(model, original(model), kmh / 3.6, grade)
    before, pedals = state, Command(state.throttle, state.brake)  # type: ignore[attr-defined]
    assert state.speed == pytest.approx(kmh / 3.6)  # type: ignore[attr-defined]
    for _ in range(200):
        state = SYSTEMS[model].vehicle.advance(prepared, state, pedals)
    for name in ("speed", "wheel_speed", "engine_speed", "engine_rpm", "gear", "traction_torque"):
        if hasattr(state, name):
            assert getattr(state, name) == pytest.approx(getattr(before, name), rel=1e-12), name


@pytest.mark.parametrize("study", ["sun", "lgsvl", "native"])
def test_the_depart_speed_of_the_traffic_is_honoured(study: str, tmp_path: Path) -> None:
    chosen = load_study(study)
    folder = tmp_path / "net"
    shutil.copytree(NETWORKS / chosen.scenario.model, folder)
    traffic = folder / "traffic.rou.xml"
    head, vut, tail = traffic.read_text().partition('<vehicle id="vut"')
    traffic.write_text(head + vut + tail.replace('departSpeed="0"', 'departSpeed="5"', 1))
    scenario = msgspec.structs.replace(
        chosen.scenario, parameters={**chosen.scenario.parameters, "network": str(folder)}
    )
    system = assemble(msgspec.structs.replace(chosen, scenario=scenario))
    trace = simulate(system, system.characteristics.original[np.newaxis]).trace
    assert trace.speed[0, 0] == 5
    assert abs(trace.speed[1, 0] - 5) < 0.3, "no jump in the first step, whatever the system commands"


G = 9.81
ANGLE = math.atan(0.08)


def test_a_grade_is_the_tangent_of_the_slopes_angle_and_none_is_level_to_the_bit() -> None:
    slope = slope_of(np.array([8.0, -8.0, 0.0]))
    assert slope.back == pytest.approx([G * math.sin(ANGLE), -G * math.sin(ANGLE), 0.0])
    assert slope.down == pytest.approx([G * math.cos(ANGLE), G * math.cos(ANGLE), G])
    assert (slope.back[2], slope.down[2]) == LEVEL


@pytest.mark.parametrize("model", ["sumo", "worn"])
@pytest.mark.parametrize(("grade", "gained"), [(8.0, -G * math.sin(ANGLE)), (-8.0, G * math.sin(ANGLE))])
def test_who_coasts_loses_or_gains_g_sin(model: str, grade: float, gained: float) -> None:
    run = drive(model, original(model), lambda time: (0.0, 0.0), 4.0, rolling=12.0, grade=grade)
    assert run.speed[-1, 0] - 12.0 == pytest.approx(4.0 * gained)


@pytest.mark.parametrize("model", sorted(SYSTEMS))
@pytest.mark.parametrize("grade", [8.0, -8.0])
def test_the_way_to_stop_is_v2_over_twice_what_the_tyres_hold_and_the_slope_adds(model: str, grade: float) -> None:
    """On ice, where the tyres limit the deceleration to mu g cos; between 10 and 4 m/s, after the brake has built
    up.
    """

    def distance(grade: float) -> float:
        run = drive(model, original(model), lambda time: (0.0, 1.0), 25.0, rolling=12.0, road=0.25, grade=grade)
        return float(
            np.interp(-4.0, -run.speed[:, 0], run.distance[:, 0])
            - np.interp(-10.0, -run.speed[:, 0], run.distance[:, 0])
        )

    level = (10**2 - 4**2) / (2 * distance(0.0))
    expected = level * math.cos(ANGLE) + math.copysign(G * math.sin(ANGLE), grade)
    assert (10**2 - 4**2) / (2 * distance(grade)) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("model", sorted(SYSTEMS))
@pytest.mark.parametrize("grade", [12.0, -12.0])
def test_whoever_stands_with_the_brake_on_stays_and_nobody_rolls_back(model: str, grade: float) -> None:
    braked = drive(model, original(model), lambda time: (0.0, 1.0), 20.0, rolling=5.0, grade=grade)
    assert np.all(braked.speed[-100:] == 0)
    released = drive(model, original(model), lambda time: (0.0, 0.0), 3.0, grade=grade).speed[-1, 0]
    assert released == 0 if grade > 0 else released > 1
