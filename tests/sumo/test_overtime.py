"""Runs go on beyond their time while the vehicle still closes on somebody."""

from __future__ import annotations

from dataclasses import replace

import pytest
from msgspec.structs import replace as replace_in

from safevar_sumo.api.simulation import load_study
from safevar_sumo.questions.part import at_point
from safevar_sumo.records import Outcome
from safevar_sumo.scenarios.ahead import CarToCar
from safevar_sumo.sumo.batch import drive_all
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import System, assemble
from tests.support.in_process import SLOW
from tests.support.made_up import assert_same_results, drawn, original_of, system_of

CREEPS = (
    "braking lead vehicle, 50 km/h, headway 0.864, target_deceleration 4.905, clear"
)
"""A test at whose end many vehicles still roll towards the leader, who stands."""


@pytest.fixture(scope="module")
def creeping() -> System:
    system = system_of("fmvss127")
    return system.at(next(point for point in system.points if point.name == CREEPS))


def test_a_run_that_goes_on_ends_as_one_that_had_the_time(creeping: System) -> None:
    scenario = creeping.points[0].scenario
    assert isinstance(scenario, CarToCar)
    longer = replace_in(scenario, time_after=35.0)
    patient = creeping.at(creeping.points[0]._replace(scenario=longer))
    population = drawn(creeping, 60, 3)
    found = drive_and_score(creeping, population)
    assert set(found.outcome) <= {Outcome.STOPPED, Outcome.COLLISION}
    assert_same_results(found, drive_and_score(patient, population))


@pytest.mark.parametrize("in_sumo", [False, True])
def test_the_new_car_stops_behind_the_leader(creeping: System, in_sumo: bool) -> None:
    heard = []
    runs = drive_all(
        replace(creeping, in_sumo=in_sumo), original_of(creeping), heard.append
    )
    assert runs.outcome[0] == Outcome.STOPPED
    assert runs.trace.speed[-1, 0] == 0
    assert runs.trace.gap[-1, 0] == pytest.approx(0.7035, abs=1e-4)
    assert len(heard) == len(runs.trace.time)


@SLOW
def test_an_encounter_that_ended_before_its_collision_counts_as_one() -> None:
    system = assemble(at_point(load_study("alks", encounters="ranges"), "cut_in"))
    (point,) = system.points
    patient = system.at(
        point._replace(scenario=replace_in(point.scenario, duration=60.0))
    )
    population = drawn(system, 300, 1)
    found = drive_and_score(system, population, with_originals=False)
    longer = drive_and_score(patient, population, with_originals=False)
    collided = found.collided
    assert_same_results(found.take(collided), longer.take(collided))
