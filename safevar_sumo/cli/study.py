"""The command that searches a study."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import msgspec
from rich.console import Console

from safevar_sumo.campaign import RunKey, algorithm_of, all_runs, carry_out, forecast
from safevar_sumo.cli.program import commands
from safevar_sumo.computing import available_cores, cluster_pool, local_pool
from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.results import ResultsDirectory
from safevar_sumo.simulation import assemble, network_fingerprint
from safevar_sumo.study import Study, load_study
from safevar_sumo.terminal.campaign import print_forecast, print_summary
from safevar_sumo.terminal.progress import CampaignProgress


@commands.command()
@click.argument("study")
@click.option("--runs", type=click.IntRange(1, 100_000), help="Runs of each algorithm.")
@click.option("--evaluations", type=click.IntRange(1, 10_000_000), help="Simulations of each run.")
@click.option("--algorithms", help="Which algorithms, separated by commas.")
@click.option("--seed", type=click.IntRange(min=0, max=2**63 - 1), help="Seed of the whole study.")
@click.option("--batch", type=click.IntRange(1, 10_000),
              help="Settings per SUMO simulation; never changes a result.  [default: the population's size]")
@click.option("--out", type=click.Path(path_type=Path), help="Directory of the results.  [default: results/STUDY]")
@click.option("--jobs", type=click.IntRange(1, 1024), help="Worker processes.  [default: the cores of this machine]")
@click.option("--cluster", metavar="ADDRESS", help="Compute on the workers of this Dask scheduler instead.")
@click.option("--only", metavar="ALGORITHM:RUN", help="This run alone, the first run is 0.")
@click.option("--shard", metavar="K/N", help="Every N-th run, from the K-th (1..N): for job arrays that share --out.")
@click.option("--quiet", is_flag=True, help="Print errors and warnings alone.")
@click.option("--dry-run", is_flag=True, help="Tell what would run, how long and how much disk it would take.")
def study(study: str, batch: int | None, out: Path | None, jobs: int | None, cluster: str | None, only: str | None, shard: str | None,
          quiet: bool, dry_run: bool, **options: Any) -> None:
    """Search STUDY; the same command again goes on where it was stopped."""
    chosen = _with_options(load_study(study), **options)
    system = assemble(chosen, study)
    for name in chosen.search.algorithms:
        algorithm_of(name, chosen)
    keys = _selected(all_runs(chosen), only, shard)
    limit = chosen.search.time_limit
    with cluster_pool(cluster, limit) if cluster is not None else local_pool(jobs or available_cores(), limit) as pool:
        if dry_run:
            print_forecast(Console(), chosen, len(keys), forecast(chosen, len(keys), pool, batch))
            return
        results = ResultsDirectory(out or Path("results") / chosen.name, chosen, network_fingerprint(system.scenario.network))
        with CampaignProgress(Console(stderr=True), chosen, keys, quiet) as progress:
            campaign = carry_out(chosen, keys, results, pool, progress, batch)
    if campaign.busy:
        raise SafevarError(f"another process works on {', '.join(map(str, campaign.busy))}: the same command later finishes the study")
    if keys == all_runs(chosen):
        results.finish(campaign.solutions)
    if not quiet:
        print_summary(Console(), chosen, campaign, results.path)
        Console().print(f"Results: {results.path}", soft_wrap=True)


def _with_options(study: Study, algorithms: str | None, **numbers: int | None) -> Study:
    """The study with a command's options in place of its own search table."""
    changes: dict[str, Any] = {name: value for name, value in numbers.items() if value is not None}
    if algorithms is not None:
        changes["algorithms"] = list(dict.fromkeys(name.strip() for name in algorithms.split(",")))
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
