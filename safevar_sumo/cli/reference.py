"""Commands that hold a study against reference data."""

from __future__ import annotations

import json
from pathlib import Path

import click
import numpy as np
from rich.console import Console

from safevar_sumo import terminal
from safevar_sumo.analysis import agreement, plot_agreement, read_reference
from safevar_sumo.calibration import calibrate, calibration_comment
from safevar_sumo.cli.program import commands
from safevar_sumo.computing import available_cores, local_pool
from safevar_sumo.errors import InputError
from safevar_sumo.simulation import assemble
from safevar_sumo.study import check_writable, load_study, write_study
from safevar_sumo.validation import evaluate_all

PICTURES = (".png", ".pdf", ".svg")


@commands.command()
@click.argument("study")
@click.argument("reference", type=click.Path(path_type=Path), metavar="REFERENCE.csv")
@click.option("--jobs", type=click.IntRange(min=1), help="Worker processes.  [default: the cores of this machine]")
@click.option("--plot", type=click.Path(path_type=Path), metavar="FILE.png", help="Draw here against reference.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def validate(study: str, reference: Path, jobs: int | None, plot: Path | None, as_json: bool) -> None:
    """Compare STUDY with settings and metrics in the published package's CSV format."""
    chosen = load_study(study)
    system = assemble(chosen, study)
    if plot is not None and plot.suffix not in PICTURES:
        raise InputError("--plot", str(plot), f"a file that ends in {', '.join(PICTURES)}")
    data = read_reference(reference, system.characteristics)
    if data.skipped:
        click.echo(f"warning: {reference}: {data.skipped} rows with values outside the domains are left out", err=True)
    settings = np.concatenate([system.characteristics.original[np.newaxis], data.settings])
    with (local_pool(jobs or available_cores(), chosen.search.time_limit) as pool,
          terminal.counted(Console(stderr=True), "settings", len(np.unique(settings, axis=0))) as done):
        evaluations = evaluate_all(chosen, settings, pool, done)
    here = evaluations.take(np.arange(1, len(settings)))
    result = agreement(data, here, chosen.published, evaluations.take([0]))
    if plot is not None:
        plot_agreement(plot, f"{chosen.title}\nagainst {reference.name}", system.characteristics, data, here)
    if as_json:
        click.echo(json.dumps(result.to_dict(), indent=2, allow_nan=False))
    else:
        terminal.print_agreement(Console(), chosen, result)


@commands.command(name="calibrate")
@click.argument("study")
@click.argument("references", type=click.Path(path_type=Path), nargs=-1, metavar="[REFERENCE.csv]...")
@click.option("--trials", type=click.IntRange(min=1), default=400, show_default=True, help="How many sets of parameters are tried.")
@click.option("--seed", type=click.IntRange(min=0, max=2**63 - 1), default=1, show_default=True, help="Seed of the search.")
@click.option("--jobs", type=click.IntRange(min=1), help="Worker processes.  [default: the cores of this machine]")
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE.toml", help="Study file to write.  [default: STUDY-calibrated.toml]")
def calibrate_command(study: str, references: tuple[Path, ...], trials: int, seed: int, jobs: int | None, out: Path | None) -> None:
    """Fit what STUDY declares under [calibration] to the published values and to half of the rows of reference files."""
    chosen = load_study(study)
    system = assemble(chosen, study)
    target = out or Path(f"{chosen.name}-calibrated.toml")
    check_writable(target)
    if len({path.name for path in references}) < len(references):
        raise InputError("REFERENCE.csv", "two files have one name", "files of different names")
    data = {path.name: read_reference(path, system.characteristics) for path in references}
    with (local_pool(jobs or available_cores(), chosen.search.time_limit) as pool,
          terminal.trials(Console(stderr=True), trials) as done):
        found = calibrate(chosen, data, pool, trials, seed, done)
    write_study(target, found.study, calibration_comment(found, chosen, references, trials, seed))
    terminal.print_calibration(Console(), chosen, found)
    Console().print(f"Study file: {target}", soft_wrap=True)
