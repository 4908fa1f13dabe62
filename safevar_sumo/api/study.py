"""The command `study`: a search with its summary, what it would take, and how far it is."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
import pandas as pd

from safevar_sumo.api.running import load_for_search
from safevar_sumo.campaign import Campaign, RunKey, all_runs, run_campaign
from safevar_sumo.campaign.campaign import choose_engine, measure_speed
from safevar_sumo.campaign.evaluation import Task
from safevar_sumo.campaign.pool import open_pool
from safevar_sumo.errors import InputError, warn
from safevar_sumo.metrics import RATING_POINTS
from safevar_sumo.questions.answer import Answer, Column, tabulate
from safevar_sumo.questions.ask import Jobs, Range
from safevar_sumo.questions.case import Case, UnanswerableError, build_case
from safevar_sumo.questions.research_questions.comparisons import compare_over_runs, opponents_of, titles_of
from safevar_sumo.questions.words import ending_in_words, list_of_changes, number_of, question_command
from safevar_sumo.records import Evaluations, JsonObject, Outcome
from safevar_sumo.results import CHOICES, evaluations_frame, failure_lines, load_runs, record, solutions_frame
from safevar_sumo.scenarios import degree_note
from safevar_sumo.study import Study, label_of, load_study
from safevar_sumo.sumo import settings_per_batch, vehicle_remarks
from safevar_sumo.sumo.matrix import contact_degree
from safevar_sumo.sumo.system import System
from safevar_sumo.terminal import open_progress
from safevar_sumo.vehicles import CharacteristicSet

ALGORITHM = {"algorithm": Column("", "algorithm")}
STATUS = ALGORITHM | {
    "finished": Column("", "finished runs"),
    "runs": Column("", "runs"),
    "simulated": Column("", "different settings simulated so far"),
    "collisions": Column("", "those that collide"),
    "simulator_errors": Column("", "those that cannot be simulated"),
    "best": Column("m", "least safety degree; minus the collision's speed in m/s", ".2f"),
}
SUMMARY = {
    "algorithm": Column("", "algorithm, or the original vehicle"),
    "evaluations": Column("", "different settings that a run simulates, mean", ".0f"),
    "simulated_collisions": Column("", "simulations that collide"),
    "solutions": Column("", "solutions"),
    "collisions": Column("", "solutions that collide"),
}
COMPARISONS = {
    "question": Column("", "research question"),
    "algorithm": Column("", "algorithm"),
    "baseline": Column("", "the other algorithm, or the original vehicle"),
    "metric": Column("", "safety metric or quality of the runs' fronts"),
    "effect_size": Column("", "A12 over runs; RQ1: below 0.5 more unsafe; RQ2: above 0.5 better", ".2f"),
    "p_holm": Column("", "p-value after Holm's correction", ".2g"),
    "significant": Column("", "whether it is significant"),
}
REMARKS = {"remark": Column("", "what to know about these results")}


def study(
    study: str,
    *,
    runs: Annotated[int | None, Range(1, 100_000)] = None,
    evaluations: Annotated[int | None, Range(1, 10_000_000)] = None,
    algorithms: Annotated[str | None, "NAME,..."] = None,
    seed: Annotated[int | None, Range(0, 2**63 - 1)] = None,
    batch: Annotated[int | None, Range(1, 10_000)] = None,
    engine: Literal["recorded", "sumo"] = "recorded",
    out: Path | None = None,
    jobs: Jobs = None,
    cluster: Annotated[str | None, "ADDRESS"] = None,
    only: Annotated[str | None, "ALGORITHM:RUN"] = None,
    shard: Annotated[str | None, "K/N"] = None,
    retry_failed: bool = False,
    quiet: bool = False,
    dry_run: bool = False,
    status: bool = False,
) -> Answer | None:
    """Search a study; run the same command again to continue where it stopped.

    Parameters
    ----------
    runs
        Runs of each algorithm.
    evaluations
        Simulations of each run.
    algorithms
        Algorithms, separated by commas.
    seed
        Seed of the whole study.
    batch
        Maximum settings per batch, gathered from several runs; does not change results. By default the fastest.
    engine
        What moves the vehicles. recorded: numpy, in a scene that SUMO has played once, if no actor reacts to the
        vehicles; results are verified in SUMO. sumo: always SUMO.
    out
        Directory of the results, by default results/STUDY.
    jobs
        Number of worker processes, by default one for each core.
    cluster
        Compute on the workers of this Dask scheduler instead.
    only
        Only this run; runs count from 0.
    shard
        Every N-th run, from the K-th (1..N): for job arrays that share the directory.
    retry_failed
        Simulate again the settings that could not be simulated before (simulator-error).
    quiet
        Print only errors and warnings.
    dry_run
        Estimate the time from a short measurement.
    status
        Show the progress of the study in its directory, without disturbing it.
    """
    as_written = load_study(study)
    directory = out or Path("results") / as_written.name
    if status:
        return read_status(directory)
    search, given = as_written.search, {"runs": runs, "evaluations": evaluations, "seed": seed}
    changes: JsonObject = {name: value for name, value in given.items() if value is not None}
    if algorithms is not None:
        names = [name.strip() for name in algorithms.split(",")]
        changes["algorithms"] = [search.labels.get(name, name) for name in names]
    changed = msgspec.structs.replace(as_written, search=msgspec.structs.replace(search, **changes))
    loaded, system = load_for_search(changed, study)
    for remark in dict.fromkeys([*loaded.origin.remarks, *system.remarks, *vehicle_remarks(system)]):
        warn(remark)
    keys = _select_runs(all_runs(loaded), only, shard)
    if not keys:
        warn(f"--shard {shard} selects none of the runs")
    with open_pool(jobs, cluster) as pool:
        if dry_run:
            used, reason = choose_engine(system, engine)
            task = Task(study=loaded, engine=used, batch_size=batch or settings_per_batch(system, used))
            return _forecast(loaded, len(keys), measure_speed(task, pool), f"{used}: {reason}")
        try:
            with open_progress(not quiet) as show:
                arguments = (loaded, system, keys, directory, pool, show, warn, batch, engine)
                campaign = run_campaign(*arguments, retry_failed=retry_failed)
        except KeyboardInterrupt:
            warn(f"finished evaluations are kept in {directory}: run the same command again to continue")
            raise
    return None if quiet else _summary(loaded, system, campaign, directory)


def _select_runs(keys: list[RunKey], only: str | None, shard: str | None) -> list[RunKey]:
    """The runs that `only` and `shard` select."""
    if only is not None:
        algorithm, _, run = only.rpartition(":")
        keys = [key for key in keys if key.algorithm == algorithm and str(key.run) == run]
        if not keys:
            legal = "ALGORITHM:RUN, an algorithm of the study and a run from 0 to less than --runs"
            raise InputError("only", repr(only), legal)
    if shard is not None:
        rank, _, count = shard.partition("/")
        if not (all(text.isdecimal() and len(text) < 10 for text in (rank, count)) and 1 <= int(rank) <= int(count)):
            raise InputError("shard", repr(shard), "K/N, with K in 1..N")
        keys = keys[int(rank) - 1 :: int(count)]
    return keys


def read_status(directory: Path) -> Answer:
    """How far the study in a directory is: runs, evaluations, collisions."""
    results = load_runs(directory)
    study, finished = msgspec.convert(results.manifest["study"], Study), Counter(name for name, _ in results.finished)
    if "imported" in results.manifest:
        raise InputError(directory, "holds imported solutions, which have no runs", "results of the command `study`")
    rows = []
    for algorithm in map(label_of, study.search.algorithms):
        group = results.evaluations[results.evaluations["algorithm"] == algorithm]
        counts = [(group["outcome"] == outcome).sum() for outcome in (Outcome.COLLISION, Outcome.SIMULATOR_ERROR)]
        rows.append((algorithm, finished[algorithm], study.search.runs, len(group), *counts, group["f_safe"].min()))
    runs = study.search.runs * len(rows)
    return Answer(
        question="study",
        study=study,
        verdict=f"{sum(finished.values())} of {number_of(runs, 'run')} finished in {directory}.",
        numbers={"finished": sum(finished.values()), "runs": runs, "evaluations": study.search.evaluations},
        tables={"algorithms": tabulate(study.title, STATUS, rows)},
    )


def _forecast(study: Study, runs: int, rate: float, engine: str) -> Answer:
    """The estimated time of a search from its evaluations per second."""
    evaluations = runs * study.search.evaluations
    seconds = evaluations / rate
    time = f"{seconds / 60:.1f} min" if seconds >= 60 else f"{seconds:.0f} s"
    names = ", ".join(study.search.labels)
    return Answer(
        question="study",
        study=study,
        verdict=f"At most {time} for {evaluations} evaluations, {runs} runs of {names}; nothing was written.",
        numbers={
            "runs": runs,
            "engine": engine,
            "evaluations": evaluations,
            "evaluations_per_second": rate,
            "seconds": seconds,
        },
        tables={},
    )


def _summary(study: Study, system: System, campaign: Campaign, directory: Path) -> Answer:
    """The verdict, the original and each algorithm's solutions, RQ1 and RQ2 over runs, and the next two commands."""
    names = system.characteristics.names
    solutions = solutions_frame(names, [(run.key, run.solutions) for run in campaign.runs])
    case = build_case(
        study,
        record(campaign.original, row=0),
        solutions,
        solutions_frame(names, []),
        tuple(run.key for run in campaign.runs),
        scoring=campaign.scoring,
    )
    remarks = [degree_note(contact_degree(system)), "TET and TIT are means over solutions without collision."]
    comparisons, reason = _compare_over_runs(case)
    remarks += [reason] if reason else []
    if failures := [failure for run in campaign.runs for failure in run.failures]:
        lines = "; ".join(failure_lines(failures))
        remarks.append(f"{len(failures)} settings could not be simulated (simulator-error): {lines}.")
    if invalid := sum(run.invalid_tests for run in campaign.runs):
        remarks.append(
            f"{invalid} settings violate a test's speed tolerance before the ADS acts (invalid-test): "
            "they are neither failures nor successes, and no result contains them."
        )
    verdict = [campaign.no_verdict] if campaign.no_verdict else _verdict(case, system, campaign.original)
    following = ", ".join(question_command(name, str(directory)) for name in ("explain", "tolerance"))
    return Answer(
        question="study",
        study=study,
        verdict=" ".join([*verdict, f"Next: {following}"]),
        numbers={
            "driven": not campaign.no_verdict,
            "results": str(directory),
            "runs": len(campaign.runs),
            "solutions": len(solutions),
            "unsafe": str(case.unsafe),
        },
        tables={
            "algorithms": _summary_table(study, campaign, solutions),
            "comparisons": tabulate("RQ1 and RQ2 over runs", COMPARISONS, comparisons, words=titles_of([case])),
            "remarks": tabulate("Remarks", REMARKS, [(remark,) for remark in remarks]),
        },
    )


