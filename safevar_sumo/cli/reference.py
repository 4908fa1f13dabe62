"""The command `import`, for published data."""

from __future__ import annotations

from pathlib import Path

import click

from safevar_sumo.cli.arguments import complete_study, file_option
from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.reference.rows import RANGES, import_published

METRIC_NAMES = {word: metric.name for metric in METRICS.values() for word in (metric.name, metric.title.lower())}
"""Names of metrics by each name that `--original` accepts."""
ORIGINAL_FORM = "sd=NUMBER,tet=NUMBER,tit=NUMBER,ave_dece=NUMBER"


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
