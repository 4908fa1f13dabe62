"""Pedestrians who cross: where they are at every moment, where they are hit, what hides them, and that SUMO says so too."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safevar_sumo.ads.aeb import Aeb
from safevar_sumo.errors import InputError
from safevar_sumo.records import Outcome
from safevar_sumo.scenarios.crossing import Crossing
from safevar_sumo.scenarios.euro_ncap import VUT_WIDTH, Walk
from tests.scenarios.holding import CARLA, Hold, at_contact, driven

STANDARD = [("CPFA", 50.0), ("CPNA", 25.0), ("CPNA", 50.0), ("CPNA", 75.0), ("CPNCO", 50.0)]
NUMBERS = {"CPFA": (8 / 3.6, 6.0, 1.5), "CPNA": (5 / 3.6, 4.0, 1.0), "CPNCO": (5 / 3.6, 4.0, 1.0)}
"""Speed [m/s], lateral start and acceleration distance [m] of the protocol."""


@pytest.mark.parametrize(("test", "location"), [*STANDARD, ("CPFA", 0.0), ("CPNA", 100.0), ("CPNCO", 10.0)])
@pytest.mark.parametrize("speed", [10.0, 30.0, 60.0])
def test_whoever_does_not_brake_hits_the_impact_location_when_it_is_time(test: str, location: float, speed: float) -> None:
    run = driven(Crossing(test=test, speed=speed, impact_location=location))
    assert run.outcome[0] == Outcome.COLLISION
    assert run.collision_speed[0] == pytest.approx(speed / 3.6)
    assert at_contact(run, run.trace.time) == pytest.approx(6.0, abs=1e-6)
    struck = at_contact(run, run.trace.lateral[:, 0]) / VUT_WIDTH + 0.5
    assert struck == pytest.approx(location / 100, abs=1e-6)


@pytest.mark.parametrize("test", NUMBERS)
def test_the_pedestrian_is_where_the_closed_form_has_him(test: str) -> None:
    """s = a (t - t0)^2 / 2 up to the acceleration distance, with a = u^2 / (2 s_a); then steady; at the impact location at 6 s."""
    speed, start, run_up = NUMBERS[test]
    trace = driven(Crossing(test=test, speed=20.0), Hold(np.array([0.0]))).trace
    acceleration = speed**2 / (2 * run_up)
    begin = 6.0 - (speed / acceleration + (start - run_up) / speed)
    since = np.maximum(trace.time - begin, 0.0)
    way = np.where(since < speed / acceleration, acceleration * since**2 / 2, run_up + speed * (since - speed / acceleration))
    assert trace.lateral[:, 0] == pytest.approx(-start + way, abs=1e-6)
    assert trace.lateral_speed[-1, 0] == pytest.approx(speed)


@settings(max_examples=40)
@given(speed=st.floats(1, 5), run_up=st.just(0.0) | st.floats(0.1, 3), rest=st.floats(0.01, 8), time=st.floats(20, 60))
def test_a_walk_arrives_in_time_whatever_it_is(speed: float, run_up: float, rest: float, time: float) -> None:
    walk = Walk.reaching(run_up + rest, time, speed, run_up)
    assert walk.travelled(time) == pytest.approx(run_up + rest)
    assert walk.travelled(walk.begin) == 0
    if run_up:
        assert walk.travelled(walk.begin + 2 * run_up / speed) == pytest.approx(run_up, abs=1e-9)


def test_sumo_reports_a_crash_just_where_bodies_overlap() -> None:
    """Many ways to brake, from both sides: bodies overlap for sure, or do not even touch, and SUMO says the same."""
    half_width, seen = VUT_WIDTH / 2, set()
    for test, location, (length, width) in (("CPFA", 20.0, (0.6, 0.5)), ("CPNA", 60.0, (0.6, 0.5)), ("CPNCO", 5.0, (0.711, 0.298))):
        brakes_at = np.linspace(3.0, 6.2, 60)
        run = driven(Crossing(test=test, speed=30.0, impact_location=location), Hold(brakes_at),
                     np.repeat(CARLA.characteristics.original[np.newaxis], 60, axis=0))
        trace, collided = run.trace, run.outcome == Outcome.COLLISION
        away, reach = np.abs(trace.lateral), half_width + length / 2
        behind = -width - trace.vehicle_length
        overlaps = trace.active & (away < reach - 0.03) & (trace.gap < -0.03) & (trace.gap > behind + 0.03)
        touches = trace.active & (away < reach + 0.03) & (trace.gap < 0.03) & (trace.gap > behind - 0.03)
        assert np.all(collided[overlaps.any(axis=0)])
        assert np.all(touches.any(axis=0)[collided])
        seen |= set(collided.tolist())
    assert seen == {True, False}


@pytest.mark.parametrize("setback", [0.0, 2.0])
def test_a_child_is_seen_once_the_line_to_it_passes_the_parked_cars_corner(setback: float) -> None:
    """Corner: 1 m from the vehicle's side, 1 m before the child's path. Similar triangles from the sensors in the vehicle's middle."""
    scenario = Crossing(test="CPNCO", speed=40.0, sensor_setback=setback)
    recorder = _Recorder()
    run = driven(scenario, recorder)
    trace = run.trace
    away = trace.gap[:, 0] + 0.298 / 2 + setback
    at_corner = -trace.lateral[:, 0] * (away - 1.0) / away
    expected = at_corner < VUT_WIDTH / 2 + 1.0
    assert np.isfinite(recorder.gaps).tolist() == expected.tolist()
    first = int(np.argmax(expected))
    assert 0.9 < 6.0 - trace.time[first] < 2.0
    assert np.isinf(recorder.laterals[:first]).all(), "nothing of what is hidden is told"


