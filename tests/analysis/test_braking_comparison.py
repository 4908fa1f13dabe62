"""What makes a changed vehicle brake worse than the original: the distance it loses, in parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safevar_sumo.analysis.explain.braking_comparison import BrakingComparison, compare_braking, measure_braking
from safevar_sumo.records import SimulationRuns
from tests.made_up import made_up_runs

STEP, OBSTACLE = 0.002, 20.0


def drive_of(*vehicles: tuple[float, float, float, float]) -> SimulationRuns:
    """Vehicles of (speed, gap at which the brake is commanded, delay, deceleration) towards an obstacle at 20 m."""
    time = np.arange(0, 8, STEP)
    drives = []
    for v, gap, delay, deceleration in vehicles:
        begins = (OBSTACLE - gap) / v
        braking = np.maximum(time - begins - delay, 0.0)
        speed = np.maximum(v - deceleration * braking, 0.0)
        braking = np.minimum(braking, v / deceleration)
        place = np.where(
            time < begins + delay, v * time, v * (begins + delay) + v * braking - deceleration * braking**2 / 2
        )
        drives.append((speed, place, np.where(time >= begins, 1.0, 0.0), np.where(time >= begins + delay, 1.0, 0.0)))
    speed, place, brake, pedal = (np.stack(part, axis=1) for part in zip(*drives, strict=True))
    hit = place >= OBSTACLE
    collision_speed = np.where(hit.any(axis=0), speed[np.argmax(hit, axis=0), np.arange(len(vehicles))], np.nan)
    active = np.cumsum(hit, axis=0) <= 1
    gap, throttle = OBSTACLE - place, np.zeros_like(speed)
    columns = {"position": place, "throttle": throttle, "brake": brake, "pedal": pedal, "active": active}
    return made_up_runs(STEP, speed, gap, collision_speed, **columns)


def compared(one: tuple[float, float, float, float], other: tuple[float, float, float, float]) -> BrakingComparison:
    return compare_braking(drive_of(one, other), 1, np.ones(2))


SAME = (10.0, 15.0, 0.2, 6.0)


@pytest.mark.parametrize(
    ("other", "part", "lost"),
    [
        ((10.0, 13.5, 0.2, 6.0), "gap", 1.5),
        ((10.0, 15.0, 0.4, 6.0), "delay", 10 * 0.2),
        ((10.0, 15.0, 0.2, 5.0), "deceleration", 100 / 10 - 100 / 12),
        ((11.0, 15.0, 0.2, 6.0), "speed", 1 * 0.2 + (121 - 100) / 12),
        ((10.0, 15.0, 0.2, 3.5), "deceleration", 100 / 7 - 100 / 12),  # which hits
        ((8.0, 15.0, 0.2, 6.0), "speed", -2 * 0.2 - (100 - 64) / 12),  # which gains
    ],
)
def test_one_difference_is_one_part(other: tuple[float, float, float, float], part: str, lost: float) -> None:
    comparison = compared(SAME, other)
    assert comparison.parts[part] == pytest.approx(lost, abs=0.05)
    assert all(abs(value) < 0.05 for name, value in comparison.parts.items() if name != part)


def test_an_obstacle_that_walks_on_leaves_nothing_unexplained() -> None:
    """The same drives seen from a frame in which the obstacle moves: the same parts."""
    runs, walking = drive_of(SAME, (11.0, 15.0, 0.2, 6.0)), 1.4
    trace = runs.trace
    position = trace.position + walking * trace.time[:, np.newaxis]
    moved = replace(runs, trace=replace(trace, speed=trace.speed + walking, position=position))
    stands, walks = (compare_braking(one, 1, np.ones(2)) for one in (runs, moved))
    assert walks.parts == pytest.approx(stands.parts, abs=1e-4)
    assert abs(walks.parts["remainder"]) < 0.01
    assert walks.changed is not None
    assert walks.changed.speed == pytest.approx(11.0 + walking)


def test_an_overshooting_cruise_control_does_not_brake_for_the_obstacle() -> None:
    """Two overshoot; the throttle ends that, or a brake that fades until the hazard. The last one does nothing else
    before it collides.
    """
    runs = drive_of(SAME, SAME, SAME, (10.0, -5.0, 0.2, 6.0))
    runs.trace.brake[50:150, 1:3] = 0.5
    runs.trace.throttle[150:200, 1] = 0.1
    runs.trace.brake[150:250, 2:] = 0.01
    plain, overshot, settling, unbraked = (measure_braking(runs, column) for column in range(4))
    assert overshot == settling == plain
    assert plain is not None
    assert plain.gap == pytest.approx(15.0)
    assert unbraked is None
