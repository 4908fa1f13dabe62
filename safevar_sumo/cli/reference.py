"""Commands for published data: import it, and compare a study with it."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console

from safevar_sumo.cli.arguments import check_output, complete_study, file_option, jobs_option, json_option
from safevar_sumo.cli.program import commands, print_json, print_remarks
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.reference import agreement
from safevar_sumo.reference.rows import RANGES, import_published
from safevar_sumo.study import load_study
from safevar_sumo.terminal import WholeTable, open_progress, print_text

METRIC_NAMES = {word: metric.name for metric in METRICS.values() for word in (metric.name, metric.title.lower())}
"""Names of metrics by each name that `--original` accepts."""
ORIGINAL_FORM = "sd=NUMBER,tet=NUMBER,tit=NUMBER,ave_dece=NUMBER"


@commands.command()
@click.argument("study", shell_complete=complete_study)
@click.argument("reference", type=click.Path(path_type=Path), metavar="REFERENCE.csv")
@jobs_option
@file_option("--plot", "Plot simulated against reference values.", metavar="FILE.png")
@json_option
def validate(study: str, reference: Path, jobs: int | None, plot: Path | None, as_json: bool) -> None:
    """Compare STUDY with settings and metrics in the published package's CSV format."""
    loaded_study = load_study(study)
    print_remarks(loaded_study)
    check_output(plot, "--plot")
    with open_progress(True) as progress:
        result = agreement.validate(loaded_study, reference, jobs=jobs, progress=progress)
    if plot is not None:
        result.plot(plot, f"{loaded_study.title}\nagainst {reference.name}")
    if as_json:
        print_json(result.to_dict())
        return
    console = Console()
    print_text(console, result.verdict)
    table = WholeTable("metric", right=agreement.HEADINGS.values(), title=loaded_study.title)
    for name, *values in result.table.itertuples():
        table.add_row(METRICS[name].heading, *(f"{value:.3f}".replace("nan", "-") for value in values))
    console.print(table)
    print_text(console, ", ".join(f"{name} {number}" for name, number in result.numbers.items()))


@commands.command(name="import")
@click.argument("study", shell_complete=complete_study)
@file_option("--out", "Directory for the results.", metavar="DIR", required=True)
@file_option("--nsga2", "Solutions of NSGA-II.", metavar="FILE.csv")
@file_option("--rs", "Solutions of random search.", metavar="FILE.csv")
@file_option("--safe-fuzzer", "Solutions of SafeFuzzer.", metavar="FILE.csv")
@click.option(
    "--original",
    metavar="sd=2.7,tet=1.2,tit=0.44,ave_dece=5.97",
    help="The original vehicle's metrics.  [default: those published for STUDY]",
)
def import_command(study: str, out: Path, original: str | None, **files: Path | None) -> None:
    """Import published CSV solutions of STUDY as a results directory, in place of an earlier import."""
    metrics = None if original is None else read_metrics(original)
    solutions = import_published(study, out, original=metrics, **files).solutions
    counts = ", ".join(f"{count} of {name}" for name, count in solutions["algorithm"].value_counts().items())
    click.echo(f"Results: {out}, solutions: {counts}")


def read_metrics(text: str) -> dict[str, float]:
    """The metrics in `text` (sd=2.7,tet=1.2,...), by name.

    Raises
    ------
    InputError
        If `text` has another form.
    """
    metrics: dict[str, float] = {}
    try:
        for assignment in text.split(","):
            word, _, number = assignment.partition("=")
            name = METRIC_NAMES[word.strip()]
            lowest, highest = RANGES[name]
            if name in metrics or not lowest <= float(number) <= highest:
                raise ValueError
            metrics[name] = float(number)
    except (KeyError, ValueError):
        raise InputError(
            "--original", f"{assignment!r} in {text!r}", f"{ORIGINAL_FORM}: each metric once, in its range"
        ) from None
    return metrics
