"""Settings in a matrix: the worst point counts, independently of the batch, the order of points and
the other points.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace as replace_in

from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.part import at_point
from safevar_sumo.records import (
    Command,
    FloatArray,
    Outcome,
)
from safevar_sumo.scenarios import Crossing, Point
from safevar_sumo.scenarios.ahead import CarToCar
from safevar_sumo.study import Study
from safevar_sumo.sumo.bodies import Body, find_touches
from safevar_sumo.sumo.driving_robot import DrivingRobot
from safevar_sumo.sumo.matrix import drive_and_score, simulate_all_points
from safevar_sumo.sumo.system import assemble
from tests.support.holding import CARLA as SUN, Pedals, driven
from tests.support.in_process import SLOW
from tests.support.made_up import (
    assert_same_results,
    changed,
    drawn,
    original_of,
    system_of,
)


@SLOW
def test_the_worst_point_decides_a_settings_result_and_points_do_not_affect_each_other() -> (
    None
):
    tests = [
        {
            "name": "CPNA",
            "parameters": {"test": "CPNA"},
            "over": {"speed": [20, 50], "impact_location": [25, 75]},
            "weathers": ["clear", "carla_hard_rain"],
        },
        {"name": "CPNCO", "parameters": {"test": "CPNCO"}, "over": {"speed": [40]}},
        {"name": "CPLA", "model": "along", "over": {"speed": [30]}},
    ]
    system = system_of("euro_ncap_pedestrian", matrix={"tests": tests})
    population = drawn(system, 3, 3)
    points = simulate_all_points(system, population)
    assert [one.point.name for one in points][:3] == [
        "CPNA, speed 20, impact_location 25, clear",
        "CPNA, speed 20, impact_location 25, carla_hard_rain",
        "CPNA, speed 20, impact_location 75, clear",
    ]
    assert len(points) == 10
    for one in points[::3]:
        alone = drive_and_score(system.at(one.point), population)
        assert_same_results(alone, one.evaluations)
    whole = drive_and_score(system, population)
    assert (
        whole.f_safe.tolist()
        == np.min([one.evaluations.f_safe for one in points], axis=0).tolist()
    )
    collided = [one.evaluations.collided for one in points]
    assert whole.collided.tolist() == np.any(collided, axis=0).tolist()


EAST = np.array([1.0, 0.0])


HOLDS_HALF = Pedals(lambda seen: (0.5, 0))
"""Half of the throttle."""


def with_max_rpm(*values: float) -> FloatArray:
    return np.concatenate([changed(SUN, max_rpm=value) for value in values])


@pytest.mark.parametrize(
    ("scenario", "settings"),
    [
        (Crossing(test="CPFA", speed=50.0), with_max_rpm(5800, 6567, 6570, 6575)),
        (CarToCar(test="CCRm", speed=70.0), with_max_rpm(4200, 5800, 7000)),
    ],
)
def test_unbraked_a_vehicle_holds_the_tests_speed_in_one_gear_and_hits_with_its_front(
    scenario: Any, settings: FloatArray
) -> None:
    runs = driven(scenario, HOLDS_HALF, settings)
    speed = np.where(runs.trace.active, runs.trace.speed * 3.6, scenario.speed)
    assert speed.max() < scenario.speed + 1.0
    assert speed.min() > scenario.speed - 0.5
    assert (runs.trace.gear == runs.trace.gear[0]).all(where=runs.trace.active)
    assert set(runs.contact.side) == {"front"}
    assert runs.contact.place == pytest.approx(np.full(len(settings), 50.0), abs=2.0)


@pytest.mark.parametrize(
    ("error", "invalid"), [(-0.51, True), (-0.49, False), (0.99, False), (1.01, True)]
)
def test_a_test_is_invalid_beyond_1_km_h_too_fast_and_half_a_km_h_too_slow(
    error: float, invalid: bool
) -> None:
    """Euro NCAP's tolerance applies until the ADS acts."""
    vehicle = SUN.vehicle
    original = SUN.characteristics.columns(SUN.characteristics.original_settings)
    prepared = vehicle.prepare(original, 1.0, 0.05)
    state = vehicle.at_speed(prepared, np.array([50 / 3.6]))
    all_open = np.ones(1, dtype=bool)
    robot = DrivingRobot(
        [Point(CarToCar(speed=50), SUN.points[0].weather)],
        vehicle,
        prepared,
        state,
        0.05,
    )
    robot.drive(
        Command(state.throttle, state.brake),
        state._replace(speed=np.array([(50 + error) / 3.6])),
        all_open,
    )
    assert robot.invalid.tolist() == [invalid]


