"""Many runs at once on one pool, each run with its journal."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from safevar_sumo.campaign.batcher import Batcher
from safevar_sumo.campaign.keys import RunKey, search_of
from safevar_sumo.campaign.run import Observer, Run
from safevar_sumo.campaign.verification import Verification
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import PUBLISHED_SCORING, Scoring
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.records import Evaluations
from safevar_sumo.results import ORIGINAL, Failure, JournalBusy, ResultsDirectory
from safevar_sumo.search import Problem, Search
from safevar_sumo.study import Study
from safevar_sumo.sumo import Engine
from safevar_sumo.sumo.matrix import LARGEST_WORLD
from safevar_sumo.vehicles import CharacteristicSet, region_of
from safevar_sumo.workers.evaluation import Pool, packed
from safevar_sumo.workers.interrupts import awaited, first_of
from safevar_sumo.workers.isolation import check_code
from safevar_sumo.workers.retrying import RetryingPool

JOURNALS_AT_ONCE = 8
"""Number of journals written at the same time: a run waits until the disk has its evaluations."""


class Campaign(NamedTuple):
    """Results of the runs of a study: the evaluation of the original vehicle, and the solutions of each finished run.

    `failures` are settings that could not be simulated. `busy` are runs that another process carries out. `collisions` is the number
    of distinct settings of each finished run that collided, `invalid_tests` the number of those that left the speed tolerance of a
    test. `scoring` holds the metrics and objectives.
    """

    original: Evaluations
    solutions: dict[RunKey, Evaluations]
    failures: list[Failure]
    busy: list[RunKey]
    collisions: dict[RunKey, int]
    invalid_tests: dict[RunKey, int]
    scoring: Scoring = PUBLISHED_SCORING


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
        Maximum number of settings of several runs in a batch.
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
    retrying_pool, work = RetryingPool(pool, study, results.note), packed(study, results.inputs, engine=engine)
    original = _original(study, work, characteristics, results, retrying_pool, observer)
    if not original.valid[0]:
        raise InputError(study.source, "the original vehicle leaves the tolerance of a test's speed before the ADS acts "
                         "(invalid-test): nothing can be compared with it", "tests whose speed the vehicle can hold")
    if original.collided[0] and not is_rated(study):
        observer.warned(f"study {study.name!r}: the original vehicle itself collides, no change is needed for that")
    results.begin(original)
    problem = Problem(characteristics=characteristics, original=original, evaluations=study.search.evaluations,
                      population=study.search.population, scoring=results.scoring, region=region_of(study))
    campaign = Campaign(original, {}, [], [], {}, {}, results.scoring)
    keys_left, runs = deque(keys), set[Run]()

    def begin_search(key: RunKey) -> Search:
        return search_of(key, study, problem, results.note)

    batcher = Batcher(retrying_pool, work, batch or LARGEST_WORLD)
    verification = Verification(study, results, retrying_pool, begin_search, engine, observer)

    def advance(run: Run) -> None:
        """Advance a run as far as its known evaluations allow, then queue the missing settings, verify the run or finish it."""
        if not run.advance():
            batcher.add(run, run.missing)
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
            while keys_left and len(runs) < batcher.runs_wanted(study.search.population):
                key = keys_left.popleft()
                try:
                    journal = results.journal(str(key))
                except JournalBusy:
                    campaign.busy.append(key)
                    continue
                runs.add(run := Run(key, begin_search(key), journal, observer, study.search.evaluations, retry=retry_failed))
                advance(run)
            batcher.send()
            verification.send()
            for future in first_of([*batcher.under_way, *verification.under_way]):
                if future in verification.under_way:
                    for run in verification.take(future):
                        finish(run)
                    continue
                shares = list(batcher.take(future))
                for (run, _), is_complete in zip(shares, journalling.map(_take, shares), strict=True):
                    if is_complete:
                        advance(run)
    finally:
        journalling.shutdown()
        for run in runs:
            run.close()
    return campaign._replace(solutions={key: campaign.solutions[key] for key in sorted(campaign.solutions)},
                             failures=sorted(campaign.failures))


def _take(share: tuple[Run, Evaluations]) -> bool:
    run, evaluations = share
    return run.take(evaluations)


def _original(study: Study, work: bytes, characteristics: CharacteristicSet, results: ResultsDirectory, pool: RetryingPool,
              observer: Observer) -> Evaluations:
    """The evaluation of the original vehicle, from its journal or simulated; raises if it fails, or if models mix settings up."""
    def simulate() -> Evaluations:
        return awaited(pool.submit(work, characteristics.original[np.newaxis], must_succeed=True))

    try:
        journal = results.journal(ORIGINAL)
    except JournalBusy:  # another process, such as a job of an array, writes this journal
        return simulate()
    try:
        if journal.cut:
            observer.warned(f"{journal.path}: the last {journal.cut} bytes were torn; what they held is simulated again")
        if journal.content.evaluations is not None:
            return journal.content.evaluations
        evaluations = simulate()
        for remark in check_code(study, results.inputs, pool):
            observer.warned(remark)
        journal.append([0], evaluations)
        return evaluations
    finally:
        journal.close()
