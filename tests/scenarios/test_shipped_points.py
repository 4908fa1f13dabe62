"""Every point of the shipped matrices: place and time of the impact without braking, and that the original vehicles
avoid it.
"""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.records import Outcome, SimulationRuns
from safevar_sumo.scenarios import Crossing, pre_crash_sentence
from safevar_sumo.scenarios.along import Along
from safevar_sumo.scenarios.car_to_car import CarToCar
from safevar_sumo.scenarios.euro_ncap import VUT_WIDTH
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.sumo.system import System, assemble
from tests.scenarios.holding import NATIVE, Hold, at_contact, driven

BRAKE = {"euro_ncap_pedestrian": "maxBrakeTorque", "euro_ncap_car_to_car": "maxBrakeTorque", "wear": "brakeTorque"}


def clear(study: str) -> System:
    """The matrix by day: darkness does not change the motion of targets."""
    system = assemble(load_study(study))
    return replace(system, matrix=tuple(point for point in system.points if point.weather.name != "night"))


def original_and_half_its_brakes(study: str, system: System) -> np.ndarray:
    half = system.characteristics.original.copy()
    half[system.characteristics.names.index(BRAKE[study])] /= 2
    return np.stack([system.characteristics.original, half])


@pytest.mark.slow
@pytest.mark.parametrize("study", BRAKE)
def test_a_vehicle_that_does_not_brake_hits_the_protocols_impact_location_at_every_point(study: str) -> None:
    """The impact location within 2 % of the width; a pedestrian's arrival within 5 cm of his way or of the vehicle's.

    So does a vehicle at any corner of the domains: within the protocol's +1.0 and -0.5 km/h of the test's speed.
    """
    system = replace(clear(study), ads=Hold())
    domain = system.characteristics
    corners = np.where(np.random.default_rng(7).random((6, len(domain))) < 0.5, domain.lower, domain.upper)
    for there in simulate_all_points(system, np.concatenate([domain.original[np.newaxis], corners])):
        scenario, run = there.point.scenario, there.runs
        assert there.evaluations.collided.all(), there.point.name
        assert set(run.contact.side) == {"front"}, there.point.name
        assert run.contact.place == pytest.approx(np.full(7, scenario.impact_location), abs=2), there.point.name
        error = np.where(run.trace.active, run.trace.speed * 3.6 - scenario.speed, 0.0)
        assert error.min() > -0.5, there.point.name
        assert error.max() < 1.0, there.point.name
        assert struck(run, scenario.vut_width) == pytest.approx(scenario.impact_location / 100, abs=0.02), (
            there.point.name
        )
        if isinstance(scenario, Crossing | Along):
            late = abs(at_contact(run, run.trace.time) - 6.0)
            assert late * scenario.speed / 3.6 < 0.05, there.point.name


def struck(run: SimulationRuns, width: float) -> float:
    return at_contact(run, run.trace.lateral[:, 0]) / width + 0.5


@pytest.mark.slow
@pytest.mark.parametrize("study", BRAKE)
def test_the_originals_avoid_every_shipped_point_and_with_half_their_brakes_some_fail(study: str) -> None:
    system = assemble(load_study(study))
    collided = np.stack(
        [one.evaluations.collided for one in simulate_all_points(system, original_and_half_its_brakes(study, system))]
    )
    assert not collided[:, 0].any()
    assert collided[:, 1].any()


def test_the_worn_cars_matrix_at_its_edges() -> None:
    system = assemble(load_study("wear"))
    edges = tuple(point for point in system.points if point.name in ("CPNCO, speed 40, wet", "CPLA, speed 60, wet"))
    system = replace(system, matrix=edges)
    collided = [
        one.evaluations.collided.tolist()
        for one in simulate_all_points(system, original_and_half_its_brakes("wear", system))
    ]
    assert collided == [[False, False], [False, True]]


PEDESTRIAN = "pedestrian crash without prior vehicle manoeuvre"


@pytest.mark.parametrize(
    ("study", "types"),
    [
        ("sun", "pedestrian crash with prior vehicle manoeuvre; by day"),
        ("lgsvl", "lead vehicle stopped; by day"),
        ("euro_ncap_pedestrian", f"{PEDESTRIAN}; by day and by night"),
        ("wear", f"{PEDESTRIAN}; by day"),
        (
            "euro_ncap_car_to_car",
            "lead vehicle stopped; lead vehicle moving at lower constant speed; lead vehicle decelerating; by day",
        ),
    ],
)
def test_the_tags_of_the_shipped_studies(study: str, types: str) -> None:
    assert pre_crash_sentence(assemble(load_study(study)).points) == f"NHTSA's pre-crash types: {types}."


