"""A study carried out: many runs at once, their batches computed elsewhere, their journals kept.

A search is a generator that knows nothing of this. A run answers it from its journal and its memory, hands what is
new to a pool in batches, journals the answers and sends them in: so a resumed run is a replayed one, a lost worker
costs a batch, and no result depends on who computed what.
"""

from __future__ import annotations

import signal
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from typing import NamedTuple, Protocol

import numpy as np

from safevar_sumo.computing import PersistentPool, Pool, packed
from safevar_sumo.errors import InputError, one_of
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import Journal, JournalBusy, ResultsDirectory
from safevar_sumo.search import ALGORITHMS, Algorithm, Problem, Search
from safevar_sumo.study import Study
from safevar_sumo.vehicles import CharacteristicSet

SECONDS_BETWEEN_LOOKS = 0.2
"""How long Ctrl-C may go unnoticed at the most."""
RUNS_PER_WORKER = 2
"""How many runs are under way for each worker: one is computed while another is searched and journalled."""

PROBE_BATCHES = 4
"""Batches on every worker that a forecast is measured with."""
NUMBERS_BESIDE_METRICS = 4
"""A journal keeps f_diff, f_num_diff, the collision's speed and a position and outcome with the metrics of a setting."""


class RunKey(NamedTuple):
    """One run of one algorithm; runs are numbered from 0."""

    algorithm: str
    run: int

    def __str__(self) -> str:
        return f"{self.algorithm}-{self.run:02d}"


class Campaign(NamedTuple):
    """What runs of a study found: the original vehicle's evaluation and the solutions of every finished run.

    `failures` settings could not be simulated; `busy` runs are in the hands of another process.
    """

    original: Evaluations
    solutions: dict[RunKey, Evaluations]
    failures: int
    busy: list[RunKey]


class Forecast(NamedTuple):
    """Evaluations, evaluations per second, seconds and bytes that a campaign takes at the most."""

    evaluations: int
    rate: float
    seconds: float
    size: int


class Observer(Protocol):
    """Is told how a campaign goes on."""

    def evaluated(self, key: RunKey, evaluations: Evaluations, simulated: int) -> None:
        """A population of a run is evaluated, `simulated` of it now, the others from journal or memory."""

    def finished(self, key: RunKey, asked: int) -> None:
        """A run is over, after `asked` evaluations."""

    def warned(self, message: str) -> None:
        """Something happened that the user should know."""


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


def carry_out(study: Study, keys: Iterable[RunKey], results: ResultsDirectory, pool: Pool, observer: Observer,
              batch: int | None = None) -> Campaign:
    """Carry out runs of a study, or finish what of them is unfinished.

    Parameters
    ----------
    keys
        Which runs.
    results
        Where their journals are kept.
    pool
        Computes batches.
    batch
        Settings per SUMO simulation, the population's size by default.

    Raises
    ------
    SafevarError
        If a journal cannot be written or the study itself is at fault.
    """
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    persistent, work = PersistentPool(pool, characteristics), packed(study)
    original = _original(work, characteristics, results, persistent)
    results.begin(original)
    problem = Problem(characteristics=characteristics, original=original, evaluations=study.search.evaluations)
    campaign = Campaign(original, {}, 0, [])
    waiting, active = deque(keys), dict[Future[Evaluations], _Run]()
    runs: set[_Run] = set()

    def go_on(run: _Run) -> None:
        """Let a run go as far as it can, then have computed what it misses."""
        nonlocal campaign
        if run.advance():
            campaign.solutions[run.key] = run.result
            campaign = campaign._replace(failures=campaign.failures + run.failures)
            runs.discard(run)
            run.close()
        else:
            for settings in _batches(run.missing, batch or study.search.population):
                active[persistent.submit(work, settings)] = run

    try:
        with _interrupts_between_waits() as first_of:
            while waiting or active:
                while waiting and len(runs) < RUNS_PER_WORKER * persistent.workers:
                    key = waiting.popleft()
                    try:
                        journal = results.journal(str(key))
                    except JournalBusy:
                        campaign.busy.append(key)
                        continue
                    search = algorithm_of(key.algorithm, study).search(problem, run_generator(study, key))
                    runs.add(run := _Run(key, search, journal, observer))
                    go_on(run)
                for future in first_of(active):
                    run = active.pop(future)
                    if run.take(future.result()):
                        go_on(run)
    finally:
        for run in runs:
            run.close()
    return campaign._replace(solutions={key: campaign.solutions[key] for key in sorted(campaign.solutions)})


def forecast(study: Study, runs: int, pool: Pool, batch: int | None = None) -> Forecast:
    """What carrying out `runs` runs takes at the most, after a short probe of the pool that will do it."""
    characteristics, size = CharacteristicSet.of(study.vehicle.characteristics), batch or study.search.population
    persistent, work, rng = PersistentPool(pool, characteristics), packed(study), np.random.default_rng(study.search.seed)

    def probe(number: int) -> float:
        """Seconds that `number` batches on every worker take."""
        start = time.perf_counter()
        drawn = [characteristics.filter(rng.uniform(characteristics.lower, characteristics.upper, (size, len(characteristics))))
                 for _ in range(number * pool.workers)]
        for future in [persistent.submit(work, settings) for settings in drawn]:
            future.result()
        return time.perf_counter() - start

    persistent.submit(work, characteristics.original[np.newaxis], must_succeed=True).result()
    probe(1)  # starts the workers and builds the network
    rate = PROBE_BATCHES * pool.workers * size / probe(PROBE_BATCHES)
    evaluations = runs * study.search.evaluations
    row = 8 * (len(characteristics) + len(METRICS) + NUMBERS_BESIDE_METRICS)
    return Forecast(evaluations, rate, evaluations / rate, evaluations * row)


