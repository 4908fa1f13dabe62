"""Makes studies with encounters between the listed values of a matrix: axes that a scenario can
move become ranges, and the phase varies.

A driving system decides once in a step. The result of an encounter depends on the phase: the moment
between two decisions at which the encounter begins. Therefore claims are tested at all phases.
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
from safevar_sumo.sumo.batch import reason_against_scenes
from safevar_sumo.sumo.system import System, assemble

if TYPE_CHECKING:
    from safevar_sumo.questions.models import Model

AT_ONE_PHASE = (
    "Every encounter began at the same moment of a step (the time between two decisions of the"
    " driving system)."
)
"""The remark if a study has no phases."""
COUNTS_STEPS = (
    "In this study, an encounter that begins one step later ends differently, because the driving"
    " system or a sensor counts steps. Only encounters that begin within one step were simulated."
)
"""The remark if the driving system or a sensor has a cycle that is longer than a step."""
SAME_ROBUSTNESS = 1e-6
"""Largest difference of the robustness at two phases that counts as no difference."""
DOMAIN = Domain(unit=PHASES[PHASE].unit, original=0.0, lower=0.0, upper=1.0)
"""All phases. An encounter that begins a whole step later (phase 1) should end as at phase 0."""


def in_phases(study: Study, system: System) -> Study:
    """The study with the phase as a further searched parameter, which comes last. The study itself
    is returned if it has the phase already, or if the encounters of some point have no phase,
    because bodies do not move on tracks.
    """
    has_phases = all(point.scenario.has_phase for point in system.points)
    if (
        not has_phases
        or reason_against_scenes(system)
        or PHASE in system.characteristics.names
    ):
        return study
    base = study if study.ranges else study.listed().all_count
    over = {**base.scenario.over, PHASE: axis_of(DOMAIN)}
    return replace_in(
        base, encounters=RANGES, scenario=replace_in(base.scenario, over=over)
    )


def remark_on_phases(claim: Model | None) -> str:
    """The remark on the phases of a claim; "" if none is needed. `claim` is the model with phases,
    or None if the study has no phases. The second remark is needed if the original vehicle's
    encounter ends in another way when it begins a whole step later.
    """
    if claim is None:
        return AT_ONE_PHASE
    rows = np.repeat(claim.characteristics.original_settings, 2, axis=0)
    rows[1, -1] = 1.0
    runs = claim.evaluate(rows, "phases of the original")
    at_begin, at_end = np.where(runs.valid, claim.unsafe.robustness(runs), np.inf)
    return "" if np.isclose(at_begin, at_end, atol=SAME_ROBUSTNESS) else COUNTS_STEPS


def in_ranges(
    study: Study, tests: Sequence[tuple[MatrixTest, dict[str, Domain]]]
) -> Study:
    """The study with only some tests. Each test comes with the axes that become ranges, and with
    their domains. All encounters count, also if the original vehicle is unsafe in them.
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
    """The study and its system, in a form in which a user can set the values called `changes`.

    If axes of the matrix, or the phase, are among these names, they become searched parameters, so
    that settings have values of them. Only tests that have all these axes remain.

    Raises
    ------
    InputError
        If the phase is set, but the study's encounters have no phase; or if no test has all the
        axes that are set.
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
    """The study in which some listed axes become ranges: those of `names` that a scenario can move.
    Only tests that have all of them remain.
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
