"""Run a study on this machine or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path

from safevar_sumo.analysis.subject import Results, load
from safevar_sumo.analysis.words import number_of
from safevar_sumo.api.simulation import load_and_assemble
from safevar_sumo.campaign import Campaign, Observer, RunKey, RunProgress, algorithm_of, all_runs, run_campaign
from safevar_sumo.campaign.batches import ask_why_no_verdict
from safevar_sumo.campaign.cluster import cluster_pool
from safevar_sumo.campaign.identity import identity_of
from safevar_sumo.campaign.local import available_cores, local_pool
from safevar_sumo.campaign.pool import Pool
from safevar_sumo.errors import InputError, SafevarError, one_of, warn
from safevar_sumo.results import MANIFEST, ResultsDirectory, read_manifest, stored_runs
from safevar_sumo.study import Study, StudyLike
from safevar_sumo.sumo import Engine, reason_for_sumo, settings_per_batch
from safevar_sumo.sumo.system import System
from safevar_sumo.terminal import Progress, open_progress

ENGINES = (str(Engine.RECORDED), str(Engine.LIBSUMO))
"""The engines that a study may name."""


def run(
    study: StudyLike,
    out: str | Path | None = None,
    *,
    jobs: int | None = None,
    cluster: str | None = None,
    pool: Pool | None = None,
    progress: bool | Progress | Observer = False,
    only: Sequence[tuple[str, int]] | None = None,
    batch: int | None = None,
    engine: str = Engine.RECORDED,
    retry_failed: bool = False,
) -> Results:
    """Search a study; a call with the same study and directory continues where an earlier one was stopped.

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
        True for a bar on the terminal; a function called with the study's name and what it has found, the number of
        evaluations done, and the number to do at most; or an `Observer`.
    only
        The only runs to carry out, as (algorithm, number from 0); the results are complete once every run is finished.
    batch
        Maximum number of settings per batch, gathered from several runs; never changes a result.
    engine
        "recorded": simulate in a recorded scene if no actor reacts to the vehicle under test, else in SUMO; "sumo":
        always in SUMO. Never changes a result.
    retry_failed
        Whether to simulate again the settings that failed before (simulator-error).

    Raises
    ------
    InputError
        If the study cannot be used, or the directory belongs to another study.
    SafevarError
        If nothing can be computed, a file cannot be written, or another process works on one of the runs.
    """
    loaded_study, system = load_for_search(study)
    keys = all_runs(loaded_study) if only is None else [RunKey(*key) for key in only]
    directory = Path(out) if out is not None else Path("results") / loaded_study.name
    pool_context = nullcontext(pool) if pool is not None else open_pool(loaded_study, jobs, cluster)
    with pool_context as workers, open_observer(progress, loaded_study, keys) as observer:
        carry_out_runs(
            loaded_study, system, keys, directory, workers, observer, batch, engine, retry_failed=retry_failed
        )
    return load(directory)


def load_for_search(study: StudyLike, source: str = "") -> tuple[Study, System]:
    """Load a study, assemble its system and check its algorithms; errors name the study `source`.

    Raises
    ------
    InputError
        If one of its names or parameters cannot be used.
    """
    loaded_study, system = load_and_assemble(study, source)
    for name in loaded_study.search.labels:
        algorithm_of(name, loaded_study)
    return loaded_study, system


def carry_out_runs(
    study: Study,
    system: System,
    keys: list[RunKey],
    directory: Path,
    pool: Pool,
    observer: Observer,
    batch: int | None,
    engine: str = Engine.RECORDED,
    *,
    retry_failed: bool = False,
) -> Campaign:
    """Carry out runs of a study in a directory with `run_campaign`; write the solutions once all of the study's runs
    are finished.

    Raises
    ------
    SafevarError
        If another process works on one of the runs, or `run_campaign` raises it.
    """
    results = ResultsDirectory(directory, study, identity_of(study, system), system.measuring.scoring)
    engine_used, reason = choose_engine(system, engine)
    for remark in _extent_remarks(results, study):
        observer.warned(remark)
    results.manifest["engine"] = {"name": str(engine_used), "reason": reason}
    algorithms = {name: algorithm_of(name, study) for name in study.search.labels}
    results.manifest["titles"] = {name: one.title for name, one in algorithms.items() if one.title}
    no_verdict = ask_why_no_verdict(study, pool)
    if no_verdict:
        observer.warned(f"study {study.name!r}: {no_verdict}")
    campaign = run_campaign(
        study,
        keys,
        results,
        pool,
        observer,
        batch or settings_per_batch(system, engine_used),
        engine=engine_used,
        retry_failed=retry_failed,
    )
    if campaign.busy:
        raise SafevarError(
            f"another process works on {', '.join(map(str, campaign.busy))}: run the study again later to finish it"
        )
    if keys == all_runs(study):
        results.finish(campaign.solutions)
    return campaign._replace(no_verdict=no_verdict)


def _extent_remarks(results: ResultsDirectory, study: Study) -> list[str]:
    """Remarks on earlier results in a directory: runs of other lengths, and runs that the study no longer has."""
    if not (results.path / MANIFEST).exists():
        return []
    earlier_budget, budget = read_manifest(results.path)["study"]["search"]["evaluations"], study.search.evaluations
    remarks = []
    if earlier_budget != budget:
        remarks.append(
            f"{results.path}: each run had {earlier_budget} evaluations before and has {budget} now: an id such as "
            "nsga2:0:0 may name another solution than in earlier output and reports"
        )
    names = stored_runs(results.path) - set(map(str, all_runs(study)))
    if names:
        remarks.append(
            f"{results.path}: {number_of(len(names), 'earlier run')} left out of the results: "
            f"{', '.join(sorted(names))}"
        )
    return remarks


def choose_engine(system: System, name: str) -> tuple[Engine, str]:
    """Choose the engine that moves a system's vehicles, and say why; raises InputError for an unknown engine."""
    if name not in ENGINES:
        raise InputError("engine", repr(name), one_of(ENGINES))
    if name == Engine.LIBSUMO:
        return Engine.LIBSUMO, "requested"
    reason = reason_for_sumo(system)
    return (Engine.LIBSUMO, reason) if reason else (Engine.RECORDED, "nobody reacts to the vehicle under test")


