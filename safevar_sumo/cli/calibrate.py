"""The command `calibrate`, which fits studies to published data, and the text that it prints."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import click
import msgspec
import numpy as np
from rich.console import Console

from safevar_sumo.cli.arguments import PICTURE_ENDINGS, check_output, complete_study, refuse_overwriting
from safevar_sumo.cli.program import commands
from safevar_sumo.cli.reference import read_rows
from safevar_sumo.cli.target import jobs_option
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.output import check_writable
from safevar_sumo.progress import open_progress
from safevar_sumo.reference import Calibration, FitSubject, calibrate, calibrate_together
from safevar_sumo.reference.fit_result import rename_fitted
from safevar_sumo.reference.profiles import plot_profiles
from safevar_sumo.study import FITTED_TABLES, Study, load_study, study_names, write_study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import WholeTable, print_text
from safevar_sumo.workers.identity import input_files
from safevar_sumo.workers.interrupts import terminate_as_interrupt
from safevar_sumo.workers.local import available_cores, local_pool

SECONDS_BETWEEN_SAVES = 60.0
"""Least time between two study files with the best values so far, which remain if the process is killed [s]."""


@commands.command(name="calibrate")
@click.argument("study", shell_complete=complete_study)
@click.argument("words", nargs=-1, metavar="[STUDY]... [[STUDY=]REFERENCE.csv]...")
@click.option("--trials", type=click.IntRange(min=1), help="Number of parameter sets to try.  [default: the first study's]")
@click.option("--seed", type=click.IntRange(min=0, max=2**31), help="Seed of the search.  [default: the first study's]")
@click.option("--starts", type=click.IntRange(min=0, max=1000), help="Number of additional random starts.  [default: the first study's]")
@click.option("--from-scratch", is_flag=True, help="Start only from random points, not from the values in the studies.")
@jobs_option
@click.option("--plot", type=click.Path(path_type=Path), metavar="FILE.png", help="Draw the loss over every parameter.")
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE.toml",
              help="Study file to write; for several studies, the directory for their files.  [default: STUDY-calibrated.toml]")
def calibrate_command(study: str, words: tuple[str, ...], trials: int | None, seed: int | None, starts: int | None,
                      from_scratch: bool, jobs: int | None, plot: Path | None, out: Path | None) -> None:
    """Fit the parameters under [calibration] of STUDY to published values and to rows of reference files, as [fit] says.

    Several studies are fitted together: they share each parameter to which they give the same value, unless [calibration] marks it as
    a study's own. STUDY=FILE.csv assigns a reference file to a study; otherwise the file's name must begin with the study's name.
    """
    names = [study, *(word for word in words if _is_study(word))]
    files = [word for word in words if not _is_study(word)]
    fit_options = {name: value for name, value in (("trials", trials), ("seed", seed), ("starts", starts)) if value is not None}
    studies = [msgspec.structs.replace(item, fit=msgspec.structs.replace(item.fit, **fit_options)) for item in map(load_study, names)]
    systems = [assemble(item, name) for item, name in zip(studies, names, strict=True)]
    if len({item.name for item in studies}) < len(studies):
        raise InputError("STUDY", f"two studies are called {studies[0].name!r}", "studies of different names")
    targets = _choose_targets(studies, out)
    if plot is not None:
        check_output(plot, "--plot", PICTURE_ENDINGS)
    owners = [_find_owner(file, studies) for file in files]
    inputs = [file for item, system in zip(studies, systems, strict=True) for file in input_files(item, system)]
    for target in targets:
        refuse_overwriting(target, "--out", *names, *inputs, *(path for _, path in owners))
        check_writable(target)
    if len({path.name for _, path in owners}) < len(owners):
        raise InputError("REFERENCE.csv", "two files have the same name", "files of different names")
    data = [{path.name: read_rows(path, system.characteristics) for owner, path in owners if owner == index}
            for index, system in enumerate(systems)]
    trials_done, least_loss, best_studies, last_save = 0, np.inf, tuple(studies), time.monotonic()
    max_trials = studies[0].fit.trials

    def save_best(ending: str) -> list[InputError | None]:
        comment = f"Best of {trials_done} of {max_trials} trials, {ending} (seed {studies[0].fit.seed}). Loss {least_loss:.4f}."
        fitted = [msgspec.structs.replace(item, spread={}, model_error={}) for item in best_studies]  # those of the values before the fit
        return _write_studies(targets, studies, fitted, [comment] * len(studies))

    def after_trial(loss: float, best: Study | tuple[Study, ...]) -> None:
        nonlocal trials_done, least_loss, best_studies, last_save
        trials_done, least_loss, best_studies = trials_done + 1, loss, best if isinstance(best, tuple) else (best,)
        show_progress(f"trials, lowest loss {loss:.4f}", trials_done, max_trials)
        if time.monotonic() - last_save > SECONDS_BETWEEN_SAVES:
            save_best("while more are tried")  # without space for it now, there may be space at the end
            last_save = time.monotonic()

    try:
        with (local_pool(jobs or available_cores(), max(item.search.time_limit for item in studies)) as pool, terminate_as_interrupt(),
              open_progress(True) as show_progress):
            show_progress("trials", 0, max_trials)
            if len(studies) == 1:
                calibrations = [calibrate(studies[0], data[0], pool, after_trial, from_scratch=from_scratch)]
            else:
                subjects = [FitSubject(item, references) for item, references in zip(studies, data, strict=True)]
                calibrations = calibrate_together(subjects, pool, after_trial, from_scratch=from_scratch)
    except KeyboardInterrupt:
        if trials_done:
            _raise_first(save_best("then interrupted"))
            click.echo(f"interrupted: the best of {trials_done} trials is in {', '.join(map(str, targets))}", err=True)
        raise
    comments = [calibration.comment(item, references, from_scratch=from_scratch)
                for item, calibration, references in zip(studies, calibrations, data, strict=True)]
    errors = _write_studies(targets, studies, [calibration.study for calibration in calibrations], comments)
    for item, calibration, target, error in zip(studies, calibrations, targets, errors, strict=True):
        print_calibration(Console(), item, calibration)
        if error is None:
            Console().print(f"Study file: {target}", soft_wrap=True)
        else:
            for key, value in calibration.values.items():
                click.echo(f"fitted, but not written: {key} = {value!r}", err=True)
    _raise_first(errors)
    if plot is not None and calibrations[0].profiles is not None:
        plot_profiles(plot, calibrations[0].profiles, studies)


def _write_studies(targets: Sequence[Path], studies: Sequence[Study], fitted: Sequence[Study], comments: Sequence[str]
                   ) -> list[InputError | None]:
    """Write the fitted studies; returns the error of each file, None if the file is written."""
    errors: list[InputError | None] = []
    for target, study, fitted_study, comment in zip(targets, studies, fitted, comments, strict=True):
        try:
            write_study(target, rename_fitted(study, fitted_study), comment)
            errors.append(None)
        except InputError as error:
            errors.append(error)
    return errors


def _raise_first(errors: Sequence[InputError | None]) -> None:
    for error in errors:
        if error is not None:
            raise error


def _is_study(word: str) -> bool:
    """Whether a word names a study rather than a reference file."""
    return word in study_names() or word.endswith(".toml")


def _choose_targets(studies: Sequence[Study], out: Path | None) -> list[Path]:
    """Choose the study files to write, one for each study."""
    if len(studies) == 1:
        return [out or Path(f"{studies[0].name}-calibrated.toml")]
    if out is not None and not out.is_dir():
        raise InputError("--out", f"{out} is not a directory", "an existing directory, for the files of several studies")
    return [(out or Path()) / f"{study.name}-calibrated.toml" for study in studies]


def _find_owner(word: str, studies: Sequence[Study]) -> tuple[int, Path]:
    """Find the index of the study that a reference file belongs to, and the file's path."""
    names = [study.name for study in studies]
    name, _, file = word.partition("=")
    if file and name in names and not Path(word).exists():
        return names.index(name), Path(file)
    path = Path(word)
    if len(names) == 1:
        return 0, path
    candidates = [name for name in names if path.name.startswith(name)]
    if not candidates:
        expected = "STUDY=FILE.csv, or a file name that begins with the study's name"
        raise InputError("REFERENCE.csv", f"{word} may belong to any of {', '.join(names)}", expected)
    return names.index(max(candidates, key=len)), path




