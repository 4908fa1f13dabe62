"""A task, what a worker computes with every setting of a study; the evaluation of a batch of settings, a pure function
for any process on any machine; and the check of its results against SUMO.
"""

from __future__ import annotations

import faulthandler
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import IO, Literal

import msgspec
import numpy as np

from safevar_sumo.ads.varied import VariedAds
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.plugins import Files, changed_files
from safevar_sumo.protocol.rater import study_for_sumo_check
from safevar_sumo.records import ROUNDING, Evaluations, FloatArray, differences
from safevar_sumo.study import Study
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.engine import Engine
from safevar_sumo.sumo.matrix import evaluate, evaluate_cells, settings_per_batch
from safevar_sumo.sumo.system import System, assemble

VERIFIED_SETTINGS = 50
"""Number of settings to verify in SUMO: of a study in questions; of each run of a campaign, besides its solutions."""
Evaluate = Callable[[bytes, FloatArray], Evaluations]
"""A function of a packed task and settings, as `evaluate_batch`."""


class Selection(msgspec.Struct, frozen=True):
    """Restricts a task to some points of a study, and varies parameters of its ADS.

    Attributes
    ----------
    parameters
        Parameters of the ADS whose values follow the characteristics in every row of the settings.
    points
        Numbers of the points of a matrix to simulate; all if empty.
    arrays
        Whether one ADS drives all rows, with arrays as parameters.
    """

    parameters: tuple[str, ...] = ()
    points: tuple[int, ...] = ()
    arrays: bool = True

    def of(self, system: System) -> System:
        """The system at the selected points."""
        points = tuple(system.points[number] for number in self.points)
        return replace(system, matrix=points) if points else system


EVERYTHING = Selection()
"""All points, and the study's own values of the ADS's parameters."""


class Task(msgspec.Struct, frozen=True, kw_only=True):
    """What a worker computes with every setting of a study.

    Attributes
    ----------
    files
        Digests of files by name: a worker refuses to compute with other files.
    engine
        What moves the vehicles.
    afresh
        Whether models are reloaded, which removes all state of earlier batches from their modules and classes.
    purpose
        "evaluate" the settings; or, without settings, "check" the user code, or apply `why_no_verdict` on an "empty
        road", whose sentence, if any, is the only one of the result's `reasons`.
    cells
        (k, n): for a rated study, results in part k of n parts of the cells, instead of points for all cells.
    selection
        Parameters of the ADS that vary, and points; by default no parameter, and all points.
    """

    study: Study
    files: Files = {}
    engine: Engine = Engine.RECORDED
    afresh: bool = False
    purpose: Literal["evaluate", "check", "empty road"] = "evaluate"
    cells: tuple[int, int] | None = None
    selection: Selection = EVERYTHING

    @property
    def packed(self) -> bytes:
        """The task as bytes: so it is sent to workers, and serves as the key of a cache."""
        return msgspec.msgpack.encode(self)


@lru_cache(maxsize=8)
def task_of(packed_task: bytes) -> Task:
    """The unpacked task."""
    return msgspec.msgpack.decode(packed_task, type=Task)


def evaluate_batch(packed_task: bytes, settings: FloatArray) -> Evaluations:
    """Carry out a packed task with k settings, shape (k, n).

    Raises
    ------
    InputError
        If files of the study have changed since the campaign began.
    """
    task = task_of(packed_task)
    if task.purpose == "check":
        from safevar_sumo.plugins.check import refuse_defects  # slow to import, and rarely needed

        refuse_defects(task.study)
        return Evaluations.none(settings.shape[1], METRICS)
    refuse_changed_files(changed_files(task.files, task.study.origin.places))
    system = assemble(task.study) if task.afresh else system_of(task)
    if task.purpose == "empty road":
        reason = why_no_verdict(system)
        return replace(Evaluations.none(settings.shape[1], METRICS), reasons={b"": reason} if reason else {})
    if task.cells is not None:
        return evaluate_cells(system, settings, task.cells, task.engine)
    if task.selection != EVERYTHING:
        return _evaluate_parameters(system, task, settings)
    return evaluate(system, settings, task.engine)