def open_pool(study: Study, jobs: int | None, cluster: str | None) -> AbstractContextManager[Pool]:
    """Open the pool that computes a study's batches: worker processes, or the workers of a cluster."""
    limit = study.search.time_limit
    return cluster_pool(cluster, limit) if cluster is not None else local_pool(jobs or available_cores(), limit)


@contextmanager
def open_observer(
    progress: bool | Progress | Observer,
    study: Study,
    keys: Sequence[RunKey],
    show_warning: Callable[[str], None] = warn,
) -> Iterator[Observer]:
    """Yield the observer for a value of `progress`."""
    if not (isinstance(progress, bool) or callable(progress)):
        yield progress
        return
    with open_progress(progress) as show_progress:
        yield CampaignProgress(show_progress, study, keys, show_warning)


class CampaignProgress:
    """Passes on the progress of a campaign: evaluations, without those of journals, and what runs have found."""

    def __init__(
        self, progress: Progress, study: Study, keys: Sequence[RunKey], show_warning: Callable[[str], None] = warn
    ) -> None:
        self.warned, self._progress, self._study, self._run_count = show_warning, progress, study, len(keys)
        self._runs, self._replayed = dict[RunKey, RunProgress](), dict[RunKey, int]()
        self._finished_runs = set[RunKey]()
        self.progressed([])

    def progressed(self, runs: Sequence[RunProgress]) -> None:
        """Take note of the state of some runs; what a journal held at first is not left to be done."""
        for run in runs:
            self._runs[run.key] = run
            self._replayed.setdefault(run.key, run.replayed)
        budget, replayed = self._study.search.evaluations, sum(self._replayed.values())
        unused = sum(budget - self._runs[key].asked for key in self._finished_runs)
        degrees = [run.best for run in self._runs.values() if run.best is not None]
        collisions = sum(run.collisions for run in self._runs.values())
        findings = f", {collisions} collisions, best SD {min(degrees):.2f}" if degrees else ""
        self._progress(
            f"{self._study.name}: runs {len(self._finished_runs)}/{self._run_count}{findings}",
            sum(run.asked for run in self._runs.values()) - replayed,
            self._run_count * budget - unused - replayed,
        )

    def finished(self, run: RunProgress) -> None:
        """Take note of the last state of a run, which may have taken fewer evaluations than it was allowed."""
        self._finished_runs.add(run.key)
        self.progressed([run])