def _verdict(case: Case, system: System, original: Evaluations) -> list[str]:
    """How many solutions are unsafe, and how little is enough."""
    unsafe, names = case.unsafe, list(case.characteristics.names)
    if original.collided[0] and not system.rater:
        return ["The original vehicle itself collides: no change is needed."]
    solutions = case.solutions.drop_duplicates(names)
    if solutions.empty:
        return ["No solution."]
    failures = solutions[unsafe.rows(solutions)].sort_values(CHOICES["fewest"], kind="stable")
    counts = f"{len(failures)} of {len(solutions)} different solutions are unsafe: {unsafe.description}."
    if failures.empty:
        return [counts]
    fewest = failures.iloc[0]
    ending = ending_in_words(fewest["outcome"], fewest["f_safe"], contact_degree(system))
    if system.rater:
        ending = f"keeps {fewest[RATING_POINTS.name]:.2f} points"
    changes = list_of_changes(case.characteristics, {name: float(fewest[name]) for name in names})
    return [counts, f"With the fewest changes it {ending}: {changes}."]


def _summary_table(study: Study, campaign: Campaign, solutions: pd.DataFrame) -> pd.DataFrame:
    """The original vehicle, and each algorithm's solutions: their number, collisions, and means of metrics."""
    metrics = campaign.scoring.metrics
    original = evaluations_frame(CharacteristicSet.of(study).names, [(("", 0), campaign.original)])
    rows = [("original", np.nan, int(campaign.original.collided[0]), np.nan, np.nan, *_means(original, campaign))]
    for name in study.search.labels:
        runs = [run for run in campaign.runs if run.key.algorithm == name]
        found = solutions[solutions["algorithm"] == name]
        if runs:
            counts = (np.mean([run.simulated for run in runs]), sum(run.collisions for run in runs), len(found))
            collisions = (found["outcome"] == Outcome.COLLISION).sum()
            rows.append((name, *counts, collisions, *_means(found, campaign)))
    columns = SUMMARY | {metric.name: Column(metric.unit, f"mean {metric.title}", ".2f") for metric in metrics}
    return tabulate(study.title, columns, rows)


def _means(frame: pd.DataFrame, campaign: Campaign) -> list[float]:
    return [frame[metric.name].mean() for metric in campaign.scoring.metrics]


def _compare_over_runs(case: Case) -> tuple[pd.DataFrame, str]:
    """The rows of `COMPARISONS`, and why some are missing."""
    try:
        tests = compare_over_runs(case).rename_axis("question").reset_index()
    except UnanswerableError as error:
        return pd.DataFrame(), f"RQ1 and RQ2: {error.problem}."
    if "baseline" not in tests:
        tests["baseline"] = None
    tests["baseline"] = tests["baseline"].fillna("original")
    try:
        opponents_of(case)
    except UnanswerableError as error:
        return tests, f"RQ2: {error.problem}."
    few = tests[~tests["enough_runs"]]["question"].unique()
    return tests, f"Too few runs for a test: {', '.join(few)}." if len(few) else ""
