"""Comfort against closed forms and scipy's filters."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

import safevar_sumo as sv
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import OPTIONAL_METRICS
from safevar_sumo.metrics.comfort import weight_acceleration
from safevar_sumo.records import Encounter, SimulationRuns, Trace
from safevar_sumo.study import MetricsTable, load_study
from safevar_sumo.sumo.system import assemble

STEP = 0.05


def comfort(name: str, speed: np.ndarray, until: float = np.inf, collision_speed: float = np.nan) -> np.ndarray:
    v = speed.reshape(len(speed), -1)
    time, zero = np.arange(len(v)) * STEP, np.zeros_like(v)
    trace = Trace(
        step=STEP,
        vehicle_length=4.0,
        time=time,
        position=zero,
        speed=v,
        gap=zero,
        lateral=zero,
        lateral_speed=zero,
        throttle=zero,
        brake=zero,
        gear=zero,
        active=np.repeat((time <= until)[:, np.newaxis], v.shape[1], axis=1),
    )
    runs = SimulationRuns(
        trace=trace,
        encounter=Encounter(zero, zero, zero, zero > 0),
        outcome=np.full(v.shape[1], "stopped"),
        collision_speed=np.full(v.shape[1], collision_speed),
    )
    return OPTIONAL_METRICS[name](runs, MetricsTable(ttc_threshold=2.0))


def sampled(speed: Callable[[np.ndarray], np.ndarray], seconds: float = 6.0) -> np.ndarray:
    return speed(np.arange(0, seconds + STEP / 2, STEP))


def test_harshness_of_a_constant_deceleration_equals_it_and_jerk_occurs_only_at_its_ends() -> None:
    """5 m/s^2 from 15 m/s, for 3 s; at the stop the deceleration ends within the second over which jerk is averaged."""
    speed = sampled(lambda t: np.maximum(15 - 5 * t, 0))
    assert comfort("brake_harshness", speed)[0] == pytest.approx(5.0)
    assert comfort("max_jerk", speed)[0] == pytest.approx(5.0)
    assert comfort("max_jerk", speed, until=2.9)[0] == pytest.approx(0.0, abs=1e-9), (
        "what follows the run's end does not count"
    )


def test_jerk_of_a_ramp_is_its_slope_and_harshness_the_mean_of_its_last_half_second() -> None:
    """Deceleration 2 t: jerk 2 everywhere; the mean over the last half of the first 3 seconds is 2 (3 - 0.25)."""
    speed = sampled(lambda t: 20 - t**2, 3.0)
    assert comfort("max_jerk", speed)[0] == pytest.approx(2.0)
    assert comfort("brake_harshness", speed)[0] == pytest.approx(5.5)


@pytest.mark.slow
@pytest.mark.parametrize("frequency", [0.2, 0.5, 1.0, 2.0, 5.0])
def test_weighting_agrees_with_iso_2631_1(frequency: float) -> None:
    """The magnitude of H(s) by the standard's formula, on a settled sine sampled with a short step."""
    step, f = 0.001, frequency
    time = np.arange(0, 40, step)
    low = np.abs(1j * f) ** 2 / np.abs((1j * f) ** 2 + np.sqrt(2) * 0.4 * 1j * f + 0.4**2)
    shape = np.abs((1 + 1j * f / 2) / (1 + 1j * f / (0.63 * 2) - (f / 2) ** 2))
    settled = weight_acceleration(np.sin(2 * np.pi * f * time)[:, np.newaxis], step)[len(time) // 2 :]
    assert np.sqrt(2 * np.mean(settled**2)) == pytest.approx(low * shape, rel=2e-3)


def test_rms_agrees_with_scipys_filters() -> None:
    rng = np.random.default_rng(1)
    speed = np.cumsum(rng.normal(size=(200, 3)), axis=0)
    high, corner = 2 * np.pi * 0.4, 2 * np.pi * 2
    first = signal.bilinear(*signal.butter(2, high, "high", analog=True), fs=1 / STEP)
    second = signal.bilinear([corner, corner**2], [1, corner / 0.63, corner**2], fs=1 / STEP)
    expected = np.diff(speed, axis=0) / STEP
    for taps in (first, second):
        expected = signal.lfilter(*taps, expected, axis=0)
    assert comfort("rms_acceleration", speed) == pytest.approx(np.sqrt((expected**2).mean(axis=0)), rel=1e-9)


def test_rms_is_over_the_run_and_not_over_what_follows_its_end() -> None:
    speed = np.cumsum(np.random.default_rng(3).normal(size=(200, 2)), axis=0)
    assert comfort("rms_acceleration", speed, until=99 * STEP + STEP / 2) == pytest.approx(
        comfort("rms_acceleration", speed[:100])
    )


@pytest.mark.parametrize("name", OPTIONAL_METRICS)
def test_each_vehicle_counts_for_itself_to_the_bit_and_not_on_a_collision(name: str) -> None:
    speed = np.cumsum(np.random.default_rng(2).normal(size=(150, 7)), axis=0)
    assert np.array_equal(comfort(name, speed)[[4]], comfort(name, speed[:, 4].copy()))
    assert np.isnan(comfort(name, speed, collision_speed=3.0)).all()


@pytest.mark.slow
def test_the_study_makes_braking_as_jerky_as_it_can_and_reports_what_it_costs(in_tmp: Path) -> None:
    study = load_study("comfort", search={"algorithms": ["nsga2"], "runs": 1, "evaluations": 60, "population": 20})
    system = assemble(study)
    assert [one.name for one in system.measuring.scoring.objectives] == ["max_jerk", "f_diff", "f_num_diff"]
    results = sv.run(study, out="out", jobs=1)
    assert (results.solutions["outcome"] != "collision").all()
    assert results.solutions["max_jerk"].max() >= results.evaluations["max_jerk"].max()
    assert {"rms_acceleration", "brake_harshness"} <= set(results.solutions)
    assert {"max_jerk", "brake_harshness"} <= set(sv.tables(results)["rq1"]["metric"])


def test_studies_that_name_no_comfort_have_none() -> None:
    assert [one.name for one in assemble(load_study("sun")).measuring.scoring.metrics] == [
        "safety_degree",
        "tet",
        "tit",
        "ave_dece",
    ]
    with pytest.raises(InputError, match="did you mean 'max_jerk'"):
        assemble(load_study("sun", metrics={"also": ["max_jark"]}))
