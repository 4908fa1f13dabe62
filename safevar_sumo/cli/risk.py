"""The command that estimates how likely an unsafe outcome is."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from safevar_sumo.cli.outputs import PICTURES, check_output
from safevar_sumo.cli.program import commands
from safevar_sumo.cli.simulating import jobs_option, json_option, now_option, options_of, point_option, study_of
from safevar_sumo.errors import InputError
from safevar_sumo.options import RiskOptions


@commands.command()
@click.argument("place", metavar="STUDY|DIR")
@options_of(RiskOptions)
@point_option
@now_option
@jobs_option
@json_option
@click.option("--plot", type=click.Path(path_type=Path), metavar="FILE", help="Draw what decides here: png, pdf or svg.")
def risk(place: str, point: str | None, jobs: int | None, as_json: bool, plot: Path | None, **given: Any) -> None:
    """Estimate how likely an unsafe outcome is when vehicles vary as STUDY says under [variation], and what decides."""
    from safevar_sumo import answers
    from safevar_sumo.terminal.risk import print_risk
    from safevar_sumo.terminal.stages import stages

    chosen = study_of(place, point)
    if plot is not None:
        check_output(plot, "--plot", PICTURES)
        if chosen.correlations:
            raise InputError("--plot", "sensitivity indices of correlated characteristics are not defined", "a study without correlations")
    with stages(Console(stderr=True)) as progress:
        told = answers.risk(chosen, **RiskOptions(**given).keywords(), jobs=jobs, progress=progress)
    if told.sensitivity is None:
        click.echo("note: characteristics are correlated, for which sensitivity indices are not defined: there are none", err=True)
    if told.errors:
        click.echo(f"warning: {told.errors} vehicles could not be simulated and are left out", err=True)
    if as_json:
        click.echo(json.dumps(told.record(), indent=2, allow_nan=False))
    else:
        print_risk(Console(), told)
    if plot is not None:
        answers.save(answers.sensitivity_figure(told), plot, "--plot")
