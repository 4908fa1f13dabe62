"""Exported solutions: second libraries read the same places, lanes and values as the simulation
has.
"""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from safevar_sumo.api.simulation import load_study, simulate
from safevar_sumo.questions.part import at_point
from safevar_sumo.records import JsonObject
from safevar_sumo.replay.comparison import Comparison, comparison_of
from safevar_sumo.replay.export import Poses
from safevar_sumo.results import write_imported
from safevar_sumo.study import Study
from safevar_sumo.vehicles import CharacteristicSet
from tests.support.in_process import SLOW, refused, run
from tests.support.made_up import made_up_evaluations
from tests.support.needs import (
    is_built_for_this_python,
    need_library,
    skip_unless_forbidden,
)

ASAM = Path(sys.prefix) / "asam" / "bin"
SCENES = {
    "pedestrian_crossing": ("rain", ""),
    "crossing": ("euro_ncap_pedestrian", "CPNCO, speed 30, clear"),
    "along": ("euro_ncap_pedestrian", "CPLA, speed 40, clear"),
    "car_to_car": ("euro_ncap_car_to_car", "CCRm, speed 40, impact_location 50, clear"),
    "lead_vehicle_stopped": ("lgsvl", ""),
}
HANDLE = "--solution made:0:0"


def results_of(study: Study, folder: Path) -> tuple[Path, dict[str, float]]:
    """Results with one solution, and its setting: a tenth of each domain away from the original."""
    characteristics = CharacteristicSet.of(study)
    middle = (characteristics.lower + characteristics.upper) / 2
    setting = characteristics.original + np.sign(
        middle - characteristics.original
    ) * 0.1 * (characteristics.upper - characteristics.lower)
    undefined = dict.fromkeys(("tet", "tit", "ave_dece"), np.array([np.nan]))
    solutions = made_up_evaluations(
        [1.0],
        settings=setting[np.newaxis],
        metrics={"safety_degree": np.array([1.0]), **undefined},
    )
    write_imported(
        folder / "results",
        study,
        {"made": solutions},
        {"safety_degree": 1.0},
        {"made": "made.csv"},
    )
    return folder / "results", characteristics.named(setting)


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(name, marks=() if name == "lead_vehicle_stopped" else SLOW)
        for name in SCENES
    ],
)
def exported(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Comparison]:
    name, point = SCENES[request.param]
    study = load_study(name)
    results, setting = results_of(study, tmp_path_factory.mktemp(request.param))
    out = results.with_name("out")
    chosen = f"--point '{point}'" if point else ""
    run(f"export {results} {HANDLE} {chosen} --to openscenario --out {out}")
    there = at_point(study, point) if point else study
    return out, comparison_of(simulate(there, setting))


@SLOW
def test_a_second_library_reads_the_places_of_the_trace(
    exported: tuple[Path, Comparison],
) -> None:
    xosc = need_library("scenariogeneration.xosc")
    out, comparison = exported
    scenario = xosc.ParseOpenScenario(str(out / "scenario.xosc"))
    row = comparison.rows[-1]
    samples = slice(0, comparison.moments[row].end + 1)
    boxes = {
        item.name: item.entityobject.boundingbox
        for item in scenario.entities.scenario_objects
    }
    groups = scenario.storyboard.stories[0].acts[0].maneuvergroup
    assert {group.actors.actors[0].entity for group in groups} == {
        "Ego",
        *comparison.tracks,
    } - {"vut"}
    for group in groups:
        name = group.actors.actors[0].entity
        track = comparison.tracks["vut" if name == "Ego" else name]
        box = boxes[name]
        trajectory = group.maneuvers[0].events[0].action[0].action.trajectory
        places = trajectory.shapes.positions
        # All others have one place more, from which a reader has their speed at the end.
        assert len(places) - samples.stop in ((0,) if name == "Ego" else (0, 1))
        x, y, heading = (
            np.array([getattr(place, axis) for place in places[samples]], dtype=float)
            for axis in "xyh"
        )
        assert np.allclose(
            trajectory.shapes.time[samples],
            comparison.runs.trace.time[samples],
            rtol=0,
            atol=1e-9,
        )
        front = 0.0 if track.is_person else box.center.x + box.boundingbox.length / 2
        assert np.abs(x + front * np.cos(heading) - track.x[samples, row]).max() < 0.01
        assert np.abs(y + front * np.sin(heading) - track.y[samples, row]).max() < 0.01


