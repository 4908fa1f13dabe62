"""Encounters between the tests of a matrix: the axes that a test's scenario can move, as ranges.

Each such test alone, with its axes as searched parameters, is a study of its own; a setting there
has the vehicle's characteristics, then a place on each axis.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.phases import in_phases
from safevar_sumo.questions.scope import moving_axes, points_of_tests
from safevar_sumo.questions.words import join_phrases
from safevar_sumo.records import FloatArray
from safevar_sumo.study import PHASE, RANGES, Domain, MatrixTest, Study, axis_of
from safevar_sumo.study.encounters import Axes, at_values
from safevar_sumo.sumo.system import System, assemble

PLACES = 8
"""Number of random places on the axes that each vehicle meets first."""
MOST_ENCOUNTERS = 8
"""Largest number of encounters of a test that a search finds and later ones meet, the worst
first.
"""


class MovingTest(NamedTuple):
    """A test of a model's matrix, whose axes are ranges.

    Attributes
    ----------
    test
        The test of the matrix, with the values of its axes.
    base
        The model in all tests, at their points.
    model
        The model in this test alone. An encounter counts only where the original is safe, too.
    """

    test: MatrixTest
    base: Model
    model: Model

    def box(self, box: Box) -> Box:
        """A box of vehicles, at all places."""
        return box.in_encounters_of(self.model.evaluator.region)

    def spread(self, vehicles: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Vehicles, shape (K, n), each at `PLACES` random places, shape (K PLACES, n + axes)."""
        axes = self.model.characteristics.scenario
        settings = np.repeat(vehicles, PLACES, axis=0)
        places = rng.random((len(settings), len(axes)))
        return np.hstack([settings, axes.lower + places * (axes.upper - axes.lower)])

    def robustness(self, settings: FloatArray, stage: str) -> FloatArray:
        """What settings leave to the limit, shape (M,), in encounters as they are printed."""
        return self.model.robustness(self.as_printed(settings), stage)

    def as_printed(self, settings: FloatArray) -> FloatArray:
        """Settings in encounters as they are printed."""
        return self.model.characteristics.with_printed_encounters(settings)

    def as_tests(self, settings: FloatArray) -> tuple[Model, FloatArray]:
        """The vehicles of unsafe settings, the worst first, shape (K, n), and the model at their
        first encounters alone, as tests of a matrix; settings in other encounters are left out.
        """
        vehicles, places = self.model.evaluator.system.split(self.as_printed(settings))
        first = [*dict.fromkeys(map(tuple, places.tolist()))][:MOST_ENCOUNTERS]
        axes = self.model.characteristics.scenario.names
        tests = [at_values(self.test, dict(zip(axes, place, strict=True))) for place in first]
        is_first = [tuple(place) in first for place in places.tolist()]
        return meeting(self.base, tests, alone=True), vehicles[is_first]


def moving_tests(model: Model, new_car: Unsafe) -> list[MovingTest]:
    """The tests of a model's matrix with axes that move; an encounter counts unless the original is
    unsafe by `new_car` in it.
    """
    study = model.evaluator.study
    tests = list[MovingTest]()
    for test, points in points_of_tests(study, assemble(study).points):
        axes = moving_axes(study, test, points)
        lists = study.lists_of(test)
        # An axis with one value does not move.
        domains = {name: axes[name] for name in axes if len(lists[name]) > 1}
        if test and domains:
            listed = replace_in(test, over={**lists})
            evaluator = model.evaluator.for_study(in_ranges(study, [(listed, domains)]), verified=0)
            # The original is simulated only where a vehicle fails.
            moving = Model(model.fit, evaluator, model.unsafe, new_car=new_car)
            tests.append(MovingTest(listed, model, moving))
    return tests


def in_ranges(study: Study, tests: Sequence[tuple[MatrixTest, dict[str, Domain]]]) -> Study:
    """A study of some tests alone, of which some axes may have any value of a domain; all of its
    encounters count.
    """
    moving = []
    for test, domains in tests:
        over: Axes = {**study.lists_of(test), **{name: axis_of(domains[name]) for name in domains}}
        moving.append(replace_in(test, over=over))
    return replace_in(study.listed().all_count.with_tests(moving), encounters=RANGES)


def meeting(model: Model, tests: Sequence[MatrixTest], *, alone: bool = False) -> Model:
    """A model at further tests beside those of its matrix, or at these `alone`; a point that the
    matrix has counts once.
    """
    study = model.evaluator.study.listed()
    known = [] if alone else study.tests
    points = {_point_key(study, point): point for test in tests for point in study.points_of(test)}
    for test in known:
        for point in study.points_of(test):
            points.pop(_point_key(study, point), None)
    further = study.with_tests([*known, *points.values()])
    return model._replace(evaluator=model.evaluator.for_study(further, verified=0), points=None)


def _point_key(study: Study, point: MatrixTest) -> tuple[Any, ...]:
    """What tells a test at one point from others."""
    weather = [*map(repr, point.weathers)]
    return (point.name, *((name, *at) for name, at in study.lists_of(point).items()), *weather)


def with_set_axes(study: Study, system: System, changes: Collection[str]) -> tuple[Study, System]:
    """A study and its system; if axes of its matrix, or the phase, are among the names of what a
    user sets, settings have values of these, in the tests that have all of the axes.

    Raises
    ------
    InputError
        If the phase is set, and the study's encounters have none; or axes that no test has
        together.
    """
    names = {*changes} - {*system.characteristics.names}
    found = _with_axes(study, system, names)
    if PHASE in names:
        phased = in_phases(found, assemble(found))
        if phased == found:
            problem = f"study {study.name!r} has no {PHASE}"
            expected = "a study whose actors move on tracks, and react to nobody"
            raise InputError("", problem, expected)
        found = phased
    return found, system if found == study else assemble(found)


def _with_axes(study: Study, system: System, names: set[str]) -> Study:
    """A study in which those of the names that are listed axes, which a scenario can move, may have
    any value, in the tests that have all of them.
    """
    moving = [
        (test, moving_axes(study, test, own))
        for test, own in points_of_tests(study, system.points)
        if test
    ]
    axes = names & {name for _, domains in moving for name in domains}
    if not axes:
        return study
    kept = [
        (test, {name: domains[name] for name in domains if name in axes})
        for test, domains in moving
        if axes <= domains.keys()
    ]
    if not kept:
        problem = f"no test has {join_phrases(sorted(axes))} together"
        raise InputError("", problem, "values of one test's axes")
    return in_ranges(study, kept)
