"""Commands that compare studies with published data: validate, calibrate, import, replicate; and what they print."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import click
import msgspec
import numpy as np
from rich.console import Console

from safevar_sumo.analysis.research_questions.case import Case, load_cases
from safevar_sumo.cli.options import PICTURES, check_output, complete_study, refuse_inputs
from safevar_sumo.cli.program import commands, tell_remarks
from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.metrics import METRICS
from safevar_sumo.progress import counted
from safevar_sumo.records import Evaluations
from safevar_sumo.reference import (
    Agreement,
    Calibration,
    ReferenceData,
    agreement,
    calibrate,
    calibration_comment,
    cost_line,
    evaluations_of,
    fitted_as,
    keep_totals,
    on_a_bound,
    original_metrics,
    plot_agreement,
    read_reference,
)
from safevar_sumo.reference.replication import Nearness, nearness, paired, replication
from safevar_sumo.results import write_imported, write_whole
from safevar_sumo.study import SAFETY_DEGREE, Study, check_writable, load_study, write_study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import WholeTable, stages
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.batches import evaluate_all
from safevar_sumo.workers.local import available_cores, local_pool


@commands.command()
@click.argument("study", shell_complete=complete_study)
@click.argument("reference", type=click.Path(path_type=Path), metavar="REFERENCE.csv")
@click.option("--jobs", type=click.IntRange(min=1), help="Worker processes.  [default: the cores of this machine]")
@click.option("--plot", type=click.Path(path_type=Path), metavar="FILE.png", help="Draw here against reference.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.option("--totals", type=click.Path(path_type=Path), metavar="FILE.toml",
              help="Keep rank correlations, errors and counts of collisions there too: no row of the data.")
def validate(study: str, reference: Path, jobs: int | None, plot: Path | None, as_json: bool, totals: Path | None) -> None:
    """Compare STUDY with settings and metrics in the published package's CSV format."""
    chosen = load_study(study)
    tell_remarks(chosen)
    system = assemble(chosen, study)
    if plot is not None:
        check_output(plot, "--plot", PICTURES)
    if totals is not None:
        check_output(totals, "--totals", (".toml",))
    data = _read(reference, system.characteristics)
    settings = np.concatenate([system.characteristics.original[np.newaxis], data.settings])
    with (local_pool(jobs or available_cores(), chosen.search.time_limit) as pool,
          counted(Console(stderr=True), "settings", len(np.unique(settings, axis=0))) as done):
        evaluations = evaluate_all(chosen, settings, pool, done)
    data, here = _simulated(reference, data, evaluations.take(np.arange(1, len(settings))))
    if not evaluations.valid[0]:
        raise SimulationError(f"study {study!r} cannot be simulated with the original vehicle")
    result = agreement(data, here, chosen, evaluations.take([0]))
    if plot is not None:
        plot_agreement(plot, f"{chosen.title}\nagainst {reference.name}", system.characteristics, data, here,
                       chosen.repeatability.get(SAFETY_DEGREE))
    if totals is not None:
        keep_totals(totals, chosen, reference.name, result)
    if as_json:
        click.echo(json.dumps(result.to_dict(), indent=2, allow_nan=False))
    else:
        print_agreement(Console(), chosen, result)


