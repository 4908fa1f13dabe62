"""The road's grade as a parameter of a scenario: who drives up and down it, in one batch with others, and who may not."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from safevar_sumo.ads.aeb import Aeb
from safevar_sumo.errors import InputError
from safevar_sumo.scenarios.along import Along
from safevar_sumo.scenarios.car_to_car import CarToCar
from safevar_sumo.scenarios.crossing import Crossing
from safevar_sumo.scenarios.euro_ncap import VUT_WIDTH
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import evaluate, simulate
from safevar_sumo.sumo.system import assemble
from tests.scenarios.holding import CARLA, NATIVE, Hold, at_contact, driven

WORN = assemble(load_study("wear", matrix=None))


@pytest.mark.parametrize("grade", [0.0, 10.0, -10.0])
def test_the_braking_distance_is_v2_over_2_b_plus_g_sin(grade: float) -> None:
    """The worn car on a dry road: b is what the brakes or tyres of mu g cos give."""
    dry = replace(WORN, weather=CARLA.weather)
    trace = driven(CarToCar(test="CCRs", speed=50, grade=grade), Hold(np.array([1.0])), system=dry).trace
    speed, brakes = trace.speed[:, 0], WORN.vehicle.sumo_type(WORN.vehicle.prepare(values(), 1.0, 0.05)).decel[0]
    angle = math.atan(grade / 100)
    limit = min(brakes, 0.9 * 9.81 * math.cos(angle)) + 9.81 * math.sin(angle)
    way = float(np.interp(-1.0, -speed, trace.position[:, 0]) - np.interp(-13.0, -speed, trace.position[:, 0]))
    assert (13.0**2 - 1) / (2 * way) == pytest.approx(limit, rel=0.01)


def values() -> dict[str, np.ndarray]:
    return {name: np.full(1, value) for name, value in zip(WORN.characteristics.names, WORN.characteristics.original, strict=True)}


@pytest.mark.parametrize("grade", [6.0, -6.0])
def test_whoever_does_not_brake_keeps_his_speed_uphill_and_downhill(grade: float) -> None:
    for system in (CARLA, NATIVE, WORN):
        run = driven(Crossing(test="CPFA", speed=40.0, grade=grade), Aeb(reach=0.1), system=system)
        assert run.trace.speed[:100, 0] == pytest.approx(40 / 3.6, rel=1e-3)
    run = driven(Crossing(test="CPNA", speed=40.0, impact_location=25.0, grade=grade))
    assert at_contact(run, run.trace.time) == pytest.approx(6.0, abs=0.01)
    assert at_contact(run, run.trace.lateral[:, 0]) / VUT_WIDTH + 0.5 == pytest.approx(0.25, abs=0.02)


def test_downhill_takes_what_aeb_has_kept_and_uphill_gives_more() -> None:
    left = [float(np.min(driven(Along(speed=50, grade=grade), Aeb()).trace.gap)) for grade in (-12.0, 0.0, 12.0)]
    assert left[0] < left[1] < left[2]


def test_points_of_a_matrix_may_rise_and_fall_and_are_each_as_if_alone() -> None:
    tests = [{"name": "CPLA", "model": "along", "parameters": {"speed": 40}, "over": {"grade": [-8, 0, 8]}}]
    together = assemble(load_study("euro_ncap_pedestrian", matrix={"tests": tests}))
    original = together.characteristics.original[None]
    assert [point.name for point in together.points] == ["CPLA, grade -8, clear", "CPLA, grade 0, clear", "CPLA, grade 8, clear"]
    degrees = [evaluate(together.at(point), original).f_safe[0] for point in together.points]
    assert evaluate(together, original).f_safe[0] == min(degrees)
    assert len(set(degrees)) == 3


def test_a_grade_beyond_30_percent_is_refused_and_one_outside_the_protocol_told() -> None:
    with pytest.raises(msgspec.ValidationError, match="grade"):
        msgspec.convert({"grade": 31}, Crossing)
    assert CarToCar(grade=-5.0).remarks() == ["CCRs: grade = -5 %, and the protocol's road is level"]


def test_a_vehicle_that_knows_no_slope_is_refused_on_one_in_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "flat.py").write_text(
        "from safevar_sumo.vehicles.sumo import SumoVehicle\n\n\nclass Flat(SumoVehicle, frozen=True):\n"
        "    def prepare(self, characteristics, road_friction, step):\n"
        "        return super().prepare(characteristics, road_friction, step)\n")
    native = load_study("native")
    vehicle = msgspec.structs.replace(native.vehicle, model="flat:Flat")
    for grade in (0.0, 4.0):
        scenario = msgspec.structs.replace(native.scenario, parameters={"grade": grade})
        system = assemble(msgspec.structs.replace(native, vehicle=vehicle, scenario=scenario))
        if grade:
            with pytest.raises(InputError, match=r"has no slope in prepare.*the road has a grade"):
                simulate(system, system.characteristics.original[None])
        else:
            assert simulate(system, system.characteristics.original[None]).trace.speed.max() > 5
