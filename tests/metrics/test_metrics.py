"""Metrics against closed forms and scipy's filters."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.random import default_rng

from safevar_sumo.metrics import (
    F_DIFF,
    F_SAFE,
    METRICS,
    OPTIONAL_METRICS,
    Measure,
    Scoring,
    Unsafe,
    impact_in_words,
)
from safevar_sumo.records import (
    NO_CONTACT,
    Encounter,
    FloatArray,
    Outcome,
    SimulationRuns,
)
from safevar_sumo.study import MetricsTable
from tests.support.made_up import made_up_evaluations, made_up_runs

STEP = 0.01
THRESHOLDS = MetricsTable(ttc_threshold=2.0)
IMPACTS = "impact_speed", "impact_excess"
STOPS = "stopping_distance", "stop_from_pedal", "mfdd"


def braking_run(collision_speed: float = np.nan) -> SimulationRuns:
    """One vehicle that brakes at once from 10 m/s with 5 m/s^2, 12 m ahead of an obstacle."""
    time = np.arange(0, 10, STEP)[:, np.newaxis]
    moving = np.minimum(time, 2.0)
    way = 10 * moving - 5 * moving**2 / 2
    v = np.where(time < 2.0, 10 - 5 * moving, 0.0)
    return made_up_runs(
        STEP, v, 12 - way, collision_speed, position=way, brake=np.ones_like(v)
    )


RUN = braking_run()


def meeting(**encounter: FloatArray) -> SimulationRuns:
    """The same run with parts of another encounter."""
    return dataclasses.replace(RUN, encounter=RUN.encounter._replace(**encounter))


def driving(**trace: FloatArray) -> SimulationRuns:
    """The same run with parts of another trace."""
    return dataclasses.replace(RUN, trace=dataclasses.replace(RUN.trace, **trace))


HIT = braking_run(collision_speed=3.5)
FIRST_SECOND = RUN.trace.time[:, np.newaxis] < 1.0
COARSE = MetricsTable(ttc_threshold=2.0, sampling_interval=0.2)


def value(
    name: str, run: SimulationRuns, thresholds: MetricsTable = THRESHOLDS
) -> float:
    """A metric of a run's first vehicle."""
    return float({**METRICS, **OPTIONAL_METRICS}[name].function(run, thresholds)[0])


def test_safety_degree_is_the_distance_at_standstill_or_minus_the_speed_of_the_collision() -> (
    None
):
    assert value("safety_degree", RUN) == pytest.approx(2.0)
    assert value("safety_degree", HIT) == -3.5


@pytest.mark.parametrize(
    ("speed_of_the_struck", "degree"),
    [(2.5, -1.0), (-1.0, -4.5), (9.0, -0.001)],
)
def test_severity_is_the_closing_speed_and_every_collision_is_below_0(
    speed_of_the_struck: float, degree: float
) -> None:
    """The vehicle hits at 3.5 m/s."""
    contact = NO_CONTACT._replace(speed=np.array([speed_of_the_struck]))
    assert value("safety_degree", dataclasses.replace(HIT, contact=contact)) == degree


def test_safety_degree_is_the_least_separation_of_the_encounter_alone() -> None:
    """The encounter ends after 1 s and 7.5 m, at a gap of 4.5 m; the last gap is 2 m. Without an
    encounter it is undefined.
    """
    assert value("safety_degree", meeting(in_conflict=FIRST_SECOND)) == pytest.approx(
        4.5, abs=10 * STEP
    )
    assert np.isnan(value("safety_degree", meeting(in_conflict=RUN.trace.gap < 0)))