def test_a_lane_of_the_road_lies_under_the_ego_at_every_sample(
    exported: tuple[Path, Comparison],
) -> None:
    carla = need_library("carla")
    out, comparison = exported
    road = carla.Map("road", (out / "road.xodr").read_text())
    row = comparison.rows[-1]
    track = comparison.tracks["vut"]
    lanes = [lane for lane in comparison.road if lane.kind == "road"]
    for sample in range(comparison.moments[row].end + 1):
        x, y, heading = (
            float(values[sample, row]) for values in (track.x, track.y, track.heading)
        )
        waypoint = road.get_waypoint(carla.Location(x, -y, 0.0), project_to_road=False)
        assert waypoint.lane_type == carla.LaneType.Driving
        assert any(
            np.isclose(waypoint.lane_width, lane.width, atol=0.01) for lane in lanes
        )
        assert np.isclose(
            np.cos(np.deg2rad(waypoint.transform.rotation.yaw) + heading), 1, atol=1e-3
        )


@SLOW
def test_asam_finds_no_fault(exported: tuple[Path, Comparison]) -> None:
    if not is_built_for_this_python("qc_opendrive"):
        pytest.skip("ASAM's checks are not built for this Python")
    if not ASAM.is_dir():
        skip_unless_forbidden("make .venv/installed-asam installs ASAM's checks")
    out, _ = exported
    for kind, program, file in (
        ("xodr", "qc_opendrive", "road.xodr"),
        ("xosc", "qc_openscenario", "scenario.xosc"),
    ):
        report = out.with_name(f"{kind}.xqar")
        config = out.with_name(f"{kind}.xml")
        config.write_text(
            f'<Config><Param name="InputFile" value="{out / file}"/><CheckerBundle'
            f' application="{kind}Bundle"><Param name="resultFile"'
            f' value="{report}"/></CheckerBundle></Config>'
        )
        subprocess.run([ASAM / program, "-c", config], check=True, capture_output=True)
        states = re.findall(
            r'<Checker status="(\w+)" checkerId="(\w+)"', report.read_text()
        )
        assert ("completed", f"check_asam_{kind}_xml_valid_schema") in states
        assert not any(state == "error" for state, _ in states)
        assert "<Issue " not in report.read_text()


ForCarla = tuple[Any, JsonObject, dict[str, float]]


@pytest.fixture
def for_carla(tmp_path: Path) -> ForCarla:
    """The exported script's functions, its record, and the setting."""
    need_library("carla")
    results, setting = results_of(load_study("rain"), tmp_path)
    run(f"export {results} {HANDLE} --to carla --out {tmp_path / 'out'}")
    script = SimpleNamespace(**runpy.run_path(str(tmp_path / "out/run_in_carla.py")))
    return script, json.loads((tmp_path / "out/vehicle.json").read_text()), setting


def test_carla_gets_all_twelve_values_in_its_units(for_carla: ForCarla) -> None:
    import carla

    script, scene, setting = for_carla
    empty = carla.VehiclePhysicsControl(
        wheels=[carla.WheelPhysicsControl() for _ in range(4)]
    )
    physics = script.apply_values(empty, scene)
    assert len(physics.wheels) == 4
    wheel_values = [
        [wheel.tire_friction, wheel.damping_rate, wheel.radius, wheel.max_brake_torque]
        for wheel in physics.wheels
    ]
    body_values = [
        physics.max_rpm,
        physics.damping_rate_full_throttle,
        physics.damping_rate_zero_throttle_clutch_engaged,
        physics.damping_rate_zero_throttle_clutch_disengaged,
        physics.gear_switch_time,
        physics.clutch_strength,
        physics.mass,
        physics.drag_coefficient,
    ]
    for wheel in wheel_values:  # in the order of the paper's table; float32 in CARLA
        assert np.allclose(
            [*body_values, *wheel], [*setting.values()], rtol=1e-6, atol=0
        )
    assert 30 < wheel_values[0][2] < 40, "centimetres"


