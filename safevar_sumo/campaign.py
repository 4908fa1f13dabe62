"""A study carried out: every run of every algorithm, its evaluations computed in batches, its results collected."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np

from safevar_sumo.errors import InputError, one_of
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.search import ALGORITHMS, Algorithm
from safevar_sumo.simulation import System, assemble, evaluate
from safevar_sumo.study import Study


class RunKey(NamedTuple):
    """One run of one algorithm; runs are numbered from 0."""

    algorithm: str
    run: int


class Campaign(NamedTuple):
    """What a study found: the original vehicle's evaluation, and the solutions of every run."""

    original: Evaluations
    solutions: dict[RunKey, Evaluations]


class Observer(Protocol):
    """Is told how a campaign goes on."""

    def evaluated(self, key: RunKey, evaluations: Evaluations) -> None:
        """A population of a run is evaluated."""

    def finished(self, key: RunKey) -> None:
        """A run is over."""


def carry_out(study: Study, observer: Observer, batch: int | None = None) -> Campaign:
    """Carry out every run of a study, `batch` settings per SUMO simulation (the population's size by default).

    Raises
    ------
    InputError
        If the study names an algorithm or model that does not exist.
    SimulationError
        If SUMO fails.
    """
    system = assemble(study)
    algorithms = {name: algorithm_of(name, study) for name in study.search.algorithms}
    size = batch or study.search.population
    original = evaluate(system, system.characteristics.original[np.newaxis])
    keys = [RunKey(name, run) for name in algorithms for run in range(study.search.runs)]
    return Campaign(original, {key: _run(key, algorithms[key.algorithm], study, system, observer, size) for key in keys})


def algorithm_of(name: str, study: Study) -> Algorithm:
    """An algorithm by name, set as the study says."""
    if name not in ALGORITHMS:
        raise InputError(f"study {study.name!r}", f"search.algorithms: there is no algorithm {name!r}", one_of(ALGORITHMS))
    return ALGORITHMS[name](population=study.search.population)


def run_generator(study: Study, key: RunKey) -> np.random.Generator:
    """The random numbers of one run: the same whether it runs alone or with others."""
    sequence = np.random.SeedSequence(study.search.seed, spawn_key=(zlib.crc32(key.algorithm.encode()), key.run))
    return np.random.Generator(np.random.PCG64(sequence))


def _run(key: RunKey, algorithm: Algorithm, study: Study, system: System, observer: Observer, batch: int) -> Evaluations:
    search = algorithm.search(system.characteristics, study.search.evaluations, run_generator(study, key))
    memory = _Memory(system, batch)
    settings = next(search)
    while True:
        evaluations = memory.evaluations(settings)
        observer.evaluated(key, evaluations)
        try:
            settings = search.send(evaluations)
        except StopIteration as end:
            observer.finished(key)
            result: Evaluations = end.value
            return result


class _Memory:
    """Evaluates settings in batches; a setting that was simulated before is answered from memory."""

    def __init__(self, system: System, batch: int) -> None:
        self._system, self._batch = system, batch
        self._known: dict[bytes, Evaluations] = {}

    def evaluations(self, settings: FloatArray) -> Evaluations:
        """The evaluations of `settings`, row by row."""
        keys = [row.tobytes() for row in settings]
        new = {key: row for key, row in zip(keys, settings, strict=True) if key not in self._known}
        for batch in _batches(np.array(list(new.values())), self._batch):
            evaluated = evaluate(self._system, batch)
            for i, row in enumerate(batch):
                self._known[row.tobytes()] = evaluated.take([i])
        return Evaluations.concatenate([self._known[key] for key in keys])


def _batches(settings: FloatArray, size: int) -> Iterator[FloatArray]:
    for start in range(0, len(settings), size):
        yield settings[start:start + size]
