"""Evaluation of a batch, a pure function that any process of any machine may run, and the protocol of the pools that run it."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import replace
from functools import lru_cache
from typing import Any, Protocol

import msgspec

from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.metrics import METRICS
from safevar_sumo.plugins import Files, changed_files, digests, forget_foreign, noted_reading
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study, foreign_packages
from safevar_sumo.sumo.engine import Engine
from safevar_sumo.sumo.matrix import evaluate, in_cells
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.workers.identity import Inputs, networks_of

SHARED = ("network", "sources")
"""Layers of a study's identity that must be the same on every worker."""


class WorkerLostError(SafevarError):
    """The process that computed a batch died or was stopped for taking too long."""


class PoolLostError(SafevarError):
    """The pool can compute nothing any more: every further attempt would fail, too."""


class Pool(Protocol):
    """Computes batches somewhere; futures fail with `WorkerLostError`, `PoolLostError` or the batch's own error."""

    @property
    def workers(self) -> int:
        """Number of batches that are computed at the same time."""

    def submit(self, study: bytes, settings: FloatArray) -> Future[Evaluations]:
        """Evaluate filtered settings, shape (k, n), of a packed study."""


class _Work(msgspec.Struct, frozen=True):
    """A study packed for a worker, with the digests of the files that it depends on, and the way to evaluate its settings.

    With `check` the worker checks the study's code from outside instead.
    """

    study: Study
    inputs: Inputs
    engine: Engine
    afresh: bool
    check: bool
    cells: tuple[int, int] | None = None


class _Mode(msgspec.Struct, frozen=True):
    """The fields of `_Work` that are read before models are loaded."""

    afresh: bool
    check: bool
    cells: tuple[int, int] | None = None


def packed(study: Study, inputs: Mapping[str, Any] | None = None, *, engine: Engine = Engine.RECORDED, afresh: bool = False,
           check: bool = False, cells: tuple[int, int] | None = None) -> bytes:
    """A study packed for a worker.

    Parameters
    ----------
    inputs
        Layers of the study's identity by name: a worker with other files computes nothing, and reports the files that other
        people's code reads and `sources` lacks. By default the networks as they are now.
    engine
        What moves the vehicles.
    afresh
        Whether models are loaded anew, without anything that earlier batches left in their modules and classes.
    check
        Whether a batch checks the code from outside instead; its `reasons` are remarks on that code.
    cells
        (k, n): for a rated study, results in the k-th of n parts of the cells, instead of points for all cells.
    """
    if inputs is None:
        inputs = {"network": networks_of(assemble(study))}
    return msgspec.msgpack.encode(_Work(study, {layer: dict(inputs[layer]) for layer in SHARED if layer in inputs}, engine, afresh,
                                        check, cells))


def evaluate_batch(work: bytes, settings: FloatArray) -> Evaluations:
    """The function that a worker runs: (study, settings) -> evaluations.

    Raises
    ------
    InputError
        If the study's files are not those that the campaign began with.
    """
    mode = msgspec.msgpack.decode(work, type=_Mode)
    if mode.check:
        from safevar_sumo.conformance import refuse_defects  # it loads the searches, which a simulation does not need

        remarks = refuse_defects(msgspec.msgpack.decode(work, type=_Work).study)
        return replace(Evaluations.none(settings.shape[1], METRICS), reasons={remark.encode(): remark for remark in remarks})
    if mode.afresh:
        forget_foreign()
        assembled = _assembled.__wrapped__
    else:
        assembled = _assembled
    with noted_reading() as reading:
        cells = mode.cells
        task, system = assembled(work if cells is None else _in_all_cells(work))
        _refuse_changes(task.inputs, system)
        evaluations = evaluate(system, settings, task.engine) if cells is None else in_cells(system, settings, cells, task.engine)
    _refuse_changes(task.inputs, system)
    return replace(evaluations, files=_unknown(task, digests(reading.files(foreign_packages(task.study)), task.study.origin.places)))


def _in_all_cells(work: bytes) -> bytes:
    """The same work for all cells, so that the parts of the cells share a system."""
    return msgspec.msgpack.encode(msgspec.structs.replace(msgspec.msgpack.decode(work, type=_Work), cells=None))


@lru_cache(maxsize=4)
def _assembled(work: bytes) -> tuple[_Work, System]:
    """The unpacked work, and the system that its study names; loaded code stays, even if its files change."""
    task = msgspec.msgpack.decode(work, type=_Work)
    return task, assemble(task.study)


def _refuse_changes(expected: Inputs, system: System) -> None:
    if "network" in expected:
        _refuse(changed_files(expected["network"], networks_of(system)))


def _unknown(task: _Work, files: Files) -> Files:
    """The files that the study did not begin with; refuses files that have changed since it began."""
    sources = task.inputs.get("sources", {})
    _refuse([name for name, digest in files.items() if sources.get(name, digest) != digest])
    return {name: digest for name, digest in files.items() if name not in sources}


def _refuse(files: list[str]) -> None:
    if files:
        raise InputError(files[0], "is not the file that this study began with: it was changed meanwhile, or a worker has another one",
                         "the file as it was, and the same command; or another --out")