@commands.command(name="calibrate")
@click.argument("study", shell_complete=complete_study)
@click.argument("references", type=click.Path(path_type=Path), nargs=-1, metavar="[REFERENCE.csv]...")
@click.option("--trials", type=click.IntRange(min=1), help="How many sets of parameters are tried.  [default: the study's]")
@click.option("--seed", type=click.IntRange(min=0, max=2**31), help="Seed of the search.  [default: the study's]")
@click.option("--from-scratch", is_flag=True, help="Start from random places alone, as if the study's values were not known.")
@click.option("--jobs", type=click.IntRange(min=1), help="Worker processes.  [default: the cores of this machine]")
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE.toml", help="Study file to write.  [default: STUDY-calibrated.toml]")
def calibrate_command(study: str, references: tuple[Path, ...], trials: int | None, seed: int | None, from_scratch: bool,
                      jobs: int | None, out: Path | None) -> None:
    """Fit what STUDY declares under [calibration] to the published values and to rows of reference files, as [fit] says."""
    given = load_study(study)
    asked = {name: value for name, value in (("trials", trials), ("seed", seed)) if value is not None}
    chosen = msgspec.structs.replace(given, fit=msgspec.structs.replace(given.fit, **asked))
    system = assemble(chosen, study)
    target = out or Path(f"{chosen.name}-calibrated.toml")
    for source in (Path(study), *references):
        if target.exists() and source.exists() and target.samefile(source):
            raise InputError("--out", f"{target} is what the calibration starts from", "another file")
    check_writable(target)
    if len({path.name for path in references}) < len(references):
        raise InputError("REFERENCE.csv", "two files have one name", "files of different names")
    data = {path.name: _read(path, system.characteristics) for path in references}
    tried, lowest, best = 0, np.inf, chosen
    try:
        with (local_pool(jobs or available_cores(), chosen.search.time_limit) as pool,
              stages(Console(stderr=True)) as show):
            show("trials", 0, chosen.fit.trials)

            def one_done(cost: float, so_far: Study) -> None:
                nonlocal tried, lowest, best
                tried, lowest, best = tried + 1, cost, so_far
                show(f"trials, lowest cost {cost:.4f}", tried, chosen.fit.trials)

            calibration = calibrate(chosen, data, pool, one_done, from_scratch=from_scratch)
    except KeyboardInterrupt:
        if tried:
            account = f"Best of {tried} of {chosen.fit.trials} trials, then interrupted (seed {chosen.fit.seed}). Cost {lowest:.4f}."
            write_study(target, fitted_as(chosen, best), account)
            click.echo(f"interrupted: the best of {tried} trials is in {target}", err=True)
        raise
    print_calibration(Console(), chosen, calibration)
    write_study(target, fitted_as(chosen, calibration.study), calibration_comment(calibration, chosen, data, from_scratch=from_scratch))
    Console().print(f"Study file: {target}", soft_wrap=True)


@commands.command(name="import")
@click.argument("study", shell_complete=complete_study)
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="DIR", help="Directory of the results.")
@click.option("--nsga2", type=click.Path(path_type=Path), metavar="FILE.csv", help="Solutions of NSGA-II.")
@click.option("--rs", type=click.Path(path_type=Path), metavar="FILE.csv", help="Solutions of random search.")
@click.option("--safe-fuzzer", type=click.Path(path_type=Path), metavar="FILE.csv", help="Solutions of SafeFuzzer.")
@click.option("--original", metavar="sd=2.7,tet=1.2,tit=0.44,ave_dece=5.97",
              help="The original vehicle's metrics.  [default: those published for STUDY]")
def import_command(study: str, out: Path, original: str | None, **given: Path | None) -> None:
    """Import published CSV solutions of STUDY as a results directory, or add another algorithm's solutions to it."""
    chosen = load_study(study)
    files = {algorithm: path for algorithm, path in given.items() if path is not None}
    if not files:
        raise InputError("import", "no file is given", "at least one of --nsga2, --rs, --safe-fuzzer")
    adds = original is None and (out / "manifest.json").exists()
    metrics = None if adds else original_metrics(original, chosen.published)
    characteristics = CharacteristicSet.of(chosen.vehicle.characteristics)
    solutions = {}
    for algorithm, path in files.items():
        solutions[algorithm] = evaluations_of(_read(path, characteristics), characteristics)
    write_imported(out, chosen, solutions, metrics, {algorithm: path.name for algorithm, path in files.items()})
    click.echo(f"Results: {out}, {', '.join(f'{len(found)} solutions of {name}' for name, found in solutions.items())}")


def _read(path: Path, characteristics: CharacteristicSet) -> ReferenceData:
    data = read_reference(path, characteristics)
    if data.skipped:
        click.echo(f"warning: {path}: {data.skipped} rows with values outside the domains are left out", err=True)
    return data


def _simulated(path: Path, data: ReferenceData, here: Evaluations) -> tuple[ReferenceData, Evaluations]:
    """The rows that could be simulated."""
    valid = here.valid
    if not valid.any():
        raise SimulationError(f"{path}: not one of its {len(valid)} rows could be simulated")
    if not valid.all():
        click.echo(f"warning: {path}: {np.count_nonzero(~valid)} rows could not be simulated and are left out", err=True)
    return data.take(valid), here.take(valid)


SEVERAL = ("--published", "--reference")
"""Options that take all words up to the next option."""


