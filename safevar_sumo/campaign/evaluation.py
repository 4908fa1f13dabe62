"""Evaluation of a batch, a pure function for any process on any machine."""

from __future__ import annotations

import faulthandler
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import IO, Literal

import msgspec
import numpy as np

from safevar_sumo.ads.varied import VariedAds
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.plugins import changed_files, digests, note_inputs, unload_user_modules
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study, user_code_packages
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.engine import Engine
from safevar_sumo.sumo.matrix import evaluate, evaluate_cells, settings_per_batch
from safevar_sumo.sumo.network import open_network
from safevar_sumo.sumo.system import System, assemble

Inputs = dict[str, dict[str, str]]
"""Digests of files, by layer and name."""


VERIFIED_SETTINGS = 50
"""Number of settings to verify in SUMO: of a study in questions; and of each run of a campaign, besides the
solutions.
"""
Evaluate = Callable[[bytes, FloatArray], Evaluations]
"""A function that does a packed task with settings, as `evaluate_batch` does."""


class Selection(msgspec.Struct, frozen=True):
    """Which parameters of the ADS have values in every row of the settings, after the characteristics; the numbers of
    the only points to simulate, without any all; with `arrays`, one ADS drives all rows, with arrays as parameters.
    """

    parameters: tuple[str, ...] = ()
    points: tuple[int, ...] = ()
    arrays: bool = True

    def of(self, system: System) -> System:
        """The system at the selected points."""
        points = tuple(system.points[number] for number in self.points)
        return replace(system, matrix=points) if points else system


EVERYTHING = Selection()
"""All points, with the parameters of the study."""


class Task(msgspec.Struct, frozen=True, kw_only=True):
    """What a worker computes of a study.

    Attributes
    ----------
    inputs
        Digests of files by layer and name: a worker refuses to compute with other files of a network, and reports files
        that user code reads and `sources` lacks.
    engine
        What moves the vehicles.
    afresh
        Whether models are reloaded, which removes all state of earlier batches from their modules and classes.
    purpose
        What to do with the settings; "check" only checks the user code, "empty road" only applies `why_no_verdict`: the
        sentence, if any, is the only one of the result's `reasons`.
    cells
        (k, n): for a rated study, results in part k of n parts of the cells, instead of points for all cells.
    selection
        Parameters of the ADS that vary, and points; by default no parameter, and all points.
    """

    study: Study
    inputs: Inputs = {}
    engine: Engine = Engine.RECORDED
    afresh: bool = False
    purpose: Literal["evaluate", "check", "empty road"] = "evaluate"
    cells: tuple[int, int] | None = None
    selection: Selection = EVERYTHING

    @property
    def packed(self) -> bytes:
        """The task as bytes."""
        return msgspec.msgpack.encode(self)


@lru_cache(maxsize=8)
def task_of(work: bytes) -> Task:
    """The unpacked task."""
    return msgspec.msgpack.decode(work, type=Task)


def evaluate_batch(work: bytes, settings: FloatArray) -> Evaluations:
    """Do a packed task with settings, shape (k, n).

    Raises
    ------
    InputError
        If files of the study have changed since the campaign began.
    """
    task = task_of(work)
    if task.purpose == "check":
        from safevar_sumo.plugins.check import refuse_defects  # slow to import, and rarely needed

        refuse_defects(task.study)
        return Evaluations.none(settings.shape[1], METRICS)
    if task.afresh:
        unload_user_modules()
    with note_inputs() as reading:
        system = assemble(task.study) if task.afresh else system_of(task)
        if "network" in task.inputs:
            refuse_changed_files(changed_files(task.inputs["network"], network_digests(system)))
        if task.purpose == "empty road":
            reason = why_no_verdict(system)
            evaluations = replace(Evaluations.none(settings.shape[1], METRICS), reasons={b"": reason} if reason else {})
        elif task.cells is not None:
            evaluations = evaluate_cells(system, settings, task.cells, task.engine)
        elif task.selection != EVERYTHING:
            evaluations = _evaluate_parameters(system, task, settings)
        else:
            evaluations = evaluate(system, settings, task.engine)
    files_read = digests(reading.files(user_code_packages(task.study)), task.study.origin.places)
    known = task.inputs.get("sources", {})
    refuse_changed_files([name for name, digest in files_read.items() if known.get(name, digest) != digest])
    return replace(evaluations, files={name: digest for name, digest in files_read.items() if name not in known})


def _evaluate_parameters(system: System, task: Task, rows: FloatArray) -> Evaluations:
    """Evaluate rows of n characteristics and the values of some parameters of the ADS, at the points of a task."""
    selection, n = task.selection, len(system.characteristics)
    settings, values, system = rows[:, :n], rows[:, n:], selection.of(system)
    if not values.size:
        return evaluate(system, settings, task.engine)
    if selection.arrays and len(rows) <= settings_per_batch(system, task.engine):
        system = replace(system, ads=VariedAds(system.ads, selection.parameters, values))
        return replace(evaluate(system, settings, task.engine), settings=rows)
    distinct_values, set_of_row = np.unique(values, axis=0, return_inverse=True)
    batches, order = [], []
    for number, own_values in enumerate(distinct_values):
        members = np.flatnonzero(set_of_row.ravel() == number)
        own_study = with_parameters(task.study, dict(zip(selection.parameters, own_values.tolist(), strict=True)))
        own_system = replace(system, ads=assemble(own_study).ads)
        batches.append(replace(evaluate(own_system, settings[members], task.engine), settings=rows[members]))
        order.append(members)
    return Evaluations.concatenate(batches).take(np.argsort(np.concatenate(order)))


def with_parameters(study: Study, values: Mapping[str, float]) -> Study:
    """A study with other values of parameters of its ADS."""
    ads = msgspec.structs.replace(study.ads, parameters={**study.ads.parameters, **values})
    return msgspec.structs.replace(study, ads=ads)


def evaluate_in_time(work: bytes, settings: FloatArray, time_limit: float, last_words: IO[str]) -> Evaluations:
    """Evaluate a batch; a process that takes longer than the time limit [s] writes to a file what it is doing, and
    ends.
    """
    faulthandler.dump_traceback_later(time_limit, exit=True, file=last_words)
    try:
        return evaluate_batch(work, settings)
    finally:
        faulthandler.cancel_dump_traceback_later()


def system_of(task: Task) -> System:
    """The system of a task's study; it is kept, and stays the same even if source files change."""
    return _assemble_packed(Task(study=task.study, inputs=task.inputs).packed)


@lru_cache(maxsize=4)
def _assemble_packed(work: bytes) -> System:
    return assemble(task_of(work).study)


def refuse_changed_files(files: list[str]) -> None:
    """Raise an error if there are files that have changed since the study began."""
    if files:
        raise InputError(
            files[0],
            "is not the file that this study began with: it was changed meanwhile, or a worker has another one",
            "the file as it was, and the same command; or another `out`",
        )


def network_digests(system: System) -> dict[str, str]:
    """Digests of the files of all networks in the simulations."""
    folders = list(dict.fromkeys(point.scenario.network for point in system.points))
    if len(folders) == 1:
        return dict(open_network(folders[0]).digests)
    return {
        f"{Path(folder).name}/{name}": digest for folder in folders for name, digest in open_network(folder).digests
    }
