"""The command that finds rules."""

from __future__ import annotations

import json

import click
from rich.console import Console

from safevar_sumo.cli.program import commands
from safevar_sumo.cli.simulating import jobs_option, json_option, point_option, study_of, unsafe_option


@commands.command()
@click.argument("place", metavar="STUDY|DIR")
@click.option("--samples", type=click.IntRange(2, 10_000_000), default=16_384, show_default=True, metavar="N",
              help="Settings over the whole domain: half of them make the rules, the other half judges them.")
@unsafe_option
@point_option
@jobs_option
@json_option
def rules(place: str, samples: int, unsafe: str | None, point: str | None, jobs: int | None, as_json: bool) -> None:
    """Find rules that tell where STUDY is unsafe, in physical units, from settings spread evenly and never from what a search found."""
    from safevar_sumo import answers
    from safevar_sumo.terminal.rules import print_rules
    from safevar_sumo.terminal.stages import stages

    with stages(Console(stderr=True)) as progress:
        told = answers.rules(study_of(place, point), samples=samples, unsafe=unsafe, jobs=jobs, progress=progress)
    if as_json:
        if told.remark:
            click.echo(f"note: {told.remark}", err=True)
        click.echo(json.dumps(told.records(), indent=2, allow_nan=False))
    else:
        print_rules(Console(), told)
