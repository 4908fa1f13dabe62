"""Printed counterexamples fail as printed, printed speeds and limits hold, and what does not count
is said.
"""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from safevar_sumo import tolerance
from safevar_sumo.api.simulation import load_study
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.counterexamples import describe
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.falsify import LEAST_SIMULATIONS
from safevar_sumo.questions.models import Model, judges_of
from safevar_sumo.questions.reach import falsify_limits, reach, rounded_towards
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import ORIGINAL_DEGREE, Study
from safevar_sumo.sumo.matrix import drive_and_score
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import Characteristic, region_of
from tests.in_process import InlinePool
from tests.questions.conftest import made_up_evaluator, made_up_study

ONE_TEST = """
extends = "wear"
name = "child_at_any_speed"
title = "A child from behind a parked car, at any speed"
wider = ""
[matrix]
tests = [{ name = "CPNCO", parameters = { test = "CPNCO" } }]
[scenario.search]
speed = { unit = "km/h", original = 40, lower = 10, upper = 60, meaning = "speed at the start" }
impact_location = { unit = "%", original = 50, lower = 25, upper = 75, meaning = "impact location" }
"""
GRID = 41
"""Values of speed and of impact location at which a claim is driven through."""


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> Study:
    file = tmp_path_factory.mktemp("counterexamples") / "child.toml"
    file.write_text(ONE_TEST)
    return load_study(str(file))


@pytest.fixture(scope="module")
def rough(searched: Study) -> Answer:
    """Limits with the study's own fit, of one characteristic, after few simulations."""
    options: dict[str, Any] = {"characteristics": ("treadDepth",), "limits": ("treadDepth >= 3",)}
    return tolerance(searched, by="speed=40,60", fits=0, attack=100, jobs=1, **options)