def test_a_setting_with_an_invalid_test_has_no_verdict_unless_it_collides_elsewhere() -> (
    None
):
    parameters = {"test": "CCRs", "grade": 20.0}
    test = {"name": "CCRs", "parameters": parameters, "over": {"speed": [10, 50]}}
    steep = system_of("euro_ncap_car_to_car", matrix={"tests": [test]})
    weak = replace_in(SUN.vehicle, engine_torque=0.5)  # type: ignore[type-var]
    steep = replace(steep, vehicle=weak)
    original = original_of(SUN)
    assert [
        str(one.evaluations.outcome[0]) for one in simulate_all_points(steep, original)
    ] == [
        "stopped",
        "invalid-test",
    ]
    evaluations = drive_and_score(steep, original)
    assert evaluations.outcome[0] == Outcome.INVALID_TEST
    assert not evaluations.valid[0]
    assert not evaluations.failed[0]
    assert np.isnan(evaluations.f_safe[0])
    assert (
        drive_and_score(replace(steep, ads=HOLDS_HALF), original).outcome[0]
        == Outcome.COLLISION
    ), "at 10 km/h, where the speed is held"


def test_an_ads_that_releases_the_accelerator_or_brakes_takes_control_of_the_vehicle() -> (
    None
):
    far = CarToCar(test="CCRs", speed=50.0, headway=20.0)
    coasts = driven(far, Pedals(lambda seen: (0.5 * (seen.time < 2), 0)))
    assert coasts.outcome[0] != Outcome.INVALID_TEST
    assert coasts.trace.throttle[41:, 0].max() == 0
    faster = driven(
        far, Pedals(lambda seen: (0, 0.5) if 1.0 <= seen.time < 1.1 else (1, 0))
    )
    assert abs(faster.test_speed_error[0]) * 3.6 < 0.5
    assert faster.trace.speed.max() * 3.6 > 60


@pytest.mark.parametrize(
    ("middle", "along", "speed", "contact"),
    [
        # own: 4 m by 2 m at the origin, east at 10 m/s; the other: 0.6 m by 0.4 m
        (
            (2.1, 0.0),
            (0.0, 1.0),
            0.0,
            ("front", 0.01, 0.0),
        ),  # reach 2 + 0.2; overlaps by 0.1
        (
            (2.1, -1.2),
            (0.0, 1.0),
            1.0,
            ("front", 0.01, 0.0),
        ),  # across since 0.1 s, along since 0.01 s
        (
            (1.0, -1.25),
            (0.0, 1.0),
            1.0,
            ("right", 0.05, None),
        ),  # along since 0.12 s, across by 0.05 m at 1 m/s
        ((-1.0, 1.25), (0.0, -1.0), 1.0, ("left", 0.05, None)),
        (
            (-2.2, 0.0),
            (1.0, 0.0),
            12.0,
            ("rear", 0.05, None),
        ),  # 2 m/s faster, reach 2 + 0.3
    ],
)
def test_bodies_touch_at_the_side_where_the_overlap_began_last(
    middle: tuple[float, float],
    along: tuple[float, float],
    speed: float,
    contact: tuple[str, float, float | None],
) -> None:
    own = Body(np.zeros((1, 2)), EAST[np.newaxis], 4.0, 2.0, np.array([10.0]))
    other = Body(np.array([middle]), np.array([along]), 0.6, 0.4, np.array([speed]))
    touches = find_touches(own, other)
    assert touches.side == contact[0]
    assert touches.age == pytest.approx(contact[1])
    if contact[2] is not None:
        assert touches.behind_front == pytest.approx(contact[2] - 0.2)


def names(study: Study) -> list[str]:
    return [point.name for point in assemble(study).points]


def test_one_study_has_listed_encounters_and_ranges_and_is_reduced_to_a_test_or_point() -> (
    None
):
    wear, one = load_study("wear"), "CPNA, speed 20, impact_location 50, wet"
    points = names(wear)
    assert (len(points), points[3], points[8]) == (26, "CPFA, speed 40, wet", one)
    assert names(at_point(wear, one)) == [one]
    assert names(at_point(wear, "CPFA")) == points[:4]
    assert [*load_study("wear", encounters="ranges").ranges] == [
        "speed",
        "impact_location",
    ]


@SLOW
def test_a_setting_meets_only_tests_whose_ranges_and_constraints_have_its_encounter() -> (
    None
):
    """The cut-out takes gaps from 20 m, and at 130 km/h from 69 m."""
    study = load_study("alks", encounters="ranges")
    system = assemble(study)
    settings = np.tile(system.characteristics.original, (3, 1))
    for name, values in {
        "gap": (10, 60, 60),
        "speed": (60, 130, 80),
        "brakeTorque": 0.6,
    }.items():
        settings[:, [*system.characteristics.names].index(name)] = values
    least = np.full(3, np.inf)
    for name, met in {
        "cut_in": [0, 1, 2],
        "cut_out": [2],
        "following": [0, 1, 2],
    }.items():
        alone = assemble(at_point(study, name))
        own = alone.characteristics.of_others(system.characteristics, settings[met])
        least[met] = np.minimum(least[met], drive_and_score(alone, own).f_safe)
    assert drive_and_score(system, settings).f_safe.tolist() == least.tolist()
