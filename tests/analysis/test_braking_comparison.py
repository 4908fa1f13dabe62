"""Where lost distance goes, against drives of which every part is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from safevar_sumo.analysis.explain.braking_comparison import BrakingComparison, compare, course, sentence
from safevar_sumo.records import Encounter, Outcome, SimulationRuns, Trace

STEP, OBSTACLE = 0.002, 20.0


def drive_of(*vehicles: tuple[float, float, float, float]) -> SimulationRuns:
    """Vehicles of (speed, gap at which the brake is commanded, delay, deceleration) towards an obstacle at 20 m."""
    time = np.arange(0, 8, STEP)
    columns = []
    for v, gap, delay, deceleration in vehicles:
        begins = (OBSTACLE - gap) / v
        braking = np.maximum(time - begins - delay, 0.0)
        speed = np.maximum(v - deceleration * braking, 0.0)
        braking = np.minimum(braking, v / deceleration)
        place = np.where(time < begins + delay, v * time, v * (begins + delay) + v * braking - deceleration * braking**2 / 2)
        columns.append((speed, place, np.where(time >= begins, 1.0, 0.0), np.where(time >= begins + delay, 1.0, 0.0)))
    speed, place, brake, pedal = (np.stack(part, axis=1) for part in zip(*columns, strict=True))
    hit = place >= OBSTACLE
    collision_speed = np.where(hit.any(axis=0), speed[np.argmax(hit, axis=0), np.arange(len(vehicles))], np.nan)
    active = np.cumsum(hit, axis=0) <= 1
    nothing = np.zeros_like(speed)
    trace = Trace(step=STEP, vehicle_length=5.0, time=time, position=place, speed=speed, gap=OBSTACLE - place, lateral=nothing,
                  lateral_speed=nothing, throttle=nothing, brake=brake, gear=nothing, active=active, pedal=pedal)
    outcome = np.where(np.isnan(collision_speed), Outcome.STOPPED.value, Outcome.COLLISION.value)
    return SimulationRuns(trace=trace, encounter=Encounter(trace.gap, trace.gap, speed, trace.gap > 0), outcome=outcome,
                  collision_speed=collision_speed)


def compared(one: tuple[float, float, float, float], other: tuple[float, float, float, float]) -> BrakingComparison:
    drives = drive_of(one, other)
    return compare(*(course(drives, column, 1.0) for column in (0, 1)))


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


def test_a_vehicle_that_does_not_brake_at_all_has_lost_the_place() -> None:
    told = compared(SAME, (10.0, -1.0, 0.2, 6.0))
    assert told.changed.braking is None
    assert told.parts["place"] == pytest.approx(15.0, abs=0.1)
    assert "without any effect of its brake" in sentence(told)


def test_the_sentence_tells_the_largest_part_first_and_what_was_instead() -> None:
    told = sentence(compared(SAME, (10.0, 14.0, 0.2, 3.0)))
    assert told.startswith("The original stops, safety degree 1.00 m; this one hits at")
    assert told.index("brakes more weakly (3.00 instead of 6.00 m/s^2)") < told.index("begins to brake nearer (14.00 instead of 15.00 m")
    assert "They brake alike" in sentence(compared(SAME, SAME))


def test_a_creeping_deceleration_is_no_late_pedal() -> None:
    """Both pedals are down 0.1 s after the command; one vehicle decelerates with 6 m/s^2 at once, the other comes to 6 within a second."""
    drives = drive_of((10.0, 15.0, 0.1, 6.0), (10.0, 15.0, 0.1, 6.0))
    time, begins = drives.trace.time, 0.5
    rises = np.clip(time - begins - 0.1, 0.0, None)
    slower = 10 - np.where(rises < 1, 3 * rises**2, 3 + 6 * (rises - 1))
    drives.trace.speed[:, 1] = np.maximum(slower, 0.0)
    drives.trace.position[1:, 1] = np.cumsum((drives.trace.speed[1:, 1] + drives.trace.speed[:-1, 1]) / 2) * STEP
    drives.trace.gap[:, 1] = OBSTACLE - drives.trace.position[:, 1]
    told = compare(*(course(drives, column, 1.0) for column in (0, 1)))
    assert told.parts["delay"] == 0
    assert told.parts["deceleration"] == pytest.approx(told.lost)
    assert "later" not in sentence(told)
    assert "brakes more weakly" in sentence(told)