def drives(study: Study, tread: float, highest: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Speeds, what a car with this tread keeps, and what the original does, over a grid of
    encounters.
    """
    system = assemble(study)
    members = system.characteristics
    speeds, places = np.meshgrid(np.linspace(10, highest, GRID), np.linspace(25, 75, GRID))
    settings = np.tile(members.original, (speeds.size, 1))
    columns = [members.names.index(name) for name in ("treadDepth", "speed", "impact_location")]
    settings[:, columns] = np.stack(
        [np.full(speeds.size, tread), speeds.ravel(), places.ravel()], axis=1
    )
    runs = drive_and_score(system, settings)
    return speeds.ravel(), runs.f_safe, runs.column(ORIGINAL_DEGREE)


@pytest.mark.slow
def test_what_fails_first_fails_as_it_is_printed(searched: Study, rough: Answer) -> None:
    """Simulated anew with the values of `fails_at`, each car keeps less than the margin, and the
    original does not.
    """
    rows = rough.to_dict()["tables"]["limits"]["rows"]
    system = assemble(searched)
    names = system.characteristics.names
    assert any(row["fails_at"] for row in rows)
    for row in rows:
        if row["fails_at"]:
            runs = drive_and_score(system, np.array([[row["fails_at"][name] for name in names]]))
            assert runs.f_safe[0] < rough.numbers["margin"]
            assert runs.column(ORIGINAL_DEGREE)[0] >= searched.scenario.margin
            speed = f"at {row['fails_at']['speed']:.10g} km/h"
            assert speed in row["fails_first"], "the encounter is named"
            assert row["alone_low"] > row["fails_at"]["treadDepth"] > row["alone_low"] - 0.5


@pytest.mark.slow
def test_up_to_the_printed_speed_no_car_is_unsafe_and_soon_beyond_it_one_is(
    searched: Study, rough: Answer
) -> None:
    up_to = rough.numbers["up_to"]
    assert round(up_to, 1) == up_to
    assert rough.numbers["attacked"] >= LEAST_SIMULATIONS
    _, keeps, original = drives(searched, 3.0, up_to)
    assert keeps[original >= searched.scenario.margin].min() >= rough.numbers["margin"]
    if up_to < rough.numbers["original_keeps_up_to"]:
        _, keeps, original = drives(searched, 3.0, up_to + 1.5)
        assert keeps[original >= searched.scenario.margin].min() < rough.numbers["margin"]
    assert rough.verdict.startswith("Rough answer, with 100 instead of 5,000 simulations")
    assert rough.numbers["rough"] is True


@pytest.mark.slow
def test_every_limit_of_a_table_by_speed_holds_in_all_encounters_that_count(
    searched: Study, rough: Answer
) -> None:
    for row in rough.to_dict()["tables"]["limits"]["rows"]:
        _, keeps, original = drives(searched, row["alone_low"], row["by_speed"])
        assert keeps[original >= searched.scenario.margin].min() >= rough.numbers["margin"]


@pytest.mark.slow
def test_the_originals_own_limit_is_a_number_and_is_said_early(
    searched: Study, rough: Answer
) -> None:
    keeps_up_to = rough.numbers["original_keeps_up_to"]
    safe_up_to = rough.numbers["original_safe_up_to"]
    speeds, _, original = drives(searched, 3.0, 60.0)
    margin = searched.scenario.margin
    assert original[speeds <= keeps_up_to].min() >= margin
    assert original[speeds <= safe_up_to].min() >= 0
    step = 50 / (GRID - 1)
    assert original[speeds <= keeps_up_to + step].min() < margin
    assert original[speeds <= safe_up_to + step].min() < 0
    assert rough.numbers["up_to"] <= keeps_up_to <= safe_up_to
    second = rough.verdict.split(". ")[2]
    assert second.startswith(
        f"The original vehicle itself keeps 0.3 m of clearance only up to {keeps_up_to:g} km/h"
    )
    beyond = next(
        row for row in rough.to_dict()["tables"]["limits"]["rows"] if row["by_speed"] == 60
    )
    assert "of the encounters in which the original keeps 0.3 m" in beyond["sentence"]


@pytest.mark.slow
def test_contacts_where_the_original_keeps_too_little_are_counted(
    searched: Study, rough: Answer
) -> None:
    speeds, keeps, original = drives(searched, 3.0, 60.0)
    is_contact = (keeps < 0) & (original >= 0) & (original < searched.scenario.margin)
    assert rough.numbers["contacts_left_out"] > 0
    assert is_contact.any()
    lowest = float(
        re.search(r"such contacts? found, the lowest at speed ([\d.]+) km/h", rough.verdict)[1]
    )  # type: ignore[index]
    assert lowest <= speeds[is_contact].min() + 0.1
    assert lowest >= rough.numbers["original_keeps_up_to"] - 0.1


@pytest.mark.slow
def test_without_a_search_for_counterexamples_no_speed_is_printed_and_nothing_is_kept(
    searched: Study,
) -> None:
    options: dict[str, Any] = {
        "characteristics": ("treadDepth",),
        "limits": ("treadDepth >= 7.5",),
        "fits": 0,
    }
    answer = tolerance(searched, by="speed=20", attack=0, jobs=1, **options)
    assert (answer.numbers["up_to"], answer.numbers["kept"]) == (None, None)
    assert answer.values("limits.kept") == [None]
    assert answer.failures == ("with --attack 0, no simulation searched for a counterexample",)
    assert "km/h: " not in answer.verdict.partition("Scope")[0]


@pytest.mark.slow
def test_every_sentence_of_a_limit_has_its_scope(rough: Answer) -> None:
    for sentence in rough.values("limits.sentence"):
        assert "Scope: crossing (CPNCO) at 10 to" in sentence
        assert "weather wet" in sentence


def test_a_counterexample_that_is_safe_as_rounded_gets_more_digits_or_is_left_out() -> None:
    """Unsafe are values of the first from 7.13 to 7.1302 without the former: with up to three
    digits none is.
    """

    def sliver(rows: FloatArray) -> BoolArray:
        return np.asarray((rows[:, 0] >= 7.13) & (rows[:, 0] <= 7.1302) & (rows[:, 0] != 7.13))

    model = Model(0, made_up_evaluator(2, sliver), Unsafe())
    unsafe = np.array([7.13005, 5.0])
    found = describe(model, {"a": unsafe, "b": np.array([7.5, 5.0])})
    assert [*found] == ["a"], "a setting that is safe is not described"
    assert sliver(found["a"].setting[np.newaxis])[0]


def test_a_described_setting_stays_within_the_limits_that_it_breaks() -> None:
    study = made_up_study(2)
    model = Model(0, made_up_evaluator(2, lambda rows: rows[:, 0] > 7), Unsafe())
    within = Box(region_of(study), np.array([5.0, 5.0]), np.array([7.1234, 5.0]))
    found = describe(model, {"": np.array([7.12339, 5.0])}, within)
    assert within.holds(found[""].setting[np.newaxis])[0]


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("edge", [1.0, 2.77, 4.99, 0.0, -0.1])
def test_a_reach_ends_just_before_a_planted_boundary_at_its_start_or_nowhere(
    edge: float, side: int
) -> None:
    """Unsafe is a beyond `edge` from the original, on either side, where b is within 0.4 of 8: a
    narrow pocket.
    """

    def pocket(rows: FloatArray) -> BoolArray:
        return np.asarray((side * (rows[:, 0] - 5) > edge) & (np.abs(rows[:, 1] - 8) < 0.4))

    evaluator = made_up_evaluator(2, pocket)
    ends = np.sort([[5.0, 0.0], [5.0 + 5 * side, 10.0]], axis=0)
    judges = judges_of([Model(0, evaluator, Unsafe())], "reach")
    found = reach(
        Box(evaluator.region, *ends), (int(side > 0), 0), 5.0, judges, LEAST_SIMULATIONS, (1,)
    )
    if edge < 0:
        assert found.value is None
        return
    assert found.value is not None
    assert edge - 0.11 <= side * (found.value - 5) <= edge
    assert edge == 0 or found.falsification.simulated >= LEAST_SIMULATIONS  # type: ignore[union-attr]


def test_a_falsification_names_the_model_that_fails() -> None:
    models = [
        Model(0, made_up_evaluator(2, lambda rows: np.zeros(len(rows), dtype=bool)), Unsafe()),
        Model(1, made_up_evaluator(2, lambda rows: rows[:, 1] > 9.5), Unsafe()),
    ]
    box = Box(models[0].evaluator.region, np.zeros(2), np.full(2, 10.0))
    found = falsify_limits(box, judges_of(models, "falsification"), 2000, (1,))
    assert [*found.failures] == [1]
    assert (found.failures[1][:, 1] > 9.5).all()


@pytest.mark.parametrize(
    ("start", "value", "unit", "expected"),
    [
        (10, 48.97, "km/h", 48.9),
        (10, 48.9, "km/h", 48.9),
        (0, 0.127, "s", 0.12),
        (0.5, 0.121, "s", 0.13),
        (0.125, 0.127, "s", 0.125),
    ],
)
def test_values_are_rounded_towards_the_start_as_they_are_printed(
    start: float, value: float, unit: str, expected: float
) -> None:
    item = SimpleNamespace(digits=2, unit=unit)
    assert rounded_towards(start, value, cast(Characteristic, item)) == expected


def test_a_margin_that_the_original_does_not_keep_ends_the_question() -> None:
    study = load_study("wear")
    evaluator = Evaluator(study, InlinePool(), verified=0)
    answer = tolerance.compute(study, evaluator, margin=30)
    assert evaluator.simulated <= 2
    assert answer.verdict.startswith(
        "The original vehicle itself keeps 0.88 m of clearance, less than 30"
    )
    assert answer.numbers["kept"] is False
