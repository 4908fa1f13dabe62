"""Speeds and ways of a trace: what honest simulators return agrees, however they sample and
integrate; mistakes are found.
"""

from __future__ import annotations

import numpy as np
import pytest

from safevar_sumo.records import FloatArray
from safevar_sumo.scenarios.trace_ways import contradiction_of_speeds, lag_of_speed

STEP = 0.05


def approach(
    step: float = STEP, obstacle: float = 0.0, decel: float = 6.0, apart: float = 60.0
) -> dict[str, FloatArray]:
    """A car at 15 m/s comes to an obstacle that drives at a constant speed. After 1 s it brakes, in
    closed form.
    """
    time = np.arange(0.0, 8.0, step)
    braked = np.clip(time - 1.0, 0.0, 15.0 / decel)
    way = 15.0 * (np.minimum(time, 1.0) + braked) - decel * braked**2 / 2
    return {
        "speed": 15.0 - decel * braked,
        "position": way,
        "gap": apart + obstacle * time - way,
        "obstacle_speed": np.full(len(time), obstacle),
    }


def euler() -> dict[str, FloatArray]:
    """Two cars brake alike, one in steps by the speed before, the other by the speed after."""
    columns = approach()
    speed = columns["speed"]
    own = np.append(0.0, np.cumsum(speed[:-1]) * STEP)
    others = np.append(0.0, np.cumsum(speed[1:]) * STEP)
    return {
        "speed": speed,
        "position": own,
        "gap": 20 + others - own,
        "obstacle_speed": speed,
    }


def wall() -> dict[str, FloatArray]:
    """A car hits a wall: the speed jumps to 0, and the gap ends at 0."""
    columns = approach(apart=9.0)
    gap = np.maximum(columns["gap"], 0.0)
    speed = np.where(gap > 0, columns["speed"], 0.0)
    return {"speed": speed, "gap": gap, "obstacle_speed": columns["obstacle_speed"]}


def next_obstacle() -> dict[str, FloatArray]:
    """The first obstacle leaves after 2 s: the gap is then that of a car 40 m farther, and infinite
    after 6 s.
    """
    columns = approach(obstacle=3.0)
    time = np.arange(len(columns["speed"])) * STEP
    gap = columns["gap"] + np.where(time > 2, 40.0, 0.0)
    return {**columns, "gap": np.where(time < 6, gap, np.inf)}


HONEST = {
    "closed form": approach(),
    "rounded to one decimal": {
        name: np.round(column, 1) for name, column in approach().items()
    },
    "two ways to integrate": euler(),
    "jump at an impact": wall(),
    "brakes at once": approach(decel=500.0),
    "next obstacle": next_obstacle(),
    "oncoming": approach(obstacle=-10.0, apart=200.0),
    "slipping wheels": {
        **approach(obstacle=12.0),
        "speed": approach()["speed"] * 1.08,
    },
    "standing": {name: column * 0 for name, column in approach().items()},
    "two samples": {name: column[:2] for name, column in approach().items()},
}


@pytest.mark.parametrize("name", HONEST)
def test_honest_traces_agree(name: str) -> None:
    assert contradiction_of_speeds(HONEST[name], STEP) is None
    assert not lag_of_speed(HONEST[name], STEP)


@pytest.mark.parametrize("decel", [2.0, 6.0])
@pytest.mark.parametrize("step", [0.01, 0.1, 0.5])
@pytest.mark.parametrize(
    ("own", "others", "relative", "expected"),
    [
        (3.6, 1.0, 0.0, "speeds in m/s, not in km/h: a gap [m]"),
        (1 / 3.6, 1.0, 0.0, "a gap [m] that changes by obstacle_speed - speed"),
        (1.0, -1.0, 0.0, "a gap [m] that changes by obstacle_speed - speed"),
        (1.0, 1.0, 1.0, "a gap [m] that changes by obstacle_speed - speed"),
    ],
)
def test_a_mistake_is_found(
    own: float, others: float, relative: float, expected: str, step: float, decel: float
) -> None:
    """Behind a slow car: speeds in km/h or divided by 3.6 twice, an obstacle's speed with the wrong
    sign or relative to the vehicle. The car that brakes hard stands in the second half of the run.
    """
    columns = approach(step, obstacle=6.0, decel=decel)
    del columns["position"]
    speed = columns["speed"]
    columns["speed"] = speed * own
    columns["obstacle_speed"] = columns["obstacle_speed"] * others - relative * speed
    wrong = contradiction_of_speeds(columns, step)
    assert wrong is not None
    assert "speed and gap disagree" in wrong.problem
    assert wrong.expected.startswith(expected)


def test_the_ways_are_told_as_numbers() -> None:
    """The gap shrinks by the way until the vehicle stands, and the speeds say 3.6 times as much."""
    columns = approach()
    del columns["position"]
    wrong = contradiction_of_speeds({**columns, "speed": columns["speed"] * 3.6}, STEP)
    assert wrong is not None
    driven = 15 + 15**2 / 12
    assert f": {3.6 * driven:.3g} m and {driven:.3g} m of way" in wrong.problem


def test_speeds_of_both_bodies_may_be_in_kmh() -> None:
    columns = approach(obstacle=2.0)
    del columns["position"]
    for name in ("speed", "obstacle_speed"):
        columns[name] = columns[name] * 3.6
    wrong = contradiction_of_speeds(columns, STEP)
    assert wrong is not None
    assert wrong.expected.startswith("speeds in m/s, not in km/h")


@pytest.mark.parametrize(("samples", "word"), [(1, "late"), (-1, "early")])
def test_a_speed_of_another_sample_is_found(samples: int, word: str) -> None:
    """Also if the first speeds are those of the end, as `np.roll` leaves them."""
    columns = approach()
    columns["speed"] = np.roll(columns["speed"], samples)
    assert contradiction_of_speeds(columns, STEP) is None
    assert f"1 sample {word} beside its position" in lag_of_speed(columns, STEP)
    del columns["position"]
    assert f"1 sample {word} beside its gap" in lag_of_speed(columns, STEP)
