"""The command `calibrate`, which fits studies to published data, and the text that it prints."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import click
import msgspec
from rich.console import Console

from safevar_sumo.campaign.local import available_cores, local_pool
from safevar_sumo.cli.arguments import check_output, check_study_output, complete_study, file_option, jobs_option
from safevar_sumo.cli.program import commands
from safevar_sumo.cli.reference import find_owner, print_by_metric, read_rows
from safevar_sumo.errors import InputError
from safevar_sumo.reference.calibration import Calibration, FitSubject, calibrate, describe_fit, plot_profiles
from safevar_sumo.study import FITTED_TABLES, Study, load_study, study_names, write_study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import WholeTable, open_progress, print_text

SECONDS_BETWEEN_SAVES = 60.0
"""Least time between two study files with the best values so far, which remain if the process is killed [s]."""


@commands.command(name="calibrate")
@click.argument("study", shell_complete=complete_study)
@click.argument("words", nargs=-1, metavar="[STUDY]... [[STUDY=]REFERENCE.csv]...")
@click.option(
    "--trials", type=click.IntRange(min=1), help="Number of parameter sets to try.  [default: the first study's]"
)
@click.option("--seed", type=click.IntRange(min=0, max=2**31), help="Seed of the search.  [default: the first study's]")
@click.option(
    "--repeats",
    type=click.IntRange(min=1, max=100),
    help="Number of seeds, each with all trials.  [default: the first study's]",
)
@click.option(
    "--starts",
    type=click.IntRange(min=0, max=1000),
    help="Number of additional random starts.  [default: the first study's]",
)
@click.option("--from-scratch", is_flag=True, help="Start only from random points, not from the values in the studies.")
@jobs_option
@file_option("--plot", "Draw the loss over every parameter.", metavar="FILE.png")
@file_option(
    "--out",
    "Study file to write; for several studies, the directory for their files.  [default: STUDY-calibrated.toml]",
    metavar="FILE.toml",
)
def calibrate_command(
    study: str,
    words: tuple[str, ...],
    from_scratch: bool,
    jobs: int | None,
    plot: Path | None,
    out: Path | None,
    **fit_options: int | None,
) -> None:
    """Fit the parameters under [calibration] of STUDY to published values and to rows of reference files, as [fit]
    says.

    Several studies are fitted together: they share each parameter to which they give the same value, unless
    [calibration] marks it as a study's own. STUDY=FILE.csv assigns a reference file to a study; otherwise the file's
    name must begin with the study's name.
    """
    names = [study, *(word for word in words if word in study_names() or word.endswith(".toml"))]
    changes = {name: value for name, value in fit_options.items() if value is not None}
    studies = [
        msgspec.structs.replace(written, fit=msgspec.structs.replace(written.fit, **changes))
        for written in map(load_study, names)
    ]
    systems = [assemble(loaded_study, name) for loaded_study, name in zip(studies, names, strict=True)]
    if len({loaded_study.name for loaded_study in studies}) < len(studies):
        raise InputError("STUDY", f"two studies are called {studies[0].name!r}", "studies of different names")
    check_output(plot, "--plot")
    owners = [find_owner(word, studies) for word in words if word not in names]
    if len({path.name for _, path in owners}) < len(owners):
        raise InputError("REFERENCE.csv", "two files have the same name", "files of different names")
    targets = _choose_targets(studies, out)
    for target in targets:
        check_study_output(target, "--out", studies)
    subjects = [
        FitSubject(
            loaded_study,
            {path.name: read_rows(path, system.characteristics) for owner, path in owners if owner == index},
        )
        for index, (loaded_study, system) in enumerate(zip(studies, systems, strict=True))
    ]
    results = _fit(subjects, targets, from_scratch, jobs)
    for subject, result in zip(subjects, results, strict=True):
        print_calibration(
            Console(), subject.study, result, [other.name for other in studies if other is not subject.study]
        )
    comments = [
        describe_fit(subject, result, studies, from_scratch=from_scratch)
        for subject, result in zip(subjects, results, strict=True)
    ]
    _write_studies(targets, studies, [result.study for result in results], comments)
    for target in targets:
        print_text(Console(), f"Study file: {target}")
    if plot is not None:
        plot_profiles(plot, results[0].profiles, studies)


def _fit(
    subjects: Sequence[FitSubject], targets: Sequence[Path], from_scratch: bool, jobs: int | None
) -> list[Calibration]:
    """Fit the studies with progress; now and then, and if it is interrupted, write the best studies so far, without
    `spread` and `model_error`, which belong to the values before the fit.
    """
    studies = [subject.study for subject in subjects]
    fit, done, lowest_loss, best, last_save = studies[0].fit, 0, 0.0, list(studies), time.monotonic()
    trials = fit.trials * fit.repeats

    def save_best(ending: str) -> None:
        comment = f"Best of {done} of {trials} trials, {ending} (seed {fit.seed}). Loss {lowest_loss:.4f}."
        best_without_spread = [msgspec.structs.replace(study, spread={}, model_error={}) for study in best]
        _write_studies(targets, studies, best_without_spread, [comment] * len(studies))

    def after_trial(loss: float, best_studies: tuple[Study, ...]) -> None:
        nonlocal done, lowest_loss, best, last_save
        done, lowest_loss, best = done + 1, loss, list(best_studies)
        show_progress(f"trials, lowest loss {loss:.4f}", done, trials)
        if time.monotonic() - last_save > SECONDS_BETWEEN_SAVES:
            save_best("while more are tried")
            last_save = time.monotonic()

    try:
        with (
            local_pool(jobs or available_cores(), max(study.search.time_limit for study in studies)) as pool,
            open_progress(True) as show_progress,
        ):
            show_progress("trials", 0, trials)
            return calibrate(subjects, pool, after_trial, from_scratch=from_scratch)
    except KeyboardInterrupt:
        if done:
            save_best("then interrupted")
            click.echo(f"interrupted: the best of {done} trials is in {', '.join(map(str, targets))}", err=True)
        raise


def _write_studies(
    targets: Sequence[Path], studies: Sequence[Study], fitted: Sequence[Study], comments: Sequence[str]
) -> None:
    """Write the fitted studies as `STUDY-calibrated`, so that they cannot be mistaken for those before the fit."""
    for target, study, fitted_study, comment in zip(targets, studies, fitted, comments, strict=True):
        write_study(target, msgspec.structs.replace(fitted_study, name=f"{study.name}-calibrated"), comment)


def _choose_targets(studies: Sequence[Study], out: Path | None) -> list[Path]:
    """Choose the study files to write, one for each study."""
    if len(studies) == 1:
        return [out or Path(f"{studies[0].name}-calibrated.toml")]
    if out is not None and not out.is_dir():
        raise InputError(
            "--out", f"{out} is not a directory", "an existing directory, for the files of several studies"
        )
    return [(out or Path()) / f"{study.name}-calibrated.toml" for study in studies]


def print_calibration(console: Console, study: Study, result: Calibration, others: Sequence[str]) -> None:
    """Print the fitted values, as they are written, and their agreement with the rows used and with the rows held
    back.
    """
    table = WholeTable("parameter", "unit", right=("fitted", "equal fit", "bounds"), title=study.title)
    for prefix in FITTED_TABLES:
        values = {key: value for key, value in result.values.items() if key.startswith(prefix)}
        if values:
            table.add_section()
            table.add_row(f"[{prefix.removesuffix('.')}]", "", "", "", "")
        for key, (parameter, value, interval) in values.items():
            bounds, mark = parameter.bounds, " *" if len(parameter.study_indices) > 1 else ""
            ranges = (f"{lower:.5g} to {upper:.5g}" for lower, upper in (interval, (bounds.lower, bounds.upper)))
            table.add_row(f"{key.removeprefix(prefix)}{mark}", bounds.unit, f"{value:.6g}", *ranges)
    console.print(table)
    if others and any(value.is_shared for value in result.values.values()):
        print_text(console, f"* shared with {', '.join(others)}")
    for name, used in result.used.items():
        fits = (used, result.held_back[name])
        print_by_metric(
            console,
            f"{name}: rows used / held back",
            {
                "Spearman's rho": [fit.spearman for fit in fits],
                "mean abs. error": [fit.mean_absolute_error for fit in fits],
                "bias": [fit.bias for fit in fits],
            },
        )
    for name, fitted in result.values.items():
        if fitted.is_on_bound:
            console.print(f"{name} lies on its bound: a wider bound may fit better.", markup=False)
    console.print(result.loss_line)
