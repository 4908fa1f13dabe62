"""Commands that compare studies with published data (validate, import, replicate), and the text that they print."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np
from rich.console import Console

from safevar_sumo.analysis.research_questions.case import Case, load_cases
from safevar_sumo.analysis.words import two_decimals
from safevar_sumo.api.simulation import evaluate_settings
from safevar_sumo.cli.arguments import PICTURE_ENDINGS, check_output, complete_study, refuse_overwriting
from safevar_sumo.cli.program import commands, print_remarks
from safevar_sumo.cli.target import jobs_option, json_option
from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.metrics import METRICS
from safevar_sumo.output import check_writable
from safevar_sumo.progress import open_progress
from safevar_sumo.records import Evaluations
from safevar_sumo.reference import (
    Agreement,
    Effect,
    ReferenceData,
    effects_of,
    evaluations_of,
    measure_agreement,
    measure_coverage,
    original_metrics,
    plot_agreement,
    read_reference,
    write_totals,
)
from safevar_sumo.reference.conclusions import pair_cases
from safevar_sumo.reference.effects import ABSOLUTE_TOLERANCE, RELATIVE_TOLERANCE
from safevar_sumo.reference.replication import Nearness, compare_with_nearest_rows, render_replication
from safevar_sumo.results import MANIFEST, write_imported, write_whole
from safevar_sumo.study import SAFETY_DEGREE, Study, load_study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import WholeTable
from safevar_sumo.vehicles import CharacteristicSet


@commands.command()
@click.argument("study", shell_complete=complete_study)
@click.argument("reference", type=click.Path(path_type=Path), metavar="REFERENCE.csv")
@jobs_option
@click.option("--plot", type=click.Path(path_type=Path), metavar="FILE.png", help="Plot simulated against reference values.")
@json_option
@click.option("--totals", type=click.Path(path_type=Path), metavar="FILE.toml",
              help="Also save rank correlations, errors and counts of collisions to this file, without any row of the data.")
@click.option("--effects", "with_effects", is_flag=True, help="Compare the characteristics' linear effects here and in the reference.")
@click.option("--spread", "with_spread", is_flag=True, help="Count the published values within the spread of the model and of repeats.")
def validate(study: str, reference: Path, jobs: int | None, plot: Path | None, as_json: bool, totals: Path | None,
             with_effects: bool, with_spread: bool) -> None:
    """Compare STUDY with settings and metrics in the published package's CSV format."""
    loaded_study = load_study(study)
    print_remarks(loaded_study)
    system = assemble(loaded_study, study)
    if plot is not None:
        check_output(plot, "--plot", PICTURE_ENDINGS)
    if totals is not None:
        check_output(totals, "--totals", (".toml",))
    data = read_rows(reference, system.characteristics)
    settings = np.concatenate([system.characteristics.original[np.newaxis], data.settings])
    with open_progress(True) as progress:
        evaluations = evaluate_settings(loaded_study, settings, jobs=jobs, progress=progress)
    data, simulated = _simulated_rows(reference, data, evaluations.take(np.arange(1, len(settings))))
    if not evaluations.valid[0]:
        raise SimulationError(f"study {study!r} cannot be simulated with the original vehicle")
    result = measure_agreement(data, simulated, loaded_study, evaluations.take([0]))
    if plot is not None:
        plot_agreement(plot, f"{loaded_study.title}\nagainst {reference.name}", system.characteristics, data, simulated,
                       loaded_study.repeatability.get(SAFETY_DEGREE))
    if totals is not None:
        write_totals(totals, loaded_study, reference.name, result)
    effects = effects_of(data, simulated, system.characteristics) if with_effects else []
    coverage = measure_coverage(data, loaded_study) if with_spread else None
    if as_json:
        by_name = {effect.name: {"reference": effect.reference, "here": effect.here, "agrees": effect.agrees} for effect in effects}
        extras = {**({"effects": by_name} if with_effects else {}), **({"spread": coverage.to_dict()} if coverage is not None else {})}
        click.echo(json.dumps({**result.to_dict(), **extras}, indent=2, allow_nan=False))
    else:
        print_agreement(Console(), loaded_study, result)
        if with_effects:
            print_effects(Console(), effects)
        if coverage is not None:
            Console().print(str(coverage))


