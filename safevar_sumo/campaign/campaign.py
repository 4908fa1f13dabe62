"""Many runs at once over one pool, each with its journal."""

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
from safevar_sumo.metrics import SAFEVAR, Scoring
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
"""Number of journals written at the same time: each append is synced to the disk before its run goes on."""


class Campaign(NamedTuple):
    """Results of a study's runs: the original vehicle's evaluation and the solutions of every finished run.

    `failures` are settings that could not be simulated; another process works on `busy` runs; `scoring` holds the metrics and
    objectives; `collisions` counts the distinct settings of each finished run that collided, `invalid_tests` those that left the
    tolerance of a test's speed.
    """

    original: Evaluations
    solutions: dict[RunKey, Evaluations]
    failures: list[Failure]
    busy: list[RunKey]
    collisions: dict[RunKey, int]
    invalid_tests: dict[RunKey, int]
    scoring: Scoring = SAFEVAR


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
        Maximum number of settings per batch, gathered from several runs.
    engine
        What moves the vehicles; results from recorded scenes are verified in SUMO before a run counts as finished.
    retry_failed
        Whether settings that could not be simulated before are tried again.

    Raises
    ------
    SafevarError
        If a journal cannot be written or the study itself is at fault.
    """
    characteristics = CharacteristicSet.of(study.vehicle.characteristics)
    retrying, work = RetryingPool(pool, study, results.note), packed(study, results.inputs, engine=engine)
    original = _original(study, work, characteristics, results, retrying, observer)
    if not original.valid[0]:
        raise InputError(study.source, "the original vehicle leaves the tolerance of a test's speed before the ADS acts "
                         "(invalid-test): nothing can be compared with it", "tests whose speed the vehicle can hold")
    if original.collided[0] and not is_rated(study):
        observer.warned(f"study {study.name!r}: the original vehicle itself collides, no change is needed for that")
    results.begin(original)
    problem = Problem(characteristics=characteristics, original=original, evaluations=study.search.evaluations,
                      population=study.search.population, scoring=results.scoring, region=region_of(study))
    campaign = Campaign(original, {}, [], [], {}, {}, results.scoring)
    waiting, runs = deque(keys), set[Run]()

    def begin_search(key: RunKey) -> Search:
        return search_of(key, study, problem, results.note)

    batcher = Batcher(retrying, work, batch or LARGEST_WORLD)
    verification = Verification(study, results, retrying, begin_search, engine, observer)

    def advance(run: Run) -> None:
        """Advance a run as far as its known evaluations allow, then queue its missing settings."""
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
        while waiting or runs:
            while waiting and len(runs) < batcher.runs_wanted(study.search.population):
                key = waiting.popleft()
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
    """The original vehicle's evaluation, simulated once; raises if that fails, or if models mix settings up."""
    def simulated() -> Evaluations:
        return awaited(pool.submit(work, characteristics.original[np.newaxis], must_succeed=True))

    try:
        journal = results.journal(ORIGINAL)
    except JournalBusy:  # another process, of a job array say, is about to write the same
        return simulated()
    try:
        if journal.cut:
            observer.warned(f"{journal.path}: the last {journal.cut} bytes were torn; what they held is simulated again")
        if journal.content.evaluations is not None:
            return journal.content.evaluations
        evaluations = simulated()
        for remark in check_code(study, results.inputs, pool):
            observer.warned(remark)
        journal.append([0], evaluations)
        return evaluations
    finally:
        journal.close()
