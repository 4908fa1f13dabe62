"""Parts of the search for joint limits: falsifications side by side, cuts, and what needs none."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from numpy.random import default_rng

from safevar_sumo.api.simulation import load_study
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.between import moving_tests
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.falsify import Falsification, falsify, falsify_all
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.part import at_point
from safevar_sumo.questions.scope import scope_of
from safevar_sumo.questions.tolerance.extension import Extension
from safevar_sumo.questions.tolerance.search import BoxSearch
from safevar_sumo.questions.tolerance.specified import _keeps_its_margin, broken_specification
from safevar_sumo.records import FloatArray
from safevar_sumo.vehicles import region_of
from tests.in_process import InlinePool
from tests.questions.conftest import made_up_study, model_of


def test_attacks_side_by_side_find_what_each_finds_alone() -> None:
    region = region_of(load_study("smoke"))
    members = region.characteristics
    boxes = [
        Box(region, members.lower, members.upper),
        Box(region, members.original, members.upper),
    ]

    def judge(rows: FloatArray) -> FloatArray:
        return (
            np.abs((rows - members.lower) / (members.upper - members.lower) - 0.7).sum(axis=1) - 0.5
        )

    def alone(number: int) -> Falsification:
        return falsify(boxes[number], [judge, judge], [], 2000, default_rng(number))

    rngs = [default_rng(number) for number in (0, 1)]
    for one, other in zip(
        falsify_all(boxes, [judge, judge], [(), ()], 2000, rngs), map(alone, (0, 1)), strict=True
    ):
        assert np.array_equal(one.settings, other.settings)
        assert one.simulated == other.simulated


def test_a_cut_keeps_off_failures_by_its_clearance() -> None:
    """Each failure alone would move in its cheapest limit; both are cut off at once by one limit of
    the first.
    """
    search = BoxSearch(model_of(made_up_study(2)), [0, 1], {}, np.array([[9.0, 9.5], [9.5, 8.0]]))
    whole = search.box(search.domain)
    cut = Extension(search).cut(whole, 0.8)
    assert cut.upper.tolist() == pytest.approx([8.9, 10], abs=0.1)
    assert not cut.holds(search.unsafe_settings).any()
    assert Extension(search).cut(whole, 4.8).upper[0] < cut.upper[0] - 0.2, "it keeps off by more"


def test_no_box_without_failures_is_larger_than_the_cut() -> None:
    """Of all that move one limit in for each failure."""
    failures = default_rng(1).uniform(0, 10, (7, 2))
    search = BoxSearch(model_of(made_up_study(2)), [0, 1], {}, failures)
    cut = Extension(search).cut(search.box(search.domain), 1e-6)
    volumes = []
    for columns in product((0, 1), repeat=7):
        sides = search.domain.copy()
        for failure, column in zip(search.extents(failures), columns, strict=True):
            side = np.argmax(failure[:, column])
            sides[side, column] = min(sides[side, column], failure[side, column])
        volumes.append(search.log_volume(sides))
    assert search.log_volume(search.sides_of(cut)) == pytest.approx(max(volumes), abs=0.02)


@pytest.mark.slow
def test_a_new_car_needs_no_trial_where_an_encounter_counts_only_if_it_keeps_its_margin() -> None:
    study = load_study("wear", encounters="ranges")
    evaluator = Evaluator(study, InlinePool(), verified=0)
    members = evaluator.characteristics
    lower = np.where(members.of_vehicle, members.original, members.lower)
    upper = np.where(members.of_vehicle, members.original, members.upper)
    model = Model(0, evaluator, Unsafe(keep=0.1))
    new_car = Box(evaluator.region, lower, upper)
    worn = Box(evaluator.region, np.where(members.of_vehicle, members.lower, lower), upper)
    robustness = model.robustness(new_car.draw(16, default_rng(5)), "new car")
    assert robustness.min() >= study.scenario.margin - 0.1
    assert broken_specification(new_car, [model], {0: ()}) == {}
    assert evaluator.simulated == 16
    assert not _keeps_its_margin(worn, model)
    assert not _keeps_its_margin(
        new_car, model._replace(unsafe=Unsafe(keep=study.scenario.margin + 0.1))
    )


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
    assert moving_tests(model_of(study), Unsafe()) == []
