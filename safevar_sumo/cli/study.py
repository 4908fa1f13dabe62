"""Commands that run a study and show its progress: study, status; and the text that they print."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click
import msgspec
import numpy as np
from rich.console import Console

from safevar_sumo.api.running import load_for_search
from safevar_sumo.campaign import Campaign, RunKey, all_runs, run_campaign
from safevar_sumo.campaign.campaign import ENGINES, choose_engine, measure_speed
from safevar_sumo.campaign.evaluation import Task
from safevar_sumo.campaign.pool import open_pool
from safevar_sumo.cli.arguments import complete_study, file_option, jobs_option, split_names
from safevar_sumo.cli.program import commands, print_json, print_remarks, print_warning
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import RATING_POINTS
from safevar_sumo.questions.words import ending_in_words, list_of_changes, question_command, two_decimals
from safevar_sumo.records import Evaluations, JsonObject, Outcome, finite_or_none
from safevar_sumo.results import CHOICES, evaluations_frame, failure_lines, record, solutions_frame
from safevar_sumo.scenarios import degree_note
from safevar_sumo.study import Study, label_of, load_study
from safevar_sumo.sumo import settings_per_batch, vehicle_remarks
from safevar_sumo.sumo.matrix import contact_degree
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import WholeTable, open_progress, print_text

if TYPE_CHECKING:
    import pandas as pd

    from safevar_sumo.questions.case import Case


@commands.command()
@click.argument("study", shell_complete=complete_study)
@click.option("--runs", type=click.IntRange(1, 100_000), help="Runs of each algorithm.")
@click.option("--evaluations", type=click.IntRange(1, 10_000_000), help="Simulations of each run.")
@click.option("--algorithms", help="Algorithms, separated by commas.")
@click.option("--seed", type=click.IntRange(min=0, max=2**63 - 1), help="Seed of the whole study.")
@click.option(
    "--batch",
    type=click.IntRange(1, 10_000),
    help="Maximum settings per batch, gathered from several runs; does not change results.  [default: the fastest]",
)
@click.option(
    "--engine",
    type=click.Choice(ENGINES),
    default=ENGINES[0],
    show_default=True,
    help="What moves the vehicles. recorded: numpy, in a scene that SUMO has played once, if no actor reacts to "
    "the vehicles; "
    "results are verified in SUMO. sumo: always SUMO.",
)
@file_option("--out", "Directory of the results.  [default: results/STUDY]", metavar="PATH")
@jobs_option
@click.option("--cluster", metavar="ADDRESS", help="Compute on the workers of this Dask scheduler instead.")
@click.option("--only", metavar="ALGORITHM:RUN", help="Only this run; runs count from 0.")
@click.option("--shard", metavar="K/N", help="Every N-th run, from the K-th (1..N): for job arrays that share --out.")
@click.option(
    "--retry-failed",
    is_flag=True,
    help="Simulate again the settings that could not be simulated before (simulator-error).",
)
@click.option("--quiet", is_flag=True, help="Print only errors and warnings.")
@click.option("--dry-run", is_flag=True, help="Estimate the time from a short measurement.")
def study(
    study: str,
    batch: int | None,
    engine: str,
    out: Path | None,
    jobs: int | None,
    cluster: str | None,
    only: str | None,
    shard: str | None,
    retry_failed: bool,
    quiet: bool,
    dry_run: bool,
    algorithms: str | None,
    **numbers: int | None,
) -> None:
    """Search STUDY; run the same command again to continue where it stopped."""
    as_written = load_study(study)
    search = as_written.search
    changes: JsonObject = {name: value for name, value in numbers.items() if value is not None}
    if algorithms is not None:
        changes["algorithms"] = [search.labels.get(name, name) for name in split_names(algorithms)]
    loaded_study, system = load_for_search(
        msgspec.structs.replace(as_written, search=msgspec.structs.replace(search, **changes)), study
    )
    print_remarks(loaded_study, [*system.remarks, *vehicle_remarks(system)])
    keys = _select_runs(all_runs(loaded_study), only, shard)
    if not keys:
        print_warning(f"--shard {shard} selects none of the runs")
    directory = out or Path("results") / loaded_study.name
    with open_pool(jobs, cluster) as pool:
        if dry_run:
            used_engine, reason = choose_engine(system, engine)
            task = Task(
                study=loaded_study, engine=used_engine, batch_size=batch or settings_per_batch(system, used_engine)
            )
            rate = measure_speed(task, pool)
            print_forecast(Console(), loaded_study, len(keys), rate, f"{used_engine}: {reason}")
            return
        try:
            with open_progress(not quiet) as progress:
                campaign = run_campaign(
                    loaded_study,
                    system,
                    keys,
                    directory,
                    pool,
                    progress,
                    print_warning,
                    batch,
                    engine,
                    retry_failed=retry_failed,
                )
        except KeyboardInterrupt:
            click.echo(
                f"finished evaluations are kept in {directory}: run the same command again to continue", err=True
            )
            raise
    if not quiet:
        print_summary(Console(), loaded_study, campaign, directory)
        print_text(Console(), f"Results: {directory}")


def _select_runs(keys: list[RunKey], only: str | None, shard: str | None) -> list[RunKey]:
    """The runs that --only and --shard select."""
    if only is not None:
        algorithm, _, run = only.rpartition(":")
        keys = [key for key in keys if key.algorithm == algorithm and str(key.run) == run]
        if not keys:
            raise InputError(
                "--only", repr(only), "ALGORITHM:RUN, an algorithm of the study and a run from 0 to less than --runs"
            )
    if shard is not None:
        rank, _, count = shard.partition("/")
        if not (all(text.isdecimal() and len(text) < 10 for text in (rank, count)) and 1 <= int(rank) <= int(count)):
            raise InputError("--shard", repr(shard), "K/N, with K in 1..N")
        keys = keys[int(rank) - 1 :: int(count)]
    return keys


@commands.command()
@click.argument("directory", metavar="DIR")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def status(directory: str, as_json: bool) -> None:
    """Show the progress of the study in DIR, without disturbing it: runs, evaluations, collisions."""
    from safevar_sumo.results import load_runs

    results = load_runs(directory)
    study, finished = results.manifest["study"], Counter(algorithm for algorithm, _ in results.finished)
    if "imported" in results.manifest:
        raise InputError(directory, "holds imported solutions, which have no runs", "results of the command `study`")
    rows = {
        algorithm: {
            "finished": finished[algorithm],
            "runs": study["search"]["runs"],
            "simulated": len(group),
            "collisions": int((group["outcome"] == Outcome.COLLISION).sum()),
            "simulator_errors": int((group["outcome"] == Outcome.SIMULATOR_ERROR).sum()),
            "best": finite_or_none(group["f_safe"].min()),
        }
        for algorithm in map(label_of, study["search"]["algorithms"])
        for group in [results.evaluations[results.evaluations["algorithm"] == algorithm]]
    }
    if as_json:
        print_json({"study": study["name"], "evaluations": study["search"]["evaluations"], "algorithms": rows})
        return
    heads = ("finished\nruns", "runs", "simulated", "collisions", "simulator\nerrors", "best\nSD")
    table = WholeTable("algorithm", right=heads, title=study["title"])
    for algorithm, row in rows.items():
        *counts, best = row.values()
        table.add_row(algorithm, *map(str, counts), two_decimals(best))
    Console().print(table)
    sd = "SD: least distance in m, behind lead vehicles from centre to centre, or minus the collision's speed in m/s."
    print_text(Console(), sd)


def print_forecast(console: Console, study: Study, runs: int, rate: float, engine: str) -> None:
    """Print the estimated time of a campaign from its evaluations per second."""
    print_text(console, study.title)
    evaluations = runs * study.search.evaluations
    seconds = evaluations / rate
    table = WholeTable(show_header=False)
    table.add_row("algorithms", ", ".join(study.search.labels))
    table.add_row("runs", str(runs))
    table.add_row("engine", engine)
    table.add_row("evaluations, at most", str(evaluations))
    table.add_row("evaluations/s, measured on random settings", f"{rate:.{0 if rate >= 10 else 1}f}")
    table.add_row("time, at most", f"{seconds / 60:.1f} min" if seconds >= 60 else f"{seconds:.0f} s")
    console.print(table)


def print_summary(console: Console, study: Study, campaign: Campaign, directory: Path) -> None:
    """Print the verdict, a table of the original and of each algorithm's solutions, RQ1 and RQ2 in brief, and the next
    two commands.
    """
    from safevar_sumo.questions.case import build_case

    # Loads more slowly than all other modules.
    from safevar_sumo.questions.research_questions.comparisons import summary_lines

    names = study.vehicle.characteristics
    solutions = solutions_frame(names, [(run.key, run.solutions) for run in campaign.runs])
    case = build_case(
        study,
        record(campaign.original, row=0),
        solutions,
        solutions_frame(names, []),
        tuple(run.key for run in campaign.runs),
        scoring=campaign.scoring,
    )
    for line in [campaign.no_verdict] if campaign.no_verdict else _verdict(case, campaign.original):
        print_text(console, line)
    console.print(_summary_table(study, campaign, solutions))
    lines = [degree_note(contact_degree(assemble(study))), "TET, TIT: over solutions without collision."]
    if failures := [failure for run in campaign.runs for failure in run.failures]:
        lines.append(f"{len(failures)} settings could not be simulated (simulator-error); no result contains them:")
        lines += [f"  {line}" for line in failure_lines(failures)]
    if invalid := sum(run.invalid_tests for run in campaign.runs):
        lines.append(
            f"{invalid} settings violate a test's speed tolerance before the ADS acts (invalid-test): "
            "they are neither failures nor successes, and no result contains them."
        )
    commands = (question_command(name, str(directory)) for name in ("explain", "tolerance"))
    for line in (*lines, *summary_lines(case), f"Next: {', '.join(commands)}"):
        print_text(console, line)


def _verdict(case: Case, original: Evaluations) -> list[str]:
    """How many solutions are unsafe, and how little is enough."""
    system, unsafe, names = assemble(case.study), case.unsafe, list(case.characteristics.names)
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
    return [f"{counts} With the fewest changes it {ending}: {changes}."]


def _summary_table(study: Study, campaign: Campaign, solutions: pd.DataFrame) -> WholeTable:
    """The original vehicle, and each algorithm's solutions: their number, collisions, and means of metrics."""
    original = evaluations_frame(study.vehicle.characteristics, [(("", 0), campaign.original)])
    searched = {run.key.algorithm for run in campaign.runs}
    by_algorithm = {name: solutions[solutions["algorithm"] == name] for name in study.search.labels if name in searched}
    frames = {"original vehicle": original, **by_algorithm}
    simulated = Counter({"original vehicle": int(campaign.original.collided[0])})
    for run in campaign.runs:
        simulated[run.key.algorithm] += run.collisions
    table = WholeTable("", right=frames, title=study.title)
    means = (np.mean([run.simulated for run in campaign.runs if run.key.algorithm == name]) for name in by_algorithm)
    table.add_row(
        f"evaluations of a run (of {study.search.evaluations}), mean", "-", *(f"{mean:.0f}" for mean in means)
    )
    table.add_row("solutions", "-", *(str(len(frame)) for frame in by_algorithm.values()))
    table.add_row(
        "solutions that collide", *(str((frame["outcome"] == Outcome.COLLISION).sum()) for frame in frames.values())
    )
    table.add_row("collisions simulated", *(str(simulated[name]) for name in frames))
    for metric in campaign.scoring.metrics:
        table.add_row(f"mean {metric.heading}", *(two_decimals(frame[metric.name].mean()) for frame in frames.values()))
    return table
