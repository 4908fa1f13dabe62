"""Metrics against closed forms: a vehicle approaches a standing obstacle and brakes evenly, or does not brake."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import F_DIFF, F_NUM_DIFF, F_SAFE, METRICS, Objective, Scoring, Unsafe, time_to_collision
from safevar_sumo.records import Encounter, Evaluations, Outcome, SimulationRuns, Trace
from safevar_sumo.study import OBJECTIVES, MetricsTable
from safevar_sumo.vehicles import CHANGES

STEP = 0.01
THRESHOLDS = MetricsTable(ttc_threshold=2.0)


def braking_run(speed: float, deceleration: float, gap: float, collision_speed: float = np.nan) -> SimulationRuns:
    """One vehicle that brakes from `speed` at once and stands in the end."""
    time = np.arange(0, 10, STEP)
    stop = speed / deceleration
    moving = np.minimum(time, stop)
    v = (speed - deceleration * moving)[:, np.newaxis]
    x = (speed * moving - deceleration * moving**2 / 2)[:, np.newaxis]
    v[time >= stop] = 0
    zero, gaps = np.zeros_like(v), gap - x
    trace = Trace(
        step=STEP,
        vehicle_length=4.0,
        time=time,
        position=x,
        speed=v,
        gap=gaps,
        lateral=zero,
        lateral_speed=zero,
        throttle=zero,
        brake=np.ones_like(v),
        gear=zero,
        active=np.ones_like(v, dtype=bool),
    )
    outcome = Outcome.STOPPED if np.isnan(collision_speed) else Outcome.COLLISION
    return SimulationRuns(
        trace=trace,
        encounter=Encounter(gaps, gaps, v, gaps > 0),
        outcome=np.array([outcome.value]),
        collision_speed=np.array([collision_speed]),
    )


def value(name: str, run: SimulationRuns, thresholds: MetricsTable = THRESHOLDS) -> float:
    return float(METRICS[name](run, thresholds)[0])


def test_safety_degree_is_the_distance_at_standstill() -> None:
    assert value("safety_degree", braking_run(10, 5, 12)) == pytest.approx(2.0)


def test_safety_degree_of_a_collision_is_minus_its_speed() -> None:
    assert value("safety_degree", braking_run(10, 5, 12, collision_speed=3.5)) == -3.5


def test_safety_degree_is_the_least_separation_of_the_encounter_alone() -> None:
    """The encounter ends after 1 s and 7.5 m, at a gap of 4.5 m; the last gap is 2 m. Without an encounter it is
    undefined.
    """
    run = braking_run(10, 5, 12)
    while_it_lasts = run.encounter._replace(in_conflict=run.trace.time[:, np.newaxis] < 1.0)
    assert value("safety_degree", dataclasses.replace(run, encounter=while_it_lasts)) == pytest.approx(
        4.5, abs=10 * STEP
    )
    never = run.encounter._replace(in_conflict=run.trace.gap < 0)
    assert np.isnan(value("safety_degree", dataclasses.replace(run, encounter=never)))


def test_exposed_and_integrated_time_of_even_approach() -> None:
    """At constant speed v from distance d, TTC = d/v - t: TET = TTC*, TIT = TTC*^2 / 2 when it goes on to contact."""
    time = np.arange(0, 5 + STEP / 2, STEP)
    v = np.full((len(time), 1), 4.0)
    gap = 20 - 4.0 * time[:, np.newaxis]
    zero = np.zeros_like(v)
    trace = Trace(
        step=STEP,
        vehicle_length=4.0,
        time=time,
        position=-gap,
        speed=v,
        gap=gap,
        lateral=zero,
        lateral_speed=zero,
        throttle=zero,
        brake=zero,
        gear=zero,
        active=np.ones_like(v, dtype=bool),
    )
    run = SimulationRuns(
        trace=trace,
        encounter=Encounter(gap, gap, v, gap > -1),
        outcome=np.array(["stopped"]),
        collision_speed=np.array([np.nan]),
    )
    assert time_to_collision(run)[0, 0] == pytest.approx(5.0)
    assert value("tet", run) == pytest.approx(2.0, abs=2 * STEP)
    assert value("tit", run) == pytest.approx(2.0, abs=4 * STEP)


def test_a_coarser_sampling_interval_counts_fewer_and_longer_samples() -> None:
    run = braking_run(10, 5, 12)
    fine = value("tet", run)
    coarse = value("tet", run, MetricsTable(ttc_threshold=2.0, sampling_interval=0.2))
    assert coarse == pytest.approx(fine, abs=0.2)
    assert coarse / 0.2 == pytest.approx(round(coarse / 0.2))


def test_exposure_is_undefined_on_a_collision() -> None:
    run = braking_run(10, 5, 12, collision_speed=3.5)
    assert np.isnan(value("tet", run))
    assert np.isnan(value("tit", run))


def test_time_to_collision_ends_with_the_first_standstill() -> None:
    run = braking_run(10, 5, 12)
    still = Encounter(
        run.encounter.separation,
        run.encounter.distance,
        np.ones_like(run.encounter.distance),
        run.encounter.in_conflict,
    )
    ttc = time_to_collision(
        SimulationRuns(trace=run.trace, encounter=still, outcome=run.outcome, collision_speed=run.collision_speed)
    )
    assert np.all(np.isinf(ttc[run.trace.time > 2.0]))


def test_a_vehicle_that_stands_at_the_start_has_a_time_to_collision_once_it_drives() -> None:
    run = braking_run(10, 5, 12)
    speed = np.where(run.trace.time[:, np.newaxis] < 1.0, 0.0, 2.0)
    gap = 20.0 + 0 * speed
    later = dataclasses.replace(
        run, trace=dataclasses.replace(run.trace, speed=speed), encounter=Encounter(gap, gap, speed, gap > 0)
    )
    ttc = time_to_collision(later)[:, 0]
    assert np.isinf(ttc[run.trace.time < 1.0]).all()
    assert ttc[run.trace.time >= 1.0] == pytest.approx(10.0)


def test_a_vehicle_that_never_brakes_has_no_average_deceleration() -> None:
    run = braking_run(10, 5, 12)
    coasting = Trace(
        **{**{name: getattr(run.trace, name) for name in run.trace.__dataclass_fields__}, "brake": run.trace.throttle}
    )
    never = SimulationRuns(
        trace=coasting, encounter=run.encounter, outcome=run.outcome, collision_speed=run.collision_speed
    )
    assert np.isnan(value("ave_dece", never))


def with_end(run: SimulationRuns, after: float) -> SimulationRuns:
    """An equal run in which only the samples before `after` [s] count."""
    return dataclasses.replace(run, trace=dataclasses.replace(run.trace, active=run.trace.time[:, np.newaxis] < after))


@pytest.mark.parametrize("name", ["tet", "tit", "ave_dece"])
def test_samples_that_are_not_active_do_not_count(name: str) -> None:
    run = braking_run(10, 5, 12)
    slower = dataclasses.replace(
        run.trace, speed=np.where(run.trace.time[:, np.newaxis] < 1.0, run.trace.speed, run.trace.speed / 2)
    )
    assert value(name, with_end(run, 0.5)) != value(name, run) or name == "ave_dece"
    assert value(name, with_end(run, 1.0)) == value(name, with_end(dataclasses.replace(run, trace=slower), 1.0))


def test_a_distance_below_zero_is_no_time_to_collision() -> None:
    run = braking_run(10, 5, 12)
    behind = dataclasses.replace(run, encounter=run.encounter._replace(distance=run.encounter.distance - 20))
    assert np.isinf(time_to_collision(behind)).all()
    assert value("tit", behind) == 0


@pytest.mark.parametrize("interval", [STEP / 2, 1.5 * STEP, STEP / 1000, 1e-7])
def test_a_sampling_interval_between_steps_is_refused(interval: float) -> None:
    with pytest.raises(InputError, match="whole multiple"):
        value("tet", braking_run(10, 5, 12), MetricsTable(ttc_threshold=2.0, sampling_interval=interval))


def test_time_to_collision_is_distance_over_closing_speed_and_infinite_while_opening() -> None:
    run = braking_run(10, 5, 12)
    assert time_to_collision(run)[0, 0] == pytest.approx(1.2)
    opening = dataclasses.replace(run, encounter=run.encounter._replace(closing_speed=-run.encounter.closing_speed))
    assert np.isinf(time_to_collision(opening)).all()
    assert value("tet", opening) == 0


def test_a_time_to_collision_at_the_threshold_is_exposed() -> None:
    run = braking_run(10, 5, 12)
    level = dataclasses.replace(run, encounter=run.encounter._replace(distance=2.0 * run.encounter.closing_speed))
    moving = np.count_nonzero(run.encounter.closing_speed[:, 0] > 0)
    assert value("tet", level) == pytest.approx(moving * STEP, abs=2 * STEP)
    assert value("tit", level) == pytest.approx(0.0, abs=1e-12)


def test_a_batch_that_failed_as_a_whole_has_no_valid_objective() -> None:
    """Without a simulation, a user's metric is undefined, and so is the safety degree."""
    undefined = np.full(2, np.nan)
    failed = Evaluations(
        settings=np.ones((2, 1)),
        outcome=np.full(2, "simulator-error"),
        collision_speed=undefined,
        metrics={"safety_degree": undefined},
        f_diff=np.zeros(2),
        f_num_diff=np.zeros(2),
    )
    scoring = Scoring(metrics=(), objectives=(F_SAFE, F_DIFF, Objective(name="jerk", title="jerk", unit="m/s^3")))
    assert scoring.valid(failed).tolist() == [False, False]
    assert np.isnan(scoring.values(failed)[:, 2]).all()