def test_exposed_and_integrated_time_of_even_approach() -> None:
    """At constant speed v from distance d, TTC = d/v - t: TET = TTC*, TIT = TTC*^2 / 2 when it goes
    on to contact.
    """
    time = np.arange(0, 5 + STEP / 2, STEP)[:, np.newaxis]
    run = made_up_runs(STEP, np.full_like(time, 4.0), 20 - 4.0 * time)
    run = dataclasses.replace(
        run, encounter=run.encounter._replace(in_conflict=run.trace.gap > -1)
    )
    assert run.time_to_collision[0, 0] == pytest.approx(5.0)
    assert value("tet", run) == pytest.approx(2.0, abs=2 * STEP)
    assert value("tit", run) == pytest.approx(2.0, abs=4 * STEP)


def test_least_ttc_and_largest_drac_of_even_braking() -> None:
    """From 10 m/s with 5 m/s^2 and 12 m ahead, at speed v the distance is 2 m + v^2 / (10
    m/s^2).
    """
    least = value("ttc_min", RUN)
    largest = value("drac", RUN)
    speed = np.linspace(0.01, 10, 100_001)
    distance = 2 + speed**2 / 10
    assert least == pytest.approx((distance / speed).min(), rel=1e-3)
    assert largest == pytest.approx((speed**2 / (2 * distance)).max(), rel=1e-3)
    nobody = meeting(closing_speed=np.zeros_like(RUN.encounter.closing_speed))
    assert np.isnan([value(name, nobody) for name in ("ttc_min", "drac")]).all()


@pytest.mark.parametrize(
    ("gap", "lateral", "lateral_speed", "expected"),
    [
        (6.0, 1.6, 2.0, 0.6),  # he has left, and the vehicle is 6 m before his path
        (
            -7.0,
            -3.6,
            2.0,
            1.0,
        ),  # the vehicle's rear has left, and his side is 2 m beside its path
        (6.0, -3.6, 2.0, np.nan),  # he has not crossed yet
        (6.0, 1.0, 2.0, np.nan),  # he is in the path
        (-7.0, -3.6, -2.0, np.nan),  # he goes back
    ],
)
def test_post_encroachment_time_is_that_of_the_second_one(
    gap: float, lateral: float, lateral_speed: float, expected: float
) -> None:
    """A vehicle 2 m wide at 10 m/s, and somebody 1.2 m wide across the lane; the last sample is
    after the run's end.
    """
    at = np.ones((3, 1))
    columns = {
        "lateral": lateral * at,
        "lateral_speed": lateral_speed * at,
        "obstacle_width": 1.2 * at,
    }
    run = made_up_runs(
        STEP, 10 * at, gap * at, **columns, active=np.array([[True], [True], [False]])
    )
    run = dataclasses.replace(
        run, trace=dataclasses.replace(run.trace, vehicle_width=2.0)
    )
    assert np.isnan(value("pet", run)), "it has stopped"
    run.outcome[:] = "passed"
    assert value("pet", run) == pytest.approx(expected, nan_ok=True)


def test_reaction_time_begins_with_the_first_sight() -> None:
    """It brakes a little before it sees somebody after 1 s, and again from 1.7 s on."""
    time = RUN.trace.time[:, np.newaxis]
    brake = ((time > 0.5) & (time < 0.9)) | (time >= 1.7)
    visible = time >= 1.0
    for seen, expected in (
        ({"brake": brake.astype(float), "visible": visible}, 0.7),
        ({"brake": brake & (time < 0.9), "visible": visible}, np.nan),
        ({"visible": visible & False}, np.nan),
    ):
        assert value("reaction_time", driving(**seen)) == pytest.approx(
            expected, nan_ok=True
        )


def test_who_collides_is_unsafe_by_every_measure_of_a_run() -> None:
    """The third vehicle collides with a measure on the safe side, the fourth without one."""
    nan = np.nan
    columns = {
        "safety_degree": [1.0, 2.0, -3.0, -1.0, 1.0],
        "drac": [5.0, 7.0, 1.0, nan, nan],
    }
    runs = made_up_evaluations(
        columns["safety_degree"], metrics={k: np.array(v) for k, v in columns.items()}
    )
    for text, expected in (
        ("drac > 6", [False, True, True, True, False]),
        ("drac < 6", [True, False, True, True, False]),
        ("below=1.5", [True, False, True, True, True]),
        ("below=0", [False, False, True, True, False]),
        ("safety_degree < 1.5", [True, False, True, True, True]),
        ("safety_degree < -2", [False, False, True, False, False]),
    ):
        criterion = Unsafe.parse(text)
        assert criterion.of(runs).tolist() == expected, text
        assert "collision" in criterion.description or "safety_degree" in text
        assert (criterion.robustness(runs) < 0).tolist() == expected, text


