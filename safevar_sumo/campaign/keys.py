"""The runs of a study: their keys, algorithms and random numbers."""

from __future__ import annotations

import zlib
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError, one_of
from safevar_sumo.search import ALGORITHMS, Algorithm
from safevar_sumo.study import Study


class RunKey(NamedTuple):
    """One run of one algorithm; runs are numbered from 0."""

    algorithm: str
    run: int

    def __str__(self) -> str:
        return f"{self.algorithm}-{self.run:02d}"


def all_runs(study: Study) -> list[RunKey]:
    """Every run of a study."""
    return [RunKey(name, run) for name in dict.fromkeys(study.search.algorithms) for run in range(study.search.runs)]


def algorithm_of(name: str, study: Study) -> Algorithm:
    """An algorithm by name, set as the study says."""
    if name not in ALGORITHMS:
        raise InputError(f"study {study.name!r}", f"search.algorithms: there is no algorithm {name!r}", one_of(ALGORITHMS))
    return ALGORITHMS[name].of(study.search)


def run_generator(study: Study, key: RunKey) -> np.random.Generator:
    """The random numbers of one run: the same whether it runs alone or with others."""
    sequence = np.random.SeedSequence(study.search.seed, spawn_key=(zlib.crc32(key.algorithm.encode()), key.run))
    return np.random.Generator(np.random.PCG64(sequence))
