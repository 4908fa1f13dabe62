"""Metrics at their edges: nothing undefined becomes a number, nothing outside the encounter counts, the sampling is what was asked for."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import time_to_collision
from safevar_sumo.metrics.scoring import F_DIFF, F_SAFE, Objective, Scoring
from safevar_sumo.records import Encounter, Evaluations, SimulationRuns
from safevar_sumo.study import MetricsTable
from tests.metrics.test_metrics import STEP, braking_run, value


def ended(run: SimulationRuns, after: float) -> SimulationRuns:
    """The same drive of which only the samples before a moment count."""
    return dataclasses.replace(run, trace=dataclasses.replace(run.trace, active=run.trace.time[:, np.newaxis] < after))


def test_no_encounter_is_undefined_not_infinitely_safe() -> None:
    run = braking_run(10, 5, 12)
    without = dataclasses.replace(run, encounter=Encounter(*run.encounter[:3], np.zeros_like(run.encounter.in_conflict)))
    assert np.isnan(value("safety_degree", without))


@pytest.mark.parametrize("name", ["tet", "tit", "ave_dece"])
def test_samples_that_are_not_active_do_not_count(name: str) -> None:
    run = braking_run(10, 5, 12)
    slower = dataclasses.replace(run.trace, speed=np.where(run.trace.time[:, np.newaxis] < 1.0, run.trace.speed, run.trace.speed / 2))
    assert value(name, ended(run, 0.5)) != value(name, run) or name == "ave_dece"
    assert value(name, ended(run, 1.0)) == value(name, ended(dataclasses.replace(run, trace=slower), 1.0))


def test_exposed_time_up_to_an_end_is_that_of_the_samples_before_it() -> None:
    """10 m/s from 12 m at 5 m/s^2: TTC falls from 1.2 s at once, so every sample before the end is exposed."""
    assert value("tet", ended(braking_run(10, 5, 12), 0.3)) == pytest.approx(0.3)


def test_a_distance_below_zero_is_no_time_to_collision() -> None:
    run = braking_run(10, 5, 12)
    behind = dataclasses.replace(run, encounter=run.encounter._replace(distance=run.encounter.distance - 20))
    assert np.isinf(time_to_collision(behind)).all()
    assert value("tit", behind) == 0


def test_a_sampling_interval_of_one_step_is_every_step() -> None:
    run = braking_run(10, 5, 12)
    for name in ("tet", "tit", "ave_dece"):
        assert value(name, run, MetricsTable(ttc_threshold=2.0, sampling_interval=STEP)) == value(name, run)


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
    """Nothing measured the metric of a user's own: it is undefined, as is the safety degree."""
    undefined = np.full(2, np.nan)
    failed = Evaluations(settings=np.ones((2, 1)), outcome=np.full(2, "simulator-error"), collision_speed=undefined,
                         metrics={"safety_degree": undefined}, f_diff=np.zeros(2), f_num_diff=np.zeros(2))
    scoring = Scoring(metrics=(), objectives=(F_SAFE, F_DIFF, Objective(name="jerk", title="jerk", unit="m/s^3")))
    assert scoring.valid(failed).tolist() == [False, False]
    assert np.isnan(scoring.values(failed)[:, 2]).all()
