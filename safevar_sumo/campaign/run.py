"""The runs of a study: their algorithms and random numbers; and one run under way, its search and its known
evaluations.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.campaign.batches import VERIFIED_SETTINGS
from safevar_sumo.campaign.pool import RunKey, RunProgress, RunResult
from safevar_sumo.errors import InputError, unknown_name
from safevar_sumo.plugins import Files, Lookup, digests, instance_of, note_inputs, unload_user_modules
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.results import SPARE_POSITION, Failure, Journal
from safevar_sumo.search import ALGORITHMS, Algorithm, GuardedAlgorithm, MapElites, MoCell, Problem, Search
from safevar_sumo.study import SearchTable, Study

RANDOM_SAMPLES = 10
"""Number of random evaluations of a run that are simulated again. 30 runs then reveal an error in 1 % of the
evaluations with a probability of 1 - 0.99^300 = 95 %.
"""
# Numpy compares enums slowly.
SIMULATOR_ERROR, COLLISION, INVALID_TEST = (
    outcome.value for outcome in (Outcome.SIMULATOR_ERROR, Outcome.COLLISION, Outcome.INVALID_TEST)
)


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
    lookup = Lookup(source, study.origin.places)
    member = lookup.class_of(ALGORITHMS, name, "search.algorithms", Algorithm)
    parameters = lookup.with_paths(member, search.parameters.get(label, {}), key)
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


def random_generator_of(study: Study, key: RunKey) -> np.random.Generator:
    """The random generator of a run, independent of those of other runs."""
    sequence = np.random.SeedSequence(study.search.seed, spawn_key=(zlib.crc32(key.algorithm.encode()), key.run))
    return np.random.Generator(np.random.PCG64(sequence))


class _EvaluatedSetting(NamedTuple):
    """The `position` of a setting in the run (`SPARE_POSITION` until the search requests it), and its `row` in
    `evaluations`.
    """

    position: int
    evaluations: Evaluations
    row: int


class Run:
    """A search, the settings that it requests, and their known evaluations.

    Parameters
    ----------
    budget
        Number of evaluations that the search may request.
    retry
        Whether to simulate settings again that failed before.

    Attributes
    ----------
    result
        The search's solutions, once it has ended.
    """

    def __init__(self, key: RunKey, search: Search, journal: Journal, budget: int, *, retry: bool = False) -> None:
        self.key, self._search, self._journal, self._budget = key, search, journal, budget
        self._entries: dict[bytes, _EvaluatedSetting] = {}
        self._evaluated_positions: set[int] = set()
        """Positions in the run whose settings are evaluated."""
        self._requested = 0
        """Number of settings in all earlier requests."""
        self._settings: FloatArray = np.empty((0, 0))
        self._positions: dict[bytes, int] = {}
        """Position in the run of each setting of the present request."""
        self._replayed = self._collisions = self._invalid_tests = 0
        self._has_simulated = False
        self._best: float | None = None
        self.result: Evaluations
        if retry and journal.content.evaluations.failed.any():
            journal.retry()
        stored_result = journal.content.results.get(budget)
        self._remember(journal.content.positions, journal.content.evaluations)
        if stored_result is not None:
            positions, self._requested = stored_result
            self.result, self._replayed = journal.content.take_positions(positions), self._requested
        self.is_finished = stored_result is not None
        """Whether the journal has the result."""

    @property
    def missing_settings(self) -> FloatArray:
        """The distinct requested settings without a known evaluation, shape (k, n)."""
        return self._settings[
            [
                position - self._requested
                for setting, position in self._positions.items()
                if setting not in self._entries
            ]
        ]

    @property
    def progress(self) -> RunProgress:
        """The state of the run."""
        return RunProgress(self.key, self._requested, self._replayed, self._collisions, self._best)

    def advance(self) -> bool:
        """Answer the search while all requested evaluations are known; returns whether it has ended."""
        if not self._positions:
            self._note_request(next(self._search))
        while self._positions.keys() <= self._entries.keys():
            spares = [
                position - self._requested
                for setting, position in self._positions.items()
                if self._entries[setting].position == SPARE_POSITION
            ]
            if spares:
                self._store(self._evaluations_of(self._settings[spares]), {})
            evaluations = self._evaluations_of(self._settings)
            self._requested += len(evaluations)
            if not self._has_simulated:
                self._replayed = self._requested
            try:
                self._note_request(self._search.send(evaluations))
            except StopIteration as end:
                self.result = end.value
                return True
        return False

    def receive(self, evaluations: Evaluations, files: Mapping[str, str]) -> None:
        """Journal and remember new evaluations of requested settings, and files that user code has read for the first
        time.
        """
        self._store(evaluations, files)
        self._has_simulated = True

    def sample_evaluations(self, rng: np.random.Generator) -> list[Evaluations]:
        """Sample the worst evaluation, at which users look; the last one, where leaked state accumulates; and random
        ones.
        """
        entries = [entry for entry in self._requested_entries() if entry.evaluations.valid[entry.row]]
        if not entries:
            return []
        worst_entry = min(entries, key=lambda entry: np.nan_to_num(entry.evaluations.f_safe[entry.row], nan=np.inf))
        random_entries = [entries[i] for i in rng.permutation(len(entries))[:RANDOM_SAMPLES].tolist()]
        sample = {entry.position: entry for entry in (worst_entry, entries[-1], *random_entries)}
        return [evaluations.take([row]) for _, evaluations, row in sample.values()]

    def sample_for_sumo(self, rng: np.random.Generator) -> Evaluations:
        """Sample the evaluations to verify in SUMO: all solutions, and `VERIFIED_SETTINGS` random other settings."""
        solutions = {setting.tobytes() for setting in self.result.settings}
        settings = [
            evaluations.settings[row]
            for _, evaluations, row in self._requested_entries()
            if evaluations.outcome[row] != SIMULATOR_ERROR
        ]
        sample = [setting for setting in settings if setting.tobytes() in solutions]
        other_settings = [setting for setting in settings if setting.tobytes() not in solutions]
        sample += [other_settings[i] for i in rng.permutation(len(other_settings))[:VERIFIED_SETTINGS].tolist()]
        return self._evaluations_of(np.array(sample)) if sample else self.result.take([])

    def finish(self) -> RunResult:
        """Journal the result of a search that has ended, and close the journal."""
        if not self.is_finished:
            positions = [self._entries[setting.tobytes()].position for setting in self.result.settings]
            self._journal.finish(positions, self._requested, self._budget)
        self._journal.close()
        failures = [
            Failure(self.key.algorithm, self.key.run, position, evaluations.reason(row))
            for position, evaluations, row in self._requested_entries()
            if evaluations.outcome[row] == SIMULATOR_ERROR
        ]
        return RunResult(self.progress, self.result, failures, self._invalid_tests)

    def close(self) -> None:
        """Close the journal."""
        self._journal.close()

    def _requested_entries(self) -> list[_EvaluatedSetting]:
        """The known settings that this run requested, in the order of their positions."""
        return sorted(
            (entry for entry in self._entries.values() if 0 <= entry.position < self._budget),
            key=lambda entry: entry.position,
        )

    def _note_request(self, settings: FloatArray) -> None:
        """Note the settings that the search requests next, and the first position of each in the run."""
        self._settings, self._positions = settings, {}
        for i, setting in enumerate(settings):
            self._positions.setdefault(setting.tobytes(), self._requested + i)

    def _store(self, evaluations: Evaluations, files: Mapping[str, str]) -> None:
        """Journal and remember evaluations of the present request."""
        positions = [self._positions[setting.tobytes()] for setting in evaluations.settings]
        if not self._evaluated_positions.isdisjoint(positions):
            raise InputError(self._journal.path, "holds other settings than this search requests", "another `out`")
        self._journal.append(positions, evaluations, files)
        self._remember(positions, evaluations)

    def _remember(self, positions: list[int], evaluations: Evaluations) -> None:
        requested_rows = [row for row, position in enumerate(positions) if 0 <= position < self._budget]
        self._evaluated_positions.update(position for position in positions if position != SPARE_POSITION)
        for row, position in enumerate(positions):
            self._entries[evaluations.settings[row].tobytes()] = _EvaluatedSetting(position, evaluations, row)
        outcomes = evaluations.outcome[requested_rows]
        self._collisions += int(np.count_nonzero(outcomes == COLLISION))
        self._invalid_tests += int(np.count_nonzero(outcomes == INVALID_TEST))
        degrees = evaluations.f_safe[requested_rows][evaluations.valid[requested_rows]]
        if not np.isnan(degrees).all():
            lowest = float(np.nanmin(degrees))
            self._best = lowest if self._best is None else min(self._best, lowest)

    def _evaluations_of(self, settings: FloatArray) -> Evaluations:
        """The evaluations of known settings, in their order."""
        entries = [self._entries[setting.tobytes()] for setting in settings]
        batches = list({id(evaluations): evaluations for _, evaluations, _ in entries}.values())
        starts = dict(zip(map(id, batches), accumulate(map(len, batches), initial=0), strict=False))
        return Evaluations.concatenate(batches).take([starts[id(evaluations)] + row for _, evaluations, row in entries])
