"""The command that writes a report."""

from __future__ import annotations

import warnings
from pathlib import Path

import click
from rich.console import Console

from safevar_sumo.cli.options import check_output
from safevar_sumo.cli.program import commands
from safevar_sumo.cli.target import as_it_is_now, jobs_option, now_option, point_option
from safevar_sumo.results import write_whole


@commands.command()
@click.argument("directories", nargs=-1, required=True, metavar="DIR...")
@click.option("--out", type=click.Path(path_type=Path), default=Path("report.html"), show_default=True, metavar="FILE.html",
              help="The page.")
@click.option("--only", metavar="SECTION,...", help="These sections alone, separated by commas: tested, verdict, causes, ...")
@point_option
@now_option
@jobs_option
def report(directories: tuple[str, ...], out: Path, only: str | None, point: str | None, jobs: int | None) -> None:
    """Write one self-contained page about the results directories DIR...: verdict, causes, replays, tables, figures."""
    from safevar_sumo.report import make_report
    from safevar_sumo.terminal import stages

    check_output(out, "--out", (".html", ".htm"))
    sections = [name.strip() for name in only.split(",")] if only is not None else []
    with stages(Console(stderr=True)) as progress, warnings.catch_warnings(record=True) as otherwise:
        warnings.simplefilter("always", UserWarning)
        page = make_report(directories, sections, jobs, progress, point=point or "", as_it_is_now=as_it_is_now())
    for one in otherwise:
        click.echo(f"warning: {one.message}", err=True)
    write_whole(out, page)
    click.echo(f"Report: {out} ({len(page.encode()) / 1e6:.2f} MB)")
