"""Limits up to each of some speeds against cars driven at random, and what `--by` refuses."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from safevar_sumo import tolerance
from safevar_sumo.api.simulation import load_study
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.falsify import Falsification, falsify, falsify_all
from safevar_sumo.questions.model_spread import studies_of_sets
from safevar_sumo.questions.models import Model, tests_between as drawn_between
from safevar_sumo.questions.scope import scope_of
from safevar_sumo.questions.tolerance.by_parameter import Parameter, cells_between, study_between
from safevar_sumo.questions.tolerance.extension import Extension
from safevar_sumo.questions.tolerance.search import BoxSearch
from safevar_sumo.questions.tolerance.together import _keeps_its_margin, broken_specification
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import Study
from safevar_sumo.sumo.matrix import at_point, drive_and_score, simulate_all_points
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet, region_of
from tests.in_process import InlinePool, json_of
from tests.questions.conftest import made_up_study

SEARCHED = """
extends = "wear"
name = "crossing_at_any_speed"
title = "A pedestrian from the near side, at any speed"
[matrix]
tests = [{ name = "CPNA", parameters = { test = "CPNA" } }]
[scenario.search]
speed = { unit = "km/h", original = 40, lower = 10, upper = 60, meaning = "speed at the start" }
impact_location = { unit = "%", original = 50, lower = 25, upper = 75, meaning = "impact location" }
"""
SPEEDS = (20, 45, 60)
FITS = 2
"""Fits of the vehicle in which limits are sought, and driven through."""


def test_a_level_of_a_matrix_drives_what_the_one_below_did_not() -> None:
    """All points of `wear` up to 40 km/h stand in exactly one level, and a cell's ends are its
    points or values.
    """
    study = load_study("wear")
    by = Parameter.parse("speed=40,15,30", study)
    assert by.values == (15, 30, 40)
    lows = (None, *by.values)
    levels = [
        study_between(study, by, low, high) for low, high in zip(lows, by.values, strict=False)
    ]
    names = [point.name for level in levels for point in assemble(level).points]
    whole = [point for point in assemble(study).points if dict(point.parameters)["speed"] <= 40]
    assert sorted(names) == sorted(point.name for point in whole)
    cells = [
        cells_between(study, by, low, high) for low, high in zip(lows, by.values, strict=False)
    ]
    assert [tests[0].over["speed"] for tests in cells] == [[10, 15], [15, 20, 30], [30, 40]]
    assert "15 km/h in CPFA, CPNA, CPNCO and CPLA only what the attack drove" in by.scope(
        study, 15, between=True
    )
    assert "only what the attack" not in by.scope(study, 30, between=True)


def test_attacks_side_by_side_find_what_each_finds_alone() -> None:
    study = load_study("smoke")
    region = region_of(study)
    members = region.characteristics
    boxes = [
        Box(region, members.lower, members.upper),
        Box(region, members.original, members.upper),
    ]

    def judge(rows: FloatArray) -> FloatArray:
        return np.asarray(
            np.abs((rows - members.lower) / (members.upper - members.lower) - 0.7).sum(axis=1) - 0.5
        )

    def alone(number: int) -> Falsification:
        return falsify(boxes[number], [judge, judge], [], 2000, np.random.default_rng(number))

    rngs = [np.random.default_rng(number) for number in (0, 1)]
    for one, other in zip(
        falsify_all(boxes, [judge, judge], [(), ()], 2000, rngs), map(alone, (0, 1)), strict=True
    ):
        assert np.array_equal(one.settings, other.settings)
        assert one.simulated == other.simulated


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> Study:
    file = tmp_path_factory.mktemp("by") / "at_any_speed.toml"
    file.write_text(SEARCHED)
    return load_study(str(file))


@pytest.fixture(scope="module")
def answer(searched: Study) -> Answer:
    by = f"speed={','.join(map(str, SPEEDS))}"
    names = ("brakeTorque,brakeResponse,sensorRange",)
    return tolerance(
        searched, by=by, fits=FITS, jobs=2, characteristics=names, limits=["brakeTorque >= 0.55"]
    )


def rows_of(answer: Answer) -> list[dict[str, Any]]:
    return list(answer.to_dict()["tables"]["limits"]["rows"])


def unsafe_cars(study: Study, margin: float, settings: FloatArray) -> BoolArray:
    """Which cars keep less than the margin with the study's own fit, or collide with another one,
    where the original keeps that of the study.
    """
    are_unsafe = np.zeros(len(settings), dtype=bool)
    for fit, fitted in enumerate(studies_of_sets(study)[:FITS]):
        found = drive_and_score(assemble(fitted), settings)
        counts = found.metrics["original_safety_degree"] >= study.scenario.margin
        are_unsafe |= counts & (found.collided | ((found.f_safe < margin) & (fit == 0)))
    return are_unsafe


@pytest.mark.slow
def test_no_car_within_a_limit_is_unsafe_up_to_its_speed_and_one_beyond_is(
    searched: Study, answer: Answer
) -> None:
    """400 cars a row, at speeds up to its own; and up to 10 % of the domain beyond, in the
    encounter of its failure.
    """
    characteristics, rng = CharacteristicSet.of(searched), np.random.default_rng(3)
    margin = answer.numbers["margin"]
    beyond = 0
    for row in rows_of(answer):
        column = characteristics.names.index(row["characteristic"])
        speed = characteristics.names.index("speed")
        settings = np.tile(characteristics.original, (400, 1))
        for item in characteristics.scenario:
            settings[:, characteristics.names.index(item.name)] = rng.uniform(
                item.lower, item.upper, 400
            )
        settings[:, speed] = rng.uniform(10, row["by_speed"], 400)
        settings[:, column] = rng.uniform(row["alone_low"], row["alone_high"], 400)
        settings[:100, column] = row["alone_low"]
        settings[100:200, column] = row["alone_high"]
        assert not unsafe_cars(searched, margin, settings).any(), row
        item = characteristics.members[column]
        if row["fails_at"] is None:
            assert (row["alone_low"], row["alone_high"]) == (item.lower, item.upper)
            continue
        failure = np.array([row["fails_at"][name] for name in characteristics.names])
        assert failure[speed] <= row["by_speed"]
        side = "alone_low" if failure[column] < item.original else "alone_high"
        end = row[side]
        step = 0.1 * (item.upper - item.lower) * (-1 if side == "alone_low" else 1)
        tried = np.tile(failure, (21, 1))
        tried[:, column] = np.clip(end + np.linspace(0, step, 21), item.lower, item.upper)
        assert unsafe_cars(searched, margin, tried)[1:].any(), row
        beyond += 1
    assert beyond >= 3
    assert answer.numbers["fits"] == answer.numbers["fits_tried"] == FITS


@pytest.mark.slow
def test_limits_are_wider_up_to_a_slower_speed_and_never_narrower(answer: Answer) -> None:
    for _, rows in itertools.groupby(rows_of(answer), key=lambda row: row["characteristic"]):
        levels = list(rows)
        assert [row["by_speed"] for row in levels] == [*SPEEDS]
        for slower, faster in itertools.pairwise(levels):
            assert slower["alone_low"] <= faster["alone_low"]
            assert slower["alone_high"] >= faster["alone_high"]
            assert slower["kept"] in (None, True) or not faster["kept"]


@pytest.mark.slow
def test_the_verdict_says_up_to_which_speed_a_worn_car_may_drive(
    searched: Study, answer: Answer
) -> None:
    """Cars at the specified limit are safe at every speed up to the one that is said, and one a
    little above is not.
    """
    reach = answer.numbers["up_to"]
    assert (
        "In wet weather with brakeTorque at least 0.55, all others as in the original: up to"
        f" {reach:g} km/h." in (answer.verdict)
    )
    kept = [row["by_speed"] for row in rows_of(answer) if row["kept"]]
    assert max(kept) <= reach < 60
    assert (answer.numbers["kept"], len(answer.failures)) == (False, 1)
    characteristics = CharacteristicSet.of(searched)
    settings = np.tile(characteristics.original, (2000, 1))
    settings[:, characteristics.names.index("brakeTorque")] = 0.55
    rng = np.random.default_rng(4)
    settings[:, characteristics.names.index("impact_location")] = rng.uniform(25, 75, 2000)
    for low, high, is_safe in ((10.0, reach, True), (reach, reach + 3, False)):
        settings[:, characteristics.names.index("speed")] = rng.uniform(low, high, 2000)
        assert unsafe_cars(searched, answer.numbers["margin"], settings).any() != is_safe


@pytest.mark.slow
def test_of_a_matrix_the_limits_hold_at_its_points_and_their_failures_are_named(
    tmp_path: Path,
) -> None:
    study = load_study("wear")
    picture = tmp_path / "by.png"
    asked = "--by speed=20,35,40 --characteristics brakeTorque,sensorLatency --fits 0 --attack 100"
    answer = json_of("tolerance", "wear", *asked.split(), "--plot", str(picture))
    assert picture.stat().st_size > 10_000
    characteristics = CharacteristicSet.of(study)
    rows = answer["tables"]["limits"]["rows"]
    assert [row["by_speed"] for row in rows] == [20, 35, 40] * 2
    for row in rows:
        column = characteristics.names.index(row["characteristic"])
        settings = np.tile(characteristics.original, (100, 1))
        settings[:, column] = np.linspace(row["alone_low"], row["alone_high"], 100)
        up_to = msgspec.structs.replace(
            study,
            matrix=study_between(
                study, Parameter.parse("speed=40", study), None, row["by_speed"]
            ).matrix,
        )
        for result in simulate_all_points(assemble(up_to), settings):
            assert result.evaluations.f_safe.min() >= answer["numbers"]["margin"], (
                row,
                result.point.name,
            )
    assert any(row["fails_first"] for row in rows)
    assert (
        "up to 35 km/h in CPFA, CPNA, CPNCO and CPLA only what the attack drove" in rows[1]["scope"]
    )


def test_a_box_is_cut_where_it_loses_least_whatever_the_order_of_its_failures() -> None:
    """Each failure alone would move in its cheapest limit; both are cut off at once by one limit of
    the first.
    """
    study = made_up_study(2)
    region = region_of(study)
    model = Model(0, Evaluator(study, InlinePool(), verified=0), Unsafe())
    search = BoxSearch(model, [0, 1], {}, np.array([[9.0, 9.5], [9.5, 8.0]]))
    whole = Box(region, np.array([0.0, 0.0]), np.array([10.0, 10.0]))
    cut = Extension(search).cut(whole)
    assert cut.upper.tolist() == pytest.approx([8.9, 10], abs=0.1)
    assert not cut.holds(search.unsafe_settings).any()
    assert Extension(search).cut(whole, attempts=10).upper[0] < cut.upper[0] - 0.2, (
        "it keeps off by more"
    )


@pytest.mark.slow
def test_a_new_car_needs_no_trial_where_an_encounter_counts_only_if_it_keeps_its_margin() -> None:
    study = load_study("wear_joint")
    evaluator = Evaluator(study, InlinePool(), verified=0)
    members = evaluator.characteristics
    lower = np.where(members.of_vehicle, members.original, members.lower)
    upper = np.where(members.of_vehicle, members.original, members.upper)
    model = Model(0, evaluator, Unsafe(keep=0.1))
    new_car = Box(evaluator.region, lower, upper)
    worn = Box(evaluator.region, np.where(members.of_vehicle, members.lower, lower), upper)
    robustness = model.robustness(new_car.draw(16, np.random.default_rng(5)), "new car")
    assert robustness.min() >= study.scenario.margin - 0.1
    assert broken_specification(new_car, [model]) == {}
    assert evaluator.simulated == 16
    assert not _keeps_its_margin(worn, model)
    assert not _keeps_its_margin(
        new_car, model._replace(unsafe=Unsafe(keep=study.scenario.margin + 0.1))
    )


def test_no_limit_is_kept_where_the_original_is_unsafe_up_to_each_value() -> None:
    study = load_study("wear")
    evaluator = Evaluator(study, InlinePool(), verified=0)
    options = {"fits": 0, "attack": 0, "characteristics": ("brakeTorque",)}
    answer = tolerance.compute(study, evaluator, by="speed=10", margin=99, **options)
    assert "Up to 10 km/h no limit holds: the original vehicle itself is unsafe" in answer.verdict
    assert answer.numbers["kept"] is False
    assert answer.failures == ("the limits hold up to none of these values, not 10 km/h",)


@pytest.mark.parametrize(
    ("point", "scope"),
    [
        ("CPNA, speed 40, impact_location 25, wet", "crossing (CPNA) at 40 km/h, impact location"),
        ("CPLA, speed 60, wet", "along (CPLA) at 60 km/h; weather wet"),
    ],
)
def test_limits_at_one_point_of_a_matrix_claim_nothing_beyond_it(point: str, scope: str) -> None:
    study = at_point(load_study("wear"), point)
    assert scope_of(study).startswith(scope)
    assert drawn_between(study, np.random.default_rng(0), None) == []