def print_calibration(console: Console, study: Study, result: Calibration) -> None:
    """Print the fitted values, and their agreement with the rows used and with the rows held back."""
    table = WholeTable("parameter", "unit", right=("fitted", "equal fit", "bounds"), title=study.title)
    group = ""
    for key, value in result.values.items():
        prefix = next(prefix for prefix in FITTED_TABLES if key.startswith(prefix))
        if prefix != group:
            table.add_section()
            table.add_row(f"[{prefix.removesuffix('.')}]", "", "", "", "")
            group = prefix
        bound = result.bounds[key]
        mark = " *" if key in result.shared else ""
        ranges = (f"{lower:.5g} to {upper:.5g}" for lower, upper in (result.intervals[key], (bound.lower, bound.upper)))
        table.add_row(f"{key.removeprefix(prefix)}{mark}", bound.unit, f"{value:.5g}", *ranges)
    console.print(table)
    if result.shared:
        print_text(console, f"* shared with {', '.join(result.together)}")
    for name in result.used:
        comparison = WholeTable("", right=("Spearman's rho", "mean abs. error", "bias"), title=f"{name}: rows used / held back")
        agreements = (result.used[name], result.held_back[name])
        for metric in agreements[0].spearman:
            heading = METRICS[metric].heading
            comparison.add_row(heading, *(
                " / ".join("-" if number is None else f"{number:.3f}" for number in (getattr(fit, quantity)[metric] for fit in agreements))
                for quantity in ("spearman", "mean_absolute_error", "bias")))
        console.print(comparison)
    for name in result.on_a_bound:
        console.print(f"{name} lies on its bound: a wider bound may fit better.", markup=False)
    console.print(result.loss_line)