def test_a_coarser_sampling_interval_counts_fewer_and_longer_samples() -> None:
    fine = value("tet", RUN)
    coarse = value("tet", RUN, COARSE)
    assert coarse == pytest.approx(fine, abs=0.2)
    assert coarse / 0.2 == pytest.approx(round(coarse / 0.2))
    assert (
        value("tet", RUN, MetricsTable(ttc_threshold=2.0, sampling_interval=STEP))
        == fine
    )


def test_time_to_collision_ends_with_the_first_standstill() -> None:
    ttc = meeting(closing_speed=np.ones_like(RUN.encounter.distance)).time_to_collision
    assert np.all(np.isinf(ttc[RUN.trace.time > 2.0]))


def test_a_vehicle_that_stands_at_the_start_has_a_time_to_collision_once_it_drives() -> (
    None
):
    speed = np.where(FIRST_SECOND, 0.0, 2.0)
    gap = 20.0 + 0 * speed
    later = dataclasses.replace(
        driving(speed=speed), encounter=Encounter(gap, gap, speed, gap > 0)
    )
    ttc = later.time_to_collision[:, 0]
    assert np.isinf(ttc[RUN.trace.time < 1.0]).all()
    assert ttc[RUN.trace.time >= 1.0] == pytest.approx(10.0)


def test_a_vehicle_that_never_brakes_has_no_average_deceleration() -> None:
    assert np.isnan(value("ave_dece", driving(brake=RUN.trace.throttle)))


@pytest.mark.parametrize("name", ["tet", "tit", "ave_dece"])
def test_samples_that_are_not_active_do_not_count(name: str) -> None:
    slower = np.where(FIRST_SECOND, RUN.trace.speed, RUN.trace.speed / 2)
    begun = value(name, driving(active=FIRST_SECOND))
    assert begun != value(name, RUN) or name == "ave_dece"
    assert begun == value(name, driving(active=FIRST_SECOND, speed=slower))


@pytest.mark.parametrize(
    "encounter",
    [
        {"closing_speed": -RUN.encounter.closing_speed},
        {"distance": RUN.encounter.distance - 20},
    ],
)
def test_what_opens_or_lies_behind_has_no_time_to_collision(
    encounter: dict[str, FloatArray],
) -> None:
    run = meeting(**encounter)
    assert np.isinf(run.time_to_collision).all()
    assert value("tet", run) == value("tit", run) == 0


def test_a_time_to_collision_at_the_threshold_is_exposed() -> None:
    level = meeting(distance=2.0 * RUN.encounter.closing_speed)
    moving = np.count_nonzero(RUN.encounter.closing_speed[:, 0] > 0)
    assert value("tet", level) == pytest.approx(moving * STEP, abs=2 * STEP)
    assert value("tit", level) == pytest.approx(0.0, abs=1e-12)


def test_a_batch_that_failed_as_a_whole_has_no_valid_objective() -> None:
    """Without a simulation, a user's metric is undefined, and so is the safety degree."""
    failed = made_up_evaluations(
        [np.nan, np.nan], outcome=np.full(2, "simulator-error")
    )
    scoring = Scoring(
        metrics=(),
        objectives=(F_SAFE, F_DIFF, Measure(name="jerk", title="jerk", unit="m/s^3")),
    )
    assert scoring.valid(failed).tolist() == [False, False]
    assert np.isnan(scoring.values(failed)[:, 2]).all()