class _TakesSeveral(click.Command):
    """`--published A B` as `--published A --published B`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        words: list[str] = []
        flag = None
        for word in args:
            if word.startswith("-"):
                flag = word if word in SEVERAL else None
                words += [] if flag else [word]
            else:
                words += [flag, word] if flag else [word]
        return super().parse_args(ctx, words)


@commands.command(cls=_TakesSeveral)
@click.argument("directories", nargs=-1, required=True, metavar="DIR...")
@click.option("--published", "published", multiple=True, required=True, metavar="DIR...", help="Imported results (command import).")
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE.md", help="Write the page to this file.")
@click.option("--reference", "references", multiple=True, metavar="[STUDY=]FILE.csv...",
              help="Published rows to look for next to what the searches found; of which study, where several have one vehicle.")
def replicate(directories: tuple[str, ...], published: tuple[str, ...], out: Path | None, references: tuple[str, ...]) -> None:
    """Compare the results DIR... with published ones: tables side by side, and whether each conclusion holds."""
    if out is not None:
        refuse_inputs(out, "--out", *directories, *published, *references)
        check_writable(out)
    for directory in published:
        if Path(directory).resolve() in [Path(other).resolve() for other in directories]:
            raise InputError("--published", f"{directory} is given as results too", "results that the command import has written")
    pairs = paired(load_cases(directories), load_cases(published))
    page = replication(pairs, _near(pairs.here, references))
    if out is None:
        click.echo(page, nl=False)
    else:
        write_whole(out, page)
        click.echo(f"Replication: {out}")


def _near(cases: Sequence[Case], references: Sequence[str]) -> list[Nearness]:
    """Published rows next to the solutions, for the case that each file belongs to."""
    rows: dict[str, list[ReferenceData]] = {}
    for given in references:
        name, _, place = given.rpartition("=")
        fitting = [case for case in cases if name in ("", case.study.name)]
        read = _rows_by_case(Path(place), fitting) if fitting else {}
        if len(read) != 1:
            relation = "may belong to each of" if read else "belongs to none of"
            names = ", ".join(read or (case.study.name for case in cases))
            raise InputError("--reference", f"{given} {relation} {names}", "STUDY=FILE.csv")
        for case, data in read.items():
            rows.setdefault(case, []).append(data)
    return [one for case in cases if case.name in rows for one in nearness(case, rows[case.name])]


def _rows_by_case(path: Path, cases: Sequence[Case]) -> dict[str, ReferenceData]:
    """The rows of a file for every case with the vehicle of the file."""
    rows: dict[str, ReferenceData] = {}
    for case in cases:
        try:
            rows[case.name] = read_reference(path, case.characteristics)
        except InputError as error:
            if len(cases) == 1 or not ("lacks the columns" in error.problem or "in the domains" in error.problem):
                raise
    return rows


def print_agreement(console: Console, study: Study, result: Agreement) -> None:
    """Comparison with reference data, metric by metric."""
    table = WholeTable("", right=("Spearman's rho", "mean abs. error", "in repeats", "bias", "original there", "original here"),
                       title=f"{study.title}: {result.rows} rows")
    for name in result.spearman:
        head = METRICS[name].heading
        numbers = (result.spearman[name], result.mean_absolute_error[name], result.in_repeats[name], result.bias[name],
                   *result.original[name].values())
        table.add_row(head, *("-" if number is None else f"{number:.3f}" for number in numbers))
    console.print(table)
    collisions = result.collisions
    console.print(f"Collisions: {collisions['reference']} in the reference, {collisions['here']} here, {collisions['both']} in both: "
                  f"precision {_number(result.precision)}, recall {_number(result.recall)}; their mean speed is "
                  f"{_number(result.collision_speed['reference'])} m/s there and {_number(result.collision_speed['here'])} m/s here.")
    if result.undecided["within_repeats"] is not None:
        console.print(f"Of {result.undecided['differ']} settings that collide on one side alone, {result.undecided['within_repeats']} "
                      "may do either: repeats of them differ by as much.")
    bins = ", ".join(f"{part['lowest']:.2f} to {part['highest']:.2f}: {part['bias']:+.2f}" for part in result.by_predicted)
    console.print(f"Mean error by the safety degree here: {bins}.", markup=False)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def print_calibration(console: Console, study: Study, result: Calibration) -> None:
    """Fitted values, and how well they agree with both halves of the data."""
    table = WholeTable("parameter", "unit", right=("fitted", "lower", "upper"), title=study.title)
    for name, value in result.values.items():
        row = study.calibration[name]
        table.add_row(name, row.unit, *(f"{number:.5g}" for number in (value, row.lower, row.upper)))
    console.print(table)
    for name in result.used:
        both = WholeTable("", right=("Spearman's rho", "mean abs. error", "bias"), title=f"{name}: rows used / held back")
        halves = (result.used[name], result.held_back[name])
        for metric in halves[0].spearman:
            head = METRICS[metric].heading
            both.add_row(head, *(
                " / ".join("-" if number is None else f"{number:.3f}" for number in (getattr(half, what)[metric] for half in halves))
                for what in ("spearman", "mean_absolute_error", "bias")))
        console.print(both)
    for name in on_a_bound(result.values, study.calibration):
        console.print(f"{name} stands on its bound: a wider one may fit better.", markup=False)
    console.print(cost_line(result))
