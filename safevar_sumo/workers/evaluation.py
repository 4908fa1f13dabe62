"""Evaluating a batch is a pure function that any process of any machine may run; here is the function and the seam."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import replace
from functools import lru_cache
from typing import Any, Protocol

import msgspec

from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.metrics import METRICS
from safevar_sumo.plugins import Files, changes, digests, forget_foreign, noted_reading
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.study import Study, foreign_packages
from safevar_sumo.sumo.engine import Engine
from safevar_sumo.sumo.matrix import evaluate, in_cells
from safevar_sumo.sumo.system import System, assemble
from safevar_sumo.workers.identity import Inputs, networks_of

SHARED = ("network", "sources")
"""Layers of a study's identity that every worker must have alike."""


class WorkerLostError(SafevarError):
    """The process that computed a batch died or was stopped for taking too long."""


class PoolLostError(SafevarError):
    """Nothing can be computed any more: whatever is tried again will fail again."""


class Pool(Protocol):
    """Computes batches somewhere; futures fail with `WorkerLostError`, `PoolLostError` or what the batch itself raised."""

    @property
    def workers(self) -> int:
        """How many batches are computed at the same time."""

    def submit(self, study: bytes, settings: FloatArray) -> Future[Evaluations]:
        """Evaluate filtered settings, shape (k, n), of a packed study."""


class _Work(msgspec.Struct, frozen=True):
    """A study as it travels to a worker, the digests of the files that it is to be computed with, and how.

    With `check` the code from outside that it names is checked instead.
    """

    study: Study
    inputs: Inputs
    engine: Engine
    afresh: bool
    check: bool
    cells: tuple[int, int] | None = None


class _How(msgspec.Struct, frozen=True):
    """What of that is to be known before models are loaded."""

    afresh: bool
    check: bool
    cells: tuple[int, int] | None = None


def packed(study: Study, inputs: Mapping[str, Any] | None = None, *, engine: Engine = Engine.RECORDED, afresh: bool = False,
           check: bool = False, cells: tuple[int, int] | None = None) -> bytes:
    """A study as it travels to a worker.

    Parameters
    ----------
    inputs
        Layers of the study's identity by name: workers that have other files compute nothing, and tell which files other
        people's code reads that are not among the `sources`. By default the networks as they are now.
    engine
        Who moves the vehicles.
    afresh
        By models that are loaded anew, with nothing in their modules and classes that earlier batches left there.
    check
        A batch checks the code from outside; its `reasons` are remarks on that.
    cells
        (k, n): of a rated study what settings do in the k-th of n parts of the cells, instead of what they are worth in all.
    """
    if inputs is None:
        inputs = {"network": networks_of(assemble(study))}
    return msgspec.msgpack.encode(_Work(study, {layer: dict(inputs[layer]) for layer in SHARED if layer in inputs}, engine, afresh,
                                        check, cells))


def evaluate_batch(work: bytes, settings: FloatArray) -> Evaluations:
    """What a worker does: (study, settings) -> evaluations.

    Raises
    ------
    InputError
        If the study's files are not those that the campaign began with.
    """
    how = msgspec.msgpack.decode(work, type=_How)
    if how.check:
        from safevar_sumo.conformance import refuse_defects  # it loads the searches, which a simulation does not need

        remarks = refuse_defects(msgspec.msgpack.decode(work, type=_Work).study)
        return replace(Evaluations.none(settings.shape[1], METRICS), reasons={remark.encode(): remark for remark in remarks})
    if how.afresh:
        forget_foreign()
        assembled = _assembled.__wrapped__
    else:
        assembled = _assembled
    with noted_reading() as reading:
        cells = how.cells
        this, system = assembled(work if cells is None else _in_all_cells(work))
        _refuse_changes(this.inputs, system)
        evaluations = evaluate(system, settings, this.engine) if cells is None else in_cells(system, settings, cells, this.engine)
    _refuse_changes(this.inputs, system)
    return replace(evaluations, files=_unknown(this, digests(reading.files(foreign_packages(this.study)), this.study.origin.places)))


def _in_all_cells(work: bytes) -> bytes:
    """The same for all cells: parts of them share a system."""
    return msgspec.msgpack.encode(msgspec.structs.replace(msgspec.msgpack.decode(work, type=_Work), cells=None))


@lru_cache(maxsize=4)
def _assembled(work: bytes) -> tuple[_Work, System]:
    """What is to be computed, and the system that the study names; code that is loaded stays, whatever becomes of its files."""
    this = msgspec.msgpack.decode(work, type=_Work)
    return this, assemble(this.study)


def _refuse_changes(expected: Inputs, system: System) -> None:
    if "network" in expected:
        _refuse(changes(expected["network"], networks_of(system)))


def _unknown(this: _Work, files: Files) -> Files:
    """Of the files that were read those that the study did not begin with; others that it did not begin with so are refused."""
    known = this.inputs.get("sources", {})
    _refuse([name for name, digest in files.items() if known.get(name, digest) != digest])
    return {name: digest for name, digest in files.items() if name not in known}


def _refuse(files: list[str]) -> None:
    if files:
        raise InputError(files[0], "is not the file that this study began with: it was changed meanwhile, or a worker has another one",
                         "the file as it was, and the same command; or another --out")
