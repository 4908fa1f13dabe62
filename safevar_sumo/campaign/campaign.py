"""A campaign: runs of a study, dealt out in shares to the workers of a pool; and its cost, from a short measurement."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import NamedTuple, Protocol

import msgspec

from safevar_sumo.campaign.batches import check_code
from safevar_sumo.campaign.evaluation import Task, tasks_for_sumo
from safevar_sumo.campaign.identity import identity_of
from safevar_sumo.campaign.pool import Pool, Share, carry_out, evaluate_original
from safevar_sumo.campaign.run import RunKey, RunProgress, RunResult, all_runs
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS, PUBLISHED_SCORING, Scoring
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import Evaluations
from safevar_sumo.results import ORIGINAL, Failure, JournalBusyError, ResultsDirectory
from safevar_sumo.study import Study
from safevar_sumo.sumo import Engine, assemble
from safevar_sumo.sumo.matrix import MAX_COPIES, MAX_VEHICLES
from safevar_sumo.vehicles import CharacteristicSet

PROBE_VEHICLES = 2 * MAX_VEHICLES
"""Largest number of vehicles in a batch of the measurement, over all points of a matrix."""
PROBE_SECONDS = 2.0
"""Shortest measurement [s], unless the runs are over before."""
CHARACTERS_PER_NUMBER = 18
"""Characters of a number in a journal, at most, with its comma."""
NUMBERS_BESIDE_METRICS = 5
"""Values in a journal besides the metrics of a setting: f_diff, f_num_diff, collision speed, position, outcome."""
BATCHES_PER_SHARE = 2
"""Number of largest batches that the populations of all runs of a share fill, at most."""
MAX_RUNS = 256
"""Maximum number of runs in a share: each keeps a file open."""


class Observer(Protocol):
    """Receives the progress of a campaign."""

    def progressed(self, runs: Sequence[RunProgress]) -> None:
        """The state of some runs under way."""

    def finished(self, run: RunProgress) -> None:
        """The last state of a run."""

    def warned(self, message: str) -> None:
        """A warning for the user."""


class Campaign(NamedTuple):
    """Results of the runs of a study: the evaluation of the original vehicle, and the solutions of each finished run.

    `failures` are settings that could not be simulated. `busy` are runs that another process carries out. `collisions`
    and `invalid_tests` are numbers of distinct settings of each finished run: those that collided, and those that left
    the speed tolerance of a test. `scoring` holds the metrics and objectives. `no_verdict` says why the runs tell
    nothing about the ADS.
    """

    original: Evaluations
    solutions: dict[RunKey, Evaluations]
    failures: list[Failure]
    busy: list[RunKey]
    collisions: dict[RunKey, int]
    invalid_tests: dict[RunKey, int]
    scoring: Scoring = PUBLISHED_SCORING
    no_verdict: str = ""


def run_campaign(
    study: Study,
    keys: Iterable[RunKey],
    results: ResultsDirectory,
    pool: Pool,
    observer: Observer,
    batch_size: int | None = None,
    *,
    engine: Engine = Engine.LIBSUMO,
    retry_failed: bool = False,
) -> Campaign:
    """Carry out runs of a study, or resume unfinished ones.

    Parameters
    ----------
    keys
        The runs.
    results
        The directory of their journals.
    pool
        Carries the shares of the runs.
    batch_size
        Maximum number of settings in a batch, which may hold settings of several runs.
    engine
        What moves the vehicles; before a run is finished, results from recorded scenes are verified in SUMO.
    retry_failed
        Whether to simulate settings again that failed before.

    Raises
    ------
    SafevarError
        If a journal cannot be written, or the study is at fault.
    """
    batch_size = batch_size or MAX_COPIES
    packed_task = Task(study=study, files=results.files, engine=engine).packed
    check_code(study, results.files, pool)
    original = _evaluate_original(study, packed_task, results, pool, observer)
    results.begin(original)
    sumo_tasks = tasks_for_sumo(study, results.files) if engine is Engine.RECORDED else (b"", b"")
    directory, identity = results.path.absolute(), results.digest
    runs_at_once = min(math.ceil(BATCHES_PER_SHARE * batch_size / study.search.population), MAX_RUNS)
    shares = [
        Share(packed_task, *sumo_tasks, batch_size, tuple(dealt), directory, identity, original, retry_failed)
        for dealt in deal(list(keys), pool.workers, runs_at_once)
    ]
    run_results, busy = _collect(shares, pool, observer)
    runs = [(key, run_results[key]) for key in sorted(run_results)]
    return Campaign(
        original=original,
        solutions={key: run.solutions for key, run in runs},
        busy=busy,
        scoring=results.scoring,
        failures=sorted(failure for _, run in runs for failure in run.failures),
        collisions={key: run.progress.collisions for key, run in runs},
        invalid_tests={key: run.invalid_tests for key, run in runs},
    )


def deal(keys: Sequence[RunKey], workers: int, runs_at_once: int) -> list[Sequence[RunKey]]:
    """Deal runs out in shares of at most `runs_at_once` runs; the number of shares is a multiple of the number of
    workers.

    All runs of a share are under way at the same time: they fill large batches, which cost least for each setting.
    """
    count = min(workers * math.ceil(len(keys) / (workers * runs_at_once)), len(keys))
    return [keys[number::count] for number in range(count)]  # like cards: each share gets runs of all algorithms


def _collect(shares: Sequence[Share], pool: Pool, observer: Observer) -> tuple[dict[RunKey, RunResult], list[RunKey]]:
    """Carry out shares; returns the finished runs, and the runs that another process carries out."""
    run_results, busy = dict[RunKey, RunResult](), list[RunKey]()
    with closing(carry_out(shares, pool)) as messages:
        for _, message in messages:
            if isinstance(message, RunResult):
                run_results[message.progress.key] = message
                observer.finished(message.progress)
            elif isinstance(message, RunKey):
                busy.append(message)
            elif isinstance(message, str):
                observer.warned(message)
            elif isinstance(message, list):
                observer.progressed(message)
    return run_results, busy


def _evaluate_original(
    study: Study, packed_task: bytes, results: ResultsDirectory, pool: Pool, observer: Observer
) -> Evaluations:
    """Evaluate the original vehicle, or read its journal; raises an error if the runs need another one."""
    try:
        with closing(results.journal(ORIGINAL)) as journal:
            if journal.content.tail_size:
                observer.warned(journal.remark_on_tail)
            original = journal.content.evaluations
            if not len(original):
                original = evaluate_original(study, packed_task, pool)
                journal.append([0], original)
    except JournalBusyError:  # another process, such as a job of an array, writes this journal
        original = evaluate_original(study, packed_task, pool)
    if not original.valid[0]:
        raise InputError(
            study.source,
            "the original vehicle violates a test's speed tolerance before the ADS acts (invalid-test), "
            "so there is no baseline",
            "tests whose speed the vehicle can hold",
        )
    if original.collided[0] and not is_rated(study):
        observer.warned(f"study {study.name!r}: the original vehicle itself collides: no change is needed")
    return original


class Forecast(NamedTuple):
    """Upper limits of a campaign's evaluations, `seconds`, and `size` of results [bytes]; and its evaluations per
    second, `rate`.
    """

    evaluations: int
    rate: float
    seconds: float
    size: int


class _Enough(Exception):
    """The measurement is long enough."""


class _Stopwatch:
    """Measures the evaluations per second of all workers together, from the first batch of the last worker on."""

    def __init__(self, run_count: int) -> None:
        self._run_count = run_count
        self._asked: dict[object, int] = {}
        self._start = (time.perf_counter(), 0)  # [s], and the evaluations until then
        self._is_warm = False
        self.rate = 0.0

    def progressed(self, runs: Sequence[RunProgress]) -> None:
        self._asked |= {run.key: run.asked for run in runs}
        now, asked = time.perf_counter(), sum(self._asked.values())
        if asked > self._start[1]:
            self.rate = (asked - self._start[1]) / (now - self._start[0])
        if not self._is_warm and len(self._asked) == self._run_count:
            self._is_warm, self._start = True, (now, asked)
        elif self._is_warm and now - self._start[0] > PROBE_SECONDS:
            raise _Enough

    def finished(self, run: RunProgress) -> None:
        self.progressed([run])

    def warned(self, message: str) -> None: ...


def forecast(
    study: Study, runs: int, pool: Pool, batch_size: int = MAX_COPIES, engine: Engine = Engine.RECORDED
) -> Forecast:
    """Estimate upper limits for a number of runs, from a short measurement of some of them in a temporary directory."""
    system = assemble(study, study.source)
    settings_at_once = min(batch_size, max(PROBE_VEHICLES // len(system.points), 1))
    search = study.search
    probe = msgspec.structs.replace(
        study, search=msgspec.structs.replace(search, population=min(search.population, settings_at_once))
    )
    runs_of_worker = min(math.ceil(settings_at_once / probe.search.population), math.ceil(runs / pool.workers))
    keys = all_runs(probe)[: max(runs_of_worker, 1) * pool.workers]
    stopwatch = _Stopwatch(len(keys))
    with tempfile.TemporaryDirectory(prefix="safevar-", ignore_cleanup_errors=True) as folder:
        results = ResultsDirectory(Path(folder), probe, identity_of(probe, system), system.measuring.scoring)
        with suppress(_Enough):
            run_campaign(probe, keys, results, pool, stopwatch, batch_size, engine=engine)
    evaluations = runs * search.evaluations
    numbers = len(CharacteristicSet.of(study)) + len(METRICS) + NUMBERS_BESIDE_METRICS
    return Forecast(
        evaluations, stopwatch.rate, evaluations / stopwatch.rate, evaluations * numbers * CHARACTERS_PER_NUMBER
    )
