"""Commands that compare studies with published data: validate, import, replicate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import click
import numpy as np
from rich.console import Console

from safevar_sumo.analysis.case import load_cases
from safevar_sumo.api.simulation import evaluate_settings
from safevar_sumo.cli.arguments import (
    check_output,
    complete_study,
    directories_argument,
    file_option,
    jobs_option,
    json_option,
)
from safevar_sumo.cli.program import commands, print_json, print_note, print_remarks, print_warning
from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.metrics import METRICS
from safevar_sumo.reference import replication
from safevar_sumo.reference.agreement import Agreement, measure_agreement, plot_agreement, write_totals
from safevar_sumo.reference.effects import ABSOLUTE_TOLERANCE, RELATIVE_TOLERANCE, Effect, effects_of, measure_coverage
from safevar_sumo.reference.rows import ReferenceData, evaluations_of, original_metrics, read_reference
from safevar_sumo.results import MANIFEST, write_imported, write_whole
from safevar_sumo.study import Study, load_study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import WholeTable, open_progress
from safevar_sumo.vehicles import CharacteristicSet


@commands.command()
@click.argument("study", shell_complete=complete_study)
@click.argument("reference", type=click.Path(path_type=Path), metavar="REFERENCE.csv")
@jobs_option
@file_option("--plot", "Plot simulated against reference values.", metavar="FILE.png")
@json_option
@file_option(
    "--totals",
    "Also save rank correlations, errors and counts of collisions to this file, without any row.",
    metavar="FILE.toml",
)
@click.option(
    "--effects",
    "with_effects",
    is_flag=True,
    help="Compare the characteristics' linear effects here and in the reference.",
)
@click.option(
    "--spread",
    "with_spread",
    is_flag=True,
    help="Count the published values within the spread of the model and of repeats.",
)
def validate(
    study: str,
    reference: Path,
    jobs: int | None,
    plot: Path | None,
    as_json: bool,
    totals: Path | None,
    with_effects: bool,
    with_spread: bool,
) -> None:
    """Compare STUDY with settings and metrics in the published package's CSV format."""
    loaded_study = load_study(study)
    print_remarks(loaded_study)
    characteristics = assemble(loaded_study, study).characteristics
    check_output(plot, "--plot")
    check_output(totals, "--totals", (".toml",))
    data = read_rows(reference, characteristics)
    settings = np.concatenate([characteristics.original[np.newaxis], data.settings])
    with open_progress(True) as progress:
        evaluations = evaluate_settings(loaded_study, settings, jobs=jobs, progress=progress)
    original, simulated = evaluations.take([0]), evaluations.take(range(1, len(evaluations)))
    is_valid = simulated.valid
    if not original.valid[0] or not is_valid.any():
        vehicle = "any row" if original.valid[0] else "the original vehicle"
        raise SimulationError(f"study {study!r} cannot be simulated with {vehicle}")
    if not is_valid.all():
        print_warning(f"{reference}: {np.count_nonzero(~is_valid)} rows could not be simulated and are left out")
    data, simulated = data.take(is_valid), simulated.take(is_valid)
    result = measure_agreement(data, simulated, loaded_study, original)
    if plot is not None:
        plot_agreement(plot, f"{loaded_study.title}\nagainst {reference.name}", characteristics, data, simulated)
    if totals is not None:
        write_totals(totals, loaded_study, reference.name, result)
    effects = effects_of(data, simulated, characteristics) if with_effects else {}
    coverage = measure_coverage(data, loaded_study) if with_spread else None
    if as_json:
        extras = {"effects": {name: effect._asdict() for name, effect in effects.items()}} if with_effects else {}
        extras |= {} if coverage is None else {"spread": coverage._asdict()}
        print_json({**result.to_dict(), **extras})
    else:
        sentences = [*result.sentences(), *([] if coverage is None else [str(coverage)])]
        _print_agreement(Console(), loaded_study.title, result, effects, sentences)


def _print_agreement(
    console: Console, title: str, result: Agreement, effects: Mapping[str, Effect], sentences: Sequence[str]
) -> None:
    """Print the agreement by metric, the effects by characteristic, if there are any, and sentences."""
    sides = ("reference", "here")
    columns = {
        "Spearman's rho": [result.spearman],
        "mean abs. error": [result.mean_absolute_error],
        "error / scatter": [result.in_repeats],
        "bias": [result.bias],
        **{f"original, {side}": [{name: pair[side] for name, pair in result.original.items()}] for side in sides},
    }
    print_by_metric(console, f"{title}: {result.rows} rows", columns)
    if effects:
        tolerance = f"within {RELATIVE_TOLERANCE:.0%} or {ABSOLUTE_TOLERANCE:g} m"
        table = WholeTable(
            "characteristic",
            right=(*sides, "agree"),
            title=f"Linear effects on the safety degree over a domain, m (agree: {tolerance})",
        )
        for name, (*values, agrees) in effects.items():
            cells = ("-" if value is None else f"{value:+.2f}" for value in values)
            table.add_row(name, *cells, {None: "-", True: "yes", False: "no"}[agrees])
        console.print(table)
    for sentence in sentences:
        console.print(sentence, markup=False)


