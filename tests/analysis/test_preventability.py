"""Who avoids a failure, and whether it is robust: by neighbours, by reference drivers, at the points of a matrix; and
what makes a changed vehicle brake worse than the original, in parts of the lost distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import scipy

from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.analysis.explain.braking_comparison import (
    MIN_PART,
    BrakingComparison,
    compare_braking,
    measure_braking,
)
from safevar_sumo.analysis.explain.causes import (
    STEP_FACTORS,
    Robustness,
    estimate_robustness,
    find_smallest_robust_failure,
)
from safevar_sumo.analysis.explain.compute import PointComparison, compare_at_points
from safevar_sumo.analysis.preventability import (
    Preventability,
    PreventableBy,
    assess_preventability,
    classify_collisions,
)
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import Evaluations, FloatArray, SimulationRuns
from safevar_sumo.study import ModelTable, load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import System, assemble
from tests.analysis.known_regions import box, made_up_evaluator
from tests.in_process import InlinePool
from tests.made_up import made_up_runs, original_of

COLLISION = Unsafe()


def test_robust_is_what_its_neighbours_are_too() -> None:
    evaluator = made_up_evaluator(2, box)
    threshold = evaluator.characteristics.threshold[0]
    deep, edge = estimate_robustness(evaluator, np.array([[9.0, 1.0], [7.0, 1.0]]), 0.1, COLLISION)
    assert deep.shares_by_step == {0.1: 1.0, 0.05: 1.0, 0.2: 1.0}
    assert edge.share == pytest.approx(0.5, abs=0.2)
    assert (deep.borderline, edge.borderline) == (False, True)
    (beyond,) = estimate_robustness(evaluator, np.array([[7.0 + 1.01 * threshold, 1.0]]), 0.1, COLLISION)
    assert beyond.share == 1.0


@pytest.mark.parametrize(
    ("shares", "row"),
    [
        ([(0.5, 1.0, 1.0), (0.9, 0.9, 0.9)], 0),
        ([(0.39, 1.0, 1.0), (0.9, 0.9, 0.9)], 1),
        ([(0.9, 0.6, 0.8), (0.41, 1.0, 1.0)], 1),
        ([(0.79, 0.79, 0.79), (1.0, 1.0, 0.3)], None),
    ],
)
def test_a_failure_is_robust_by_the_mean_of_all_time_steps(
    shares: list[tuple[float, ...]], row: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the study's own time step says, if the other steps can make up for it."""
    evaluator, factors_of_calls = made_up_evaluator(2, box), []

    def estimates(
        _: Evaluator, settings: FloatArray, step: float, unsafe: Unsafe, factors: Sequence[float]
    ) -> list[Robustness]:
        factors_of_calls.append((len(settings), tuple(factors)))
        return [
            Robustness({step * factor: shares[int(setting[0]) - 8][STEP_FACTORS.index(factor)] for factor in factors})
            for setting in settings
        ]

    monkeypatch.setattr("safevar_sumo.analysis.explain.causes.estimate_robustness", estimates)
    failures = evaluator.evaluate(np.array([[8.0, 1.0], [9.0, 1.0]]), "failures")
    assert find_smallest_robust_failure(evaluator, failures, 0.1, COLLISION, max_evaluations=1) == row
    candidates = sum(first > 0.39 for first, *_ in shares)
    assert factors_of_calls == [(2, STEP_FACTORS[:1]), (candidates, STEP_FACTORS[1:])]


STUDY = load_study("euro_ncap_pedestrian")
BLIND = ModelTable(model="aeb", parameters={"reach": 3.0})
NAMES = list(STUDY.vehicle.characteristics)
ORIGINAL = np.array([one.original for one in STUDY.vehicle.characteristics.values()])


def evaluator(**parameters: object) -> Evaluator:
    """A short-sighted driving system in one scenario."""
    scenario = ModelTable(model="crossing", parameters=parameters)
    return Evaluator(msgspec.structs.replace(STUDY, matrix=None, ads=BLIND, scenario=scenario), InlinePool())


