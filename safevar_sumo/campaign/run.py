"""One run under way: a search, the settings that it requests, and their known evaluations."""

from __future__ import annotations

from itertools import accumulate
from typing import Protocol

import numpy as np

from safevar_sumo.campaign.keys import RunKey
from safevar_sumo.errors import InputError
from safevar_sumo.records import Evaluations, FloatArray, Outcome
from safevar_sumo.results import SPARE, Failure, Journal
from safevar_sumo.search import Search
from safevar_sumo.workers.batches import VERIFIED

BY_CHANCE = 10
"""Number of randomly chosen evaluations of a run that are simulated again. A study of 30 runs shows an error in 1 % of its evaluations
with a probability of 1 - 0.99^300 = 95 %."""

FAILED = Outcome.SIMULATOR_ERROR.value


class Observer(Protocol):
    """Receives the progress of a campaign."""

    def evaluated(self, key: RunKey, evaluations: Evaluations, simulated: int) -> None:
        """A population of a run is evaluated: `simulated` settings of it now, the others from journal or memory."""

    def finished(self, key: RunKey, asked: int) -> None:
        """A run is over, after `asked` evaluations."""

    def warned(self, message: str) -> None:
        """Something has happened that the user should know."""


class Run:
    """A search, the settings that it requests, and their known evaluations.

    Parameters
    ----------
    budget
        Number of evaluations that the search may request.
    retry
        Whether settings that could not be simulated are tried again.

    Attributes
    ----------
    result
        The search's solutions, once it has ended.
    finished
        Whether the journal has the result.
    """

    def __init__(self, key: RunKey, search: Search, journal: Journal, observer: Observer, budget: int, *, retry: bool = False) -> None:
        self.key, self._search, self._journal, self._observer, self._budget = key, search, journal, observer, budget
        self._known: dict[bytes, tuple[int, Evaluations, int]] = {}
        self._taken: set[int] = set()
        self._asked = 0
        self._settings: FloatArray = np.empty((0, 0))
        self._places: dict[bytes, int] = {}
        self._fresh = 0
        self.result: Evaluations
        self.finished = False
        if journal.cut:
            observer.warned(f"{journal.path}: the last {journal.cut} bytes were torn; what they held is simulated again")
        if retry and journal.content.evaluations is not None and journal.content.evaluations.failed.any():
            journal.retry()
        if journal.content.evaluations is not None:
            self._remember(journal.content.positions, journal.content.evaluations)

    @property
    def missing(self) -> FloatArray:
        """The distinct requested settings without a known evaluation, shape (k, n)."""
        return self._settings[[place - self._asked for row, place in self._places.items() if row not in self._known]]

    @property
    def failures(self) -> list[Failure]:
        """Settings of this run that could not be simulated."""
        return [Failure(self.key.algorithm, self.key.run, position, evaluations.reason(i))
                for position, evaluations, i in self._asked_for() if evaluations.outcome[i] == FAILED]

    def _asked_for(self) -> list[tuple[int, Evaluations, int]]:
        """Position, evaluations and row in these for every distinct setting that this run requested, in their order."""
        return sorted((known for known in self._known.values() if 0 <= known[0] < self._budget), key=lambda known: known[0])

    @property
    def collisions(self) -> int:
        """Number of distinct requested settings that collided."""
        return self._number_of(Outcome.COLLISION)

    @property
    def invalid_tests(self) -> int:
        """Number of distinct requested settings that left the tolerance of a test's speed."""
        return self._number_of(Outcome.INVALID_TEST)

    def _number_of(self, outcome: Outcome) -> int:
        value = outcome.value  # comparisons with the member itself are slow in numpy
        return sum(evaluations.outcome[i] == value for position, evaluations, i in self._known.values()
                   if 0 <= position < self._budget)

    def advance(self) -> bool:
        """Answer the search as long as all requested evaluations are known; returns whether it has ended."""
        done = self._journal.content.result(self._budget)
        if done is not None:
            self.result = self._journal.content.by_position(done.positions)
            self._asked, self.finished = done.asked, True
            evaluations = self._journal.content.within(self._budget)
            if evaluations is not None:
                self._observer.evaluated(self.key, evaluations, 0)
            return True
        if not self._places:
            self._note_request(next(self._search))
        while self._places.keys() <= self._known.keys():
            self._place_spares()
            evaluations = self._recalled(self._settings)
            self._observer.evaluated(self.key, evaluations, self._fresh)
            self._asked, self._fresh = self._asked + len(evaluations), 0
            try:
                self._note_request(self._search.send(evaluations))
            except StopIteration as end:
                self.result = end.value
                return True
        return False

    def samples(self, rng: np.random.Generator) -> list[Evaluations]:
        """The most severe evaluation, which users will look at, the last one, to which most state may have leaked, and random others."""
        scored = [known for known in self._known.values()
                  if 0 <= known[0] < self._budget and known[1].valid[known[2]]]
        if not scored:
            return []
        scored.sort(key=lambda known: known[0])
        severe = min(scored, key=lambda known: np.nan_to_num(known[1].f_safe[known[2]], nan=np.inf))
        by_chance = [scored[place] for place in rng.permutation(len(scored))[:BY_CHANCE].tolist()]
        chosen = {known[0]: known for known in (severe, scored[-1], *by_chance)}
        return [evaluations.take([i]) for _, evaluations, i in chosen.values()]

    def solutions_and_others(self, rng: np.random.Generator) -> Evaluations:
        """The evaluations to verify in SUMO itself: all solutions, and `VERIFIED` random others."""
        solutions = {row.tobytes() for row in self.result.settings}
        scored = [known for known in self._asked_for() if known[1].outcome[known[2]] != FAILED]
        in_solutions = [known[1].settings[known[2]].tobytes() in solutions for known in scored]
        others = [known for known, is_solution in zip(scored, in_solutions, strict=True) if not is_solution]
        chosen = [known for known, is_solution in zip(scored, in_solutions, strict=True) if is_solution]
        chosen += [others[place] for place in rng.permutation(len(others))[:VERIFIED].tolist()]
        return self._recalled(np.array([known[1].settings[known[2]] for known in chosen])) if chosen else self.result.take([])

    def is_repeated_by(self, search: Search) -> bool:
        """Whether a search with this run's evaluations requests the same settings in the same places and returns the same solutions."""
        settings, asked, places = next(search), 0, dict[bytes, int]()
        while all(row.tobytes() in self._known for row in settings):
            for i, row in enumerate(settings):
                places.setdefault(row.tobytes(), asked + i)
            asked += len(settings)
            try:
                settings = search.send(self._recalled(settings))
            except StopIteration as end:
                expected = {row: place for row, (place, _, _) in self._known.items() if 0 <= place < self._budget}
                return places == expected and np.array_equal(end.value.settings, self.result.settings)
        return False

    def finish(self) -> None:
        """Journal the result of a search that has ended."""
        if not self.finished:
            self._journal.finish([self._known[row.tobytes()][0] for row in self.result.settings], self._asked, self._budget)
        self.finished = True
        self._observer.finished(self.key, self._asked)

    def take(self, evaluations: Evaluations) -> bool:
        """Journal and remember a computed batch; returns whether nothing is missing any more."""
        self._place(evaluations)
        self._fresh += len(evaluations)
        return self._places.keys() <= self._known.keys()

    def close(self) -> None:
        """Close the journal."""
        self._journal.close()

    def _note_request(self, settings: FloatArray) -> None:
        """Note the settings that the search requests next, and the first place of each in the run."""
        self._settings, self._places = settings, {}
        for i, row in enumerate(settings):
            self._places.setdefault(row.tobytes(), self._asked + i)

    def _place_spares(self) -> None:
        """Journal the places of evaluations that were known before the search requested them."""
        spares = [place - self._asked for row, place in self._places.items() if self._known[row][0] == SPARE]
        if spares:
            self._place(self._recalled(self._settings[spares]))

    def _place(self, evaluations: Evaluations) -> None:
        """Journal and remember evaluations of the present request."""
        positions = [self._places[row.tobytes()] for row in evaluations.settings]
        if not self._taken.isdisjoint(positions):
            raise InputError(self._journal.path, "holds other settings than this search requests", "another --out")
        self._journal.append(positions, evaluations)
        self._remember(positions, evaluations)

    def _remember(self, positions: list[int], evaluations: Evaluations) -> None:
        self._taken.update(position for position in positions if position != SPARE)
        for i, position in enumerate(positions):
            self._known[evaluations.settings[i].tobytes()] = (position, evaluations, i)

    def _recalled(self, settings: FloatArray) -> Evaluations:
        """The evaluations of known settings, in their order."""
        known = [self._known[row.tobytes()] for row in settings]
        parts = list({id(evaluations): evaluations for _, evaluations, _ in known}.values())
        starts = dict(zip(map(id, parts), accumulate(map(len, parts), initial=0), strict=False))
        return Evaluations.concatenate(parts).take([starts[id(evaluations)] + i for _, evaluations, i in known])
