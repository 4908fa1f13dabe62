"""Batches: the result of a setting depends on this setting only, and has a typed outcome."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from safevar_sumo.ads.base import DelayLine
from safevar_sumo.records import FloatArray, Outcome
from safevar_sumo.scenarios.base import Scene
from safevar_sumo.study import Weather
from safevar_sumo.sumo.drive import _Outcomes
from safevar_sumo.sumo.matrix import drive_and_score, drive_worst
from safevar_sumo.sumo.perception import Perception
from safevar_sumo.sumo.system import System
from safevar_sumo.sumo.without_effect import without_effect
from tests.support.in_process import EVERY_STUDY, SLOW
from tests.support.made_up import assert_same_results, drawn, original_of, system_of


@SLOW
@pytest.mark.parametrize("study", ["rain", "lgsvl", "native"])
@settings(max_examples=6, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 23), data=st.data())
def test_a_result_depends_neither_on_the_batch_nor_on_its_size(
    study: str, seed: int, n: int, data: st.DataObject
) -> None:
    system = system_of(study)
    population = drawn(system, n, seed)
    together = drive_and_score(system, population)
    some = data.draw(
        st.lists(st.integers(0, n - 1), min_size=1, max_size=n, unique=True)
    )
    for rows in (some, [0]):
        alone = drive_and_score(system, population[rows])
        assert_same_results(together.take(rows), alone)


@pytest.mark.parametrize("name", EVERY_STUDY)
def test_the_original_vehicle_does_not_collide(name: str) -> None:
    """At any point of a matrix. The collisions of one study are what docs/autoware.md is about."""
    system = system_of(name)
    original = drive_and_score(system, original_of(system))
    if name == "autoware_december":
        assert original.outcome[0] == Outcome.COLLISION
        return
    assert original.outcome[0] in (Outcome.STOPPED, Outcome.PASSED)
    # A full braking meets nobody.
    assert original.f_safe[0] > 0 or system.points[0].scenario.brakes_fully
    assert original.f_diff[0] == original.f_num_diff[0] == 0


def test_vehicles_at_the_ends_of_all_domains_move_and_have_a_typed_outcome(
    any_system: System,
) -> None:
    characteristics = any_system.characteristics
    n = len(characteristics)
    ends = np.repeat(characteristics.original_settings, 2 * n, axis=0)
    ends[np.arange(n), np.arange(n)] = characteristics.lower
    ends[np.arange(n, 2 * n), np.arange(n)] = characteristics.upper
    run = drive_worst(any_system, ends[any_system.region.feasible(ends)])
    assert set(run.outcome) <= {
        Outcome.STOPPED,
        Outcome.PASSED,
        Outcome.COLLISION,
        Outcome.TIMEOUT,
    }
    assert np.all(run.trace.speed.max(axis=0) > 1.0)


def judged(
    speeds: list[float], over: int | None = None, **crashes: float
) -> tuple[str, list[bool], float]:
    """Outcome, active samples and collision speed of one vehicle with a speed at each sample; the
    encounter has ended at the sample `over`, and a collision at sample 2 is `at_2`, its speed.
    """
    outcomes = _Outcomes(1)
    active = []
    for i, speed in enumerate(speeds):
        crash = crashes.get(f"at_{i}")
        verdicts = outcomes.note_sample(
            np.array([speed]),
            np.array([i == over]),
            {} if crash is None else {0: crash},
            is_last=np.array([i == len(speeds) - 1]),
        )
        active.append(bool(verdicts[0]))
    assert not outcomes.is_open.any()
    return str(outcomes.classify()[0]), active, float(outcomes.collision_speed[0])


@pytest.mark.parametrize(
    ("speeds", "events", "outcome"),
    [
        ([0, 2, 2], {}, Outcome.TIMEOUT),
        ([0, 0, 0], {}, Outcome.NEVER_MOVED),
        ([0, 0, 0], {"over": 2}, Outcome.NEVER_MOVED),
        ([0, 2, 0], {}, Outcome.STOPPED),
        ([0, 2, 2, 2], {"over": 2}, Outcome.PASSED),
        ([0, 2, 2, 0], {"at_2": 1.5}, Outcome.COLLISION),
        ([0, 0, 0], {"at_1": 0.0}, Outcome.COLLISION),
        ([0, 0, 3, 3], {}, Outcome.TIMEOUT),
        ([3, 0], {}, Outcome.STOPPED),
    ],
)
def test_the_last_samples_determine_the_outcome(
    speeds: list[float], events: dict[str, Any], outcome: Outcome
) -> None:
    assert judged(speeds, **events)[0] == outcome


def test_the_sample_of_a_collision_is_the_last_active_sample() -> None:
    _, active, speed = judged([3, 3, 1, 0], at_1=2.5, at_2=0.5)
    assert active == [True, True, False, False]
    assert speed == 2.5, "the first report is the collision's"


def test_the_sample_in_which_the_encounter_ends_is_active_only_at_a_collision() -> None:
    assert judged([3, 3, 3], over=1)[1] == [True, False, False]
    assert judged([3, 3, 3], over=1, at_1=3.0)[1:] == ([True, True, False], 3.0)


def test_the_last_sample_counts() -> None:
    assert judged([3, 3])[1] == [True, True]


STEP = 0.05
TIMES = np.arange(12) * STEP


def observed(delay: float) -> tuple[FloatArray, FloatArray]:
    """Observed own speeds and (gap, closing speed, lateral, lateral speed) of one vehicle whose
    scene changes linearly.
    """
    perception = Perception(
        [
            Weather(
                name="any", road_friction=1.0, visibility=0.7, recognition_delay=delay
            )
        ],
        STEP,
        1,
    )
    seen = []
    for time in TIMES:
        scene = Scene(
            np.array([20 - 5 * time]),
            np.array([-3 + 2 * time]),
            np.array([2 + time]),
            np.zeros(1, dtype=bool),
        )
        seen.append(perception.observe(float(time), np.array([5 + time]), scene))
    assert all(one.visibility == 0.7 for one in seen)
    return (
        np.array([one.speed[0] for one in seen]),
        np.array(
            [
                [
                    values[0]
                    for values in (
                        one.gap,
                        one.closing_speed,
                        one.lateral,
                        one.lateral_speed,
                    )
                ]
                for one in seen
            ]
        ),
    )


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.0863, 0.1, 0.15])
def test_the_scene_is_observed_with_delay_and_the_own_speed_without(
    delay: float,
) -> None:
    speed, scene = observed(delay)
    then = np.maximum(TIMES - delay, 0.0)
    assert speed == pytest.approx(5 + TIMES)
    if delay in (0.05, 0.15):
        assert np.array_equal(
            scene[4:], observed(0.0)[1][4 - round(delay / STEP) : -round(delay / STEP)]
        ), "whole steps are exact"
    assert scene == pytest.approx(
        np.stack([20 - 5 * then, 5 + then, -3 + 2 * then, 2 + then], axis=1)
    )


def test_an_obstacle_that_appears_is_not_interpolated_from_infinity() -> None:
    perception = Perception(
        [
            Weather(
                name="any", road_friction=1.0, visibility=1.0, recognition_delay=0.03
            )
        ],
        STEP,
        1,
    )
    nothing = np.zeros(1)
    gaps = [
        perception.observe(
            time, nothing, Scene(np.array([gap]), nothing, nothing, nothing > 0)
        ).gap[0]
        for time, gap in zip(TIMES.tolist(), [np.inf, np.inf, 5.0, 4.0], strict=False)
    ]
    assert gaps == pytest.approx([np.inf, np.inf, np.inf, 4.6])


def pressed(hesitation: float, wanted: list[float]) -> list[float]:
    """The brake of one vehicle over time, if its driver wants these brakes."""
    late = DelayLine.by(hesitation, STEP)
    brakes = []
    for brake in wanted:
        sure, late = late.delayed(np.array([brake]))
        brakes.append(float(np.minimum(brake, sure)[0]))
    return brakes


def test_hesitation_delays_braking_but_not_the_release_of_the_brake() -> None:
    wanted = [0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.2, 0.0, 0.0]
    assert pressed(0.0, wanted) == wanted
    assert pressed(0.1, wanted) == [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.2, 0.0, 0.0]
    assert pressed(0.12, wanted) == pytest.approx(
        [0.0, 0.0, 0.0, 0.0, 0.6, 1.0, 1.0, 0.2, 0.0, 0.0]
    )


def test_a_remark_says_that_a_weather_has_no_effect() -> None:
    sentence = "weather 'carla_hard_rain' has no effect"
    for driver, says in (({"model": "full_braking"}, True), ({}, False)):
        remarks = without_effect(system_of("rain", ads=driver))
        assert any(sentence in remark for remark in remarks) is says
    remarks = without_effect(system_of("sun"))
    assert not any("has no effect" in remark for remark in remarks)
