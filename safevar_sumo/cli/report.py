"""Commands that answer from results: tables, figures, report."""

from __future__ import annotations

import warnings
from pathlib import Path

import click

from safevar_sumo.analysis.research_questions.answer import QUESTIONS, answer_questions
from safevar_sumo.analysis.research_questions.case import load_cases
from safevar_sumo.analysis.research_questions.figures import FORMATS as PICTURE_FORMATS, save_figures
from safevar_sumo.analysis.research_questions.tables import ENDINGS, FORMATS
from safevar_sumo.cli.arguments import (
    as_it_is_now,
    as_it_is_now_option,
    check_output,
    directories_argument,
    file_option,
    jobs_option,
    point_option,
    split_names,
)
from safevar_sumo.cli.program import commands, print_note, print_warning
from safevar_sumo.results import make_directory, write_whole

FORMATS_WITHOUT_NOTES = ("csv", "json")
"""Formats of tables without notes; notes go to standard error."""


@commands.command()
@directories_argument
@click.option("--rq", "question", type=click.Choice(QUESTIONS), help="Answer only this question.")
@click.option(
    "--format",
    "format_name",
    type=click.Choice(list(FORMATS)),
    default="text",
    show_default=True,
    help="Format of the tables.",
)
@file_option("--out", "Write each table to a file in this directory.", metavar="DIR")
def tables(directories: tuple[str, ...], question: str | None, format_name: str, out: Path | None) -> None:
    """Answer the research questions as tables, from the results directories DIR..., one for each case."""
    write = FORMATS[format_name]
    answers = answer_questions(load_cases(directories), question)
    if format_name in FORMATS_WITHOUT_NOTES:
        _print_notes(list(dict.fromkeys(note for answer in answers for note in answer.notes)))
    if out is not None:
        make_directory(out)
        for answer in answers:
            if not answer.frame.empty:
                write_whole(out / f"{answer.name}.{ENDINGS[format_name]}", write([answer]))
        click.echo(f"Tables: {out}")
        return
    if question is not None and format_name in FORMATS_WITHOUT_NOTES:
        answers = [answer for answer in answers if answer.name == question]
    click.echo(write(answers), nl=False)


@commands.command()
@directories_argument
@file_option("--out", "Directory for the pictures.", metavar="DIR", required=True)
@click.option(
    "--format",
    "format_name",
    type=click.Choice(PICTURE_FORMATS),
    default="png",
    show_default=True,
    help="Format of the pictures.",
)
def figures(directories: tuple[str, ...], out: Path, format_name: str) -> None:
    """Draw the figures of the results directories DIR..., one file for each figure and case."""
    cases = load_cases(directories)
    make_directory(out)
    paths, notes = save_figures(cases, out, format_name)
    _print_notes([*(remark for case in cases for remark in case.remarks), *notes])
    for path in paths:
        click.echo(str(path))


def _print_notes(notes: list[str]) -> None:
    for note in notes:
        print_note(note)


@commands.command()
@directories_argument
@file_option("--out", "File to write the page to.", metavar="FILE.html", default=Path("report.html"), show_default=True)
@click.option(
    "--only", metavar="SECTION,...", help="Only these sections, separated by commas: tested, verdict, causes, ..."
)
@click.option("--paper", is_flag=True, help="With the research questions of the paper, as tables and figures.")
@point_option
@as_it_is_now_option
@jobs_option
def report(
    directories: tuple[str, ...], out: Path, only: str | None, paper: bool, point: str | None, jobs: int | None
) -> None:
    """Write one self-contained page about the results directories DIR...: first what to hand over, then the details."""
    from safevar_sumo.report import report as make_report

    check_output(out, "--out", (".html", ".htm"))
    sections = split_names(only) if only is not None else ()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        page = make_report(
            *directories,
            out=out,
            only=sections,
            paper=paper,
            point=point,
            jobs=jobs,
            progress=True,
            as_it_is_now=as_it_is_now(),
        )
    for warning in caught:
        print_warning(warning.message)
    click.echo(f"Report: {out} ({len(page.encode()) / 1e6:.2f} MB)")