def vehicle(brakes: float = 1.0, max_rpm: float = 1.0) -> FloatArray:
    """The original vehicle with these shares of its brakes (and engine drag) and of its maximum speed of the engine."""
    factors = {"maxBrakeTorque": brakes, "dampRateZeroT_CE": brakes, "max_rpm": max_rpm}
    return ORIGINAL * [factors.get(name, 1.0) for name in NAMES]


def collisions(here: Evaluator, *settings: FloatArray) -> Evaluations:
    """The evaluations of settings that collide."""
    evaluations = here.evaluate(np.concatenate([np.atleast_2d(one) for one in settings]), "collisions")
    assert evaluations.collided.all()
    return evaluations


def categories(here: Evaluator, *settings: FloatArray) -> list[PreventableBy | None]:
    """The weakest driver who avoids each collision."""
    return [avoidance and avoidance[0] for avoidance in classify_collisions(here, collisions(here, *settings))]


def test_shares_are_told_as_a_range_over_reaction_times_with_two_digits() -> None:
    by = PreventableBy
    for counts, later, number, collisions, shares, others in (
        ({by.COMPETENT_DRIVER: 5, by.FULL_BRAKING: 1, by.NOBODY: 1}, 3, 7, "7", "71 % (43 %", "14 %; nobody: 14 %"),
        (
            {by.COMPETENT_DRIVER: 999, by.FULL_BRAKING: 1},
            390,
            3000,
            "1000",
            "nearly all (39 %",
            "hardly any; nobody: none",
        ),
        ({by.FULL_BRAKING: 17}, 0, 17, "17", "none (none", "all; nobody: none"),
    ):
        sample = ", drawn at random from 3000" if number == 3000 else ""
        assert str(Preventability(counts=counts, collisions=number, later=later)) == (
            f"In the same vehicle, of {collisions} collisions{sample}, a competent driver avoids {shares} if he needs "
            f"0.4 s longer); only full braking at the first possible moment: {others}."
        )


@pytest.mark.slow
def test_a_competent_driver_avoids_what_a_short_sighted_system_does_not_and_nobody_stops_without_brakes() -> None:
    found = categories(evaluator(test="CPFA", speed=30), vehicle(), vehicle(brakes=0.1))
    assert found == [PreventableBy.COMPETENT_DRIVER, PreventableBy.NOBODY]


@pytest.mark.slow
def test_a_child_that_comes_out_late_is_avoided_by_full_braking_alone() -> None:
    assert categories(evaluator(test="CPNCO", speed=40), vehicle()) == [PreventableBy.FULL_BRAKING]


@pytest.mark.slow
def test_shares_are_those_of_all_collisions_and_a_sample_is_random() -> None:
    """Of 30 collisions, the 20 of the lowest engine speeds are the brakeless ones: those that come first when settings
    are sorted.
    """
    here = evaluator(test="CPFA", speed=30)
    brakeless = (vehicle(0.1, 1 - (30 - k) / 1e6) for k in range(20))
    every = collisions(here, *brakeless, *(vehicle(1.0, 1 - k / 1e6) for k in range(10)))
    whole = assess_preventability(here, Evaluations.concatenate([every, every])).to_dict()
    assert whole == {
        "competent_driver": pytest.approx(1 / 3),
        "full_braking": 0,
        "nobody": pytest.approx(2 / 3),
        "looked_at": 30,
        "interval_competent_driver": [pytest.approx(1 / 3)] * 2,
        "later": pytest.approx({"reaction": 1.15, "competent_driver": 1 / 3}),
    }
    sample = assess_preventability(here, every, max_simulations=45).to_dict()
    assert sample["looked_at"] == 15
    reverse = every.take(np.arange(30)[::-1])
    assert sample == assess_preventability(here, reverse, max_simulations=45).to_dict()
    hits = round(sample["competent_driver"] * 15)
    expected = scipy.stats.beta.ppf(0.025, hits, 16 - hits), scipy.stats.beta.ppf(0.975, hits + 1, 15 - hits)
    assert sample["interval_competent_driver"] == pytest.approx(expected)
    assert expected[0] < 1 / 3 < expected[1]


