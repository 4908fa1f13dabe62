"""Commands that run a study and show its progress: study, status; and the text that they print."""

from __future__ import annotations

import json
import time
from collections import Counter
from contextlib import nullcontext
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import click
import msgspec
import numpy as np
from rich import filesize
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from safevar_sumo.analysis.research_questions.fronts import nondominated_points
from safevar_sumo.analysis.words import question_command, two_decimals
from safevar_sumo.api.running import ENGINES, carry_out_runs, choose_engine, load_for_search, open_observer, open_pool
from safevar_sumo.campaign import Campaign, Forecast, RunKey, all_runs, forecast
from safevar_sumo.cli.arguments import complete_study, file_option, jobs_option, split_names
from safevar_sumo.cli.program import commands, print_note, print_remarks, print_warning
from safevar_sumo.errors import InputError
from safevar_sumo.records import JsonObject, Outcome
from safevar_sumo.results import Status, evaluations_frame, failure_lines, record, solutions_frame
from safevar_sumo.study import Study, load_study
from safevar_sumo.sumo import settings_per_batch, vehicle_remarks
from safevar_sumo.terminal import WholeTable, print_text

if TYPE_CHECKING:
    import pandas as pd


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
@click.option("--dry-run", is_flag=True, help="Estimate time and disk space without running anything.")
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
    with open_pool(loaded_study, jobs, cluster) as pool:
        if dry_run:
            used_engine, reason = choose_engine(system, engine)
            size = batch or settings_per_batch(system, used_engine)
            if system.matrix:
                print_note(f"measuring the time of a few vehicles at {len(system.matrix)} points")
            cost = forecast(loaded_study, len(keys), pool, size, used_engine)
            print_forecast(Console(), loaded_study, len(keys), cost, f"{used_engine}: {reason}")
            return
        try:
            with open_observer(not quiet, loaded_study, keys, print_warning) as observer:
                campaign = carry_out_runs(
                    loaded_study, system, keys, directory, pool, observer, batch, engine, retry_failed=retry_failed
                )
        except KeyboardInterrupt:
            click.echo(
                f"finished evaluations are kept in {directory}: run the same command again to continue", err=True
            )
            raise
        if not quiet:
            print_summary(Console(), loaded_study, campaign, directory)
    if not quiet:
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
@click.option("--watch", is_flag=True, help="Keep showing progress until the study is finished.")
@click.option(
    "--every", type=click.FloatRange(0.1, 86400), metavar="SECONDS", help="Interval of --watch.  [default: 2]"
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON; with --watch, a line at every interval.")
def status(directory: str, watch: bool, every: float | None, as_json: bool) -> None:
    """Show the progress of the study in DIR, without disturbing it: runs, front, collisions, time left."""
    from safevar_sumo.results import status as read_status

    progress, start_time, console = read_status(directory), time.monotonic(), Console()
    start_share, rate = progress.share, None
    with Live(console=console, auto_refresh=False) if watch and not as_json else nullcontext() as live:
        while True:
            if as_json:
                click.echo(json.dumps(progress.record(), indent=None if watch else 2))
            elif live is not None:
                live.update(status_view(progress, rate), refresh=True)
            else:
                console.print(status_view(progress, rate))
            if not watch or progress.finished:
                break
            time.sleep(every or 2.0)
            progress = read_status(directory)
            rate = (progress.share - start_share) / (time.monotonic() - start_time)
    if live is not None and not console.is_terminal:
        console.line()  # on a terminal, `Live` ends its last line itself


SAFETY_NOTE = (
    "SD: least distance in m, or minus the collision's speed in m/s.\nTET, TIT: over solutions without collision."
)


def print_forecast(console: Console, study: Study, runs: int, cost: Forecast, engine: str) -> None:
    """Print the estimated time and disk space of a campaign."""
    print_text(console, study.title)
    table = WholeTable(show_header=False)
    table.add_row("algorithms", ", ".join(study.search.labels))
    table.add_row("runs", str(runs))
    table.add_row("engine", engine)
    table.add_row("evaluations, at most", str(cost.evaluations))
    table.add_row("evaluations/s, measured by a short probe", f"{cost.rate:.{0 if cost.rate >= 10 else 1}f}")
    table.add_row(
        "search time, at most", f"{cost.seconds / 60:.1f} min" if cost.seconds >= 60 else f"{cost.seconds:.0f} s"
    )
    table.add_row("disk, at most", filesize.decimal(cost.size))
    console.print(table)


def print_summary(console: Console, study: Study, campaign: Campaign, directory: Path) -> None:
    """Print the verdict, a table of the original and of each algorithm's solutions, RQ1 and RQ2 in brief, and the next
    two commands.
    """
    from safevar_sumo.analysis.case import build_case
    from safevar_sumo.analysis.explain.answer import study_verdict

    # Loads more slowly than all other modules.
    from safevar_sumo.analysis.research_questions.comparisons import summary_lines

    names = study.vehicle.characteristics
    solutions = solutions_frame(names, campaign.solutions.items())
    case = build_case(
        study,
        record(campaign.original, row=0),
        solutions,
        solutions_frame(names, []),
        tuple(campaign.solutions),
        scoring=campaign.scoring,
    )
    for line in [campaign.no_verdict] if campaign.no_verdict else study_verdict(case, campaign.original):
        print_text(console, line)
    console.print(_summary_table(study, campaign, solutions))
    lines = SAFETY_NOTE.splitlines()
    if campaign.failures:
        lines.append(
            f"{len(campaign.failures)} settings could not be simulated (simulator-error); no result contains them:"
        )
        lines += [f"  {line}" for line in failure_lines(campaign.failures)]
    if invalid := sum(campaign.invalid_tests.values()):
        lines.append(
            f"{invalid} settings violate a test's speed tolerance before the ADS acts (invalid-test): "
            "they are neither failures nor successes, and no result contains them."
        )
    commands = (question_command(name, str(directory)) for name in ("explain", "tolerance"))
    for line in (*lines, *summary_lines(case), f"Next: {', '.join(commands)}"):
        print_text(console, line)


def _summary_table(study: Study, campaign: Campaign, solutions: pd.DataFrame) -> WholeTable:
    """The original vehicle, and each algorithm's solutions: their number, collisions, and means of metrics."""
    original = evaluations_frame(study.vehicle.characteristics, [(("", 0), campaign.original)])
    searched = {key.algorithm for key in campaign.solutions}
    by_algorithm = {name: solutions[solutions["algorithm"] == name] for name in study.search.labels if name in searched}
    frames = {"original vehicle": original, **by_algorithm}
    simulated = Counter({"original vehicle": int(campaign.original.collided[0])})
    for key, count in campaign.collisions.items():
        simulated[key.algorithm] += count
    table = WholeTable("", right=frames, title=study.title)
    table.add_row("solutions", "-", *(str(len(frame)) for frame in by_algorithm.values()))
    table.add_row(
        "solutions that collide", *(str((frame["outcome"] == Outcome.COLLISION).sum()) for frame in frames.values())
    )
    table.add_row("collisions simulated", *(str(simulated[name]) for name in frames))
    for metric in campaign.scoring.metrics:
        table.add_row(f"mean {metric.heading}", *(two_decimals(frame[metric.name].mean()) for frame in frames.values()))
    return table


MAX_FRONT_ROWS = 5
"""Maximum number of rows in the table of the front."""
MAX_RUNS_NAMED = 12
"""Maximum number of runs under way that the view names."""


def status_view(progress: Status, rate: float | None) -> Group:
    """The study's runs by algorithm, and its front so far; `rate` is the share of all work that is done in a second,
    None if unknown.
    """
    table = WholeTable(
        "algorithm",
        right=("runs", "under\nway", "simulated", "collisions", "simulator\nerrors", "best\nSD"),
        title=progress.title,
    )
    for algorithm in dict.fromkeys(run.algorithm for run in progress.runs):
        runs = [run for run in progress.runs if run.algorithm == algorithm]
        states = Counter(run.state for run in runs)
        counts = np.sum([(run.simulated, run.collisions, run.simulator_errors) for run in runs], axis=0)
        best = min((run.best for run in runs if run.best is not None), default=None)
        table.add_row(
            algorithm, f"{states['finished']}/{len(runs)}", str(states["begun"]), *map(str, counts), two_decimals(best)
        )
    begun = [
        f"{run.algorithm}:{run.run} {run.simulated}/{progress.budget}" for run in progress.runs if run.state == "begun"
    ]
    further_runs = f" and {len(begun) - MAX_RUNS_NAMED} more" if len(begun) > MAX_RUNS_NAMED else ""
    under_way = f"Under way: {', '.join(begun[:MAX_RUNS_NAMED])}{further_runs}" if begun else ""
    time_left = f", {timedelta(seconds=round((1 - progress.share) / rate))} left at this pace" if rate else ""
    state = "Finished." if progress.finished else f"{progress.share:.0%} done{time_left}."
    if not len(progress.points):
        return Group(table, Text(under_way), Text(state), Text("Nothing simulated yet."))
    front = nondominated_points(progress.points)
    front_table = WholeTable(
        right=("safety degree [m, -m/s]", "f_diff [fraction]", "changed"),
        title=f"Front of safety degree and changes so far: {len(front)} points, the most severe ones",
    )
    by_safety_degree = front[:, 0].argsort(kind="stable")
    for f_safe, f_diff, number in front[by_safety_degree][:MAX_FRONT_ROWS].tolist():
        front_table.add_row(f"{f_safe:.2f}", f"{f_diff:.3f}", f"{number:.0f}")
    return Group(table, Text(under_way), Text(state), front_table)
