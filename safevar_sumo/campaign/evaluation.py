"""Evaluation of a batch, a pure function for any process on any machine; and the identity of a study: all inputs of its
results.
"""

from __future__ import annotations

import faulthandler
import platform
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import IO

import msgspec
import numpy as np

from safevar_sumo.ads.varied import VariedAds
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.plugins import changed_files, digests, files_named_in, note_inputs, unload_user_modules
from safevar_sumo.records import Evaluations, FloatArray, JsonObject
from safevar_sumo.results import LAYERS_OF_FILES, RESULTS, evaluation_keys
from safevar_sumo.study import Study, user_code_packages
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.engine import Engine
from safevar_sumo.sumo.matrix import evaluate, evaluate_cells, settings_per_batch
from safevar_sumo.sumo.network import open_network
from safevar_sumo.sumo.system import System, assemble

Inputs = dict[str, dict[str, str]]
"""Digests of files, by layer and name."""


Evaluate = Callable[[bytes, FloatArray], Evaluations]
"""A function that evaluates settings of a packed study, as `evaluate_batch` does."""


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


class Task(msgspec.Struct, frozen=True):
    """A study for a worker, with digests of the files that its results depend on, and the way to evaluate its settings.

    See `pack_study` for the fields.
    """

    study: Study
    inputs: Inputs
    engine: Engine
    afresh: bool
    check: bool
    cells: tuple[int, int] | None
    empty_road: bool
    selection: Selection


def pack_study(
    study: Study,
    inputs: JsonObject | None = None,
    *,
    engine: Engine = Engine.RECORDED,
    afresh: bool = False,
    check: bool = False,
    cells: tuple[int, int] | None = None,
    empty_road: bool = False,
    selection: Selection = EVERYTHING,
) -> bytes:
    """Pack a study for a worker as bytes.

    Parameters
    ----------
    inputs
        Digests of files by layer and name; by default those of the present networks. A worker refuses to compute with
        other files, and reports files that user code reads and `sources` lacks.
    engine
        What moves the vehicles.
    afresh
        Whether models are reloaded, which removes all state of earlier batches from their modules and classes.
    check
        Whether the worker only checks the user code.
    cells
        (k, n): for a rated study, results in part k of n parts of the cells, instead of points for all cells.
    empty_road
        Whether the worker only applies `why_no_verdict`; the sentence, if any, is the only one of the result's
        `reasons`.
    selection
        Parameters of the ADS that vary, and points; by default no parameter, and all points.
    """
    if inputs is None:
        inputs = {"network": network_digests(assemble(study))}
    shared_inputs = {layer: dict(inputs[layer]) for layer in LAYERS_OF_FILES if layer in inputs}
    return msgspec.msgpack.encode(Task(study, shared_inputs, engine, afresh, check, cells, empty_road, selection))


@lru_cache(maxsize=8)
def task_of(work: bytes) -> Task:
    """The unpacked task."""
    return msgspec.msgpack.decode(work, type=Task)


def evaluate_batch(work: bytes, settings: FloatArray) -> Evaluations:
    """Evaluate settings, shape (k, n), of a packed study.

    Raises
    ------
    InputError
        If files of the study have changed since the campaign began.
    """
    task = task_of(work)
    if task.check:
        from safevar_sumo.plugins.check import refuse_defects  # slow to import, and rarely needed

        refuse_defects(task.study)
        return Evaluations.none(settings.shape[1], METRICS)
    if task.afresh:
        unload_user_modules()
    with note_inputs() as reading:
        system = assemble(task.study) if task.afresh else system_of(work)
        if "network" in task.inputs:
            refuse_changed_files(changed_files(task.inputs["network"], network_digests(system)))
        if task.empty_road:
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


def system_of(work: bytes) -> System:
    """The system of a packed study; it is kept, and stays the same even if source files change."""
    task = task_of(work)
    return _assemble_packed(msgspec.msgpack.encode((task.study, task.inputs)))


@lru_cache(maxsize=4)
def _assemble_packed(study_and_inputs: bytes) -> System:
    study, _ = msgspec.msgpack.decode(study_and_inputs, type=tuple[Study, Inputs])
    return assemble(study)


def refuse_changed_files(files: list[str]) -> None:
    """Raise an error if there are files that have changed since the study began."""
    if files:
        raise InputError(
            files[0],
            "is not the file that this study began with: it was changed meanwhile, or a worker has another one",
            "the file as it was, and the same command; or another `out`",
        )


def identity_of(study: Study, system: System, sources: Mapping[str, str] = MappingProxyType({})) -> JsonObject:
    """The layers of a manifest except the study: plain values that are the same in every process.

    `resolved` are the tables of the study with all defaults of models and all numbers of the weather; `network` and
    `sources` are digests by file; `results` is the version of the results; `platform` are properties of the machine
    that may affect the last bit of a result.

    Parameters
    ----------
    sources
        Digests of the files that user code reads: see `safevar_sumo.campaign.batches.source_digests`.
    """
    resolved = evaluation_keys(study)
    for table, model in (("vehicle", system.vehicle), ("ads", system.ads), ("scenario", system.scenario)):
        if isinstance(model, msgspec.Struct):
            texts_and_paths = {
                key: value
                for key, value in resolved[table]["parameters"].items()
                if isinstance(value, str) or any(files_named_in(value, study.origin.places))
            }
            resolved[table] = {**resolved[table], "parameters": {**msgspec.to_builtins(model), **texts_and_paths}}
    resolved["weather"] = msgspec.to_builtins(system.weather)
    if system.matrix and system.rater is None:
        resolved["weathers"] = [msgspec.to_builtins(point.weather) for point in system.matrix]
    return {
        "resolved": resolved,
        "network": network_digests(system),
        "sources": dict(sources),
        "results": RESULTS,
        "platform": {"system": platform.system(), "machine": platform.machine()},
    }


def network_digests(system: System) -> dict[str, str]:
    """Digests of the files of all networks in the simulations."""
    folders = list(dict.fromkeys(point.scenario.network for point in system.points))
    if len(folders) == 1:
        return dict(open_network(folders[0]).digests)
    return {
        f"{Path(folder).name}/{name}": digest for folder in folders for name, digest in open_network(folder).digests
    }