@commands.command(name="import")
@click.argument("study", shell_complete=complete_study)
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="DIR", help="Directory for the results.")
@click.option("--nsga2", type=click.Path(path_type=Path), metavar="FILE.csv", help="Solutions of NSGA-II.")
@click.option("--rs", type=click.Path(path_type=Path), metavar="FILE.csv", help="Solutions of random search.")
@click.option("--safe-fuzzer", type=click.Path(path_type=Path), metavar="FILE.csv", help="Solutions of SafeFuzzer.")
@click.option("--original", metavar="sd=2.7,tet=1.2,tit=0.44,ave_dece=5.97",
              help="The original vehicle's metrics.  [default: those published for STUDY]")
def import_command(study: str, out: Path, original: str | None, **paths: Path | None) -> None:
    """Import published CSV solutions of STUDY as a results directory, or add another algorithm's solutions to it."""
    loaded_study = load_study(study)
    files = {algorithm: path for algorithm, path in paths.items() if path is not None}
    if not files:
        raise InputError("import", "no file is given", "at least one of --nsga2, --rs, --safe-fuzzer")
    adds_to_results = original is None and (out / MANIFEST).exists()
    metrics = None if adds_to_results else original_metrics(original, loaded_study.published)
    characteristics = CharacteristicSet.of(loaded_study.vehicle.characteristics)
    solutions = {}
    for algorithm, path in files.items():
        solutions[algorithm] = evaluations_of(read_rows(path, characteristics), characteristics)
    replaced_counts = write_imported(out, loaded_study, solutions, metrics, {algorithm: path.name for algorithm, path in files.items()})
    click.echo(f"Results: {out}, {', '.join(f'{len(rows)} solutions of {name}' for name, rows in solutions.items())}")
    for name, count in replaced_counts.items():
        click.echo(f"note: they replace {count} solutions of {name} of an earlier import", err=True)


def read_rows(path: Path, characteristics: CharacteristicSet) -> ReferenceData:
    """Read a reference file, and warn of rows outside the domains."""
    data = read_reference(path, characteristics)
    if data.skipped:
        click.echo(f"warning: {path}: {data.skipped} rows with values outside the domains are left out", err=True)
    return data


def _simulated_rows(path: Path, data: ReferenceData, evaluations: Evaluations) -> tuple[ReferenceData, Evaluations]:
    """The rows of a reference file that could be simulated, and their evaluations."""
    valid = evaluations.valid
    if not valid.any():
        raise SimulationError(f"{path}: none of its {len(valid)} rows could be simulated")
    if not valid.all():
        click.echo(f"warning: {path}: {np.count_nonzero(~valid)} rows could not be simulated and are left out", err=True)
    return data.take(valid), evaluations.take(valid)


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
@click.argument("directories", nargs=-1, required=True, metavar="DIR...")
@click.option("--published", "published", multiple=True, required=True, metavar="DIR...", help="Imported results (command import).")
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE.md", help="Write the page to this file.")
@click.option("--reference", "references", multiple=True, metavar="[STUDY=]FILE.csv...",
              help="Published rows to compare with the solutions nearby; name the study if several have the same vehicle.")
def replicate(directories: tuple[str, ...], published: tuple[str, ...], out: Path | None, references: tuple[str, ...]) -> None:
    """Compare the results DIR... with published ones: tables side by side, and whether each conclusion holds."""
    if out is not None:
        refuse_overwriting(out, "--out", *directories, *published, *references)
        check_writable(out)
    for directory in published:
        if Path(directory).resolve() in [Path(other).resolve() for other in directories]:
            raise InputError("--published", f"{directory} is given as results too", "results that the command `import` has written")
    pairs = pair_cases(load_cases(directories), load_cases(published))
    page = render_replication(pairs, _compare_nearby(pairs.here, references))
    if out is None:
        click.echo(page, nl=False)
    else:
        write_whole(out, page)
        click.echo(f"Replication: {out}")


