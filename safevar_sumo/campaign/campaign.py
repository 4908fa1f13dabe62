"""Many runs at once on one pool, each run with its journal."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from safevar_sumo.campaign.batcher import Batcher
from safevar_sumo.campaign.keys import RunKey, make_search
from safevar_sumo.campaign.run import Observer, Run
from safevar_sumo.campaign.verification import Verification
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import PUBLISHED_SCORING, Scoring
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import Evaluations
from safevar_sumo.results import ORIGINAL, Failure, JournalBusyError, ResultsDirectory
from safevar_sumo.search import Problem, Search
from safevar_sumo.study import Study
from safevar_sumo.sumo import Engine
from safevar_sumo.sumo.matrix import MAX_COPIES
from safevar_sumo.vehicles import CharacteristicSet, region_of
from safevar_sumo.workers.evaluation import Pool, pack_study
from safevar_sumo.workers.interrupts import wait_for_first, wait_for_result
from safevar_sumo.workers.isolation import check_code
from safevar_sumo.workers.retrying import RetryingPool

JOURNALS_AT_ONCE = 8
"""Maximum number of journals written at the same time: a run waits until its evaluations are on the disk."""


class Campaign(NamedTuple):
    """Results of the runs of a study: the evaluation of the original vehicle, and the solutions of each finished run.

    `failures` are settings that could not be simulated. `busy` are runs that another process carries out. `collisions` and
    `invalid_tests` are numbers of distinct settings of each finished run: those that collided, and those that left the speed tolerance
    of a test. `scoring` holds the metrics and objectives. `no_verdict` says why the runs tell nothing about the ADS.
    """

    original: Evaluations
    solutions: dict[RunKey, Evaluations]
    failures: list[Failure]
    busy: list[RunKey]
    collisions: dict[RunKey, int]
    invalid_tests: dict[RunKey, int]
    scoring: Scoring = PUBLISHED_SCORING
    no_verdict: str = ""


def run_campaign(study: Study, keys: Iterable[RunKey], results: ResultsDirectory, pool: Pool, observer: Observer,
                 batch: int | None = None, *, engine: Engine = Engine.LIBSUMO, retry_failed: bool = False) -> Campaign:
    """Carry out runs of a study, or resume unfinished ones.

    Parameters
    ----------
    keys
        The runs.
    results
        The directory of their journals.
    pool
        Computes batches.
    batch
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
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    retrying_pool, work = RetryingPool(pool, study, results.record_late_files), pack_study(study, results.inputs, engine=engine)
    for remark in check_code(study, results.inputs, retrying_pool):
        observer.warned(remark)
    original = _evaluate_original(study, work, characteristics, results, retrying_pool, observer)
    if not original.valid[0]:
        raise InputError(study.source, "the original vehicle violates a test's speed tolerance before the ADS acts (invalid-test), "
                         "so there is no baseline", "tests whose speed the vehicle can hold")
    if original.collided[0] and not is_rated(study):
        observer.warned(f"study {study.name!r}: the original vehicle itself collides: no change is needed")
    results.begin(original)
    problem = Problem(characteristics=characteristics, original=original, evaluations=study.search.evaluations,
                      population=study.search.population, scoring=results.scoring, region=region_of(study))
    campaign = Campaign(original, solutions={}, failures=[], busy=[], collisions={}, invalid_tests={}, scoring=results.scoring)
    keys_left, runs = deque(keys), set[Run]()

    def begin_search(key: RunKey) -> Search:
        return make_search(key, study, problem, results.record_late_files)

    batcher = Batcher(retrying_pool, work, batch or MAX_COPIES)
    verification = Verification(study, results, retrying_pool, begin_search, engine, observer)

    def advance(run: Run) -> None:
        """Advance a run as far as its known evaluations allow, then queue the missing settings, verify the run or finish it."""
        if not run.advance():
            batcher.add(run, run.missing_settings)
        elif run.finished or not verification.begin(run):
            finish(run)

    def finish(run: Run) -> None:
        run.finish()
        campaign.solutions[run.key], campaign.collisions[run.key] = run.result, run.collisions
        campaign.invalid_tests[run.key] = run.invalid_tests
        campaign.failures.extend(run.failures)
        runs.discard(run)
        run.close()

    journalling = ThreadPoolExecutor(JOURNALS_AT_ONCE, thread_name_prefix="journal")
    try:
        while keys_left or runs:
            while keys_left and len(runs) < batcher.wanted_run_count(study.search.population):
                key = keys_left.popleft()
                try:
                    journal = results.journal(str(key))
                except JournalBusyError:
                    campaign.busy.append(key)
                    continue
                runs.add(run := Run(key, begin_search(key), journal, observer, study.search.evaluations, retry=retry_failed))
                advance(run)
            batcher.send()
            verification.send()
            for future in wait_for_first([*batcher.under_way, *verification.under_way]):
                if future in verification.under_way:
                    for run in verification.collect(future):
                        finish(run)
                    continue
                runs_of_batch, evaluations_of_runs = zip(*batcher.collect(future), strict=True)
                for run, is_complete in zip(runs_of_batch, journalling.map(Run.receive, runs_of_batch, evaluations_of_runs), strict=True):
                    if is_complete:
                        advance(run)
    finally:
        journalling.shutdown()
        for run in runs:
            run.close()
    return campaign._replace(solutions={key: campaign.solutions[key] for key in sorted(campaign.solutions)},
                             failures=sorted(campaign.failures))


def _evaluate_original(study: Study, work: bytes, characteristics: CharacteristicSet, results: ResultsDirectory, pool: RetryingPool,
                       observer: Observer) -> Evaluations:
    """Evaluate the original vehicle, or read its journal; raises an error if the simulation fails."""
    def simulate() -> Evaluations:
        return wait_for_result(pool.submit(work, characteristics.original[np.newaxis], must_succeed=True))

    try:
        journal = results.journal(ORIGINAL)
    except JournalBusyError:  # another process, such as a job of an array, writes this journal
        return simulate()
    try:
        if journal.cut_bytes:
            observer.warned(f"{journal.path}: the last {journal.cut_bytes} bytes were torn; what they held is simulated again")
        if journal.content.evaluations is not None:
            return journal.content.evaluations
        evaluations = simulate()
        journal.append(positions=[0], evaluations=evaluations)
        return evaluations
    finally:
        journal.close()