def test_average_deceleration_is_that_of_the_braking_cycle() -> None:
    assert value("ave_dece", RUN) == pytest.approx(5.0, rel=1e-9)
    assert value("ave_dece", RUN, COARSE) == pytest.approx(5.0)


def test_a_margin_is_the_safety_degree_above_the_limit() -> None:
    made = made_up_evaluations([2.0, -1.0])
    assert [Unsafe(below=below).robustness(made).tolist() for below in (None, 0.5)] == [
        [2.0, -1.0],
        [1.5, -1.5],
    ]


SAMPLED = 0.05


def of_speeds(
    name: str, speed: FloatArray, collision_speed: float = np.nan
) -> FloatArray:
    v = speed.reshape(len(speed), -1)
    runs = made_up_runs(
        SAMPLED, v, 0.0, collision_speed, active=np.ones(v.shape, dtype=bool)
    )
    return OPTIONAL_METRICS[name].function(runs, THRESHOLDS)


@pytest.mark.parametrize("name", OPTIONAL_METRICS)
def test_each_vehicle_counts_for_itself_to_the_bit_and_says_if_on_a_collision(
    name: str,
) -> None:
    speed = np.cumsum(default_rng(2).normal(size=(150, 7)), axis=0)
    np.testing.assert_array_equal(
        of_speeds(name, speed)[4:5], of_speeds(name, speed[:, 4])
    )
    in_collision = of_speeds(name, speed, collision_speed=3.0)
    assert OPTIONAL_METRICS[name].over_collisions or np.isnan(in_collision).all()


@pytest.mark.parametrize(
    ("unsafe", "outcome", "degree", "words"),
    [
        (Unsafe(keep=0.3), Outcome.COLLISION, -3.214, "collides at 3.21 m/s"),
        (
            Unsafe(keep=0.3),
            Outcome.STOPPED,
            0.041,
            "keeps 0.04 m of clearance, less than 0.3 m",
        ),
        (
            Unsafe(keep=0.3, contact=2.0),
            Outcome.PASSED,
            2.2999,
            "keeps 0.2999 m of clearance, less than 0.3 m",
        ),
        (
            Unsafe(degree=1.4),
            Outcome.STOPPED,
            0.8,
            "has a safety degree of 0.8 m, below 1.4 m",
        ),
        (Unsafe(degree=1.4), Outcome.COLLISION, -2.0, "collides at 2.00 m/s"),
        (
            Unsafe(below=1.4),
            Outcome.STOPPED,
            0.8,
            "keeps 0.80 m of clearance, less than 1.4 m",
        ),
        (
            Unsafe(degree=-1.4),
            Outcome.COLLISION,
            -2.0,
            "has a safety degree of -2 m/s, below -1.4 m/s",
        ),
        (Unsafe.parse("drac > 5.3"), Outcome.STOPPED, 0.8, "has drac 6.77 > 5.3"),
        (Unsafe.parse("drac > 6.77"), Outcome.STOPPED, 0.8, "has drac 6.774 > 6.77"),
        (Unsafe.parse("drac > 7"), Outcome.COLLISION, -2.0, "collides at 2.00 m/s"),
    ],
)
def test_what_an_unsafe_vehicle_does_is_said_with_its_value(
    unsafe: Unsafe, outcome: Outcome, degree: float, words: str
) -> None:
    metrics = {"drac": np.array([6.774]), "safety_degree": np.array([degree])}
    vehicle = made_up_evaluations(
        np.array([degree]), outcome=np.array([str(outcome)]), metrics=metrics
    )
    assert unsafe.of(vehicle)[0]
    assert unsafe.breach_in_words(vehicle) == words


def braked(speed: FloatArray, delay: float, step: float) -> SimulationRuns:
    """A car that is at a speed [m/s] at each sample, whose brake is commanded from the start."""
    position = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * step)])
    columns = {
        "position": position[:, np.newaxis],
        "brake": np.ones((len(speed), 1)),
        "pedal": (np.arange(len(speed)) * step >= delay - 1e-9)[:, np.newaxis].astype(
            float
        ),
    }
    return made_up_runs(step, speed[:, np.newaxis], **columns)


