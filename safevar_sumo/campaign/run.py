"""The runs of a study: their names, algorithms and random numbers; and a run under way, its search and its known
evaluations.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.campaign.evaluation import VERIFIED_SETTINGS
from safevar_sumo.errors import InputError, unknown_name
from safevar_sumo.plugins import Lookup, instance_of
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.results import Failure, Journal, run_name
from safevar_sumo.search import ALGORITHMS, Algorithm, MapElites, MoCell, Problem, Search
from safevar_sumo.study import SearchTable, Study

RANDOM_SAMPLES = 10
"""Number of random evaluations of a run that are simulated again. 30 runs then reveal an error in 1 % of the
evaluations with a probability of 1 - 0.99^300 = 95 %.
"""
INVALID_TEST = Outcome.INVALID_TEST.value


class RunKey(NamedTuple):
    """The name of a run: its algorithm, and its number from 0."""

    algorithm: str
    run: int

    def __str__(self) -> str:
        return run_name(self.algorithm, self.run)


class RunProgress(NamedTuple):
    """The state of a run.

    Attributes
    ----------
    asked
        Number of requested evaluations.
    replayed
        Number of requested evaluations that the journal held when the worker began.
    collisions
        Number of distinct settings that collided.
    best
        The lowest safety degree [m or -m/s]; None before the first valid evaluation.
    """

    key: RunKey
    asked: int
    replayed: int
    collisions: int
    best: float | None


class RunResult(NamedTuple):
    """A finished run: its last state, its solutions, settings that could not be simulated, and the number of settings
    that left the speed tolerance of a test.
    """

    progress: RunProgress
    solutions: Evaluations
    failures: list[Failure]
    invalid_tests: int


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
    lookup = Lookup.of(study)
    member = lookup.class_of(ALGORITHMS, name, "search.algorithms", Algorithm)
    parameters = lookup.with_paths(member, search.parameters.get(label, {}), key)
    algorithm: Algorithm = instance_of(member, parameters, f"search.algorithms: {name!r}", key, source)
    if isinstance(algorithm, MoCell):
        algorithm.grid_sides(search.population, source)  # raises for a grid of another size
    if isinstance(algorithm, MapElites):
        algorithm.count_cells(len(study.vehicle.characteristics), source)  # raises for too many cells
    return algorithm


def make_search(key: RunKey, study: Study, problem: Problem) -> Search:
    """Make the search of a run."""
    return algorithm_of(key.algorithm, study).search(problem, random_generator_of(study, key))


def random_generator_of(study: Study, key: RunKey) -> np.random.Generator:
    """The random generator of a run, independent of those of other runs."""
    sequence = np.random.SeedSequence(study.search.seed, spawn_key=(zlib.crc32(key.algorithm.encode()), key.run))
    return np.random.Generator(np.random.PCG64(sequence))


class _Known(NamedTuple):
    """A setting that is evaluated: its `position` in the run, and its `row` in the `evaluations` of its batch."""

    position: int
    evaluations: Evaluations
    row: int


class Run:
    """A search, the settings that it requests, and their known evaluations.

    Parameters
    ----------
    budget
        Number of evaluations that the search may request.

    Attributes
    ----------
    result
        The search's solutions, once it has ended.
    is_finished
        Whether the journal has the result.
    """

    result: Evaluations

    def __init__(self, key: RunKey, search: Search, journal: Journal, budget: int) -> None:
        self.key, self.journal, self._search, self._budget = key, journal, search, budget
        self._known = dict[bytes, _Known]()
        self._known_positions = set[int]()
        self._asked = 0
        """Number of settings in all earlier requests."""
        self._settings: FloatArray = np.empty((0, 0))
        """The settings of the present request."""
        self._positions = dict[bytes, int]()
        """The first position in the run of each of these settings."""
        self._replayed = self._collisions = self._invalid_tests = 0
        self._has_simulated = False
        self._best = np.inf
        self._remember(journal.content.positions, journal.content.evaluations)
        self.is_finished = budget in journal.content.results
        if self.is_finished:
            positions, self._asked = journal.content.results[budget]
            self.result, self._replayed = journal.content.take_positions(positions), self._asked

    @property
    def missing_settings(self) -> FloatArray:
        """The distinct requested settings without a known evaluation, shape (k, n)."""
        positions = [position for setting, position in self._positions.items() if setting not in self._known]
        return np.asarray(self._settings[np.array(positions, dtype=int) - self._asked])

    @property
    def progress(self) -> RunProgress:
        """The state of the run."""
        best = self._best if np.isfinite(self._best) else None
        return RunProgress(self.key, self._asked, self._replayed, self._collisions, best)

    def advance(self) -> bool:
        """Answer the search while all requested evaluations are known; returns whether it has ended."""
        answer: Any = None  # None starts a generator
        while self._positions.keys() <= self._known.keys():
            if self._positions:
                answer = _join([self._known[setting.tobytes()] for setting in self._settings])
                self._asked += len(answer)
                if not self._has_simulated:
                    self._replayed = self._asked
            try:
                self._settings = self._search.send(answer)
            except StopIteration as end:
                self.result = end.value
                return True
            self._positions = {}
            for position, setting in enumerate(self._settings, self._asked):
                self._positions.setdefault(setting.tobytes(), position)
        return False

    def receive(self, evaluations: Evaluations) -> None:
        """Journal and remember new evaluations of requested settings."""
        positions = [self._positions[setting.tobytes()] for setting in evaluations.settings]
        if not self._known_positions.isdisjoint(positions):
            raise InputError(self.journal.path, "holds other settings than this search requests", "another `out`")
        self.journal.append(positions, evaluations)
        self._remember(positions, evaluations)
        self._has_simulated = True

    def sample_evaluations(self, rng: np.random.Generator) -> list[Evaluations]:
        """Sample the worst evaluation, at which users look; the last one, where leaked state accumulates; and random
        ones.
        """
        _, requested = self._requested()
        rows = np.flatnonzero(requested.valid)
        if not len(rows):
            return []
        worst_row = rows[np.argmin(np.nan_to_num(requested.f_safe[rows], nan=np.inf))]
        random_rows = rows[rng.permutation(len(rows))[:RANDOM_SAMPLES]]
        return [requested.take([row]) for row in dict.fromkeys([worst_row, rows[-1], *random_rows])]

    def sample_for_sumo(self, rng: np.random.Generator) -> Evaluations:
        """Sample the evaluations to verify in SUMO: all solutions, and `VERIFIED_SETTINGS` random other settings."""
        _, requested = self._requested()
        solutions = {setting.tobytes() for setting in self.result.settings}
        is_solution = np.array([setting.tobytes() in solutions for setting in requested.settings], dtype=bool)
        other_rows = np.flatnonzero(~requested.failed & ~is_solution)
        sample = other_rows[rng.permutation(len(other_rows))[:VERIFIED_SETTINGS]]
        return requested.take(np.concatenate([np.flatnonzero(~requested.failed & is_solution), sample]))

    def finish(self) -> RunResult:
        """Journal the result of a search that has ended, and close the journal."""
        if not self.is_finished:
            positions = [self._known[setting.tobytes()].position for setting in self.result.settings]
            self.journal.finish(positions, self._asked, self._budget)
        self.journal.close()
        positions, requested = self._requested()
        failures = [
            Failure(*self.key, positions[row], requested.reason(row))
            for row in np.flatnonzero(requested.failed).tolist()
        ]
        return RunResult(self.progress, self.result, failures, self._invalid_tests)

    def _requested(self) -> tuple[list[int], Evaluations]:
        """Positions and evaluations of the known settings within the run's budget, in the order of their positions.

        A journal may hold more: those of a search with a larger budget.
        """
        known = [setting for setting in self._known.values() if setting.position < self._budget]
        known.sort(key=lambda setting: setting.position)
        return [setting.position for setting in known], _join(known) if known else self.journal.content.evaluations

    def _remember(self, positions: list[int], evaluations: Evaluations) -> None:
        self._known_positions.update(positions)
        for row, (position, setting) in enumerate(zip(positions, evaluations.settings, strict=True)):
            self._known[setting.tobytes()] = _Known(position, evaluations, row)
        is_requested = np.array(positions) < self._budget
        self._collisions += int(np.count_nonzero(evaluations.collided & is_requested))
        self._invalid_tests += int(np.count_nonzero((evaluations.outcome == INVALID_TEST) & is_requested))
        self._best = float(np.fmin.reduce(evaluations.f_safe[evaluations.valid & is_requested], initial=self._best))


def _join(known: Sequence[_Known]) -> Evaluations:
    """The evaluations of known settings, in their order."""
    batches = list({id(evaluations): evaluations for _, evaluations, _ in known}.values())
    # strict=False: the last sum is where the last batch ends
    starts = dict(zip(map(id, batches), accumulate(map(len, batches), initial=0), strict=False))
    return Evaluations.concatenate(batches).take([starts[id(evaluations)] + row for _, evaluations, row in known])
