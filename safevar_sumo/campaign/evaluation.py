"""What a worker computes with the settings of a study: a task, the evaluation of a batch of
settings, a pure function for any process on any machine, and the comparison of its results with
SUMO.
"""

from __future__ import annotations

import math
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
from safevar_sumo.campaign.pool import Look, Pool, WorkerLostError
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
"""Number of settings of a study to verify in SUMO in questions."""
KNOWN_SYSTEMS = 64
"""Number of systems that a process keeps: questions about the fits of a vehicle change between
them.
"""
_first_batches = dict[bytes, tuple["Task", FloatArray, Evaluations]]()
"""The first batch of each study with user code that this process has simulated, by packed study."""


class Selection(msgspec.Struct, frozen=True):
    """Restricts a task to some points of a study, or varies parameters of its ADS; every encounter
    counts then, so that no original vehicle drives beside a setting.

    Attributes
    ----------
    parameters
        Parameters of the ADS whose values follow the characteristics in every row of the settings.
    points
        Numbers of the points of a matrix to simulate; None for all.
    arrays
        Whether one ADS drives all rows, with arrays as parameters.
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
"""All points, the study's own values of the ADS's parameters, and its own rule of what counts."""


class Task(msgspec.Struct, frozen=True, kw_only=True):
    """What a worker computes with every setting of a study.

    Attributes
    ----------
    in_sumo
        Whether SUMO moves the vehicles, also where recorded scenes suffice.
    batch_size
        Maximum number of settings in a batch.
    selection
        Parameters of the ADS that vary, and points; by default no parameter, and all points.
    """

    study: Study
    in_sumo: bool = False
    batch_size: int = MAX_COPIES
    selection: Selection = EVERYTHING


def system_of(study: Study) -> System:
    """The system of a study, which this process assembles once."""
    return _assemble_packed(msgspec.msgpack.encode(study))


@lru_cache(maxsize=KNOWN_SYSTEMS)
def _assemble_packed(packed_study: bytes) -> System:
    return assemble(msgspec.msgpack.decode(packed_study, type=Study))


def carry_out(
    function: Work,
    jobs: Sequence[tuple[Any, ...]],
    pool: Pool,
    look: Look = lambda ended: None,
) -> list[Any]:
    """The results of a function for the arguments of each job: a task, and what to compute.

    Raises
    ------
    SafevarError
        If two workers die of a job; the error names the study, the job and user code.
    """
    try:
        return pool.map(function, jobs, look)

    except WorkerLostError as error:
        task, *arguments = jobs[error.job]
        names = user_code_names(task.study)
        argument = next(iter(arguments), None)
        work = "the check of user code"
        if argument is not None:
            work = str(argument)
        if isinstance(argument, np.ndarray):
            work = f"{len(argument)} settings"
        problem = f"two workers were lost at the same work, {work}: {error}"
        if names:
            where = f", probably in {' and '.join(names)}"
            raise UserCodeError(
                f"study {task.study.name!r}", f"{problem}{where}"
            ) from None
        raise SafevarError(f"study {task.study.name!r}: {problem}") from None


def evaluate_settings(task: Task, rows: FloatArray) -> Evaluations:
    """Evaluate settings of n characteristics, and values of the selected parameters, shape (k, n +
    p), in equal batches.

    A batch that fails is halved until the failing settings are alone: a setting that SUMO cannot
    simulate gets the outcome `simulator-error`.

    Raises
    ------
    UserCodeError
        With the command that simulates the setting on which user code fails.
    EnvironmentFault
        If this machine lacks memory, disk space or files.
    """
    if len(rows) > task.batch_size:
        batches = np.array_split(rows, math.ceil(len(rows) / task.batch_size))
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
        # Parameters of the ADS stand behind the characteristics.
        setting = rows[:, : len(characteristics)]
        if isinstance(failure, UserCodeError):
            command = reproduction_command(task.study, setting[0])
            raise UserCodeError(
                failure.source,
                f"{failure.problem}{REPRODUCED_BY}{command}",
                failure.legal,
            ) from None
        reasons = {rows[0].tobytes(): " ".join(str(failure).split())}
        changes = characteristics.change_objectives(setting)
        return Evaluations.undefined(
            rows, Outcome.SIMULATOR_ERROR, METRICS, reasons=reasons, **changes
        )
    halves = [evaluate_settings(task, half) for half in np.array_split(rows, 2)]
    if isinstance(failure, UserCodeError):
        raise failure
    return Evaluations.concatenate(halves)


def evaluate_batch(task: Task, rows: FloatArray) -> Evaluations:
    """Evaluate settings as a task says, shape (k, n + p), in one batch. A worker that takes longer
    than the study's time limit ends.
    """
    system = system_of(task.study)
    if task.in_sumo:
        system = replace(system, in_sumo=True)
    # To compile may take longer than a batch may.
    system.vehicle.compile()
    # Of runs that take long, each has the time limit.
    limit = end_if_longer(task.study.search.time_limit)
    with nullcontext() if system.mover.takes_long else limit:
        if task.selection != EVERYTHING:
            evaluations = _evaluate_parameters(task.selection.of(system), task, rows)
        else:
            evaluations = drive_and_score(system, rows)
    if user_code_names(task.study) and system.repeats == 1:
        _first_batches.setdefault(
            msgspec.msgpack.encode(task.study), (task, rows, evaluations)
        )
    return evaluations


def repeat_first_batch(study: Study) -> None:
    """Simulate the first batch of a study with user code in this process again, and forget it.

    Raises
    ------
    UserCodeError
        If a result differs: user code depends on what it has simulated before.
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
    """Evaluate rows of n characteristics and values of the selected parameters of the ADS."""
    selection = task.selection
    settings, values = np.split(rows, [len(system.characteristics)], axis=1)
    if not values.size:
        return drive_and_score(system, settings, with_originals=False)

    # A driving system that takes an array for each parameter drives all at once.
    if selection.arrays:
        system = replace(
            system, ads=VariedAds(system.ads, selection.parameters, values)
        )
        return replace(
            drive_and_score(system, settings, with_originals=False), settings=rows
        )

    # Any other one drives once for each set of values.
    parameter_sets, set_of_row = np.unique(values, axis=0, return_inverse=True)
    groups = []
    rows_of_groups = []
    for number, parameter_set in enumerate(parameter_sets.tolist()):
        group = np.flatnonzero(set_of_row.ravel() == number)
        study = with_parameters(
            task.study, dict(zip(selection.parameters, parameter_set, strict=True))
        )
        driven = replace(system, ads=assemble(study).ads)
        evaluations = drive_and_score(driven, settings[group], with_originals=False)
        groups.append(replace(evaluations, settings=rows[group]))
        rows_of_groups.append(group)
    # The evaluations get the order of the rows.
    return Evaluations.concatenate(groups).take(
        np.argsort(np.concatenate(rows_of_groups))
    )


def with_parameters(study: Study, values: NamedValues) -> Study:
    """A study with other values of parameters of its ADS."""
    ads = replace_in(study.ads, parameters={**study.ads.parameters, **values})
    return replace_in(study, ads=ads)


def reproduction_command(study: Study, setting: FloatArray) -> str:
    """The command that simulates a setting of n characteristics, shape (n,), in a study, or at the
    only point to which the study was reduced.
    """
    return f"{simulate_command(study)} {CharacteristicSet.of(study).options(setting)}".rstrip()


def verify_settings(task: Task, settings: FloatArray, worst: IntArray) -> str:
    """Verify recorded scenes of a task; see `verify_in_sumo`."""
    return verify_in_sumo(system_of(task.study), settings, worst)