def _compare_nearby(cases: Sequence[Case], references: Sequence[str]) -> list[Nearness]:
    """Compare the solutions of each case with the nearest rows of its published files."""
    data_by_case: dict[str, list[ReferenceData]] = {}
    for reference in references:
        name, _, file = reference.rpartition("=")
        candidates = [case for case in cases if name in ("", case.study.name)]
        matches = _read_for_cases(Path(file), candidates) if candidates else {}
        if len(matches) != 1:
            relation = "may belong to any of" if matches else "belongs to none of"
            names = ", ".join(matches or (case.study.name for case in cases))
            raise InputError("--reference", f"{reference} {relation} {names}", "STUDY=FILE.csv")
        for case_name, data in matches.items():
            data_by_case.setdefault(case_name, []).append(data)
    return [result for case in cases if case.name in data_by_case for result in compare_with_nearest_rows(case, data_by_case[case.name])]


def _read_for_cases(path: Path, cases: Sequence[Case]) -> dict[str, ReferenceData]:
    """Read a file for each case whose characteristics it has; returns the rows by the case's name."""
    data_by_case: dict[str, ReferenceData] = {}
    for case in cases:
        try:
            data_by_case[case.name] = read_reference(path, case.characteristics)
        except InputError as error:
            if len(cases) == 1 or not ("lacks the columns" in error.problem or "in the domains" in error.problem):
                raise
    return data_by_case


def print_agreement(console: Console, study: Study, result: Agreement) -> None:
    """Print the comparison with reference data, metric by metric."""
    table = WholeTable("", right=("Spearman's rho", "mean abs. error", "error / scatter", "bias", "original, reference", "original, here"),
                       title=f"{study.title}: {result.rows} rows")
    for name in result.spearman:
        heading = METRICS[name].heading
        numbers = (result.spearman[name], result.mean_absolute_error[name], result.in_repeats[name], result.bias[name],
                   *result.original[name].values())
        table.add_row(heading, *("-" if number is None else f"{number:.3f}" for number in numbers))
    console.print(table)
    collisions = result.collisions
    console.print(f"Collisions: {collisions['reference']} in the reference, {collisions['here']} here, {collisions['both']} in both: "
                  f"precision {two_decimals(result.precision)}, recall {two_decimals(result.recall)}; their mean speed is "
                  f"{two_decimals(result.collision_speed['reference'])} m/s in the reference, "
                  f"{two_decimals(result.collision_speed['here'])} m/s here.")
    if result.undecided["within_repeats"] is not None:
        console.print(f"Of {result.undecided['differ']} settings that collide only in the reference or only here, "
                      f"{result.undecided['within_repeats']} may collide or not within the scatter of repeats.")
    bins = ", ".join(f"{entry['lowest']:.2f} to {entry['highest']:.2f}: {entry['bias']:+.2f}" for entry in result.by_predicted)
    console.print(f"Mean error by the safety degree here: {bins}.", markup=False)


def print_effects(console: Console, effects: Sequence[Effect]) -> None:
    """Print the effects in the reference and here, and whether they agree."""
    title = f"Linear effects on the safety degree over a domain, m (agree: within {RELATIVE_TOLERANCE:.0%} or {ABSOLUTE_TOLERANCE:g} m)"
    table = WholeTable("characteristic", right=("reference", "here", "agree"), title=title)
    for effect in effects:
        agrees = "-" if effect.agrees is None else "yes" if effect.agrees else "no"
        table.add_row(effect.name, *("-" if value is None else f"{value:+.2f}" for value in (effect.reference, effect.here)), agrees)
    console.print(table)


