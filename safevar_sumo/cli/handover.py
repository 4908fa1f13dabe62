"""Commands that hand results on: a `report` of them, `export` to other simulators, `evidence`
to a reader, who runs `verify`.
"""

from __future__ import annotations

import warnings
from hashlib import file_digest
from pathlib import Path

import click
from rich.console import Console

from safevar_sumo.cli.arguments import (
    as_it_is_now,
    as_it_is_now_option,
    check_output,
    directories_argument,
    file_option,
    jobs_option,
    json_option,
    point_option,
    split_names,
)
from safevar_sumo.cli.program import commands, print_json, print_warning
from safevar_sumo.terminal import WholeTable, open_progress, print_text


@commands.command()
@directories_argument
@file_option("--out", "File to write the page to.", metavar="FILE.html", default=Path("report.html"), show_default=True)
@click.option(
    "--only", metavar="SECTION,...", help="Only these sections, separated by commas: tested, verdict, causes, ..."
)
@click.option("--paper", is_flag=True, help="With the research questions of the paper, as tables and figures.")
@point_option
@click.option(
    "--margin",
    type=click.FloatRange(0, 100),
    metavar="M",
    help="Distance to keep from a collision [m].  [default: the model's error that the study states, else 0.3]",
)
@as_it_is_now_option
@jobs_option
def report(
    directories: tuple[str, ...],
    out: Path,
    only: str | None,
    paper: bool,
    point: str | None,
    margin: float | None,
    jobs: int | None,
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
            margin=margin,
            jobs=jobs,
            progress=True,
            as_it_is_now=as_it_is_now(),
        )
    for warning in caught:
        print_warning(warning.message)
    click.echo(f"Report: {out} ({len(page.encode()) / 1e6:.2f} MB)")


@commands.command()
@directories_argument
@click.option("--out", required=True, type=click.Path(path_type=Path), metavar="PACK.zip", help="The pack to write.")
@click.option("--explain", "questions", flag_value="explain", multiple=True, help="With the causes of failures.")
@click.option("--tolerance", "questions", flag_value="tolerance", multiple=True, help="With the tolerances.")
@click.option("--risk", "questions", flag_value="risk", multiple=True, help="With the share of unsafe vehicles.")
@click.option("--rating", "questions", flag_value="rating", multiple=True, help="With the rating, of a rated study.")
@click.option(
    "--repair", "questions", flag_value="repair", multiple=True, help="With repairs, by [repair] of the study."
)
@jobs_option
def evidence(directories: tuple[str, ...], out: Path, questions: tuple[str, ...], jobs: int | None) -> None:
    """Pack results DIR... with their study, page and answers, so that anybody can compute every number again."""
    from safevar_sumo.report.evidence import make_pack
    from safevar_sumo.report.pack import write_pack

    check_output(out, "--out", (".zip",))
    with open_progress(True) as progress:
        studies, files = make_pack(directories, questions, jobs, progress)
    write_pack(out, studies, files)
    click.echo(f"Evidence: {out} ({out.stat().st_size / 1e6:.2f} MB, sha256 {file_digest_of(out)})")


@commands.command()
@click.argument("pack", type=click.Path(path_type=Path), metavar="PACK.zip")
@click.option("--search", is_flag=True, help="Repeat the whole search, too.")
@click.option("--run-code", is_flag=True, help="Let user code of the pack run.")
@jobs_option
@json_option
def verify(pack: Path, search: bool, run_code: bool, jobs: int | None, as_json: bool) -> None:
    """Compute what a pack of evidence claims again and compare: exit code 0 if all is the same, else 1."""
    from safevar_sumo.report import evidence

    with open_progress(True) as progress:
        claims = evidence.verify(pack, search=search, run_code=run_code, jobs=jobs, progress=progress)
    verdicts = {"same": evidence.SAME, "differs": evidence.DIFFERS, "cannot": evidence.CANNOT}
    counts = {key: sum(claim.verdict == verdict for claim in claims) for key, verdict in verdicts.items()}
    if as_json:
        described = {"pack": str(pack), "sha256": file_digest_of(pack), "claims": len(claims), **counts}
        print_json({**described, "table": [claim._asdict() for claim in claims]})
    else:
        table = WholeTable("study", "claim", "verdict", "in the pack", "here")
        for claim in claims:
            table.add_row(*claim)
        console = Console()
        console.print(table)
        numbers = ", ".join(f"{counts[key]} {verdict}" for key, verdict in verdicts.items())
        print_text(console, f"{len(claims)} claims: {numbers}.")
    if counts["same"] < len(claims):
        click.get_current_context().exit(1)


def file_digest_of(path: Path) -> str:
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()
