"""Evaluates batches of settings in a worker process, and verifies results in SUMO. A task and the
settings determine the results: they are the same in any process on any machine.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.ads.varied import VariedAds
from safevar_sumo.campaign.local import Work
from safevar_sumo.campaign.pool import Home, Look, Pool, WorkerLostError
from safevar_sumo.errors import (
    EnvironmentFault,
    SafevarError,
    SimulationError,
    UserCodeError,
)
from safevar_sumo.metrics import METRICS
from safevar_sumo.plugins.process import REPRODUCED_BY
from safevar_sumo.plugins.time_limit import end_if_longer
from safevar_sumo.records import (
    Evaluations,
    FloatArray,
    IntArray,
    NamedValues,
    Outcome,
    differences,
)
from safevar_sumo.study import Study, user_code_names
from safevar_sumo.sumo.matrix import MAX_COPIES, drive_and_score
from safevar_sumo.sumo.system import System, assemble, simulate_command
from safevar_sumo.sumo.verification import verify_in_sumo
from safevar_sumo.vehicles import CharacteristicSet

VERIFIED_SETTINGS = 50
"""Number of settings of a study that questions verify in SUMO."""
KNOWN_SYSTEMS = 64
"""Number of systems that a process keeps. Questions alternate between the parameter sets of a
vehicle model, and each set has a system of its own.
"""
_first_batches: dict[bytes, tuple[Task, FloatArray, Evaluations]] = {}
"""For each study with user code (packed): the first batch that this process has simulated."""


class Selection(msgspec.Struct, frozen=True):
    """Restricts a task to some points of a study, or varies parameters of the study's ADS. Every
    encounter then counts: no original vehicle drives beside a setting.

    Attributes
    ----------
    parameters
        Names of parameters of the ADS. In every row of settings, their values follow the values of
        the characteristics.
    points
        Numbers of the matrix's points that are simulated; None for all points.
    arrays
        Whether one ADS can drive all rows, with an array of values for each parameter.
    """

    parameters: tuple[str, ...] = ()
    points: tuple[int, ...] | None = None
    arrays: bool = True

    def of(self, system: System) -> System:
        """The system at the selected points."""
        if self.points is None:
            return system
        return replace(
            system, points=tuple(system.points[number] for number in self.points)
        )


EVERYTHING = Selection()
"""Selects all points, the study's own values of the ADS's parameters, and the study's own rule
which encounters count.
"""


class Task(msgspec.Struct, frozen=True, kw_only=True):
    """What a worker has to do with settings: simulate them in a study, in the way that the
    attributes say.

    Attributes
    ----------
    in_sumo
        Whether SUMO moves the vehicles even where a recorded scene suffices.
    batch_size
        Largest number of settings in a batch.
    selection
        The points, and the parameters of the ADS that vary.
    """

    study: Study
    in_sumo: bool = False
    batch_size: int = MAX_COPIES
    selection: Selection = EVERYTHING


def system_of(study: Study) -> System:
    """Return the system of a study. This process assembles the system only once, and again after an
    edit of its user code.
    """
    packed_study = msgspec.msgpack.encode(study)
    system = _assemble_packed(packed_study)
    if system.modules.are_edited:
        _assemble_packed.cache_clear()
        return _assemble_packed(packed_study)
    return system


@lru_cache(maxsize=KNOWN_SYSTEMS)
def _assemble_packed(packed_study: bytes) -> System:
    return assemble(msgspec.msgpack.decode(packed_study, type=Study))


def home_of(study: Study) -> Home:
    """The folders of a study with user code; () for other studies."""
    if not user_code_names(study):
        return ()
    return (*study.origin.places, os.getcwd())


def carry_out(
    function: Work,
    jobs: Sequence[tuple[Any, ...]],
    pool: Pool,
    look: Look = lambda ended: None,
) -> list[Any]:
    """Call a function with the arguments of each job in the pool, and return the results. The first
    argument of a job is its task; the tasks of all jobs are of one study.

    Raises
    ------
    SafevarError
        If two workers die in the same job; the error names the study, the job and user code.
    """
    home = home_of(jobs[0][0].study) if jobs else ()
    try:
        return pool.map(function, jobs, look, home)
    except WorkerLostError as error:
        task, *arguments = jobs[error.job]
        work = "the check of user code"
        if arguments:
            work = str(arguments[0])
            if isinstance(arguments[0], np.ndarray):
                work = f"{len(arguments[0])} settings"
        problem = f"two workers were lost at the same work, {work}: {error}"
        source = f"study {task.study.name!r}"
        if names := user_code_names(task.study):
            problem += f", probably in {' and '.join(names)}"
            raise UserCodeError(source, problem) from None
        raise SafevarError(f"{source}: {problem}") from None


def evaluate_settings(task: Task, rows: FloatArray) -> Evaluations:
    """Evaluate settings of n characteristics and p selected parameters, shape (k, n + p), in
    batches of equal size.

    A batch that fails is halved until the failing settings are alone. A setting that SUMO cannot
    simulate gets the outcome `simulator-error`.

    Raises
    ------
    UserCodeError
        If user code fails; the error has the command that simulates the failing setting.
    EnvironmentFault
        If this machine lacks memory, disk space or files.
    """
    if len(rows) > task.batch_size:
        batches = np.array_split(rows, math.ceil(len(rows) / task.batch_size))
        with system_of(task.study).modules.active():
            return Evaluations.concatenate(
                [evaluate_settings(task, batch) for batch in batches]
            )
    try:
        return evaluate_batch(task, rows)
    except (SimulationError, UserCodeError) as error:
        failure = error
    except (OSError, MemoryError) as error:
        raise EnvironmentFault(
            f"a batch cannot be computed: {str(error) or 'no memory is left'}"
        ) from None
    if len(rows) == 1:
        characteristics = CharacteristicSet.of(task.study)
        # In a row, values of selected parameters follow the characteristics.
        setting = rows[:, : len(characteristics)]
        if isinstance(failure, UserCodeError):
            command = reproduction_command(task.study, setting[0])
            raise UserCodeError(
                failure.source,
                f"{failure.problem}{REPRODUCED_BY}{command}",
                failure.legal,
                failure.place,
            ) from None
        reasons = {rows[0].tobytes(): " ".join(str(failure).split())}
        return Evaluations.undefined(
            rows,
            Outcome.SIMULATOR_ERROR,
            METRICS,
            reasons=reasons,
            **characteristics.change_objectives(setting),
        )
    halves = [evaluate_settings(task, half) for half in np.array_split(rows, 2)]
    if isinstance(failure, UserCodeError):
        raise failure
    return Evaluations.concatenate(halves)


def evaluate_batch(task: Task, rows: FloatArray) -> Evaluations:
    """Evaluate settings, shape (k, n + p), in one batch. If the batch takes longer than the study's
    time limit, the worker ends.
    """
    system = system_of(task.study)
    if task.in_sumo:
        system = replace(system, in_sumo=True)
    # With a simulator that takes long, each run has the time limit instead of the batch.
    limit = end_if_longer(task.study.search.time_limit)
    with system.modules.active():
        # Compilation comes first, because it may take longer than the time limit of a batch.
        system.vehicle.compile()
        with nullcontext() if system.mover.takes_long else limit:
            if task.selection != EVERYTHING:
                evaluations = _evaluate_parameters(
                    task.selection.of(system), task, rows
                )
            else:
                evaluations = drive_and_score(system, rows)
    if user_code_names(task.study) and system.repeats == 1:
        _first_batches.setdefault(
            msgspec.msgpack.encode(task.study), (task, rows, evaluations)
        )
    return evaluations


def repeat_first_batch(study: Study) -> None:
    """Simulate the first batch of a study with user code in this process again, and forget all kept
    first batches.

    Raises
    ------
    UserCodeError
        If a result differs. The user code then depends on what it has simulated before.
    """
    batch = _first_batches.pop(msgspec.msgpack.encode(study), None)
    if batch is None:
        return
    task, rows, evaluations = batch
    repeated = evaluate_batch(task, rows)
    _first_batches.clear()
    for row, difference in differences(evaluations.results, repeated.results):
        command = reproduction_command(study, rows[row, : len(study.domains)])
        raise UserCodeError(
            f"study {study.name!r}",
            f"{difference} when a worker simulated its first batch again at the end, with"
            f" {' or '.join(user_code_names(study))}{REPRODUCED_BY}{command}",
            "user code that keeps nothing in a class or a module: this result depends on what was"
            " simulated before, so no result counts",
        )


def _evaluate_parameters(system: System, task: Task, rows: FloatArray) -> Evaluations:
    """Evaluate rows that have n values of characteristics, and values of selected parameters of the
    ADS.
    """
    selection = task.selection
    settings, values = np.split(rows, [len(system.characteristics)], axis=1)
    if not values.size:
        return drive_and_score(system, settings, with_originals=False)

    # If the ADS can take an array for each parameter, it drives all rows at once.
    if selection.arrays:
        varied = replace(
            system, ads=VariedAds(system.ads, selection.parameters, values)
        )
        evaluations = drive_and_score(varied, settings, with_originals=False)
        return replace(evaluations, settings=rows)

    # Any other ADS drives once for each set of values, with all rows that have this set.
    parameter_sets, set_of_row = np.unique(values, axis=0, return_inverse=True)
    groups = []
    rows_of_groups = []
    for number, parameter_set in enumerate(parameter_sets.tolist()):
        group = np.flatnonzero(set_of_row.ravel() == number)
        parameters = dict(zip(selection.parameters, parameter_set, strict=True))
        varied_system = assemble(with_parameters(task.study, parameters))
        driven = replace(system, ads=varied_system.ads, modules=varied_system.modules)
        evaluations = drive_and_score(driven, settings[group], with_originals=False)
        groups.append(replace(evaluations, settings=rows[group]))
        rows_of_groups.append(group)
    # The groups are in the order of their sets of values: the result gets the order of the rows.
    order = np.argsort(np.concatenate(rows_of_groups))
    return Evaluations.concatenate(groups).take(order)


def with_parameters(study: Study, values: NamedValues) -> Study:
    """The study with these values of parameters of its ADS."""
    ads = replace_in(study.ads, parameters={**study.ads.parameters, **values})
    return replace_in(study, ads=ads)


def reproduction_command(study: Study, setting: FloatArray) -> str:
    """The command that simulates a setting of n characteristics, shape (n,). If the study was
    reduced to a point, the command names this point.
    """
    return f"{simulate_command(study)} {CharacteristicSet.of(study).options(setting)}".rstrip()


def verify_settings(task: Task, settings: FloatArray, worst: IntArray) -> str:
    """Simulate settings of a task again in SUMO; see `verify_in_sumo`."""
    return verify_in_sumo(system_of(task.study), settings, worst)
