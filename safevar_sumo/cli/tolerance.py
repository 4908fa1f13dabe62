"""The command that finds how far characteristics may go."""

from __future__ import annotations

import json
from pathlib import Path

import click
from rich.console import Console

from safevar_sumo.cli.outputs import PICTURES, check_output
from safevar_sumo.cli.program import commands
from safevar_sumo.cli.simulating import jobs_option, json_option, point_option, study_of, unsafe_option


@commands.command()
@click.argument("place", metavar="STUDY|DIR")
@unsafe_option
@click.option("--characteristics", metavar="A,B", help="These characteristics alone, separated by commas.  [default: all]")
@click.option("--pairs", is_flag=True, help="Look at every pair too.")
@point_option
@jobs_option
@json_option
@click.option("--plot", type=click.Path(path_type=Path), metavar="FILE",
              help="Draw the profiles here: png, pdf or svg; with --pairs, the worst pairs in a second file beside it.")
def tolerance(place: str, unsafe: str | None, characteristics: str | None, pairs: bool, point: str | None,
              jobs: int | None, as_json: bool, plot: Path | None) -> None:
    """Find how far each characteristic of STUDY may go: alone, in pairs, and all together."""
    from safevar_sumo import answers
    from safevar_sumo.terminal.stages import stages
    from safevar_sumo.terminal.tolerance import print_tolerance

    chosen = study_of(place, point)
    second = None if plot is None else plot.with_stem(f"{plot.stem}-pairs")
    for path in (plot, second if pairs else None):
        if path is not None:
            check_output(path, "--plot", PICTURES)
    names = None if characteristics is None else [name.strip() for name in characteristics.split(",")]
    with stages(Console(stderr=True)) as progress:
        told = answers.tolerance(chosen, unsafe=unsafe, characteristics=names, pairs=pairs, jobs=jobs, progress=progress)
    if as_json:
        click.echo(json.dumps(told.record(), indent=2, allow_nan=False))
    else:
        print_tolerance(Console(), told)
    if plot is not None and second is not None:
        answers.save(answers.profiles_figure(told), plot, "--plot")
        if told.pairs:
            answers.save(answers.pairs_figure(told), second, "--plot")
