"""The runs of a study: their keys, searches and random numbers."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.errors import InputError, unknown_name
from safevar_sumo.plugins import Files, Lookup, Member, digests, instance_of, note_inputs, unload_user_modules
from safevar_sumo.results.files import run_name
from safevar_sumo.search import ALGORITHMS, Algorithm, GuardedAlgorithm, MapElites, MoCell, Problem, Search
from safevar_sumo.study import SearchTable, Study


class RunKey(NamedTuple):
    """One run of an algorithm; the number `run` counts from 0."""

    algorithm: str
    run: int

    def __str__(self) -> str:
        return run_name(self.algorithm, self.run)


def all_runs(study: Study) -> list[RunKey]:
    """The keys of all runs of a study."""
    return [RunKey(label, run) for label in study.search.labels for run in range(study.search.runs)]


def algorithm_of(label: str, study: Study) -> Algorithm:
    """An algorithm by its label in results, with its parameters from the study.

    Raises
    ------
    InputError
        If no algorithm has this label, or the algorithm does not meet its contract or does not take its parameters.
    """
    source, search = study.source, study.search
    name, key = search.labels.get(label, label), f"search.{label}"
    if len(search.labels) < len(search.algorithms):
        raise InputError(
            source,
            f"search.algorithms = {search.algorithms}: two have the same name",
            "algorithms with different names",
        )
    for table in search.parameters:
        if table not in ALGORITHMS and table not in search.labels:
            legal = dict.fromkeys((*SearchTable.__struct_fields__, *ALGORITHMS, *search.labels))
            raise unknown_name(source, f"search.{table}: there is no such key and no such algorithm", table, legal)
    member = algorithm_class(name, study)
    parameters = Lookup(source, study.origin.places).with_paths(member, search.parameters.get(label, {}), key)
    algorithm = instance_of(member, parameters, f"search.algorithms: {name!r}", key, source)
    if isinstance(algorithm, MoCell):
        algorithm.grid_sides(search.population, source)  # raises for a grid of another size
    if isinstance(algorithm, MapElites):
        algorithm.count_cells(len(study.vehicle.characteristics), source)  # raises for too many cells
    return algorithm if member.guard is None else GuardedAlgorithm(algorithm, member.guard)


def files_read_by_algorithms(study: Study) -> Files:
    """Digests of files that the user's algorithms read while this process loads and instantiates them."""
    packages = _user_packages(study)
    if not packages:
        return {}
    unload_user_modules()
    with note_inputs() as reading:
        for label in study.search.labels:
            algorithm_of(label, study)
    return digests(reading.files(packages), study.origin.places)


def make_search(key: RunKey, study: Study, problem: Problem, note_files: Callable[[Files], None]) -> Search:
    """Make the search of a run; after each step, calls `note_files` with the files that a user's algorithm has read."""
    packages, rng, ended = _user_packages(study), random_generator_of(study, key), False
    search: Search | None = None
    answer: Any = None  # None starts a generator
    while True:
        with note_inputs() as reading:
            try:
                search = search or algorithm_of(key.algorithm, study).search(problem, rng)
                output: Any = search.send(answer)  # settings, or the result at the end
            except StopIteration as end:
                ended, output = True, end.value
        if packages:
            note_files(digests(reading.files(packages), study.origin.places))
        if ended:
            return output  # type: ignore[no-any-return]
        answer = yield output


def _user_packages(study: Study) -> list[str]:
    """Top-level packages of a study's user algorithms."""
    return [name.partition(":")[0].partition(".")[0] for name in study.search.algorithms if ":" in name]


def algorithm_class(name: str, study: Study) -> Member:
    """The class of an algorithm, by its name in a study."""
    lookup = Lookup(study.source, study.origin.places)
    return lookup.class_of(ALGORITHMS, name, "search.algorithms", Algorithm)


def random_generator_of(study: Study, key: RunKey) -> np.random.Generator:
    """The random generator of a run, independent of those of other runs."""
    sequence = np.random.SeedSequence(study.search.seed, spawn_key=(zlib.crc32(key.algorithm.encode()), key.run))
    return np.random.Generator(np.random.PCG64(sequence))
