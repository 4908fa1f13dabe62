"""The command that writes a report."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console

from safevar_sumo.cli.outputs import check_output
from safevar_sumo.cli.program import commands
from safevar_sumo.results import write_whole


@commands.command()
@click.argument("directories", nargs=-1, required=True, metavar="DIR...")
@click.option("--out", type=click.Path(path_type=Path), default=Path("report.html"), show_default=True, metavar="FILE.html",
              help="The page.")
@click.option("--only", metavar="SECTION,...", help="These sections alone, separated by commas: tested, verdict, causes, ...")
def report(directories: tuple[str, ...], out: Path, only: str | None) -> None:
    """Write one self-contained page about the results directories DIR...: verdict, causes, replays, tables, figures."""
    from safevar_sumo.report import make_report

    check_output(out, "--out", (".html", ".htm"))
    console = Console(stderr=True)

    def progress(what: str, done: int, total: int) -> None:
        console.print(f"report: {what} ({done}/{total})", markup=False, highlight=False, soft_wrap=True)

    page = make_report(directories, [name.strip() for name in only.split(",")] if only is not None else [], progress)
    write_whole(out, page)
    click.echo(f"Report: {out} ({len(page.encode()) / 1e6:.2f} MB)")
