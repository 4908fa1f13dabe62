"""The command that finds rules."""

from __future__ import annotations

import json
from typing import Any

import click
from rich.console import Console

from safevar_sumo.cli.program import commands
from safevar_sumo.cli.simulating import jobs_option, json_option, now_option, options_of, point_option, study_of
from safevar_sumo.options import RulesOptions


@commands.command()
@click.argument("place", metavar="STUDY|DIR")
@options_of(RulesOptions)
@point_option
@now_option
@jobs_option
@json_option
def rules(place: str, point: str | None, jobs: int | None, as_json: bool, **given: Any) -> None:
    """Find rules that tell where STUDY is unsafe, in physical units, from settings spread evenly and never from what a search found."""
    from safevar_sumo import answers
    from safevar_sumo.terminal.rules import print_rules
    from safevar_sumo.terminal.stages import stages

    with stages(Console(stderr=True)) as progress:
        told = answers.rules(study_of(place, point), **RulesOptions(**given).keywords(), jobs=jobs, progress=progress)
    if as_json:
        if told.remark:
            click.echo(f"note: {told.remark}", err=True)
        click.echo(json.dumps(told.records(), indent=2, allow_nan=False))
    else:
        print_rules(Console(), told)