@contextmanager
def _interrupts_between_waits() -> Iterator[Callable[[Iterable[Future[Evaluations]]], set[Future[Evaluations]]]]:
    """Yields how to wait for the first of some futures; Ctrl-C is raised there, never while a future's lock is held.

    An interrupt inside `concurrent.futures` may leave a lock behind that the worker's thread then waits for, for ever.
    """
    pressed = False

    def note(*_: object) -> None:
        nonlocal pressed
        pressed = True

    def first_of(futures: Iterable[Future[Evaluations]]) -> set[Future[Evaluations]]:
        while True:
            done, not_done = wait(futures, timeout=SECONDS_BETWEEN_LOOKS, return_when=FIRST_COMPLETED)
            if pressed:
                raise KeyboardInterrupt
            if done or not not_done:
                return done

    in_main_thread = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, note) if in_main_thread else None
    try:
        yield first_of
    finally:
        if in_main_thread:
            signal.signal(signal.SIGINT, before)


def _original(work: bytes, characteristics: CharacteristicSet, results: ResultsDirectory, pool: PersistentPool) -> Evaluations:
    """The original vehicle's evaluation, simulated once; where it fails, the study is at fault."""
    def simulated() -> Evaluations:
        return pool.submit(work, characteristics.original[np.newaxis], must_succeed=True).result()

    try:
        journal = results.journal("original")
    except JournalBusy:  # another process, of a job array say, is about to write the same
        return simulated()
    try:
        if journal.evaluations is None:
            evaluations = simulated()
            journal.append([0], evaluations)
            return evaluations
        return journal.evaluations
    finally:
        journal.close()


class _Run:
    """A search, what it asks for, and what of that is known."""

    def __init__(self, key: RunKey, search: Search, journal: Journal, observer: Observer) -> None:
        self.key, self._search, self._journal, self._observer = key, search, journal, observer
        self._known: dict[bytes, tuple[int, Evaluations, int]] = {}
        self.failures = self._asked = 0
        self._settings: FloatArray | None = None
        self._fresh = 0
        self.result: Evaluations
        if journal.cut:
            observer.warned(f"{journal.path}: the last {journal.cut} bytes were torn; what they held is simulated again")
        if journal.evaluations is not None:
            self._learn(journal.positions, journal.evaluations)

    @property
    def missing(self) -> FloatArray:
        """What the search asks for and nobody knows yet, each once; shape (k, n)."""
        assert self._settings is not None
        return np.array(list({row.tobytes(): row for row in self._settings if row.tobytes() not in self._known}.values()))

    def advance(self) -> bool:
        """Answer the search as long as everything it asks for is known; whether it has ended."""
        if self._journal.result is not None:
            self.result = self._by_position(self._journal.result)
            self._observer.finished(self.key, self._journal.asked)
            return True
        if self._settings is None:
            self._settings = next(self._search)
        while not len(self.missing):
            evaluations = self._recalled(self._settings)
            self._observer.evaluated(self.key, evaluations, self._fresh)
            self._asked, self._fresh = self._asked + len(evaluations), 0
            try:
                self._settings = self._search.send(evaluations)
            except StopIteration as end:
                self.result = end.value
                self._journal.finish([self._known[row.tobytes()][0] for row in self.result.settings], self._asked)
                self._observer.finished(self.key, self._asked)
                return True
        return False

    def take(self, evaluations: Evaluations) -> bool:
        """Journal and learn a computed batch; whether that was all that was missing."""
        assert self._settings is not None
        places = {row.tobytes(): self._asked + i for i, row in reversed(list(enumerate(self._settings)))}
        positions = [places[row.tobytes()] for row in evaluations.settings]
        self._journal.append(positions, evaluations)
        self._learn(positions, evaluations)
        self._fresh += len(evaluations)
        return not len(self.missing)

    def close(self) -> None:
        """Give the journal back."""
        self._journal.close()

    def _learn(self, positions: list[int], evaluations: Evaluations) -> None:
        self.failures += int(np.count_nonzero(~evaluations.valid))
        if self._journal.result is None:
            for i, position in enumerate(positions):
                self._known[evaluations.settings[i].tobytes()] = (position, evaluations, i)

    def _recalled(self, settings: FloatArray) -> Evaluations:
        """The evaluations of known settings, in their order."""
        found = [self._known[row.tobytes()] for row in settings]
        return Evaluations.concatenate([evaluations.take([i]) for _, evaluations, i in found])

    def _by_position(self, positions: list[int]) -> Evaluations:
        assert self._journal.evaluations is not None
        row_of = {position: row for row, position in enumerate(self._journal.positions)}
        return self._journal.evaluations.take([row_of[position] for position in positions])


def _batches(settings: FloatArray, size: int) -> Iterator[FloatArray]:
    for start in range(0, len(settings), size):
        yield settings[start:start + size]