def test_a_stop_is_that_of_a_constant_deceleration_after_a_delay() -> None:
    """From 100 km/h at 6 m/s^2 after 0.2 s: v^2 / (2 a) from the brake force, v t more from the
    pedal; the mean deceleration, whatever the delay, is that one.
    """
    speed, deceleration, delay, step = 100 / 3.6, 6.0, 0.2, 0.01
    times = np.arange(600) * step
    run = braked(
        np.maximum(speed - deceleration * np.maximum(times - delay, 0.0), 0.0),
        delay,
        step,
    )
    metrics = {name: value(name, run) for name in STOPS}
    stop = speed**2 / (2 * deceleration)
    assert metrics["stopping_distance"] == pytest.approx(stop, abs=1.5 * speed * step)
    assert metrics["stop_from_pedal"] == pytest.approx(stop + speed * delay, abs=0.01)
    assert metrics["mfdd"] == pytest.approx(deceleration, rel=1e-4)
    half = braked(np.linspace(speed, speed / 2, 60), 0.0, step)
    assert all(np.isnan(value(name, half)) for name in STOPS)


@pytest.mark.parametrize(
    ("allowed", "speed", "excess", "words"),
    [
        (15 / 3.6, 12 / 3.6, -3 / 3.6, "impact at 12 km/h where 15 is allowed"),
        (15 / 3.6, 18 / 3.6, 3 / 3.6, "impact at 18 km/h where 15 is allowed"),
        (0.0, 12 / 3.6, 12 / 3.6, "impact at 12 km/h where none is allowed"),
    ],
)
def test_an_impact_counts_above_the_speed_that_is_allowed(
    allowed: float, speed: float, excess: float, words: str
) -> None:
    run = made_up_runs(0.1, np.full((2, 1), speed), gap=-1.0, collision_speed=speed)
    run = dataclasses.replace(run, allowed_impact_speed=np.array(allowed))
    found = [value(name, run) for name in IMPACTS]
    assert found == pytest.approx([speed, excess])
    assert impact_in_words(*found) == words
    columns = {"safety_degree": -speed, **dict(zip(IMPACTS, found, strict=True))}
    metrics = {name: np.array([value]) for name, value in columns.items()}
    evaluations = made_up_evaluations([-speed], metrics=metrics)
    criterion = Unsafe.parse("impact_excess > 0")
    assert criterion.of(evaluations).tolist() == [excess > 0]
    assert np.sign(criterion.robustness(evaluations)[0]) == -np.sign(excess)
    assert criterion.description == "impact_excess > 0"
    if excess > 0:
        assert criterion.breach_in_words(evaluations) == f"has an {words}"


def test_without_a_contact_the_excess_is_minus_the_clearance() -> None:
    run = made_up_runs(0.1, np.full((3, 1), 3.0), gap=np.array([[5.0], [2.0], [2.5]]))
    run = dataclasses.replace(run, allowed_impact_speed=np.array(4.0))
    assert value("impact_excess", run) == -2.0
    assert np.isnan(value("impact_speed", run))


def test_the_speed_of_a_contact_is_that_where_a_gap_closes_within_a_step() -> None:
    """The gap closes from 0.5 m, or it stays open, as in a contact from the side."""
    speed = np.array([[10.0, 10.0], [8.0, 8.0]])
    gap = np.array([[0.5, 0.5], [-0.4, 0.4]])
    runs = made_up_runs(0.1, speed, gap, 8.0)
    # v^2 = 10^2 + 2 a d, with a = (8 - 10) / 0.1 m/s^2
    at_contact = np.sqrt(100 - 2 * 20 * 0.5)
    assert runs.relative_speed == pytest.approx([at_contact, 8.0])
