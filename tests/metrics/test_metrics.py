"""Metrics against closed forms: a vehicle that brakes evenly towards a standing obstacle, and one that does not."""

from __future__ import annotations

import numpy as np
import pytest

from safevar_sumo.metrics import METRICS, time_to_collision
from safevar_sumo.records import Encounter, Outcome, SimulationRuns, Trace
from safevar_sumo.study import MetricsTable

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
    trace = Trace(step=STEP, vehicle_length=4.0, time=time, position=x, speed=v, gap=gaps, lateral=zero, lateral_speed=zero,
                  throttle=zero, brake=np.ones_like(v), gear=zero, active=np.ones_like(v, dtype=bool))
    outcome = Outcome.STOPPED if np.isnan(collision_speed) else Outcome.COLLISION
    return SimulationRuns(trace=trace, encounter=Encounter(gaps, gaps, v, gaps > 0), outcome=np.array([outcome.value]),
               collision_speed=np.array([collision_speed]))


def value(name: str, run: SimulationRuns, thresholds: MetricsTable = THRESHOLDS) -> float:
    return float(METRICS[name](run, thresholds)[0])


def test_safety_degree_is_the_distance_left_when_standing() -> None:
    assert value("safety_degree", braking_run(10, 5, 12)) == pytest.approx(2.0)


def test_safety_degree_of_a_collision_is_minus_its_speed() -> None:
    assert value("safety_degree", braking_run(10, 5, 12, collision_speed=3.5)) == -3.5


def test_safety_degree_counts_only_the_encounter() -> None:
    run = braking_run(10, 5, 12)
    late = Encounter(*run.encounter[:3], run.trace.time[:, np.newaxis] < 0.5)
    only = SimulationRuns(trace=run.trace, encounter=late, outcome=run.outcome, collision_speed=run.collision_speed)
    assert value("safety_degree", only) == pytest.approx(12 - 10 * 0.49 + 5 * 0.49**2 / 2)


def test_exposed_and_integrated_time_of_even_approach() -> None:
    """At constant speed v from distance d, TTC = d/v - t: TET = TTC*, TIT = TTC*^2 / 2 when it goes on to contact."""
    time = np.arange(0, 5 + STEP / 2, STEP)
    v = np.full((len(time), 1), 4.0)
    gap = 20 - 4.0 * time[:, np.newaxis]
    zero = np.zeros_like(v)
    trace = Trace(step=STEP, vehicle_length=4.0, time=time, position=-gap, speed=v, gap=gap, lateral=zero, lateral_speed=zero,
                  throttle=zero, brake=zero, gear=zero, active=np.ones_like(v, dtype=bool))
    run = SimulationRuns(trace=trace, encounter=Encounter(gap, gap, v, gap > -1), outcome=np.array(["stopped"]),
                         collision_speed=np.array([np.nan]))
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
    still = Encounter(run.encounter.separation, run.encounter.distance, np.ones_like(run.encounter.distance), run.encounter.in_conflict)
    ttc = time_to_collision(SimulationRuns(trace=run.trace, encounter=still, outcome=run.outcome, collision_speed=run.collision_speed))
    assert np.all(np.isinf(ttc[run.trace.time > 2.0]))


def test_average_deceleration_is_that_of_the_braking_cycle() -> None:
    assert value("ave_dece", braking_run(10, 5, 12)) == pytest.approx(5.0, rel=1e-9)
    assert value("ave_dece", braking_run(10, 5, 12), MetricsTable(ttc_threshold=2, sampling_interval=0.2)) == pytest.approx(5.0)


def test_a_vehicle_that_never_brakes_has_no_average_deceleration() -> None:
    run = braking_run(10, 5, 12)
    coasting = Trace(**{**{name: getattr(run.trace, name) for name in run.trace.__dataclass_fields__}, "brake": run.trace.throttle})
    never = SimulationRuns(trace=coasting, encounter=run.encounter, outcome=run.outcome, collision_speed=run.collision_speed)
    assert np.isnan(value("ave_dece", never))


def test_samples_after_a_vehicles_end_do_not_count() -> None:
    run = braking_run(10, 5, 12)
    ended = Trace(**{**{name: getattr(run.trace, name) for name in run.trace.__dataclass_fields__},
                     "active": run.trace.time[:, np.newaxis] < 1.0})
    early = SimulationRuns(trace=ended, encounter=run.encounter, outcome=run.outcome, collision_speed=run.collision_speed)
    assert value("safety_degree", early) == pytest.approx(12 - 10 * 0.99 + 5 * 0.99**2 / 2)
    assert value("ave_dece", early) == pytest.approx(5.0)
