"""Speeds and ways of a trace: what honest simulators return agrees, however they sample and
integrate; mistakes are found, and told by their names.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pytest

from safevar_sumo.records import FloatArray
from safevar_sumo.scenarios.trace_ways import contradiction_of_speeds, lag_of_speed

Columns = Mapping[str, FloatArray]
STEP = 0.05


def braking(
    time: FloatArray, start: float, begin: float, decel: float
) -> tuple[FloatArray, FloatArray]:
    """Speed and way of a body that brakes from a time on, in closed form."""
    braked = np.clip(time - begin, 0.0, start / decel)
    speed = start - decel * braked
    way = start * np.minimum(time, begin) + start * braked - decel * braked**2 / 2
    # The first term ends when the body begins to brake, the others when it stands.
    return speed, way


def approach(
    step: float = STEP, obstacle: float = 0.0, decel: float = 6.0, apart: float = 60.0
) -> dict[str, FloatArray]:
    """A car at 15 m/s comes to an obstacle that drives at a constant speed, and brakes."""
    time = np.arange(0.0, 8.0, step)
    speed, way = braking(time, 15.0, 1.0, decel)
    return {
        "speed": speed,
        "position": way,
        "gap": apart + obstacle * time - way,
        "obstacle_speed": np.full(len(time), obstacle),
    }


def euler(first: bool) -> Columns:
    """A car that brakes, in steps that move it by the speed before or after the step."""
    columns = approach()
    speed = columns["speed"]
    steps = speed[:-1] if first else speed[1:]
    way = np.append(0.0, np.cumsum(steps) * STEP)
    return {**columns, "position": way, "gap": 60.0 - way}


def both_brake() -> Columns:
    """Two cars brake alike, one in steps by the speed before, the other by the speed after."""
    columns = approach()
    speed = columns["speed"]
    own = np.append(0.0, np.cumsum(speed[:-1]) * STEP)
    others = np.append(0.0, np.cumsum(speed[1:]) * STEP)
    return {"speed": speed, "gap": 20.0 + others - own, "obstacle_speed": speed}


def wall() -> Columns:
    """A car at 15 m/s hits a wall: the speed jumps to 0, and the gap ends at 0."""
    columns = approach(apart=9.0)
    gap = np.maximum(columns["gap"], 0.0)
    speed = np.where(gap > 0, columns["speed"], 0.0)
    return {"speed": speed, "gap": gap, "obstacle_speed": columns["obstacle_speed"]}


def turning() -> Columns:
    """The car ahead turns off after 5 s. Its speed is that on its own path, its gap that along the
    lane: for its last 2 s it hardly moves along the lane, and then it is gone.
    """
    time = np.arange(0.0, 8.0, STEP)
    along = 10 * np.cos(np.clip((time - 5) / 2, 0, 1) * np.pi / 2)
    gap = 30 + np.append(0.0, np.cumsum(along[:-1] - 12) * STEP)
    return {
        "speed": np.full(len(time), 12.0),
        "gap": np.where(time < 7, gap, np.inf),
        "obstacle_speed": np.full(len(time), 10.0),
    }


def next_obstacle() -> Columns:
    """The first obstacle leaves after 2 s: the gap is then that of a car 40 m farther."""
    columns = approach(obstacle=3.0)
    time = np.arange(len(columns["speed"])) * STEP
    return {**columns, "gap": columns["gap"] + np.where(time > 2, 40.0, 0.0)}


def rounded() -> Columns:
    """A log with one decimal."""
    return {name: np.round(column, 1) for name, column in approach().items()}


def slipping() -> Columns:
    """A speed of the wheels, which turn 8 % too fast."""
    columns = approach(obstacle=12.0)
    return {**columns, "speed": columns["speed"] * 1.08}


def standing() -> Columns:
    """A car stands the whole time, and its gap has rounding errors."""
    columns = {name: column * 0 for name, column in approach().items()}
    gap = 10 + np.random.default_rng(1).normal(0, 0.01, len(columns["speed"]))
    return {**columns, "gap": gap}


HONEST: dict[str, Callable[[], Columns]] = {
    "closed form": approach,
    "coarse sampling": lambda: approach(1.0),
    "speed before the step": lambda: euler(first=True),
    "speed after the step": lambda: euler(first=False),
    "two ways to integrate": both_brake,
    "jump at an impact": wall,
    "brakes at once": lambda: approach(decel=500.0),
    "turning obstacle": turning,
    "next obstacle": next_obstacle,
    "oncoming": lambda: approach(obstacle=-10.0, apart=200.0),
    "leading": lambda: approach(obstacle=12.0),
    "log with one decimal": rounded,
    "speed of slipping wheels": slipping,
    "standing": standing,
    "two samples": lambda: {name: column[:2] for name, column in approach().items()},
}


@pytest.mark.parametrize("name", HONEST)
def test_honest_traces_agree(name: str) -> None:
    columns = HONEST[name]()
    step = 1.0 if "coarse" in name else STEP
    assert contradiction_of_speeds(columns, step) is None
    assert not lag_of_speed(columns, step)


MISTAKES: dict[str, Callable[[Columns], FloatArray]] = {
    "speed: a speed in km/h": lambda it: it["speed"] * 3.6,
    "speed: a speed that was divided by 3.6 twice": lambda it: it["speed"] / 3.6,
    "obstacle_speed: an obstacle_speed in km/h": lambda it: it["obstacle_speed"] * 3.6,
    "obstacle_speed: an obstacle_speed with the wrong sign": lambda it: (
        -it["obstacle_speed"]
    ),
    "obstacle_speed: an obstacle_speed relative to the vehicle": lambda it: (
        it["obstacle_speed"] - it["speed"]
    ),
    "obstacle_speed: an obstacle_speed that is the closing speed": lambda it: (
        it["speed"] - it["obstacle_speed"]
    ),
}


@pytest.mark.parametrize("decel", [2.0, 6.0])
@pytest.mark.parametrize("step", [0.01, 0.1, 0.5])
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_told_by_its_name(mistake: str, step: float, decel: float) -> None:
    """Behind a slow car; the vehicle that brakes hard stands in the second half of the run."""
    obstacle = 2.0 if "closing" in mistake else 6.0
    columns = approach(step, obstacle, decel)
    del columns["position"]
    name, _, words = mistake.partition(": ")
    wrong = contradiction_of_speeds({**columns, name: MISTAKES[mistake](columns)}, step)
    assert wrong is not None
    assert "gap disagree" in wrong.problem
    assert f"({words} would explain the difference)" in wrong.expected


def test_the_ways_are_told_as_numbers() -> None:
    """The gap shrinks by the way until the vehicle stands, and the speeds say 3.6 times as much."""
    columns = approach()
    del columns["position"]
    wrong = contradiction_of_speeds({**columns, "speed": columns["speed"] * 3.6}, STEP)
    assert wrong is not None
    driven = 15 + 15**2 / 12
    assert f": {3.6 * driven:.3g} m and {driven:.3g} m of way" in wrong.problem


@pytest.mark.parametrize(
    ("samples", "words"),
    [(1, "1 sample late"), (2, "2 samples late"), (-1, "1 sample early")],
)
def test_a_speed_of_another_sample_is_found(samples: int, words: str) -> None:
    """Also if the first speeds are those of the end, as `np.roll` leaves them."""
    columns = approach()
    shifted = {**columns, "speed": np.roll(columns["speed"], samples)}
    assert contradiction_of_speeds(shifted, STEP) is None
    for distance in ("position", "gap"):
        alone = {name: shifted[name] for name in ("speed", distance)}
        alone["obstacle_speed"] = columns["obstacle_speed"]
        assert f"{words} beside its {distance}" in lag_of_speed(alone, STEP)