KMH = 1 / 3.6
STOPS_AT_ONCE = Hold(np.array([0.0]))


def closed_in(test: str, speed: float) -> float:
    """Time at which the protocol's initial gap is closed [s]: 5 s (CCRb: 1 s) at the vehicle's speed."""
    if test == "CCRs":
        return 5.0
    if test == "CCRm":
        return 5 * speed / (speed - 20)
    gap, stops = speed * KMH, (speed - 2) * KMH / 4
    return 3 + np.sqrt(gap / 2) if gap < 2 * stops**2 else 3 + stops + (gap - 2 * stops**2) / (4 * stops)


@pytest.mark.parametrize(
    ("test", "speed"), [("CCRs", 10), ("CCRs", 50), ("CCRm", 30), ("CCRm", 80), ("CCRb", 30), ("CCRb", 80)]
)
@pytest.mark.parametrize("location", [0.0, 75.0])
def test_a_vehicle_that_does_not_brake_hits_the_car_when_and_where_the_closed_form_says(
    test: str, speed: float, location: float
) -> None:
    run = driven(CarToCar(test=test, speed=speed, impact_location=location), system=NATIVE)
    assert run.outcome[0] == Outcome.COLLISION
    assert at_contact(run, run.trace.time) == pytest.approx(closed_in(test, speed), abs=2e-3)
    assert at_contact(run, run.trace.lateral[:, 0]) / VUT_WIDTH + 0.5 == pytest.approx(location / 100)


def test_the_braking_car_moves_as_the_closed_form_says() -> None:
    """The car drives at 80 km/h and from 3 s on brakes at 4 m/s^2 down to 2 km/h; the vehicle stands behind it."""
    trace = driven(CarToCar(test="CCRb", speed=80), STOPS_AT_ONCE, system=NATIVE).trace
    first, last = 80 * KMH, 2 * KMH
    since = np.clip(trace.time - 3, 0, (first - last) / 4)
    after = np.maximum(trace.time - 3 - (first - last) / 4, 0)
    place = first * np.minimum(trace.time, 3) + first * since - 2 * since**2 + last * after
    assert trace.gap[:, 0] + trace.position[:, 0] - trace.position[0, 0] == pytest.approx(first + place, abs=0.05)
    assert trace.obstacle_speed[:, 0] == pytest.approx(
        np.where(trace.time < 3, first, np.maximum(first - 4 * (trace.time - 3), last))
    )


def test_the_pedestrian_ahead_moves_as_the_closed_form_says() -> None:
    trace = driven(Along(speed=30), STOPS_AT_ONCE, system=NATIVE).trace
    speed = 5 * KMH
    way = np.where(trace.time < 2 / speed, speed**2 / 4 * trace.time**2, speed * trace.time - 1)
    gap = 6 * 30 * KMH - (6 * speed - 1)
    assert trace.gap[:, 0] + trace.position[:, 0] - trace.position[0, 0] == pytest.approx(gap + way, abs=0.05)
    run = driven(Along(speed=30), system=NATIVE)
    assert at_contact(run, run.trace.time) == pytest.approx(6.0, abs=1e-3)
    assert run.relative_speed[0] == pytest.approx(25 * KMH)


@pytest.mark.parametrize(
    "scenario", [CarToCar(test="CCRm", speed=40), CarToCar(test="CCRb", speed=40), Along(speed=40)]
)
def test_sumo_reports_a_collision_exactly_when_the_gap_is_closed(scenario: CarToCar | Along) -> None:
    n = 40
    run = driven(
        scenario,
        Hold(np.linspace(1.0, scenario.duration, n)),
        np.repeat(NATIVE.characteristics.original[np.newaxis], n, axis=0),
        NATIVE,
    )
    least = np.min(np.where(run.trace.active, run.trace.gap, np.inf), axis=0)
    collided = run.outcome == Outcome.COLLISION
    assert np.all(collided[least < -1e-3])
    assert np.all(least[collided] < 1e-3)
    assert 0 < np.count_nonzero(collided) < n


@pytest.mark.parametrize(
    ("kind", "parameters", "message"),
    [
        (CarToCar, {"speed": -5}, "speed"),
        (CarToCar, {"test": "CCRm", "speed": 15}, "never reaches"),
        (CarToCar, {"headway": 0}, "headway"),
        (Along, {"speed": 4}, "inside the vehicle"),
        (Along, {"target_speed": -1}, "target_speed"),
    ],
)
def test_impossible_parameters_are_refused(kind: type, parameters: dict[str, object], message: str) -> None:
    with pytest.raises((InputError, msgspec.ValidationError), match=message):
        driven(msgspec.convert(parameters, kind), system=NATIVE)
