"""Scenarios of tracks: who is seen, hit, passed and measured among several bodies, by formulas and
by hand.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from safevar_sumo.ads import Aeb
from safevar_sumo.errors import InputError
from safevar_sumo.records import Outcome, SimulationRuns
from safevar_sumo.scenarios import Track, TrackScenario, travelled
from safevar_sumo.sumo.bodies import Body, distance_between, find_overlaps
from safevar_sumo.sumo.moving import Moving
from tests.support.holding import Hold, driven

LENGTH, WIDTH = 4.9016, 2.1284
SPEED = 72.0 / 3.6


class Cast(TrackScenario):
    """Bodies that a test names, around a vehicle at 72 km/h."""

    def __init__(
        self, *cast: Any, duration: float = 6.0, test_speed: float | None = None
    ) -> None:
        # type: ignore[misc]
        self.cast = cast
        self.duration = duration
        self.speed = 72.0
        self.test_speed = test_speed

    def tracks(self, times: np.ndarray) -> list[Track]:
        return [one(times) for one in self.cast]


def moving(
    name: str, x: float, y: float, vx: float, vy: float, kind: str = "car"
) -> Any:
    return lambda times: Track.of(name, kind, x + vx * times, y + vy * times, vx, vy)


def held(*cast: Any, **parameters: Any) -> SimulationRuns:
    """The run of a vehicle that keeps its speed."""
    return driven(Cast(*cast, **parameters), Hold())


def test_a_cast_of_five_is_hit_by_whoever_comes_first() -> None:
    """An oncoming car in the next lane, a trailer across it behind, an overtaking car, two
    pedestrians: the second is in the way at 60 m.
    """
    cast = [
        moving("oncoming", 150.0, 3.5, -15.0, 0.0),
        lambda times: Track("trailer", "trailer", 12.0, 2.5, 90.0, 9.0, 0.0, 1.0, 0.0),
        moving("overtaking", -20.0, 3.5, 30.0, 0.0),
        moving("first", 40.0, -4.0, 0.0, 4.0, "adult"),
        moving("second", 60.0, -4.0, 0.0, 1.2, "adult"),
    ]
    run = held(*cast)
    assert run.outcome[0] == Outcome.COLLISION
    end = run.trace.last_active[0]
    assert run.trace.time[end] == pytest.approx(
        math.ceil((60 - 0.25) / SPEED / 0.05) * 0.05
    )
    assert run.trace.lateral[end, 0] == pytest.approx(-4.0 + 1.2 * run.trace.time[end])
    gone = held(*cast[:4])
    assert gone.outcome[0] == Outcome.PASSED
    nearest = math.sqrt(0.0 + (3.5 - WIDTH / 2 - 1.712 / 2) ** 2)
    assert run.encounter.separation.shape == run.trace.speed.shape
    assert np.nanmin(gone.encounter.separation[gone.trace.active]) >= min(nearest, 0.5)


def test_who_is_not_there_neither_moves_nor_jumps() -> None:
    late = moving("late", -20.0, 4.0, 30.0, 0.0)
    arrives = held(
        lambda times: late(times)._replace(length=np.where(times < 1, 0.0, 4.0))
    )
    assert arrives.outcome[0] == Outcome.TIMEOUT
    gone = [np.full((1, 1), value) for value in (0.0, 0.0, 60.0, 4.0, 1.0, 0.0, 10.0)]
    assert Moving.of(Track("gone", "car", *gone), 0.05, WIDTH).level.tolist() == [0]
    with pytest.raises(InputError, match="in x from where its speed takes it"):
        held(lambda times: Track.of("stands", "car", 60.0, 4.0, 5.0))


def test_a_contact_at_the_side_counts_but_in_a_test_of_the_front() -> None:
    cast = moving("cutting", -LENGTH / 2, -3.0, SPEED, 0.4)
    run = held(cast)
    assert run.outcome[0] == Outcome.COLLISION
    assert run.contact.side[0] == "right"
    assert held(cast, test_speed=SPEED).outcome[0] != Outcome.COLLISION


@pytest.mark.parametrize(
    ("kind", "middle"), [("adult", 1.15 + 0.25), ("car", 1.15 + 1.712 / 2)]
)
def test_a_driver_watches_his_corridor_up_to_the_bodys_side(
    kind: str, middle: float
) -> None:
    for beside, brakes in ((middle - 0.01, True), (middle + 0.01, False)):
        run = driven(
            Cast(lambda times, y=beside: Track.of("body", kind, 60.0, y)), Aeb()
        )
        assert (run.trace.brake[run.trace.active] == 1).any() == brakes


def body_of(*quantities: Any) -> Body:
    """A body that stands: its middle, its direction and its size."""
    return Body(*(np.array([value], dtype=float) for value in (*quantities, 0.0)))


angles = st.floats(-math.pi, math.pi)


@settings(max_examples=60, deadline=None)
@given(
    x=st.floats(-8, 8),
    y=st.floats(-5, 5),
    angle=angles,
    length=st.floats(0.3, 8),
    width=st.floats(0.3, 3),
)
def test_distance_and_overlap_of_bodies_agree_with_points_on_them(
    x: float, y: float, angle: float, length: float, width: float
) -> None:
    """Points of a grid on one rectangle against the other: a second implementation, coarse as its
    grid.
    """
    cosine, sine = math.cos(angle), math.sin(angle)
    body = Track("b", "car", length, width, x, y, cosine, sine, 0.0)
    distance = float(distance_between(body, np.zeros(1), LENGTH, WIDTH)[0])
    sides = np.linspace(-0.5, 0.5, 81)
    grid = np.array(np.meshgrid(length * sides, width * sides)).reshape(2, -1)
    points = np.array([[cosine, -sine], [sine, cosine]]) @ grid + [[x], [y]]
    outside = np.maximum(np.abs(points) - [[LENGTH / 2], [WIDTH / 2]], 0.0)
    assert distance == pytest.approx(np.hypot(*outside).min(), abs=0.06)
    depth = float(
        find_overlaps(
            body_of([0, 0], [1, 0], LENGTH, WIDTH),
            body_of([x, y], [cosine, sine], length, width),
        )[0]
    )
    assert (depth > 1e-9) == (distance == 0) or abs(depth) < 1e-6


def test_distances_travelled_are_sums_of_trapezes() -> None:
    times = np.arange(5)[:, np.newaxis] * 0.5
    assert travelled(2.0 * times, times)[:, 0].tolist() == [0.0, 0.25, 1.0, 2.25, 4.0]
