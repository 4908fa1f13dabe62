"""The command that finds how far characteristics may go."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from safevar_sumo.cli.outputs import PICTURES, check_output
from safevar_sumo.cli.program import commands
from safevar_sumo.cli.simulating import jobs_option, json_option, now_option, options_of, point_option, study_of
from safevar_sumo.options import ToleranceOptions


@commands.command()
@click.argument("place", metavar="STUDY|DIR")
@options_of(ToleranceOptions)
@point_option
@now_option
@jobs_option
@json_option
@click.option("--plot", type=click.Path(path_type=Path), metavar="FILE",
              help="Draw the profiles here: png, pdf or svg; with --pairs, the worst pairs in a second file beside it.")
def tolerance(place: str, point: str | None, jobs: int | None, as_json: bool, plot: Path | None, **given: Any) -> None:
    """Find how far each characteristic of STUDY may go: alone, in pairs, and all together."""
    from safevar_sumo import answers
    from safevar_sumo.terminal.stages import stages
    from safevar_sumo.terminal.tolerance import print_tolerance

    options, chosen = ToleranceOptions(**given), study_of(place, point)
    second = None if plot is None else plot.with_stem(f"{plot.stem}-pairs")
    for path in (plot, second if options.pairs else None):
        if path is not None:
            check_output(path, "--plot", PICTURES)
    with stages(Console(stderr=True)) as progress:
        told = answers.tolerance(chosen, **options.keywords(), jobs=jobs, progress=progress)
    if as_json:
        click.echo(json.dumps(told.record(), indent=2, allow_nan=False))
    else:
        print_tolerance(Console(), told)
    if plot is not None and second is not None:
        answers.save(answers.profiles_figure(told), plot, "--plot")
        if told.pairs:
            answers.save(answers.pairs_figure(told), second, "--plot")
