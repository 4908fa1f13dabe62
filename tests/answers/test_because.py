"""Where lost distance goes, against drives of which every part is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from safevar_sumo.answers.because import Because, because, course
from safevar_sumo.answers.words import sentence
from safevar_sumo.records import Drives, Encounter, Outcome, Trace

STEP, OBSTACLE = 0.002, 20.0


def drive_of(*vehicles: tuple[float, float, float, float]) -> Drives:
    """Vehicles of (speed, gap at which the brake is commanded, delay, deceleration) towards an obstacle at 20 m."""
    time = np.arange(0, 8, STEP)
    columns = []
    for v, gap, delay, deceleration in vehicles:
        begins = (OBSTACLE - gap) / v
        braking = np.maximum(time - begins - delay, 0.0)
        speed = np.maximum(v - deceleration * braking, 0.0)
        braking = np.minimum(braking, v / deceleration)
        place = np.where(time < begins + delay, v * time, v * (begins + delay) + v * braking - deceleration * braking**2 / 2)
        columns.append((speed, place, np.where(time >= begins, 1.0, 0.0)))
    speed, place, brake = (np.stack(part, axis=1) for part in zip(*columns, strict=True))
    hit = place >= OBSTACLE
    collision_speed = np.where(hit.any(axis=0), speed[np.argmax(hit, axis=0), np.arange(len(vehicles))], np.nan)
    active = np.cumsum(hit, axis=0) <= 1
    nothing = np.zeros_like(speed)
    trace = Trace(step=STEP, vehicle_length=5.0, time=time, position=place, speed=speed, gap=OBSTACLE - place, lateral=nothing,
                  lateral_speed=nothing, throttle=nothing, brake=brake, gear=nothing, active=active)
    outcome = np.where(np.isnan(collision_speed), Outcome.STOPPED.value, Outcome.COLLISION.value)
    return Drives(trace=trace, encounter=Encounter(trace.gap, trace.gap, speed, trace.gap > 0), outcome=outcome,
                  collision_speed=collision_speed)


def compared(one: tuple[float, float, float, float], other: tuple[float, float, float, float]) -> Because:
    drives = drive_of(one, other)
    return because(*(course(drives, column, 1.0) for column in (0, 1)))


SAME = (10.0, 15.0, 0.2, 6.0)


@pytest.mark.parametrize(("other", "part", "lost"), [
    ((10.0, 13.5, 0.2, 6.0), "place", 1.5),
    ((10.0, 15.0, 0.4, 6.0), "delay", 10 * 0.2),
    ((10.0, 15.0, 0.2, 5.0), "deceleration", 100 / 10 - 100 / 12),
    ((11.0, 15.0, 0.2, 6.0), "speed", 1 * 0.2 + (121 - 100) / 12),
    ((10.0, 15.0, 0.2, 3.5), "deceleration", 100 / 7 - 100 / 12),  # which hits
    ((8.0, 15.0, 0.2, 6.0), "speed", -2 * 0.2 - (100 - 64) / 12)])  # which gains
def test_one_difference_is_one_part(other: tuple[float, float, float, float], part: str, lost: float) -> None:
    told = compared(SAME, other)
    assert told.parts[part] == pytest.approx(lost, abs=0.05)
    assert all(abs(value) < 0.05 for name, value in told.parts.items() if name != part)


def test_the_parts_of_many_differences_add_up() -> None:
    told = compared(SAME, (11.0, 14.0, 0.35, 5.0))
    stops = [OBSTACLE - (OBSTACLE - gap) - v * delay - v**2 / (2 * a) for v, gap, delay, a in (SAME, (11.0, 14.0, 0.35, 5.0))]
    assert told.lost == pytest.approx(stops[0] - stops[1], abs=0.05)
    assert told.changed.outcome == "collision"
    assert abs(told.parts["remainder"]) < 0.05


def test_without_collision_they_add_up_to_the_difference_of_the_distances_left() -> None:
    told = compared(SAME, (10.0, 14.0, 0.3, 6.0))
    assert told.lost == pytest.approx(told.original.closest - told.changed.closest, abs=1e-9)


def test_a_vehicle_that_does_not_brake_at_all_has_lost_the_place() -> None:
    told = compared(SAME, (10.0, -1.0, 0.2, 6.0))
    assert told.changed.braking is None
    assert told.parts["place"] == pytest.approx(15.0, abs=0.1)
    assert "without braking" in sentence(told)


def test_the_sentence_tells_the_largest_part_first_and_what_was_instead() -> None:
    told = sentence(compared(SAME, (10.0, 14.0, 0.2, 3.0)))
    assert told.startswith("The original stops, safety degree 1.00 m; this one hits at")
    assert told.index("brakes more weakly (3.00 instead of 6.00 m/s^2)") < told.index("begins to brake nearer (14.00 instead of 15.00 m")
    assert "They brake alike" in sentence(compared(SAME, SAME))
