"""The command that holds whole studies against published ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from safevar_sumo.analysis.research_questions.case import Case, load_cases
from safevar_sumo.cli.options import refuse_inputs
from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError
from safevar_sumo.reference.replication import Nearness, nearness, paired, replication
from safevar_sumo.reference.rows import ReferenceData, read_reference
from safevar_sumo.results import write_whole
from safevar_sumo.study import check_writable

SEVERAL = ("--published", "--reference")
"""Options that take all words up to the next option."""


class _TakesSeveral(click.Command):
    """`--published A B` as `--published A --published B`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        told: list[str] = []
        flag = None
        for word in args:
            if word.startswith("-"):
                flag = word if word in SEVERAL else None
                told += [] if flag else [word]
            else:
                told += [flag, word] if flag else [word]
        return super().parse_args(ctx, told)


@commands.command(cls=_TakesSeveral)
@click.argument("directories", nargs=-1, required=True, metavar="DIR...")
@click.option("--published", "published", multiple=True, required=True, metavar="DIR...", help="Imported results (command import).")
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE.md", help="Write the page to this file.")
@click.option("--reference", "references", multiple=True, metavar="[STUDY=]FILE.csv...",
              help="Published rows to look for next to what the searches found; of which study, where several have one vehicle.")
def replicate(directories: tuple[str, ...], published: tuple[str, ...], out: Path | None, references: tuple[str, ...]) -> None:
    """Hold the results DIR... against published ones: every table cell beside cell, every conclusion marked."""
    if out is not None:
        refuse_inputs(out, "--out", *directories, *published, *references)
        check_writable(out)
    pairs = paired(load_cases(directories), load_cases(published))
    page = replication(pairs, _near(pairs.here, references))
    if out is None:
        click.echo(page, nl=False)
    else:
        write_whole(out, page)
        click.echo(f"Replication: {out}")


def _near(cases: Sequence[Case], references: Sequence[str]) -> list[Nearness]:
    """Rows next to the solutions of the case that each file belongs to."""
    rows: dict[str, list[ReferenceData]] = {}
    for given in references:
        name, _, place = given.rpartition("=")
        fitting = [case for case in cases if name in ("", case.study.name)]
        read = _read(Path(place), fitting) if fitting else {}
        if len(read) != 1:
            said = "may belong to each of" if read else "belongs to none of"
            raise InputError("--reference", f"{given} {said} {', '.join(read or (case.study.name for case in cases))}", "STUDY=FILE.csv")
        for case, data in read.items():
            rows.setdefault(case, []).append(data)
    return [one for case in cases if case.name in rows for one in nearness(case, rows[case.name])]


def _read(path: Path, cases: Sequence[Case]) -> dict[str, ReferenceData]:
    """The file's rows for every case whose vehicle it is of."""
    found: dict[str, ReferenceData] = {}
    for case in cases:
        try:
            found[case.name] = read_reference(path, case.characteristics)
        except InputError as error:
            if len(cases) == 1 or not ("lacks the columns" in error.problem or "in the domains" in error.problem):
                raise
    return found