def test_carla_gets_pedals_places_and_walker(for_carla: ForCarla) -> None:
    import carla

    script, scene, setting = for_carla
    comparison = comparison_of(simulate("rain", setting))
    control = script.pedals(scene, 3)
    end = comparison.moments[-1].end
    assert control.throttle == pytest.approx(comparison.runs.trace.throttle[3, -1])
    assert script.pedals(scene, end + 9).brake == pytest.approx(
        comparison.runs.trace.brake[end, -1]
    )
    vut, (walker,) = comparison.tracks["vut"], scene["actors"]
    start = script.place(**scene["start"])
    assert start.location.x == pytest.approx(vut.x[0, -1] - vut.length / 2)
    assert start.location.y == pytest.approx(-vut.y[0, -1])
    _, x, y, _ = walker["places"][10]
    step = script.walk(walker["places"], 10, scene["step"], carla.Location(x, -y, 0))
    assert step.speed == pytest.approx(1.8, abs=0.01)
    assert np.sign(step.direction.y) == -np.sign(walker["places"][11][2] - y), (
        "y points to the right in CARLA"
    )


def test_the_script_drives_the_whole_record(for_carla: ForCarla) -> None:
    """Calls only: no server was at hand."""
    import carla

    script, scene, _ = for_carla
    vehicle = MagicMock()
    walker = MagicMock()
    world = MagicMock()
    world.spawn_actor.side_effect = [vehicle, walker, MagicMock()]
    vehicle.get_physics_control.return_value = carla.VehiclePhysicsControl(
        wheels=[carla.WheelPhysicsControl()] * 4
    )
    vehicle.get_velocity.return_value = carla.Vector3D()
    walker.get_location.return_value = carla.Location()
    assert script.play(world, scene, None) is None
    assert (
        vehicle.apply_control.call_count
        == world.tick.call_count
        == len(scene["pedals"]) + script.SETTLING
    )
    assert walker.set_transform.call_count == len(scene["pedals"])
    assert vehicle.destroy.called


def test_what_carla_has_no_counterpart_of_is_refused(tmp_path: Path) -> None:
    worn, _ = results_of(load_study("wear"), tmp_path)
    out = tmp_path / "out"
    refused(
        f"export {worn} {HANDLE} --to carla --out {out}",
        "treadDepth, brakeTorque",
        "no counterpart in CARLA",
        "--to openscenario",
    )
    assert not out.exists()


@pytest.mark.parametrize(("kind", "behind"), [("pedestrian", 0.0), ("car", 1.16)])
def test_a_vehicle_is_placed_by_its_rear_axle_and_a_person_by_the_middle(
    kind: str, behind: float
) -> None:
    """The axles of a car of 4 m are 2.32 m apart, half of it in front of the middle."""
    heading = np.array([0.0, np.pi / 2, np.pi])
    zero = np.zeros(3)
    actor = Poses("a", kind, 4.0, 1.8, np.arange(3.0), zero + 7, zero + 2, heading)
    assert actor.to_axle == pytest.approx(behind)
    placed = np.array(actor.places(actor.to_axle))
    assert placed[:, 0].tolist() == [0, 1, 2]
    assert placed[:, 1] == pytest.approx([7 - behind, 7, 7 + behind])
    assert placed[:, 2] == pytest.approx([2, 2 - behind, 2])
    assert placed[:, 3].tolist() == heading.tolist()