TESTS = [
    {"name": "CPLA", "model": "along", "over": {"speed": [20, 40]}, "weathers": ["clear", "night"]},
    {"name": "CPFA", "parameters": {"test": "CPFA"}, "over": {"speed": [30]}},
]


@pytest.fixture(scope="module")
def system() -> System:
    return assemble(load_study("euro_ncap_pedestrian", matrix={"tests": TESTS}))


@pytest.fixture(scope="module")
def weak(system: System) -> FloatArray:
    """Half the brakes."""
    setting = system.characteristics.original.copy()
    setting[system.characteristics.names.index("maxBrakeTorque")] /= 2
    return setting[np.newaxis]


@pytest.fixture(scope="module")
def failure(system: System, weak: FloatArray) -> PointComparison:
    (one,) = compare_at_points(system, original_of(system), weak, Unsafe())
    return one


def test_both_vehicles_are_compared_at_the_point_where_the_failure_is_worst(
    system: System, weak: FloatArray, failure: PointComparison
) -> None:
    at = next(point for point in system.points if point.name == failure[0].point)
    original = evaluate(system.at(at), original_of(system)).f_safe[0]
    assert str(failure[0]).startswith(
        f"At {at.name}: the original stops, safety degree {original:.2f} m; this one collides at "
        f"{-evaluate(system, weak).f_safe[0]:.2f} m/s."
    )
    least = failure[0]._replace(parts={"gap": MIN_PART, "remainder": 0.0})
    assert f" {MIN_PART:.2f} m because" in str(least)


STEP, OBSTACLE = 0.002, 20.0
Vehicle = tuple[float, float, float, float]


def drive_of(*vehicles: Vehicle) -> SimulationRuns:
    """Vehicles of (speed, gap at which the brake is commanded, delay, deceleration) towards an obstacle at 20 m."""
    time = np.arange(0, 8, STEP)
    drives = []
    for v, gap, delay, deceleration in vehicles:
        begins = (OBSTACLE - gap) / v
        slows, stands = begins + delay, begins + delay + v / deceleration
        braking = np.clip(time, slows, stands) - slows
        place = v * np.minimum(time, stands) - deceleration * braking**2 / 2
        drives.append((v - deceleration * braking, place, 1.0 * (time >= begins), 1.0 * (time >= slows)))
    speed, place, brake, pedal = (np.stack(part, axis=1) for part in zip(*drives, strict=True))
    hit = place >= OBSTACLE
    collision_speed = np.where(hit.any(axis=0), speed[np.argmax(hit, axis=0), np.arange(len(vehicles))], np.nan)
    active = np.cumsum(hit, axis=0) <= 1
    gap, throttle = OBSTACLE - place, np.zeros_like(speed)
    columns = {"position": place, "throttle": throttle, "brake": brake, "pedal": pedal, "active": active}
    return made_up_runs(STEP, speed, gap, collision_speed, **columns)


def compared(one: Vehicle, other: Vehicle) -> BrakingComparison:
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
def test_one_difference_is_one_part(other: Vehicle, part: str, lost: float) -> None:
    comparison = compared(SAME, other)
    assert comparison.parts[part] == pytest.approx(lost, abs=0.05)
    assert all(abs(value) < 0.05 for name, value in comparison.parts.items() if name != part)


def test_a_vehicle_that_slows_down_as_if_it_coasted_does_not_brake() -> None:
    """13 m at 0.09 m/s^2, and at 0.11 m/s^2."""
    coasting, braking = (compared(SAME, (10.0, 15.0, 0.2, deceleration)).changed for deceleration in (0.09, 0.11))
    assert coasting is None
    assert braking is not None


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
