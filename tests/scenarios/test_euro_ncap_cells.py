"""Cells of Euro NCAP's tests: time, place and speed of the impact without braking; shipped points
are avoided.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from safevar_sumo.records import Outcome
from safevar_sumo.scenarios import WEATHERS, Along, CarToCar, Crossing, Point
from safevar_sumo.scenarios.tracks import BODIES
from safevar_sumo.sumo import drive
from safevar_sumo.sumo.bodies import FirstContacts
from safevar_sumo.sumo.matrix import simulate_all_points
from tests.support.holding import CARLA, Hold, Pedals, at_contact, driven
from tests.support.in_process import SLOW
from tests.support.made_up import original_of
from tests.support.same_runs import assert_same

KMH = 1 / 3.6
NEAR, FAR = 1, -1


class Cell(NamedTuple):
    """A scenario, and the arrival [s] and relative speed [m/s] by the closed form."""

    scenario: Any
    arrival: float
    relative: float


class Row(NamedTuple):
    """A crossing test of the protocol: side, target speed [km/h], lateral start and run-up [m], and
    headings.
    """

    side: int
    speed: float
    start: float | None
    run_up: float
    headings: tuple[float, ...]


CROSSING = {
    "CPNA": Row(NEAR, 5, 4, 1, (-10, 20)),
    "CPFA": Row(FAR, 8, 6, 1.5, (-10, 20)),
    "CPNCO": Row(NEAR, 5, 4, 1, (20,)),
    "CBNA": Row(NEAR, 15, None, 0, (20,)),
    "CBFA": Row(FAR, 20, None, 0, (-20,)),
    "CBNAO": Row(NEAR, 10, None, 0, (-10, 20)),
}


def crossing(test: str, speed: float, location: float) -> Iterator[Cell]:
    """A cell and its variants; the target arrives after 6 s, or as soon as it can."""
    row = CROSSING[test]
    width = Crossing().vut_width
    variants = [
        {},
        {"start_share": 0.75},
        *({"heading": float(turn)} for turn in row.headings),
    ]
    for variant in variants:
        share = variant.get("start_share", 1.0)
        target_speed_ms = row.speed * KMH
        arrival = 6.0 * share
        if row.start is not None:
            distance = (row.start + (location / 100 - 0.5) * width) * share
            arrival = max(
                6.0, math.ceil((distance + row.run_up) / target_speed_ms * 2) / 2
            )
        forward = (
            -row.side
            * math.sin(math.radians(variant.get("heading", 0.0)))
            * target_speed_ms
        )
        yield Cell(
            Crossing(test=test, speed=speed, impact_location=location, **variant),
            arrival,
            speed * KMH - forward,
        )


def junction(test: str, speed: float, target_speed: float) -> Iterator[Cell]:
    yield Cell(
        Crossing(test=test, speed=speed, target_speed=target_speed), 6.0, speed * KMH
    )


def behind(
    test: str, speed: float, location: float, target_speed: float
) -> Iterator[Cell]:
    """Cells with a standing or slower target and a gap of 5 s."""
    turns = (0.0, -10.0, 20.0) if target_speed == 0 else (0.0,)
    closing = (speed - target_speed) * KMH
    for turn in turns:
        scenario = CarToCar(
            test=test,
            speed=speed,
            target_speed=target_speed,
            impact_location=location,
            heading=turn,
        )
        yield Cell(scenario, 5 * speed * KMH / closing, closing)


def behind_braking(test: str, speed: float, location: float) -> Iterator[Cell]:
    """Headway of 1 s; from 3 s on, the target brakes at b = 4 m/s^2 down to 2 km/h: gap = closing^2
    / (2 b), then a steady speed.
    """
    for headway, deceleration in ((1, 4), (1.5, 4), (0.5, 4), (1, 6), (1, 2)):
        gap = headway * speed * KMH
        closing = min(math.sqrt(2 * deceleration * gap), (speed - 2) * KMH)
        braking_time = (
            closing / deceleration
            + max(gap - closing**2 / (2 * deceleration), 0) / closing
        )
        scenario = CarToCar(
            test=test,
            speed=speed,
            impact_location=location,
            headway=headway,
            target_deceleration=deceleration,
        )
        yield Cell(scenario, 3 + braking_time, closing)


def along(
    test: str, speed: float, location: float, target_speed: float
) -> Iterator[Cell]:
    yield Cell(
        Along(
            test=test, speed=speed, impact_location=location, target_speed=target_speed
        ),
        6.0,
        (speed - target_speed) * KMH,
    )


def edge_cells() -> Iterator[Cell]:
    """One cell of every test and its variants, at the ends of the ranges."""
    for k, test in enumerate(CROSSING):
        yield from crossing(test, (10, 60)[k % 2], (10, 90)[k // 2 % 2])
    yield from junction("CCCscp", 20, 80)
    yield from junction("CMCscp", 80, 30)
    yield from behind("CCRs", 80, 125, 0)
    yield from behind("CCRs", 10, -25, 0)
    yield from behind("CMRs", 50, 10, 0)
    yield from behind("CCRm", 130, 100, 70)
    yield from behind_braking("CMRb", 50, 90)
    yield from behind_braking("CCRb", 130, -25)
    yield from behind_braking(
        "CCRb", 90, 50
    )  # some gaps close just at the end of a step
    yield from along("CBLA", 80, 10, 20)


def middle_beside(scenario: Any) -> float:
    """How far the middle of a rotated body ahead is beside the middle of its rear, which is hit
    [m].
    """
    if not isinstance(scenario, CarToCar):
        return 0.0
    body = BODIES["motorcyclist" if scenario.test.startswith("CM") else "car"]
    return -math.sin(math.radians(scenario.heading)) * body.length / 2


def check(cells: list[Cell]) -> None:
    points = tuple(
        Point(cell.scenario, WEATHERS["clear"], str(k)) for k, cell in enumerate(cells)
    )
    system = replace(CARLA, ads=Hold(), points=points)
    for cell, there in zip(
        cells, simulate_all_points(system, original_of(system)), strict=True
    ):
        run = there.runs
        scenario = cell.scenario
        assert run.outcome[0] == Outcome.COLLISION, scenario
        assert set(run.contact.side) == {"front"}, scenario
        late = at_contact(run, run.trace.time) - cell.arrival
        assert abs(late) * scenario.speed * KMH < 0.05, (late, scenario)
        lateral = at_contact(run, run.trace.lateral[:, 0])
        expected = (
            scenario.impact_location / 100 - 0.5
        ) * scenario.vut_width + middle_beside(scenario)
        assert abs(lateral - expected) < 0.02 * scenario.vut_width, scenario
        middle = 100 * (expected / scenario.vut_width + 0.5)
        assert run.contact.place == pytest.approx(min(max(middle, 0), 100), abs=2), (
            scenario
        )
        assert run.relative_speed[0] == pytest.approx(cell.relative, abs=0.1 * KMH), (
            scenario
        )


@SLOW
def test_impacts_at_the_edges_of_ranges_agree_with_the_closed_forms() -> None:
    check([*edge_cells()])


@pytest.mark.parametrize(
    "scenario",
    [
        Crossing(test="CBNAO", impact_location=90, heading=-10),
        Crossing(test="CBFA", speed=60, impact_location=10, heading=-20),
        Crossing(test="CPNCO", start_share=0.75),
        Crossing(test="CMCscp", speed=20, target_speed=80, impact_location=10),
        CarToCar(test="CCRs", impact_location=125, heading=20),
        CarToCar(test="CMRs", impact_location=10, heading=-10),
        CarToCar(test="CMRb", speed=90, impact_location=90),
        Along(test="CBLA", speed=80, target_speed=20),
    ],
    ids=lambda scenario: scenario.test,
)
def test_targets_are_hit_on_a_lane_as_in_sumo_to_the_last_bit(scenario: Any) -> None:
    """Vehicles that never brake, or brake at any time up to the impact: impacts at the front and
    the corners, and passed targets.
    """
    assert set(hit_at_any_time(scenario)) > {Outcome.COLLISION}


def hit_at_any_time(scenario: Any) -> list[str]:
    """The outcomes of such vehicles, which are the same in SUMO."""
    n = 30
    arrival = driven(scenario).trace.time[-1]
    brakes_at = np.append(
        np.random.default_rng(4).uniform(arrival - 3, arrival + 0.3, n - 1), 99.0
    )
    system = replace(
        CARLA, ads=Hold(brakes_at), points=(Point(scenario, WEATHERS["clear"]),)
    )
    return assert_same(system, np.repeat(original_of(system), n, axis=0))


def test_whoever_walks_into_a_side_hits_the_vehicle_before_it_moves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In SUMO, persons move first. In a test, contacts of the side would not count."""
    monkeypatch.setattr(
        drive, "FirstContacts", lambda n, _: FirstContacts(n, np.zeros(n, dtype=bool))
    )
    scenario = Crossing(test="CPFA", speed=30, impact_location=-30)
    assert hit_at_any_time(scenario).count(Outcome.COLLISION) > 5


def test_a_cyclist_behind_parked_cars_is_seen_past_the_corner_whatever_his_direction() -> (
    None
):
    """The line from the front's middle to the cyclist's middle passes the corner 1 m beside the
    vehicle, 1 m before the impact.
    """
    for heading in (0.0, -10.0, 20.0):
        scenario = Crossing(test="CBNAO", heading=heading)
        trace = driven(scenario).trace
        turned = math.radians(heading)
        reach = (1.9 * abs(math.sin(turned)) + 0.5 * math.cos(turned)) / 2
        before = np.maximum(6.0 - trace.time, 0.0)
        x = trace.gap[:, 0] + reach
        corner = 40 * KMH * before + reach - 1.0
        y = 10 * KMH * before * math.cos(turned)
        hidden = (corner > 0) & (y * corner / x > scenario.vut_width / 2 + 1.0)
        gaps: list[float] = []

        def coast(seen, gaps=gaps):
            gaps.append(seen.gap[0])
            return seen.throttle, seen.brake

        driven(scenario, Pedals(coast))
        assert np.isinf(gaps).tolist() == hidden[: len(gaps)].tolist()
        assert 0.5 < before[np.argmin(hidden)] < 3.0
