"""Somebody ahead: where the target is at every moment, when and where it is hit, SUMO's collisions and time to collision."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from safevar_sumo.ads.aeb import Aeb
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import time_to_collision
from safevar_sumo.records import Outcome
from safevar_sumo.scenarios.along import Along
from safevar_sumo.scenarios.car_to_car import CarToCar
from safevar_sumo.scenarios.euro_ncap import VUT_WIDTH
from safevar_sumo.sumo.matrix import simulate
from tests.scenarios.holding import NATIVE, Hold, at_contact, driven

KMH = 1 / 3.6
STOPS_AT_ONCE = Hold(np.array([0.0]))


def closed_in(test: str, speed: float) -> float:
    """When the gap is closed that the protocol begins with: 5 s (CCRb: 1 s) of the vehicle's speed."""
    if test == "CCRs":
        return 5.0
    if test == "CCRm":
        return 5 * speed / (speed - 20)
    gap, stops = speed * KMH, (speed - 2) * KMH / 4
    return 3 + np.sqrt(gap / 2) if gap < 2 * stops**2 else 3 + stops + (gap - 2 * stops**2) / (4 * stops)


@pytest.mark.parametrize(("test", "speed"), [("CCRs", 10), ("CCRs", 50), ("CCRm", 30), ("CCRm", 80), ("CCRb", 30), ("CCRb", 80)])
@pytest.mark.parametrize("location", [0.0, 75.0])
def test_whoever_does_not_brake_hits_the_car_when_and_where_the_closed_form_says(test: str, speed: float, location: float) -> None:
    run = driven(CarToCar(test=test, speed=speed, impact_location=location), system=NATIVE)
    assert run.outcome[0] == Outcome.COLLISION
    assert at_contact(run, run.trace.time) == pytest.approx(closed_in(test, speed), abs=2e-3)
    assert at_contact(run, run.trace.lateral[:, 0]) / VUT_WIDTH + 0.5 == pytest.approx(location / 100)


def test_the_braking_car_is_where_the_closed_form_has_it() -> None:
    """80 km/h, from 3 s on 4 m/s^2 less, down to 2 km/h; the vehicle stands behind it."""
    trace = driven(CarToCar(test="CCRb", speed=80), STOPS_AT_ONCE, system=NATIVE).trace
    first, last = 80 * KMH, 2 * KMH
    since = np.clip(trace.time - 3, 0, (first - last) / 4)
    after = np.maximum(trace.time - 3 - (first - last) / 4, 0)
    place = first * np.minimum(trace.time, 3) + first * since - 2 * since**2 + last * after
    assert trace.gap[:, 0] + trace.position[:, 0] - trace.position[0, 0] == pytest.approx(first + place, abs=0.05)
    assert trace.obstacle_speed[:, 0] == pytest.approx(np.where(trace.time < 3, first, np.maximum(first - 4 * (trace.time - 3), last)))


def test_the_walker_ahead_is_where_the_closed_form_has_him() -> None:
    trace = driven(Along(speed=30), STOPS_AT_ONCE, system=NATIVE).trace
    speed = 5 * KMH
    way = np.where(trace.time < 2 / speed, speed**2 / 4 * trace.time**2, speed * trace.time - 1)
    gap = 6 * 30 * KMH - (6 * speed - 1)
    assert trace.gap[:, 0] + trace.position[:, 0] - trace.position[0, 0] == pytest.approx(gap + way, abs=0.05)
    run = driven(Along(speed=30), system=NATIVE)
    assert at_contact(run, run.trace.time) == pytest.approx(6.0, abs=1e-3)
    assert run.relative_speed[0] == pytest.approx(25 * KMH)


@pytest.mark.parametrize("scenario", [CarToCar(test="CCRm", speed=40), CarToCar(test="CCRb", speed=40), Along(speed=40)])
def test_sumo_reports_a_collision_just_when_the_gap_is_gone(scenario: CarToCar | Along) -> None:
    n = 40
    run = driven(scenario, Hold(np.linspace(1.0, scenario.duration, n)), np.repeat(NATIVE.characteristics.original[np.newaxis], n, axis=0),
                 NATIVE)
    least = np.min(np.where(run.trace.active, run.trace.gap, np.inf), axis=0)
    collided = run.outcome == Outcome.COLLISION
    assert np.all(collided[least < -1e-3])
    assert np.all(least[collided] < 1e-3)
    assert 0 < np.count_nonzero(collided) < n


def test_time_to_collision_is_that_of_sumos_ssm_device(tmp_path: Path) -> None:
    log = tmp_path / "ssm.xml"
    options = ("--device.ssm.explicit", "0.vut", "--device.ssm.measures", "TTC", "--device.ssm.thresholds", "1000",
               "--device.ssm.range", "200", "--device.ssm.extratime", "100", "--device.ssm.trajectories", "true",
               "--device.ssm.file", str(log))
    system = replace(NATIVE, scenario=CarToCar(test="CCRm", speed=50), ads=Aeb())
    run = simulate(system, system.characteristics.original[np.newaxis], options=options)
    conflict = next(one for one in ElementTree.parse(log).getroot().iter("conflict") if one.get("foe") == "0.target")
    times = [float(text) for text in conflict.find("timeSpan").get("values").split()]  # type: ignore[union-attr]
    theirs = dict(zip(times, conflict.find("TTCSpan").get("values").split(), strict=True))  # type: ignore[union-attr]
    ours, compared = time_to_collision(run)[:, 0], 0
    for sample, time in enumerate(run.trace.time):
        told = theirs.get(round(time, 3), "NA")
        if told != "NA" and np.isfinite(ours[sample]) and run.trace.speed[sample, 0] > run.trace.obstacle_speed[sample, 0] + 0.5:
            assert ours[sample] == pytest.approx(float(told), abs=0.0051)
            compared += 1
    assert compared > 50


@pytest.mark.parametrize(("kind", "parameters", "told"), [
    (CarToCar, {"speed": -5}, "speed"), (CarToCar, {"test": "CCRm", "speed": 15}, "never reaches"), (CarToCar, {"headway": 0}, "headway"),
    (Along, {"speed": 4}, "inside the vehicle"), (Along, {"target_speed": -1}, "target_speed"),
])
def test_impossible_parameters_are_refused(kind: type, parameters: dict[str, object], told: str) -> None:
    with pytest.raises((InputError, msgspec.ValidationError), match=told):
        driven(msgspec.convert(parameters, kind), system=NATIVE)
