"""Runs a study on this machine or on a cluster: `sv.run`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from safevar_sumo.api.simulation import load_and_assemble
from safevar_sumo.campaign import RunKey, all_runs, check_algorithms, run_campaign
from safevar_sumo.campaign.campaign import RECORDED
from safevar_sumo.campaign.pool import Pool, open_pool
from safevar_sumo.errors import InputError, warn
from safevar_sumo.questions.arguments import checked
from safevar_sumo.questions.case import Results
from safevar_sumo.questions.research_questions.fronts import why_few_evaluations
from safevar_sumo.questions.subject import load
from safevar_sumo.study import Study, StudyLike
from safevar_sumo.sumo.system import System
from safevar_sumo.terminal import Progress, open_progress


@checked
def run(
    study: StudyLike,
    out: str | Path | None = None,
    *,
    jobs: int | None = None,
    cluster: str | None = None,
    pool: Pool | None = None,
    progress: bool | Progress = False,
    only: Sequence[tuple[str, int]] | None = None,
    engine: str = RECORDED,
    retry_failed: bool = False,
) -> Results:
    """Search a study; a call with the same study and directory continues where an earlier one was
    stopped.

    Parameters
    ----------
    study
        A study, or anything that `load_study` accepts.
    out
        Directory of the results, by default `results/NAME`.
    jobs
        Worker processes, by default one for each core.
    cluster
        Compute on the workers of the Dask scheduler at this address instead.
    pool
        Pool that simulates, in place of new worker processes or a cluster.
    progress
        True for a bar on the terminal; or a function called with a phase (the study's name and its
        finished runs), the number of evaluations done, and the number to do at most: one in SUMO
        counts as those in recorded scenes that would take as long.
    only
        The only runs to carry out, as (algorithm, number from 0); the results are complete once
        every run is finished.
    engine
        "recorded": simulate in a recorded scene if no actor reacts to the vehicle under test, else
        in SUMO; "sumo": always in SUMO. Never changes a result.
    retry_failed
        Whether to simulate again the settings that failed before (simulator-error).

    Raises
    ------
    InputError
        If the study cannot be used, or the directory belongs to another study.
    SafevarError
        If nothing can be computed, a file cannot be written, or another process works on one of the
        runs.
    """
    loaded_study, system = load_for_search(study)
    keys = all_runs(loaded_study)
    if only is not None:
        legal = "(algorithm of the study, run from 0 to less than `search.runs`)"
        for key in only:
            if tuple(key) not in keys:
                raise InputError("only", repr(key), legal)
        keys = [RunKey(*key) for key in only]

    directory = Path("results", loaded_study.name)
    if out is not None:
        directory = Path(out)
    if out == "":
        raise InputError("out", "''", "a directory")

    # A pool of the caller stays open after the search.
    pool_context = open_pool(jobs, cluster) if pool is None else nullcontext(pool)
    with pool_context as workers, open_progress(progress) as show:
        run_campaign(
            loaded_study,
            system,
            keys,
            directory,
            workers,
            show,
            engine,
            retry_failed=retry_failed,
        )
    results = load(directory)
    remark = why_few_evaluations(results)
    if remark:
        warn(remark)
    return results


def load_for_search(study: StudyLike) -> tuple[Study, System]:
    """Load a study, assemble its system, and check its algorithms.

    Raises
    ------
    InputError
        If a name or a parameter of the study cannot be used.
    """
    loaded_study, system = load_and_assemble(study)
    check_algorithms(loaded_study, system)
    return loaded_study, system
