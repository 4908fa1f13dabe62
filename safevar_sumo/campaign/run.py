"""One run under way: a search, the settings that it requests, and their known evaluations."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from safevar_sumo.campaign.checks import VERIFIED_SETTINGS
from safevar_sumo.campaign.keys import RunKey
from safevar_sumo.campaign.pool import RunProgress, RunResult
from safevar_sumo.errors import InputError
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.results import SPARE_POSITION, Failure, Journal
from safevar_sumo.search import Search

RANDOM_SAMPLES = 10
"""Number of random evaluations of a run that are simulated again. 30 runs then reveal an error in 1 % of the
evaluations with a probability of 1 - 0.99^300 = 95 %.
"""
SIMULATOR_ERROR, COLLISION, INVALID_TEST = (
    outcome.value for outcome in (Outcome.SIMULATOR_ERROR, Outcome.COLLISION, Outcome.INVALID_TEST)
)  # numpy compares enums slowly


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
        if retry and journal.content.evaluations is not None and journal.content.evaluations.failed.any():
            journal.retry()
        stored_result = journal.content.results.get(budget)
        if journal.content.evaluations is not None:
            self._remember(journal.content.positions, journal.content.evaluations)
        if stored_result is not None:
            self.result = journal.content.take_positions(stored_result.positions)
            self._requested = self._replayed = stored_result.asked
        self.is_finished = stored_result is not None
        """Whether the journal has the result."""

    @property
    def missing_settings(self) -> FloatArray:
        """The distinct requested settings without a known evaluation, shape (k, n)."""
        return self._settings[
            [position - self._requested for key, position in self._positions.items() if key not in self._entries]
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
                for key, position in self._positions.items()
                if self._entries[key].position == SPARE_POSITION
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