def print_by_metric(console: Console, title: str, columns: Mapping[str, Sequence[Mapping[str, float | None]]]) -> None:
    """Print a table with a row for each metric; a cell shows the metric's numbers in each mapping of its column."""
    table = WholeTable("", right=columns, title=title)
    for name in next(iter(columns.values()))[0]:  # all mappings have the same metrics
        table.add_row(
            METRICS[name].heading,
            *(
                " / ".join("-" if (number := numbers.get(name)) is None else f"{number:.3f}" for numbers in column)
                for column in columns.values()
            ),
        )
    console.print(table)


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
def import_command(study: str, out: Path, original: str | None, **paths: Path | None) -> None:
    """Import published CSV solutions of STUDY as a results directory, or add another algorithm's solutions to it."""
    loaded_study = load_study(study)
    files = {algorithm: path for algorithm, path in paths.items() if path is not None}
    if not files:
        raise InputError("import", "no file is given", "at least one of --nsga2, --rs, --safe-fuzzer")
    adds_to_results = original is None and (out / MANIFEST).exists()
    metrics = None if adds_to_results else original_metrics(original, loaded_study.published)
    characteristics = CharacteristicSet.of(loaded_study)
    solutions = {
        algorithm: evaluations_of(read_rows(path, characteristics), characteristics)
        for algorithm, path in files.items()
    }
    replaced_counts = write_imported(
        out, loaded_study, solutions, metrics, {algorithm: path.name for algorithm, path in files.items()}
    )
    click.echo(f"Results: {out}, {', '.join(f'{len(rows)} solutions of {name}' for name, rows in solutions.items())}")
    for name, count in replaced_counts.items():
        print_note(f"they replace {count} solutions of {name} of an earlier import")


def read_rows(path: Path, characteristics: CharacteristicSet) -> ReferenceData:
    """Read a reference file, and warn of rows outside the domains."""
    data = read_reference(path, characteristics)
    if data.skipped:
        print_warning(f"{path}: {data.skipped} rows with values outside the domains are left out")
    return data


def find_owner(word: str, studies: Sequence[Study]) -> tuple[int, Path]:
    """Find the index of the study that a reference file belongs to, as `STUDY=FILE` or the file's name says, and the
    file's path.
    """
    names = [study.name for study in studies]
    name, _, file = word.partition("=")
    if file and name in names and not Path(word).exists():
        return names.index(name), Path(file)
    path = Path(word)
    candidates = names if len(names) == 1 else [name for name in names if path.name.startswith(name)]
    if not candidates:
        raise InputError(
            "reference",
            f"{word} may belong to any of {', '.join(names)}",
            "STUDY=FILE.csv, or a file name that begins with the study's name",
        )
    return names.index(max(candidates, key=len)), path  # sun_wet.csv belongs to `sun_wet`, not to `sun`


MULTIVALUE_FLAGS = ("--published", "--reference")
"""Flags that take all words up to the next flag as values."""


class _MultivalueCommand(click.Command):
    """Reads `--published A B` as `--published A --published B`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        words: list[str] = []
        flag = None
        for word in args:
            if word.startswith("-"):
                flag = word if word in MULTIVALUE_FLAGS else None
                words += [] if flag else [word]
            else:
                words += [flag, word] if flag else [word]
        return super().parse_args(ctx, words)


@commands.command(cls=_MultivalueCommand)
@directories_argument
@click.option(
    "--published",
    "published",
    multiple=True,
    required=True,
    metavar="DIR...",
    help="Imported results (command import).",
)
@file_option("--out", "Write the page to this file.", metavar="FILE.md")
@click.option(
    "--reference",
    "references",
    multiple=True,
    metavar="[STUDY=]FILE.csv...",
    help="Published rows to compare with the solutions nearby; name the study if the file's name does not "
    "begin with it.",
)
def replicate(
    directories: tuple[str, ...], published: tuple[str, ...], out: Path | None, references: tuple[str, ...]
) -> None:
    """Compare the results DIR... with published ones: tables side by side, and whether each conclusion holds."""
    check_output(out, "--out", (".md",))
    cases, data = load_cases(directories), dict[str, list[ReferenceData]]()
    for reference in references:
        index, path = find_owner(reference, [case.study for case in cases])
        data.setdefault(cases[index].name, []).append(read_rows(path, cases[index].characteristics))
    page = replication.replicate(cases, load_cases(published), data)
    if out is None:
        click.echo(page, nl=False)
    else:
        write_whole(out, page)
        click.echo(f"Replication: {out}")