def _evaluate_parameters(system: System, task: Task, rows: FloatArray) -> Evaluations:
    """Evaluate rows of n characteristics and values of the selected parameters of the ADS, at the selected points."""
    selection, n = task.selection, len(system.characteristics)
    settings, values, system = rows[:, :n], rows[:, n:], selection.of(system)
    if not values.size:
        return evaluate(system, settings, task.engine)
    if selection.arrays and len(rows) <= settings_per_batch(system, task.engine):
        system = replace(system, ads=VariedAds(system.ads, selection.parameters, values))
        return replace(evaluate(system, settings, task.engine), settings=rows)
    parameter_sets, set_of_row = np.unique(values, axis=0, return_inverse=True)
    groups, rows_of_groups = [], []
    for number, parameter_set in enumerate(parameter_sets.tolist()):
        group = np.flatnonzero(set_of_row.ravel() == number)
        study = with_parameters(task.study, dict(zip(selection.parameters, parameter_set, strict=True)))
        evaluations = evaluate(replace(system, ads=assemble(study).ads), settings[group], task.engine)
        groups.append(replace(evaluations, settings=rows[group]))
        rows_of_groups.append(group)
    return Evaluations.concatenate(groups).take(np.argsort(np.concatenate(rows_of_groups)))  # in the order of the rows


def with_parameters(study: Study, values: Mapping[str, float]) -> Study:
    """A study with other values of parameters of its ADS."""
    ads = msgspec.structs.replace(study.ads, parameters={**study.ads.parameters, **values})
    return msgspec.structs.replace(study, ads=ads)


def evaluate_in_time(packed_task: bytes, settings: FloatArray, time_limit: float, last_words: IO[str]) -> Evaluations:
    """Evaluate a batch. A process that takes longer than the time limit [s] writes to the file `last_words` what it is
    doing, and ends.
    """
    faulthandler.dump_traceback_later(time_limit, exit=True, file=last_words)
    try:
        return evaluate_batch(packed_task, settings)
    finally:
        faulthandler.cancel_dump_traceback_later()


def system_of(task: Task) -> System:
    """The system of a task's study; it is kept, and stays the same even if source files change."""
    return _assemble_packed(Task(study=task.study, files=task.files).packed)


@lru_cache(maxsize=4)
def _assemble_packed(packed_task: bytes) -> System:
    return assemble(task_of(packed_task).study)


def refuse_changed_files(files: list[str]) -> None:
    """Raise an error if there are files that have changed since the study began."""
    if files:
        raise InputError(
            files[0],
            "is not the file that this study began with: it was changed meanwhile, or a worker has another one",
            "the file as it was, and the same command; or another `out`",
        )


def tasks_for_sumo(study: Study, files: Files) -> tuple[bytes, bytes]:
    """The packed task with which SUMO verifies results, and one with comparable results from recorded scenes.

    SUMO repeats only a few cells of a rating; the second task then has the same cells. Otherwise it is empty, and the
    results to verify are comparable themselves.
    """
    sumo_study = study_for_sumo_check(study, assemble(study).weather)
    recorded = Task(study=sumo_study, files=files)
    in_sumo = msgspec.structs.replace(recorded, engine=Engine.LIBSUMO)
    return in_sumo.packed, b"" if sumo_study is study else recorded.packed


def refuse_unlike_sumo(study: Study, recorded: Evaluations, in_sumo: Evaluations) -> None:
    """Refuse settings with different results in a recorded scene and in SUMO, except failed simulations.

    Raises
    ------
    InputError
        With the first such setting and both values.
    """
    is_comparable = ~(recorded.failed | in_sumo.failed)
    if not is_comparable.any():
        return  # evaluations that have failed lack the user's metrics
    recorded, in_sumo = recorded.take(is_comparable), in_sumo.take(is_comparable)
    for row, difference in differences(in_sumo.results, recorded.results, ROUNDING):
        pairs = zip(study.vehicle.characteristics, recorded.settings[row], strict=True)
        values = ", ".join(f"{name} = {value:.17g}" for name, value in pairs)
        raise InputError(
            f"study {study.name!r}",
            f"{difference} in the recorded scene and in SUMO with {values}",
            "scenario: reactive_actors = True, if anybody reacts to the vehicle under test; or `engine=sumo`",
        )