class _Recorder(Hold):
    """Does nothing, and keeps what it sees."""

    def __init__(self) -> None:
        super().__init__()
        self._gaps: list[float] = []
        self._laterals: list[float] = []

    def drive(self, seen, memory):  # type: ignore[no-untyped-def]
        self._gaps.append(seen.gap[0])
        self._laterals.append(seen.lateral[0])
        return super().drive(seen, memory)

    gaps = property(lambda self: np.array(self._gaps))
    laterals = property(lambda self: np.array(self._laterals))


@pytest.mark.parametrize(("test", "location"), STANDARD)
def test_the_original_with_aeb_avoids_and_with_half_its_brakes_does_not(test: str, location: float) -> None:
    half = CARLA.characteristics.original.copy()
    half[CARLA.characteristics.names.index("maxBrakeTorque")] /= 2
    both = np.stack([CARLA.characteristics.original, half])
    outcomes = np.stack([driven(Crossing(test=test, speed=speed, impact_location=location), Aeb(), both).outcome
                         for speed in (10.0, 20.0, 30.0, 40.0)]) == Outcome.COLLISION
    assert not outcomes[:, 0].any()
    assert outcomes[2, 1]


@pytest.mark.parametrize(("parameters", "told"), [
    ({"speed": -10}, "speed"), ({"speed": 0}, "speed"), ({"impact_location": 101}, "impact_location"), ({"test": "CPXX"}, "test"),
    ({"time_to_impact": 2}, "needs 3.38 s to the impact"), ({"lateral_start": 2.0}, "lateral_start"),
    ({"acceleration_distance": 9}, "acceleration_distance"), ({"speed": 250, "time_to_impact": 20}, "begin before the road does"),
])
def test_impossible_parameters_are_refused(parameters: dict[str, object], told: str) -> None:
    with pytest.raises((InputError, msgspec.ValidationError), match=told):
        driven(msgspec.convert(parameters, Crossing))


def test_what_is_outside_the_protocol_is_allowed_with_a_word() -> None:
    assert Crossing(speed=40.0).remarks() == []
    assert "outside the protocol" in Crossing(speed=80.0).remarks()[0]
    assert "none of the protocol's" in Crossing(test="CPNA", impact_location=33.0).remarks()[0]
    assert driven(Crossing(speed=80.0)).outcome[0] == Outcome.COLLISION
