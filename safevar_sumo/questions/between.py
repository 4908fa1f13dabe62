"""Encounters between the tests of a matrix: the axes that a test's scenario can move, as ranges.

Each such test alone, with its axes as searched parameters, is a study of its own; a setting there
has the vehicle's characteristics, then a place on each axis.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

from msgspec.structs import replace as replace_in

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.phases import in_phases
from safevar_sumo.questions.scope import moving_axes, points_of_tests
from safevar_sumo.questions.words import join_phrases
from safevar_sumo.study import PHASE, RANGES, Domain, MatrixTest, Study, axis_of
from safevar_sumo.sumo.system import System, assemble


class MovingTest(NamedTuple):
    """A test of a model's matrix, whose axes are ranges.

    Attributes
    ----------
    test
        The test of the matrix, with the values of its axes.
    model
        The model in this test alone. An encounter counts only where the original is safe, too.
    """

    test: MatrixTest
    model: Model


def moving_tests(model: Model, new_car: Unsafe) -> list[MovingTest]:
    """The tests of a model's matrix with axes that move; an encounter counts unless the original is
    unsafe by `new_car` in it.
    """
    study = model.evaluator.study
    tests = []
    for test, points in points_of_tests(study, assemble(study).points):
        axes = moving_axes(study, test, points)
        lists = study.lists_of(test)
        # An axis with one value does not move.
        domains = {name: axes[name] for name in axes if len(lists[name]) > 1}
        if test and domains:
            listed = replace_in(test, over={**lists})
            evaluator = model.evaluator.for_study(
                in_ranges(study, [(listed, domains)]), verified=0
            )
            # The original is simulated only where a vehicle fails.
            moving = Model(model.fit, evaluator, model.unsafe, new_car=new_car)
            tests.append(MovingTest(listed, moving))
    return tests


def in_ranges(
    study: Study, tests: Sequence[tuple[MatrixTest, dict[str, Domain]]]
) -> Study:
    """A study of some tests alone, of which some axes may have any value of a domain; all of its
    encounters count.
    """
    moving = []
    for test, domains in tests:
        over = {
            **study.lists_of(test),
            **{name: axis_of(domains[name]) for name in domains},
        }
        moving.append(replace_in(test, over=over))
    return replace_in(study.listed().all_count.with_tests(moving), encounters=RANGES)


def with_set_axes(
    study: Study, system: System, changes: Collection[str]
) -> tuple[Study, System]:
    """A study and its system; if axes of its matrix, or the phase, are among the names of what a
    user sets, settings have values of these, in the tests that have all of the axes.

    Raises
    ------
    InputError
        If the phase is set, and the study's encounters have none; or axes that no test has
        together.
    """
    names = {*changes} - {*system.characteristics.names}
    extended = _with_axes(study, system, names)
    if PHASE in names:
        phased = in_phases(extended, assemble(extended))
        if phased == extended:
            raise InputError(
                "",
                f"study {study.name!r} has no {PHASE}",
                "a study whose actors move on tracks, and react to nobody",
            )
        extended = phased
    if extended == study:
        return study, system
    return extended, assemble(extended)


def _with_axes(study: Study, system: System, names: set[str]) -> Study:
    """A study in which those of the names that are listed axes, which a scenario can move, may have
    any value, in the tests that have all of them.
    """
    moving = []
    axes = set[str]()
    for test, points in points_of_tests(study, system.points):
        if test:
            domains = moving_axes(study, test, points)
            moving.append((test, domains))
            axes |= names & domains.keys()
    if not axes:
        return study
    tests = []
    for test, domains in moving:
        if axes <= domains.keys():
            domains_of_axes = {name: domains[name] for name in domains if name in axes}
            tests.append((test, domains_of_axes))
    if not tests:
        raise InputError(
            "",
            f"no test has {join_phrases(sorted(axes))} together",
            "values of one test's axes",
        )
    return in_ranges(study, tests)
