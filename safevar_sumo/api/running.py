"""A study carried out, on this machine or on a cluster."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from rich.console import Console

from safevar_sumo.api.results import Results, load
from safevar_sumo.api.simulation import assembled
from safevar_sumo.campaign import Campaign, Observer, RunKey, algorithm_of, all_runs, read_by_algorithms, run_campaign
from safevar_sumo.errors import SafevarError
from safevar_sumo.progress import CampaignProgress
from safevar_sumo.results import ResultsDirectory
from safevar_sumo.study import Study, StudyLike
from safevar_sumo.sumo.system import System
from safevar_sumo.workers.cluster import cluster_pool
from safevar_sumo.workers.evaluation import Pool
from safevar_sumo.workers.identity import identity_of
from safevar_sumo.workers.local import available_cores, local_pool
from safevar_sumo.workers.sources import sources_of


def run(study: StudyLike, out: str | Path | None = None, *, jobs: int | None = None, cluster: str | None = None,
        progress: bool | Observer = False, only: Sequence[tuple[str, int]] | None = None, batch: int | None = None,
        retry_failed: bool = False) -> Results:
    """Search a study; called again with the same study and directory, it goes on where it was stopped.

    Parameters
    ----------
    study
        A study, or what `load_study` makes one of.
    out
        Directory of the results, by default `results/NAME`.
    jobs
        Worker processes, by default the cores of this machine.
    cluster
        Compute on the workers of the Dask scheduler at this address instead.
    progress
        Show bars, or whom to tell.
    only
        These runs alone, as (algorithm, number from 0); the results are whole once every run is finished.
    batch
        Settings per SUMO simulation, at the most, gathered from several runs; never changes a result.
    retry_failed
        Whether settings that could not be simulated before are tried again.

    Raises
    ------
    InputError
        If the study cannot be used, or the directory belongs to another one.
    SafevarError
        If nothing can be computed, a file cannot be written, or another process works on one of the runs.
    """
    chosen, system = prepared(study)
    keys = all_runs(chosen) if only is None else [RunKey(*key) for key in only]
    directory = Path(out) if out is not None else Path("results") / chosen.name
    bars: Any = CampaignProgress(Console(stderr=True), chosen, keys, quiet=False)
    showing = bars if progress is True else nullcontext(progress or NullObserver())
    with open_pool(chosen, jobs, cluster) as pool, showing as observer:
        carried_out(chosen, system, keys, directory, pool, observer, batch, retry_failed=retry_failed)
    return load(directory)


def prepared(study: StudyLike, source: str = "") -> tuple[Study, System]:
    """A study that can be searched, and what its simulations are made of; `source` is how errors call it.

    Raises
    ------
    InputError
        If one of its names or parameters cannot be used.
    """
    chosen, system = assembled(study, source)
    for name in chosen.search.labels:
        algorithm_of(name, chosen)
    return chosen, system


def carried_out(study: Study, system: System, keys: list[RunKey], directory: Path, pool: Pool, observer: Observer,
                batch: int | None, *, retry_failed: bool = False) -> Campaign:
    """Carry out runs of a study in a directory; with all of them finished, its solutions are written. See `run_campaign`.

    Raises
    ------
    SafevarError
        If another process works on one of the runs, or as `run_campaign`.
    """
    sources = {**sources_of(study, pool), **read_by_algorithms(study)}
    results = ResultsDirectory(directory, study, identity_of(study, system, sources), system.measuring.scoring)
    campaign = run_campaign(study, keys, results, pool, observer, batch, retry_failed=retry_failed)
    if campaign.busy:
        raise SafevarError(f"another process works on {', '.join(map(str, campaign.busy))}: the same again later finishes the study")
    if keys == all_runs(study):
        results.finish(campaign.solutions)
    return campaign


def open_pool(study: Study, jobs: int | None = None, cluster: str | None = None) -> AbstractContextManager[Pool]:
    """Where batches of a study are computed: worker processes, or the workers of a cluster."""
    limit = study.search.time_limit
    return cluster_pool(cluster, limit) if cluster is not None else local_pool(jobs or available_cores(), limit)


class NullObserver:
    """Nobody looks on; warnings alone are told."""

    def evaluated(self, *_: object) -> None:
        """A population is evaluated."""

    def finished(self, *_: object) -> None:
        """A run is over."""

    def warned(self, message: str) -> None:
        """Something happened that the user should know."""
        warnings.warn(message, stacklevel=2)