def test_measures_of_change_are_the_published_objectives() -> None:
    changes = [Objective(name=change.name, title=change.title, unit=change.unit) for change in CHANGES.values()]
    assert changes == [F_DIFF, F_NUM_DIFF]
    assert tuple(change.name for change in changes) == OBJECTIVES[1:]


def test_average_deceleration_is_that_of_the_braking_cycle() -> None:
    assert value("ave_dece", braking_run(10, 5, 12)) == pytest.approx(5.0, rel=1e-9)
    assert value(
        "ave_dece", braking_run(10, 5, 12), MetricsTable(ttc_threshold=2, sampling_interval=0.2)
    ) == pytest.approx(5.0)


def test_a_vehicle_with_exactly_the_points_of_the_limit_is_unsafe() -> None:
    """The original has 40 points: a vehicle is unsafe from a loss of one point on."""
    unsafe, undefined = (
        Unsafe.default({"rating_points": 40.0, "safety_degree": np.nan}, np.array(["stopped"])),
        np.full(4, np.nan),
    )
    rated = Evaluations(
        settings=np.ones((4, 1)),
        outcome=np.full(4, "stopped"),
        collision_speed=undefined,
        f_diff=np.zeros(4),
        f_num_diff=np.zeros(4),
        metrics={"safety_degree": undefined, "rating_points": np.array([40.0, 39.25, 39.0, 38.5])},
    )
    assert unsafe.of(rated).tolist() == [False, False, True, True]
