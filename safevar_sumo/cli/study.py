"""The command that searches a study."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import msgspec
from rich.console import Console

from safevar_sumo.api.running import carried_out, open_pool, prepared
from safevar_sumo.campaign import BATCH, RunKey, all_runs, forecast
from safevar_sumo.cli.completion import complete_study
from safevar_sumo.cli.display.campaign import print_forecast, print_summary
from safevar_sumo.cli.program import commands, tell_remarks
from safevar_sumo.errors import InputError
from safevar_sumo.progress import CampaignProgress
from safevar_sumo.study import Study, load_study
from safevar_sumo.sumo.matrix import vehicle_remarks


@commands.command()
@click.argument("study", shell_complete=complete_study)
@click.option("--runs", type=click.IntRange(1, 100_000), help="Runs of each algorithm.")
@click.option("--evaluations", type=click.IntRange(1, 10_000_000), help="Simulations of each run.")
@click.option("--algorithms", help="Which algorithms, separated by commas.")
@click.option("--seed", type=click.IntRange(min=0, max=2**63 - 1), help="Seed of the whole study.")
@click.option("--batch", type=click.IntRange(1, 10_000),
              help=f"Settings per SUMO simulation at the most, of several runs; never changes a result.  [default: {BATCH}]")
@click.option("--out", type=click.Path(path_type=Path), help="Directory of the results.  [default: results/STUDY]")
@click.option("--jobs", type=click.IntRange(1, 1024), help="Worker processes.  [default: the cores of this machine]")
@click.option("--cluster", metavar="ADDRESS", help="Compute on the workers of this Dask scheduler instead.")
@click.option("--only", metavar="ALGORITHM:RUN", help="This run alone, the first run is 0.")
@click.option("--shard", metavar="K/N", help="Every N-th run, from the K-th (1..N): for job arrays that share --out.")
@click.option("--retry-failed", is_flag=True, help="Simulate again what could not be simulated before (simulator-error).")
@click.option("--quiet", is_flag=True, help="Print errors and warnings alone.")
@click.option("--dry-run", is_flag=True, help="Tell what would run, how long and how much disk it would take.")
def study(study: str, batch: int | None, out: Path | None, jobs: int | None, cluster: str | None, only: str | None, shard: str | None,
          retry_failed: bool, quiet: bool, dry_run: bool, **options: Any) -> None:
    """Search STUDY; the same command again goes on where it was stopped."""
    chosen, system = prepared(_with_options(load_study(study), **options), study)
    tell_remarks(chosen, [*system.remarks, *vehicle_remarks(system)])
    keys = _selected(all_runs(chosen), only, shard)
    directory = out or Path("results") / chosen.name
    with open_pool(chosen, jobs, cluster) as pool:
        if dry_run:
            print_forecast(Console(), chosen, len(keys), forecast(chosen, len(keys), pool, batch))
            return
        try:
            with CampaignProgress(Console(stderr=True), chosen, keys, quiet) as progress:
                campaign = carried_out(chosen, system, keys, directory, pool, progress, batch, retry_failed=retry_failed)
        except KeyboardInterrupt:
            click.echo(f"what is computed is kept in {directory}: the same command goes on from there", err=True)
            raise
        if not quiet:
            print_summary(Console(), chosen, campaign, directory, pool)
    if not quiet:
        Console().print(f"Results: {directory}", soft_wrap=True, markup=False, highlight=False)


def _with_options(study: Study, algorithms: str | None, **numbers: int | None) -> Study:
    """The study with a command's options in place of its own search table."""
    changes: dict[str, Any] = {name: value for name, value in numbers.items() if value is not None}
    if algorithms is not None:
        names = [name.strip() for name in algorithms.split(",")]
        changes["algorithms"] = list(dict.fromkeys(study.search.labels.get(name, name) for name in names))
    return msgspec.structs.replace(study, search=msgspec.structs.replace(study.search, **changes))


def _selected(keys: list[RunKey], only: str | None, shard: str | None) -> list[RunKey]:
    """The runs that a command asks for."""
    if only is not None:
        algorithm, _, run = only.rpartition(":")
        keys = [key for key in keys if key.algorithm == algorithm and str(key.run) == run]
        if not keys:
            raise InputError("--only", repr(only), "ALGORITHM:RUN, an algorithm of the study and a run from 0 to less than --runs")
    if shard is not None:
        first, _, number = shard.partition("/")
        if not (first.isdecimal() and number.isdecimal() and len(number) < 10 and len(first) < 10 and 1 <= int(first) <= int(number)):
            raise InputError("--shard", repr(shard), "K/N, with K in 1..N")
        keys = keys[int(first) - 1::int(number)]
    return keys
