"""Commands that hold a study against reference data."""

from __future__ import annotations

import json
from pathlib import Path

import click
import msgspec
import numpy as np
from rich.console import Console

from safevar_sumo.cli.completion import complete_study
from safevar_sumo.cli.display.reference import print_agreement, print_calibration
from safevar_sumo.cli.options import PICTURES, check_output
from safevar_sumo.cli.program import commands, tell_remarks
from safevar_sumo.errors import InputError, SimulationError
from safevar_sumo.progress import counted, counted_trials
from safevar_sumo.records import Evaluations
from safevar_sumo.reference import (
    ReferenceData,
    agreement,
    calibrate,
    calibration_comment,
    evaluations_of,
    fitted_as,
    keep_totals,
    original_metrics,
    plot_agreement,
    read_reference,
)
from safevar_sumo.results import write_imported
from safevar_sumo.study import SAFETY_DEGREE, Study, check_writable, load_study, write_study
from safevar_sumo.sumo.system import assemble
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
    for taken in (Path(study), *references):
        if target.exists() and taken.exists() and target.samefile(taken):
            raise InputError("--out", f"{target} is what the calibration starts from", "another file")
    check_writable(target)
    if len({path.name for path in references}) < len(references):
        raise InputError("REFERENCE.csv", "two files have one name", "files of different names")
    data = {path.name: _read(path, system.characteristics) for path in references}
    tried, lowest, best = 0, np.inf, chosen
    try:
        with (local_pool(jobs or available_cores(), chosen.search.time_limit) as pool,
              counted_trials(Console(stderr=True), chosen.fit.trials) as done):
            def one_done(cost: float, so_far: Study) -> None:
                nonlocal tried, lowest, best
                tried, lowest, best = tried + 1, cost, so_far
                done(cost)

            found = calibrate(chosen, data, pool, one_done, from_scratch=from_scratch)
    except KeyboardInterrupt:
        if tried:
            account = f"Best of {tried} of {chosen.fit.trials} trials, then interrupted (seed {chosen.fit.seed}). Cost {lowest:.4f}."
            write_study(target, fitted_as(chosen, best), account)
            click.echo(f"interrupted: the best of {tried} trials is in {target}", err=True)
        raise
    print_calibration(Console(), chosen, found)
    write_study(target, fitted_as(chosen, found.study), calibration_comment(found, chosen, data, from_scratch=from_scratch))
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
    """Make results of STUDY from solutions in the published package's CSV format, or add those of another algorithm to them."""
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
