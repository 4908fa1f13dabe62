"""The command that explains failures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from safevar_sumo.cli.program import commands
from safevar_sumo.cli.simulating import jobs_option, json_option, now_option, options_of, point_option, results_or_study
from safevar_sumo.options import ExplainOptions
from safevar_sumo.results import make_directory, write_whole


@commands.command()
@click.argument("place", metavar="DIR|STUDY")
@options_of(ExplainOptions)
@click.option("--full", is_flag=True, help="Print every explanation in full, not the answer alone.")
@point_option
@now_option
@jobs_option
@json_option
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Write causes.json, causes.csv and a picture there.")
def explain(place: str, full: bool, point: str | None, jobs: int | None, as_json: bool, out: Path | None, **given: Any) -> None:
    """Explain failures of results in DIR, or all over the domain of STUDY: which changes did it, how little is enough, why."""
    from safevar_sumo import answers
    from safevar_sumo.terminal.explanation import print_explained
    from safevar_sumo.terminal.stages import stages

    source = results_or_study(place, point)
    if out is not None:
        make_directory(out)
    with stages(Console(stderr=True)) as progress:
        told = answers.explain(source, **ExplainOptions(**given).keywords(), jobs=jobs, progress=progress)
    records = json.dumps(told.records(), indent=2, allow_nan=False)
    if as_json:
        click.echo(records)
    else:
        print_explained(Console(), place, told, point or "", full=full)
    if out is not None:
        write_whole(out / "causes.json", records + "\n")
        write_whole(out / "causes.csv", told.frame().to_csv(index=False, lineterminator="\n"))
        answers.save(answers.necessity_figure(told), out / "necessity.png")
        click.echo(f"Causes: {out}", err=as_json)
