"""The command that looks at a study while it runs."""

from __future__ import annotations

import json
import time

import click
from rich.console import Console
from rich.live import Live

from safevar_sumo.cli.options import Within
from safevar_sumo.cli.program import commands


@commands.command()
@click.argument("directory", metavar="DIR")
@click.option("--watch", is_flag=True, help="Look again and again until the study is finished.")
@click.option("--every", type=Within(0.1, 86400), default=2.0, show_default=True, metavar="SECONDS",
              help="How long --watch waits between two looks.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON; with --watch, a line for every look.")
def status(directory: str, watch: bool, every: float, as_json: bool) -> None:
    """Tell how far the study in DIR is, without disturbing it: runs, front so far, collisions, time left."""
    from safevar_sumo.cli.display.campaign import status_view
    from safevar_sumo.results.status import status as look

    told, begun = look(directory), time.monotonic()
    first = told
    if as_json:
        click.echo(json.dumps(told.record(), indent=None if watch else 2))
        while watch and not told.finished:
            time.sleep(every)
            told = look(directory)
            click.echo(json.dumps(told.record()))
        return
    if not watch:
        Console().print(status_view(told, None))
        return
    with Live(status_view(told, None), console=Console(), auto_refresh=False) as live:
        while not told.finished:
            time.sleep(every)
            told = look(directory)
            live.update(status_view(told, (told.share - first.share) / (time.monotonic() - begun)), refresh=True)
