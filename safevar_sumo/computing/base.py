"""Evaluating a batch is a pure function that any process of any machine may run; here is the function and the seam."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from functools import lru_cache
from typing import Any, Protocol

import msgspec

from safevar_sumo.computing.identity import Inputs, changed, inputs_of, networks_of
from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.plugins import forget_foreign
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.simulation import System, assemble, evaluate, score, simulate_alone
from safevar_sumo.study import Study

SHARED = ("network", "sources", "code")
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
    """A study as it travels to a worker, the digests of the files that it is to be computed with, and how."""

    study: Study
    inputs: Inputs
    alone: bool
    afresh: bool


class _How(msgspec.Struct, frozen=True):
    """What of that is to be known before models are loaded."""

    afresh: bool


def packed(study: Study, inputs: Mapping[str, Any] | None = None, *, alone: bool = False, afresh: bool = False) -> bytes:
    """A study as it travels to a worker.

    Parameters
    ----------
    inputs
        Layers of the study's identity by name; workers that have other files compute nothing. By default the files as
        they are now.
    alone
        To be simulated beside one copy of the network for all settings (`simulate_alone`).
    afresh
        By models that are loaded anew, with nothing in their modules and classes that earlier batches left there.
    """
    if inputs is None:
        inputs = inputs_of(study, assemble(study))
    return msgspec.msgpack.encode(_Work(study, {layer: dict(inputs[layer]) for layer in SHARED if layer in inputs}, alone, afresh))


def evaluate_batch(work: bytes, settings: FloatArray) -> Evaluations:
    """What a worker does: (study, settings) -> evaluations.

    Raises
    ------
    InputError
        If the study's files are not those that the campaign began with.
    """
    if msgspec.msgpack.decode(work, type=_How).afresh:
        forget_foreign()
        system, network, alone = _system.__wrapped__(work)
    else:
        system, network, alone = _system(work)
    _refuse_changes(network, {"network": networks_of(system)})
    beside = alone and not system.matrix
    evaluations = score(system, settings, simulate_alone(system, settings)) if beside else evaluate(system, settings)
    _refuse_changes(network, {"network": networks_of(system)})
    return evaluations


@lru_cache(maxsize=4)
def _system(packed_work: bytes) -> tuple[System, Inputs, bool]:
    """The system that a study names and what its network is to be; code that is loaded stays, whatever becomes of its files."""
    work = msgspec.msgpack.decode(packed_work, type=_Work)
    system = assemble(work.study)
    _refuse_changes(work.inputs, inputs_of(work.study, system))
    return system, {layer: files for layer, files in work.inputs.items() if layer == "network"}, work.alone


def _refuse_changes(expected: Inputs, here: Inputs) -> None:
    files = changed(expected, here)
    if files:
        raise InputError(files[0], "is not the file that this study began with: it was changed meanwhile, or a worker has another one",
                         "the file as it was, and the same command; or another --out")
