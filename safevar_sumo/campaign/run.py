"""One run under way: a search, the settings that it requests, and their known evaluations."""

from __future__ import annotations

from itertools import accumulate
from typing import NamedTuple, Protocol

import numpy as np

from safevar_sumo.campaign.keys import RunKey
from safevar_sumo.errors import InputError
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.results import SPARE_POSITION, Failure, Journal
from safevar_sumo.search import Search
from safevar_sumo.workers.batches import VERIFIED_SETTINGS

RANDOM_SAMPLES = 10
"""Number of random evaluations of a run that are simulated again. 30 runs then reveal an error in 1 % of the evaluations with a
probability of 1 - 0.99^300 = 95 %."""

SIMULATOR_ERROR = Outcome.SIMULATOR_ERROR.value


class Observer(Protocol):
    """Receives the progress of a campaign."""

    def evaluated(self, key: RunKey, evaluations: Evaluations, simulated: int) -> None:
        """A population of a run is evaluated: `simulated` of its settings by simulation, the others from journal or memory."""

    def finished(self, key: RunKey, asked: int) -> None:
        """A run is finished, with `asked` requested evaluations."""

    def warned(self, message: str) -> None:
        """A warning for the user."""


class _EvaluatedSetting(NamedTuple):
    """The `position` of a setting in the run (`SPARE_POSITION` until the search requests it), and its `row` in `evaluations`."""

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
    finished
        Whether the journal has the result.
    """

    def __init__(self, key: RunKey, search: Search, journal: Journal, observer: Observer, budget: int, *, retry: bool = False) -> None:
        self.key, self._search, self._journal, self._observer, self._budget = key, search, journal, observer, budget
        self._entries: dict[bytes, _EvaluatedSetting] = {}
        self._evaluated_positions: set[int] = set()
        """Positions in the run whose settings are evaluated."""
        self._requested = 0
        """Number of settings in all earlier requests."""
        self._settings: FloatArray = np.empty((0, 0))
        self._positions: dict[bytes, int] = {}
        """Position in the run of each setting of the present request."""
        self._simulated = 0
        """Number of simulated settings of the present request."""
        self.result: Evaluations
        self.finished = False
        if journal.cut_bytes:
            observer.warned(f"{journal.path}: the last {journal.cut_bytes} bytes were torn; what they held is simulated again")
        if retry and journal.content.evaluations is not None and journal.content.evaluations.failed.any():
            journal.retry()
        if journal.content.evaluations is not None:
            self._remember(journal.content.positions, journal.content.evaluations)

    @property
    def missing_settings(self) -> FloatArray:
        """The distinct requested settings without a known evaluation, shape (k, n)."""
        return self._settings[[position - self._requested for key, position in self._positions.items() if key not in self._entries]]

    @property
    def failures(self) -> list[Failure]:
        """Settings of this run that could not be simulated."""
        return [Failure(self.key.algorithm, self.key.run, position, evaluations.reason(row))
                for position, evaluations, row in self._requested_entries() if evaluations.outcome[row] == SIMULATOR_ERROR]

    def _requested_entries(self) -> list[_EvaluatedSetting]:
        """The known settings that this run requested, in the order of their positions."""
        return sorted((entry for entry in self._entries.values() if 0 <= entry.position < self._budget), key=lambda entry: entry.position)

    @property
    def collisions(self) -> int:
        """Number of distinct requested settings that collided."""
        return self._count(Outcome.COLLISION)

    @property
    def invalid_tests(self) -> int:
        """Number of distinct requested settings that left the speed tolerance of a test."""
        return self._count(Outcome.INVALID_TEST)

    def _count(self, outcome: Outcome) -> int:
        value = outcome.value  # numpy compares enum members slowly
        return sum(evaluations.outcome[row] == value for position, evaluations, row in self._entries.values()
                   if 0 <= position < self._budget)

    def advance(self) -> bool:
        """Answer the search while all requested evaluations are known, or read its journalled result; returns whether it has ended."""
        stored_result = self._journal.content.result(self._budget)
        if stored_result is not None:
            self.result = self._journal.content.take_positions(stored_result.positions)
            self._requested, self.finished = stored_result.asked, True
            evaluations = self._journal.content.requested_within(self._budget)
            if evaluations is not None:
                self._observer.evaluated(self.key, evaluations, 0)
            return True
        if not self._positions:
            self._note_request(next(self._search))
        while self._positions.keys() <= self._entries.keys():
            self._store_spares()
            evaluations = self._evaluations_of(self._settings)
            self._observer.evaluated(self.key, evaluations, self._simulated)
            self._requested, self._simulated = self._requested + len(evaluations), 0
            try:
                self._note_request(self._search.send(evaluations))
            except StopIteration as end:
                self.result = end.value
                return True
        return False

    def sample_evaluations(self, rng: np.random.Generator) -> list[Evaluations]:
        """Sample the worst evaluation, at which users look; the last one, where leaked state accumulates; and random ones."""
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
        settings = [evaluations.settings[row] for _, evaluations, row in self._requested_entries()
                    if evaluations.outcome[row] != SIMULATOR_ERROR]
        sample = [setting for setting in settings if setting.tobytes() in solutions]
        other_settings = [setting for setting in settings if setting.tobytes() not in solutions]
        sample += [other_settings[i] for i in rng.permutation(len(other_settings))[:VERIFIED_SETTINGS].tolist()]
        return self._evaluations_of(np.array(sample)) if sample else self.result.take([])

    def is_repeated_by(self, search: Search) -> bool:
        """Whether a search with the evaluations of this run requests the same settings in the same order, with the same solutions."""
        settings, requested, positions = next(search), 0, dict[bytes, int]()
        while all(setting.tobytes() in self._entries for setting in settings):
            for i, setting in enumerate(settings):
                positions.setdefault(setting.tobytes(), requested + i)
            requested += len(settings)
            try:
                settings = search.send(self._evaluations_of(settings))
            except StopIteration as end:
                expected = {key: entry.position for key, entry in self._entries.items() if 0 <= entry.position < self._budget}
                return positions == expected and np.array_equal(end.value.settings, self.result.settings)
        return False

    def finish(self) -> None:
        """Journal the result of a search that has ended."""
        if not self.finished:
            positions = [self._entries[setting.tobytes()].position for setting in self.result.settings]
            self._journal.finish(positions, self._requested, self._budget)
        self.finished = True
        self._observer.finished(self.key, self._requested)

    def receive(self, evaluations: Evaluations) -> bool:
        """Journal and remember new evaluations; returns whether all requested settings are known."""
        self._store(evaluations)
        self._simulated += len(evaluations)
        return self._positions.keys() <= self._entries.keys()

    def close(self) -> None:
        """Close the journal."""
        self._journal.close()

    def _note_request(self, settings: FloatArray) -> None:
        """Note the settings that the search requests next, and the first position of each in the run."""
        self._settings, self._positions = settings, {}
        for i, setting in enumerate(settings):
            self._positions.setdefault(setting.tobytes(), self._requested + i)

    def _store_spares(self) -> None:
        """Journal the positions of settings whose evaluations were known before the search requested them."""
        spares = [position - self._requested for key, position in self._positions.items() if self._entries[key].position == SPARE_POSITION]
        if spares:
            self._store(self._evaluations_of(self._settings[spares]))

    def _store(self, evaluations: Evaluations) -> None:
        """Journal and remember evaluations of the present request."""
        positions = [self._positions[setting.tobytes()] for setting in evaluations.settings]
        if not self._evaluated_positions.isdisjoint(positions):
            raise InputError(self._journal.path, "holds other settings than this search requests", "another `out`")
        self._journal.append(positions, evaluations)
        self._remember(positions, evaluations)

    def _remember(self, positions: list[int], evaluations: Evaluations) -> None:
        self._evaluated_positions.update(position for position in positions if position != SPARE_POSITION)
        for row, position in enumerate(positions):
            self._entries[evaluations.settings[row].tobytes()] = _EvaluatedSetting(position, evaluations, row)

    def _evaluations_of(self, settings: FloatArray) -> Evaluations:
        """The evaluations of known settings, in their order."""
        entries = [self._entries[setting.tobytes()] for setting in settings]
        batches = list({id(evaluations): evaluations for _, evaluations, _ in entries}.values())
        starts = dict(zip(map(id, batches), accumulate(map(len, batches), initial=0), strict=False))
        return Evaluations.concatenate(batches).take([starts[id(evaluations)] + row for _, evaluations, row in entries])
