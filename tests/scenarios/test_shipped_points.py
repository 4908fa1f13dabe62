"""Every point of the matrices that ship: where and when it hits who does not brake, that the originals avoid it, and what fails."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from safevar_sumo.records import SimulationRuns
from safevar_sumo.scenarios import SCENARIOS, WEATHERS, Crossing, Point, PreCrash, tags
from safevar_sumo.scenarios.along import Along
from safevar_sumo.scenarios.base import pre_crash_of
from safevar_sumo.scenarios.car_to_car import CarToCar
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import at_every_point
from safevar_sumo.sumo.system import System, assemble
from tests.scenarios.holding import Hold, at_contact

BRAKE = {"euro_ncap_pedestrian": "maxBrakeTorque", "euro_ncap_car_to_car": "maxBrakeTorque", "wear": "brakeTorque"}


def clear(study: str) -> System:
    """The matrix by day: the dark changes nothing of who walks where."""
    system = assemble(load_study(study))
    return replace(system, matrix=tuple(point for point in system.points if point.weather.name != "night"))


def original_and_half_its_brakes(study: str, system: System) -> np.ndarray:
    half = system.characteristics.original.copy()
    half[system.characteristics.names.index(BRAKE[study])] /= 2
    return np.stack([system.characteristics.original, half])


@pytest.mark.slow
@pytest.mark.parametrize("study", BRAKE)
def test_who_does_not_brake_is_where_the_protocol_says_at_every_point(study: str) -> None:
    """The impact location within 2 % of the width; a pedestrian's arrival within 5 cm of his way or of the vehicle's.

    So does a vehicle at any corner of the domains: within the protocol's +1.0 and -0.5 km/h of the test's speed.
    """
    system = replace(clear(study), ads=Hold())
    domain = system.characteristics
    corners = np.where(np.random.default_rng(7).random((6, len(domain))) < 0.5, domain.lower, domain.upper)
    for found in at_every_point(system, np.concatenate([domain.original[np.newaxis], corners])):
        scenario, run = found.point.scenario, found.drives
        assert found.evaluations.collided.all(), found.point.name
        assert set(run.contact.side) == {"front"}, found.point.name
        assert run.contact.place == pytest.approx(np.full(7, scenario.impact_location), abs=2), found.point.name
        error = np.where(run.trace.active, run.trace.speed * 3.6 - scenario.speed, 0.0)
        assert error.min() > -0.5, found.point.name
        assert error.max() < 1.0, found.point.name
        assert struck(run, scenario.vut_width) == pytest.approx(scenario.impact_location / 100, abs=0.02), found.point.name
        if isinstance(scenario, Crossing | Along):
            late = abs(at_contact(run, run.trace.time) - 6.0)
            assert late * scenario.speed / 3.6 < 0.05, found.point.name


def struck(run: SimulationRuns, width: float) -> float:
    return at_contact(run, run.trace.lateral[:, 0]) / width + 0.5


@pytest.mark.slow
@pytest.mark.parametrize("study", BRAKE)
def test_the_originals_avoid_every_shipped_point_and_with_half_their_brakes_some_fail(study: str) -> None:
    system = assemble(load_study(study))
    collided = np.stack([one.evaluations.collided for one in at_every_point(system, original_and_half_its_brakes(study, system))])
    assert not collided[:, 0].any()
    assert collided[:, 1].any()


def test_the_worn_cars_matrix_at_its_edges() -> None:
    system = assemble(load_study("wear"))
    edges = tuple(point for point in system.points if point.name in ("CPNCO, speed 40, wet", "CPLA, speed 60, wet"))
    system = replace(system, matrix=edges)
    collided = [one.evaluations.collided.tolist() for one in at_every_point(system, original_and_half_its_brakes("wear", system))]
    assert collided == [[False, False], [False, True]]


PEDESTRIAN = "pedestrian crash without prior vehicle manoeuvre"


@pytest.mark.parametrize(("study", "told"), [
    ("sun", "pedestrian crash with prior vehicle manoeuvre; by day"), ("lgsvl", "lead vehicle stopped; by day"),
    ("euro_ncap_pedestrian", f"{PEDESTRIAN}; by day and by night"), ("wear", f"{PEDESTRIAN}; by day"),
    ("euro_ncap_car_to_car", "lead vehicle stopped; lead vehicle moving at lower constant speed; lead vehicle decelerating; by day"),
])
def test_the_tags_of_the_shipped_studies(study: str, told: str) -> None:
    assert tags(assemble(load_study(study)).points) == f"NHTSA's pre-crash types: {told}."


def test_every_shipped_scenario_has_a_type_of_nhtsas_list() -> None:
    assert all(pre_crash_of(kind()) in list(PreCrash) for kind in SCENARIOS.values())
    assert {pre_crash_of(CarToCar(test=test)) for test in ("CCRs", "CCRm", "CCRb")} == {*list(PreCrash)[2:]}


def test_it_is_night_where_the_weather_says_so_and_a_scenario_may_tell_no_type() -> None:
    assert {name for name, weather in WEATHERS.items() if weather.light == "night"} == {"night"}
    night = Point(SimpleNamespace(), WEATHERS["night"])  # type: ignore[arg-type]
    assert not tags([night])
