"""Who avoids a failure, and whether it is robust: by neighbours, by reference drivers, at the
points of a matrix; and when a vehicle begins to brake.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import pytest
from msgspec.structs import replace

from safevar_sumo.api.simulation import load_study
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.braking import brake_onset
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain.failures import compare_at_points
from safevar_sumo.questions.explain.robustness import robust_shares
from safevar_sumo.questions.explain.tell import avoidance
from safevar_sumo.questions.preventability import (
    TITLES,
    assess_collisions,
    assess_sample,
    avoided_by,
    drivers_frame,
)
from safevar_sumo.questions.sampling import clopper_pearson
from safevar_sumo.questions.sentence import Verdict
from safevar_sumo.records import Evaluations, FloatArray, SimulationRuns
from safevar_sumo.study import ModelTable, ScenarioTable
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from tests.support.in_process import SLOW, InlinePool
from tests.support.made_up import made_up_runs, original_of
from tests.support.made_up_studies import box, made_up_evaluator

pytestmark = pytest.mark.usefixtures("made_up_studies")

COLLISION = Unsafe()


def test_robust_is_what_its_neighbours_are_too() -> None:
    evaluator = made_up_evaluator(2, box)
    threshold = evaluator.characteristics.threshold[0]
    deep, edge = robust_shares(evaluator, np.array([[9.0, 1.0], [7.0, 1.0]]), COLLISION)
    assert deep == 1.0
    assert edge == pytest.approx(0.5, abs=0.2)
    (beyond,) = robust_shares(
        evaluator, np.array([[7.0 + 1.01 * threshold, 1.0]]), COLLISION
    )
    assert beyond == 1.0


STUDY = load_study("euro_ncap_pedestrian")
BLIND = ModelTable(model="aeb", parameters={"reach": 3.0})
MEMBERS = CharacteristicSet.of(STUDY)


def evaluator(**parameters: object) -> Evaluator:
    """A short-sighted driving system in one scenario."""
    scenario = ScenarioTable(model="crossing", parameters=parameters)
    return Evaluator(
        replace(STUDY, matrix=None, ads=BLIND, scenario=scenario), InlinePool()
    )


def vehicle(brakes: float = 1.0, max_rpm: float = 1.0) -> FloatArray:
    """The original vehicle with these shares of its brakes (and engine drag) and of its maximum
    speed of the engine.
    """
    factors = {"maxBrakeTorque": brakes, "dampRateZeroT_CE": brakes, "max_rpm": max_rpm}
    return MEMBERS.original * [factors.get(name, 1.0) for name in MEMBERS.names]


def collisions(here: Evaluator, *settings: FloatArray) -> Evaluations:
    """The evaluations of settings that collide."""
    evaluations = here.evaluate(np.array(settings), "collisions")
    assert evaluations.collided.all()
    return evaluations


def avoiders(here: Evaluator, *settings: FloatArray) -> list[str]:
    """The weakest driver who avoids each collision."""
    assessed = assess_collisions(here, collisions(here, *settings))
    return [avoided_by(row) for row in assessed.to_dict("records")]


def verdicts(
    *drivers: Sequence[float], points: Sequence[str] | None = None
) -> pd.DataFrame:
    """Made-up verdicts of all drivers, in their order."""
    return pd.DataFrame(dict(zip(TITLES, drivers, strict=True))).assign(
        point=points or ""
    )


def test_what_drivers_avoid_is_counted_among_the_collisions_with_a_verdict() -> None:
    many = verdicts([1.0] + [0.0] * 42 + [np.nan] * 1336, [1.0] * 1061 + [0.0] * 318)
    assert Verdict(avoidance(many)) == (
        "A competent driver (as in UN R157) in the same vehicle would have avoided 1 of 43"
        " collisions with a verdict (1,379 were examined). Full braking at the first possible"
        " moment would have avoided 1,061 of 1,379 examined collisions."
    )
    assert not [*avoidance(verdicts([np.nan], [np.nan]))]


def test_who_has_no_verdict_is_counted_with_the_points() -> None:
    """A competent driver collides in the original vehicle at the point b."""
    nan = np.nan
    two = verdicts([1.0, nan], [1.0, 1.0], points=["a", "b"])
    rows = drivers_frame(two, 2).to_dict("records")
    assert [
        (row["avoided"], row["no_verdict"], row["no_verdict_points"]) for row in rows
    ] == [
        (1, 1, ["b"]),
        (2, 0, []),
    ]
    only_full, nobody = verdicts([nan], [1.0]), verdicts([nan], [nan])
    assert avoided_by(only_full.iloc[0].to_dict()) == "full braking"
    assert avoided_by(nobody.iloc[0].to_dict()) == "no verdict"
    assert (
        drivers_frame(nobody, 1)[["share", "share_low", "share_high"]]
        .isna()
        .all(axis=None)
    )


@SLOW
def test_a_competent_driver_avoids_what_a_short_sighted_system_does_not() -> None:
    found = avoiders(evaluator(test="CPFA", speed=30), vehicle(), vehicle(brakes=0.1))
    assert found == ["competent driver", "nobody"]


@SLOW
def test_behind_a_leader_that_brakes_with_4_a_competent_driver_has_no_verdict() -> None:
    tests = [
        {"name": "CCRb", "parameters": {"test": "CCRb"}, "over": {"speed": [40, 50]}}
    ]
    study = load_study("euro_ncap_car_to_car", matrix={"tests": tests})
    here = Evaluator(replace(study, ads=BLIND), InlinePool())
    found = drivers_frame(
        *assess_sample(
            here, collisions(here, vehicle(brakes=0.95), vehicle(brakes=0.9))
        )
    )
    letter = found.to_dict("records")[0]
    assert letter["no_verdict"] == 2
    assert np.isnan(letter["share"])
    (point,) = letter["no_verdict_points"]
    assert point.startswith("CCRb, speed 50")


@SLOW
def test_shares_are_those_of_all_collisions_and_a_sample_is_random() -> None:
    """Of 30 collisions, the 20 of the lowest engine speeds are the brakeless ones: those that come
    first when settings are sorted.
    """
    here = evaluator(test="CPFA", speed=30)
    brakeless = (vehicle(0.1, 1 - (30 - k) / 1e6) for k in range(20))
    every = collisions(
        here, *brakeless, *(vehicle(1.0, 1 - k / 1e6) for k in range(10))
    )
    whole, number = assess_sample(here, Evaluations.concatenate([every, every]))
    assert (len(whole), number) == (30, 30)
    letter = drivers_frame(whole, number).iloc[0]
    assert (letter["avoided"], letter["no_verdict"]) == (10, 0)
    assert [letter[name] for name in ("share", "share_low", "share_high")] == [
        pytest.approx(1 / 3)
    ] * 3
    sample, number = assess_sample(here, every, max_sample=15)
    assert (len(sample), number) == (15, 30)
    pd.testing.assert_frame_equal(
        sample, assess_sample(here, every.take(np.arange(30)[::-1]), max_sample=15)[0]
    )
    letter = drivers_frame(sample, number).iloc[0]
    low, high = clopper_pearson(letter["avoided"], 15)
    assert (letter["share_low"], letter["share_high"]) == pytest.approx((low, high))
    assert low < 1 / 3 < high


TESTS = [
    {
        "name": "CPLA",
        "model": "along",
        "over": {"speed": [20, 40]},
        "weathers": ["clear", "night"],
    },
    {"name": "CPFA", "parameters": {"test": "CPFA"}, "over": {"speed": [30]}},
]


def test_both_vehicles_are_compared_at_the_point_where_the_failure_is_worst() -> None:
    """The failed vehicle has half the brakes."""
    system = assemble(load_study("euro_ncap_pedestrian", matrix={"tests": TESTS}))
    weak = vehicle()[np.newaxis]
    weak[0, MEMBERS.names.index("maxBrakeTorque")] /= 2
    ((endings, unsafe_points),) = compare_at_points(system, weak, COLLISION)
    at = next(
        point
        for point in system.points
        if endings.startswith(f"In the test case {point.name}, ")
    )
    assert at.name in unsafe_points
    original = drive_and_score(system.at(at), original_of(system)).f_safe[0]
    assert (
        endings
        == f"In the test case {at.name}, the original vehicle stops, with a safety degree"
        f" (smallest distance) of {original:.2f} m. The failed vehicle collides at "
        f"{-drive_and_score(system, weak).f_safe[0]:.2f} m/s."
    )


STEP, SPEED, OBSTACLE = 0.002, 10.0, 20.0


def drives_of(commanded: list[float], collision_speed: list[float]) -> SimulationRuns:
    """Vehicles at 10 m/s towards an obstacle at 20 m. They brake by 6 m/s^2, from 0.2 s after the
    gap at which this is commanded.
    """
    time = np.arange(0, 8, STEP)[:, np.newaxis]
    begins = (OBSTACLE - np.array(commanded)) / SPEED
    braking = np.maximum(time - begins - 0.2, 0)
    speed = np.maximum(SPEED - 6 * braking, 0)
    gap = OBSTACLE - (np.cumsum(speed, axis=0) - SPEED) * STEP
    columns = {"brake": 1.0 * (time >= begins), "active": gap > 0}
    return made_up_runs(STEP, speed, gap, np.array(collision_speed), **columns)


def test_an_overshooting_cruise_control_does_not_brake_for_the_obstacle() -> None:
    """Two overshoot; the throttle ends that, or a brake that fades until the hazard. The last one
    does nothing else before it collides.
    """
    runs = drives_of([15.0, 15.0, 15.0, -5.0], [np.nan, np.nan, np.nan, SPEED])
    runs.trace.brake[50:150, 1:3] = 0.5
    runs.trace.throttle[150:200, 1] = 0.1
    runs.trace.brake[150:250, 2:] = 0.01
    plain, overshot, settling, unbraked = (
        brake_onset(runs, column) for column in range(4)
    )
    assert overshot == settling == plain
    assert plain is not None
    assert runs.trace.gap[plain, 0] == pytest.approx(15.0)
    assert unbraked is None
