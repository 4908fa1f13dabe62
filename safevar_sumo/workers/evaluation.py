"""Evaluation of a batch: a pure function for any process on any machine, and the protocol of the pools that run this function."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import replace
from functools import lru_cache
from typing import Any, Protocol

import msgspec

from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.metrics import METRICS
from safevar_sumo.plugins import Files, changed_files, digests, note_inputs, unload_user_modules
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study, user_code_packages
from safevar_sumo.sumo.empty_road import why_no_verdict
from safevar_sumo.sumo.engine import Engine
from safevar_sumo.sumo.matrix import evaluate, evaluate_cells
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.workers.identity import Inputs, network_digests

SHARED_LAYERS = ("network", "sources")
"""Layers of a study's identity that must be the same on every worker."""


class WorkerLostError(SafevarError):
    """The process that computed a batch died, or exceeded the time limit and was stopped."""


class PoolLostError(SafevarError):
    """The pool cannot compute any more batches."""


class Pool(Protocol):
    """Computes batches; a future may fail with `WorkerLostError`, `PoolLostError` or an error of the batch."""

    @property
    def workers(self) -> int:
        """Number of batches that are computed at the same time."""

    def submit(self, work: bytes, settings: FloatArray) -> Future[Evaluations]:
        """Evaluate k filtered settings of n characteristics, shape (k, n), of a packed study."""


class _Work(msgspec.Struct, frozen=True):
    """A study for a worker, with digests of the files that its results depend on, and the way to evaluate its settings.

    See `pack_study` for the fields.
    """

    study: Study
    inputs: Inputs
    engine: Engine
    afresh: bool
    check: bool
    cells: tuple[int, int] | None = None
    empty_road: bool = False


class _Mode(msgspec.Struct, frozen=True):
    """The fields of `_Work` that are read before models are loaded."""

    afresh: bool
    check: bool
    cells: tuple[int, int] | None = None
    empty_road: bool = False


def pack_study(study: Study, inputs: Mapping[str, Any] | None = None, *, engine: Engine = Engine.RECORDED, afresh: bool = False,
           check: bool = False, cells: tuple[int, int] | None = None, empty_road: bool = False) -> bytes:
    """Pack a study for a worker as bytes.

    Parameters
    ----------
    inputs
        Layers of the study's identity by name; by default the present networks. A worker refuses to compute with other files, and
        reports files that user code reads and `sources` lacks.
    engine
        What moves the vehicles.
    afresh
        Whether models are reloaded, which removes all state of earlier batches from their modules and classes.
    check
        Whether the worker only checks the user code; the `reasons` of the result are then remarks on this code.
    cells
        (k, n): for a rated study, results in part k of n parts of the cells, instead of points for all cells.
    empty_road
        Whether the worker only applies `why_no_verdict`; the sentence, if any, is the only one of the result's `reasons`.
    """
    if inputs is None:
        inputs = {"network": network_digests(assemble(study))}
    return msgspec.msgpack.encode(_Work(study, {layer: dict(inputs[layer]) for layer in SHARED_LAYERS if layer in inputs}, engine, afresh,
                                        check, cells, empty_road))


def evaluate_batch(work: bytes, settings: FloatArray) -> Evaluations:
    """Evaluate settings, shape (k, n), of a packed study; a worker runs this function.

    Raises
    ------
    InputError
        If files of the study have changed since the campaign began.
    """
    mode = msgspec.msgpack.decode(work, type=_Mode)
    if mode.check:
        from safevar_sumo.plugins.check import refuse_defects  # slow to import, and rarely needed

        remarks = refuse_defects(msgspec.msgpack.decode(work, type=_Work).study)
        return replace(Evaluations.none(settings.shape[1], METRICS), reasons={remark.encode(): remark for remark in remarks})
    if mode.afresh:
        unload_user_modules()
        assembler = _task_and_system.__wrapped__  # the function without its cache
    else:
        assembler = _task_and_system
    with note_inputs() as reading:
        cells = mode.cells
        task, system = assembler(_work_for_all_cells(work) if cells is not None or mode.empty_road else work)
        _refuse_changed_networks(task.inputs, system)
        if mode.empty_road:
            reason = why_no_verdict(system)
            evaluations = replace(Evaluations.none(settings.shape[1], METRICS), reasons={b"": reason} if reason else {})
        else:
            evaluations = evaluate(system, settings, task.engine) if cells is None else evaluate_cells(system, settings, cells, task.engine)
    _refuse_changed_networks(task.inputs, system)
    files_read = digests(reading.files(user_code_packages(task.study)), task.study.origin.places)
    return replace(evaluations, files=_find_unknown_files(task, files_read))


def _work_for_all_cells(work: bytes) -> bytes:
    """The work without `cells` and `empty_road`: all parts of the cells then share one cached system."""
    return msgspec.msgpack.encode(msgspec.structs.replace(msgspec.msgpack.decode(work, type=_Work), cells=None, empty_road=False))


@lru_cache(maxsize=4)
def _task_and_system(work: bytes) -> tuple[_Work, System]:
    """The unpacked work and the system of its study; both are cached and stay the same even if source files change."""
    task = msgspec.msgpack.decode(work, type=_Work)
    return task, assemble(task.study)


def _refuse_changed_networks(expected: Inputs, system: System) -> None:
    if "network" in expected:
        _refuse_changed_files(changed_files(expected["network"], network_digests(system)))


def _find_unknown_files(task: _Work, files: Files) -> Files:
    """The files that were not known when the study began; refuses known files that have changed."""
    sources = task.inputs.get("sources", {})
    _refuse_changed_files([name for name, digest in files.items() if sources.get(name, digest) != digest])
    return {name: digest for name, digest in files.items() if name not in sources}


def _refuse_changed_files(files: list[str]) -> None:
    if files:
        raise InputError(files[0], "is not the file that this study began with: it was changed meanwhile, or a worker has another one",
                         "the file as it was, and the same command; or another `out`")
