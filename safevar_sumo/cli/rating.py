"""The command `rating`: Euro NCAP points of a vehicle and of a variant, as tables, JSON, a picture and the official
spreadsheet.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from safevar_sumo.analysis.rating import RatingOptions
from safevar_sumo.cli.arguments import PICTURE_ENDINGS, check_output, read_changes
from safevar_sumo.cli.program import commands
from safevar_sumo.cli.target import add_flags, as_it_is_now_option, jobs_option, json_option, load_results_or_study
from safevar_sumo.errors import InputError
from safevar_sumo.progress import open_progress
from safevar_sumo.study import Study
from safevar_sumo.vehicles import CharacteristicSet

SPREADSHEET_ENDINGS = (".xlsx",)
FILE = click.Path(path_type=Path)


@commands.command(name="rating")
@click.argument("source", metavar="STUDY|DIR")
@add_flags(RatingOptions)
@click.option(
    "--matrix", is_flag=True, help="Print every matrix: speed by impact location, with the colours of the cells."
)
@click.option("--plot", type=FILE, metavar="FILE", help="Draw the matrices to this file: png, pdf or svg.")
@click.option(
    "--xlsx",
    type=FILE,
    metavar="FILE",
    help="Write the official spreadsheet with the predictions of the variant, if any, else "
    "of the original, to this file; needs --template or --preprocessed.",
)
@click.option(
    "--template",
    type=FILE,
    metavar="FILE",
    help="Output of the official calculator's generate-template: ca_template.xlsx.",
)
@click.option(
    "--preprocessed",
    type=FILE,
    metavar="FILE",
    help="Output of the calculator's preprocess: its verification sheets are "
    "filled with simulated results, in --xlsx, or with --force in this file.",
)
@click.option("--force", is_flag=True, help="Overwrite existing files.")
@as_it_is_now_option
@jobs_option
@json_option
def rating(
    source: str,
    changes: tuple[str, ...],
    solution: str | None,
    matrix: bool,
    plot: Path | None,
    xlsx: Path | None,
    template: Path | None,
    preprocessed: Path | None,
    force: bool,
    jobs: int | None,
    as_json: bool,
) -> None:
    """Rate the vehicle of STUDY as Euro NCAP does in 2026, and one variant: points, colours, robustness layers."""
    from safevar_sumo.analysis.figures import save
    from safevar_sumo.analysis.rating.compute import rate_variant, remarks
    from safevar_sumo.analysis.rating.render import matrices_figure, print_matrices, print_rating

    subject = load_results_or_study(source)
    study = subject if isinstance(subject, Study) else subject.study
    options = RatingOptions(changes=_read_single_changes(study, changes), solution=solution)
    if force and xlsx is None and preprocessed is None and plot is None:
        raise InputError("--force", "there is no file to overwrite", "together with --xlsx, --preprocessed or --plot")
    if plot is not None:
        check_output(plot, "--plot", PICTURE_ENDINGS)
        _refuse_existing(plot, "--plot", force)
    spreadsheet = _open_spreadsheet(xlsx, template, preprocessed, force)
    with open_progress(True) as progress:
        result = rate_variant(subject, options, jobs=jobs, progress=progress)
    for remark in remarks(result):
        click.echo(f"note: {remark}", err=True)
    if as_json:
        click.echo(json.dumps(result.to_dict(), indent=2, allow_nan=False))
    else:
        print_rating(Console(), result)
    if matrix and not as_json:
        print_matrices(Console(), result)
    if plot is not None:
        save(matrices_figure(result), plot, "--plot")
    if spreadsheet is not None:
        vehicle = result.variant or result.original
        spreadsheet.fill(vehicle)
        click.echo(f"Spreadsheet of {vehicle.name}: {spreadsheet.output}", err=True)


def _read_single_changes(study: Study, changes: tuple[str, ...]) -> dict[str, float]:
    """Parse --set into the value of each changed characteristic."""
    values = read_changes(changes, CharacteristicSet.of(study.vehicle.characteristics), beyond=False, single=True)
    return {name: value for name, (value,) in values.items()}


def _refuse_existing(path: Path, flag: str, force: bool) -> None:
    if path.exists() and not force:
        raise InputError(flag, f"{path} exists", "another file, or --force")


def _open_spreadsheet(xlsx: Path | None, template: Path | None, preprocessed: Path | None, force: bool) -> Any:
    """The spreadsheet to fill, read and checked before any simulation; None without --xlsx and --preprocessed."""
    if template is not None and preprocessed is not None:
        raise InputError(
            "--template",
            "--preprocessed is given too",
            "one of them: --preprocessed already holds the template's sheets",
        )
    source_file = template if template is not None else preprocessed
    if source_file is None:
        if xlsx is not None:
            raise InputError(
                "--xlsx",
                f"{xlsx} needs the official template; to make it, run `python -m venv calculator`, "
                "`calculator/bin/pip install euroncap-rating-2026` and "
                "`calculator/bin/euroncap_rating_2026 crash_avoidance generate-template`",
                "--template FILE, or --preprocessed FILE",
            )
        return None
    if template is not None and xlsx is None:
        raise InputError("--template", "there is no --xlsx to write to", "--xlsx FILE")
    output = xlsx if xlsx is not None else source_file
    flag = "--xlsx" if xlsx is not None else "--preprocessed"
    _refuse_existing(output, flag, force)
    check_output(output, flag, SPREADSHEET_ENDINGS)
    try:
        from safevar_sumo.analysis.rating.workbook import PreprocessedFile, Template
    except ModuleNotFoundError:
        raise InputError(flag, "openpyxl is not installed", "in the checkout: pip install '.[rating]'") from None
    return (PreprocessedFile if template is None else Template)(source_file, output)
