"""Encounters between those that a matrix lists: the axes that a scenario can move, as ranges, and
the phase.

A driving system decides once in a step, so what a vehicle leaves to the limit depends on when
between two decisions the encounter begins. Claims meet the worst phase.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.errors import InputError
from safevar_sumo.questions.part import moving_axes, points_of_tests
from safevar_sumo.questions.words import join_phrases
from safevar_sumo.scenarios import PHASES
from safevar_sumo.study import PHASE, RANGES, Domain, MatrixTest, Study, axis_of
from safevar_sumo.study.encounters import Axes
from safevar_sumo.sumo.batch import reason_against_scenes
from safevar_sumo.sumo.system import System, assemble

if TYPE_CHECKING:
    from safevar_sumo.questions.models import Model

AT_ONE_PHASE = (
    "Every encounter began at the same moment of a step (the time between two decisions of the"
    " driving system)."
)
"""What to know of encounters without phases."""
COUNTS_STEPS = (
    "In this study, an encounter that begins one step later ends differently, because the driving"
    " system or a sensor counts steps. Only encounters that begin within one step were simulated."
)
"""What to know of a driving system whose cycle is longer than a step."""
SAME = 1e-6
"""Difference up to which what is left at two phases is the same."""
DOMAIN = Domain(unit=PHASES[PHASE].unit, original=0.0, lower=0.0, upper=1.0)
"""All phases: an encounter that begins a whole step later is the same one."""


def in_phases(study: Study, system: System) -> Study:
    """A study that searches the phase, too, as its last parameter; itself where the encounters of
    some point have none, as bodies do not move on tracks.
    """
    has_phases = all(point.scenario.has_phase for point in system.points)
    if (
        not has_phases
        or reason_against_scenes(system)
        or PHASE in system.characteristics.names
    ):
        return study
    base = study if study.ranges else study.listed().all_count
    over: Axes = {**base.scenario.over, PHASE: axis_of(DOMAIN)}
    return replace_in(
        base, encounters=RANGES, scenario=replace_in(base.scenario, over=over)
    )


def remark_on_phases(claim: Model | None) -> str:
    """What to know of claims without phases, or in whose model the original vehicle ends otherwise
    in its own encounter, if that begins a whole step later; else "".
    """
    if claim is None:
        return AT_ONE_PHASE
    rows = np.repeat(claim.characteristics.original_settings, 2, axis=0)
    rows[1, -1] = 1.0
    at_begin, at_end = claim.robustness(rows, "phases of the original")
    return "" if np.isclose(at_begin, at_end, atol=SAME) else COUNTS_STEPS


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
