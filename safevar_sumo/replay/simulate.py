"""The command `simulate`: one setting of a study beside the original vehicle."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from safevar_sumo.api.simulation import Simulation, simulate_with_original
from safevar_sumo.errors import InputError, about, warn
from safevar_sumo.output import check_writable, whole_file
from safevar_sumo.questions.answer import Answer, contents
from safevar_sumo.questions.between import with_set_axes
from safevar_sumo.questions.changes import read_changes
from safevar_sumo.questions.counterexamples import fewest_changes
from safevar_sumo.questions.model_spread import studies_of_sets
from safevar_sumo.questions.options import PointName, Range, UpTo
from safevar_sumo.questions.part import part_of_study
from safevar_sumo.questions.subject import (
    refuse_part_of_results,
    study_in,
    study_or_case,
)
from safevar_sumo.records import FloatArray, JsonObject, csv_text
from safevar_sumo.replay import animation
from safevar_sumo.replay.comparison import (
    comparison_of,
    list_differences,
    why_different,
)
from safevar_sumo.replay.figure import draw_comparison
from safevar_sumo.replay.gui import show_in_gui
from safevar_sumo.replay.setting import (
    COLUMNS_BY_TABLE,
    OUTCOME_NAMES,
    REMARKS,
    answer_of_setting,
)
from safevar_sumo.results import (
    CHOICES,
    SOLUTIONS,
    SolutionId,
    choose_handle,
    row_of_handle,
)
from safevar_sumo.study import PHASE, PHASE_DECIMALS, Study
from safevar_sumo.sumo.encounters import where_met
from safevar_sumo.sumo.system import System, assemble


class Target(NamedTuple):
    """The target of `simulate`: a study, or a solution of results. `source` is its name in errors.

    A solution has its handle, and its row of the table of solutions; both are None for a study. If
    needless changes of a solution are undone (choice `fewest`), `row` has only the values of its
    characteristics, without an outcome.
    """

    study: Study
    source: str
    handle: SolutionId | None = None
    row: JsonObject | None = None

    def setting(self, system: System) -> FloatArray:
        """The setting of the solution, shape (n,); for a study, the original setting."""
        if self.row is None:
            return system.characteristics.original
        values = system.characteristics.named(system.characteristics.original)
        return np.array(
            [self.row.get(name, value) for name, value in values.items()], float
        )


@contents(
    *("solution", *OUTCOME_NAMES, ...),
    **COLUMNS_BY_TABLE,
    remarks=REMARKS,
)
def show_simulation(
    source: str,
    *,
    solution: Annotated[str | None, "ALG:RUN:N"] = None,
    set: Annotated[tuple[str, ...], "NAME=VALUE"] = (),
    beyond: bool = False,
    trace: Path | None = None,
    animate: Path | None = None,
    gui: bool = False,
    point: PointName = None,
    ranges: bool = False,
    up_to: UpTo = None,
    fit: Annotated[int, Range(0, 1000)] = 0,
    as_it_is_now: bool = False,
) -> Answer:
    """Simulate one vehicle of a STUDY, or one solution in a directory of results (DIR), beside the
    original vehicle. You get how the simulations of the two vehicles end, with safety metrics. The
    options --trace and --animate write the simulation to a file.

    Example: python -m safevar_sumo simulate rain --set tireFric=1.1

    Parameters
    ----------
    solution
        Simulate this solution of the results, such as nsga2:3:0. Three words also name an
        unsafe solution: smallest or fewest (changes), or most-severe (collision).
    set
        Change a value, such as "tireFric=1.1" or "mass=+8%"; may be repeated.
    beyond
        Accept values outside the domains (allowed ranges), and vehicles that violate a constraint
        of the study. Default: an error.
    trace
        Write the simulation step by step to this CSV file.
    animate
        Draw both vehicles from above as an animation. The name of the file ends in .gif or .html.
    gui
        Show both simulations in SUMO's window. The original vehicle is blue, the changed vehicle
        orange.
    point
        Use only this test or test case of the study, such as CPNA. Default: all tests.
    ranges
        Allow any encounter within the ranges that the study states. Default: only the listed test
        cases.
    up_to
        Use only encounters in which this value is not exceeded, such as speed=40. The unit is that
        of the study.
    fit
        Use this parameter set (calibration) of the vehicle model. 0 is the set of the study.
    as_it_is_now
        Use the present files and versions, although the results were computed with other files or
        versions. Default: an error.
    """
    target = load_target(
        source, solution, as_it_is_now, point, ranges=ranges, up_to=up_to
    )
    study = _with_set(target.study, fit)
    system = assemble(study)
    changes = set
    with about("set"):
        names = [change.partition("=")[0].strip() for change in changes]
        study, system = with_set_axes(study, system, names)
        values = read_changes(changes, system.characteristics, beyond=beyond)
        if PHASE in values:
            values[PHASE] = round(values[PHASE], PHASE_DECIMALS)
        target_values = system.characteristics.named(target.setting(system))
        requested = np.array(list({**target_values, **values}.values()))
        # Without changes the setting is that of a study or of results, which has been checked.
        if changes and not beyond:
            system.region.check(
                requested[np.newaxis], otherwise=", or any with --beyond"
            )

    # Files that cannot be written are refused first.
    if trace is not None:
        check_writable(trace, "trace", (".csv",), but=SOLUTIONS)
    if gui:
        system.require("sumo-gui", "simulate --gui")
    if animate is not None:
        check_writable(animate, "animate", animation.ENDINGS, but=SOLUTIONS)

    system = _where_met(system, requested)
    simulation = simulate_with_original(study, system, requested, filtered=False)
    # Stored results are those of the worst point of the matrix: at a chosen point they may differ.
    if target.row and "outcome" in target.row and not changes and point is None:
        _warn_of_differences(target, target.row, simulation)
    if trace is not None:
        _write_trace(trace, system, simulation)
    comparison = comparison_of(simulation)
    if animate is not None:
        animation.animate(comparison, animate)
    if gui:
        show_in_gui(comparison)
    answer = answer_of_setting(system, simulation, target.handle)
    return replace(answer, draw=lambda _: draw_comparison(comparison))


def _write_trace(path: Path, system: System, simulation: Simulation) -> None:
    """Write a simulation step by step to a CSV file. A simulator without speeds is refused."""
    if simulation.pair.runs.lacking("speed").any():
        system.require("a trace", "simulate --trace")
    with whole_file(path, "trace") as file:
        file.write_text(csv_text(simulation.trace), encoding="utf-8", newline="\n")


def _where_met(system: System, setting: FloatArray) -> System:
    """The system, reduced to the points whose ranges have the encounter of a setting, shape (n,). A
    warning names the tests that are left out.
    """
    reduced = where_met(system, setting)
    if names := sorted(_tests_of(system) - _tests_of(reduced)):
        warn(
            f"not driven, as their ranges do not have this encounter: {', '.join(names)}"
        )
    return reduced


def _tests_of(system: System) -> set[str]:
    return {point.parameters.get("test", "") for point in system.points}


def load_target(
    source: str,
    solution: str | None,
    as_it_is_now: bool,
    point: str | None,
    *,
    ranges: bool = False,
    up_to: str | None = None,
) -> Target:
    """Load a study, by its name, its path or a directory of its results, with the solution of these
    results that a handle or a choice names. `point`, `ranges` and `up_to` select a part of the
    study.

    Raises
    ------
    InputError
        If there is no such study, directory, solution or point.
    """
    subject = study_or_case(
        source, as_it_is_now=as_it_is_now, results_only=solution is not None
    )
    if not isinstance(subject, Study):
        if subject.shortfall:
            warn(subject.shortfall)
        refuse_part_of_results(ranges=ranges, up_to=up_to)
    study = part_of_study(study_in(subject), ranges, point, up_to)
    if isinstance(subject, Study) or solution is None:
        return Target(study, source)

    subject.require_solutions()
    choice = solution.replace("-", "_")
    with about(source):
        handle = (
            choose_handle(subject.solutions, subject.unsafe, choice)
            if choice in CHOICES
            else SolutionId.parse(solution)
        )
    row = row_of_handle(subject.solutions, handle)
    values: dict[Any, Any] = subject.solutions.iloc[row].to_dict()
    fewest = fewest_changes(subject) if choice == "fewest" else None
    if fewest:
        values = subject.characteristics.named(fewest.settings[0])
    return Target(study, source, handle, values)


def _with_set(study: Study, fit: int) -> Study:
    """The study with the parameter set `fit` of its vehicle model; 0 is the study's own set."""
    if not fit:
        return study
    with about("fit"):
        sets = studies_of_sets(study)
        if fit >= len(sets):
            raise InputError("", f"{fit}", f"a number up to {len(sets) - 1}")
    return sets[fit]


def _warn_of_differences(
    target: Target, row: JsonObject, simulation: Simulation
) -> None:
    reason = why_different(is_imported="run" not in row)
    for difference in list_differences(simulation.evaluation, row):
        warn(f"{target.handle} of {target.source}: {difference}; {reason}")
