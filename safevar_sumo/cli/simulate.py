"""The command that simulates a study once."""

from __future__ import annotations

import json
from pathlib import Path

import click
import numpy as np
from rich.console import Console

from safevar_sumo.cli.outputs import PICTURES, check_output
from safevar_sumo.cli.program import commands
from safevar_sumo.cli.target import Target, replay_options, target_of
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import time_to_collision
from safevar_sumo.records import Drives, Evaluations, FloatArray
from safevar_sumo.results import record
from safevar_sumo.simulation import Engine, System, assemble, score, simulate
from safevar_sumo.study import Study
from safevar_sumo.terminal.simulation import print_evaluation
from safevar_sumo.vehicles import CharacteristicSet


@commands.command(name="simulate")
@click.argument("study", metavar="STUDY|DIR")
@replay_options
@click.option("--set", "changes", multiple=True, metavar="NAME=VALUE", help="A characteristic's value, in its unit; may be repeated.")
@click.option("--no-filter", is_flag=True, help="Keep changes that are smaller than the filter's thresholds.")
@click.option("--trace", type=click.Path(path_type=Path), metavar="FILE.csv", help="Write the run, step by step.")
@click.option("--plot", type=click.Path(path_type=Path), metavar="FILE", help="Draw it beside the original vehicle: png, pdf or svg.")
@click.option("--gui", is_flag=True, help="Show it in sumo-gui.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def simulate_command(study: str, solution: str | None, choice: str | None, changes: tuple[str, ...], no_filter: bool, trace: Path | None,
                     plot: Path | None, gui: bool, as_json: bool) -> None:
    """Simulate STUDY once, or a solution of the results directory DIR with the study as recorded there."""
    target = target_of(study, solution, choice)
    chosen = target.study
    system = assemble(chosen, target.source)
    setting = _setting(system.characteristics, target, changes)[np.newaxis]
    if not no_filter:
        setting = system.characteristics.filter(setting)
    if plot is not None:
        check_output(plot, "--plot", PICTURES)
    run = simulate(system, setting, Engine.GUI if gui else Engine.LIBSUMO)
    evaluations = score(system, setting, run)
    if target.recorded is not None and not changes:
        _warn_of_differences(target, evaluations)
    if trace is not None:
        _write_trace(trace, run)
    if plot is not None:
        _draw(plot, chosen, system, setting[0])
    values = dict(zip(system.characteristics.names, setting[0].tolist(), strict=True))
    result = {"study": chosen.name, "vcs": values, **record(evaluations, 0)}
    if target.handle is not None:
        result["solution"] = str(target.handle)
    if as_json:
        click.echo(json.dumps(result, indent=2, allow_nan=False))
    else:
        print_evaluation(Console(), chosen, result, system.characteristics)


def _setting(characteristics: CharacteristicSet, target: Target, changes: tuple[str, ...]) -> FloatArray:
    """The replayed solution's values or the original's, and over them what `--set` says; shape (n,)."""
    given = characteristics.setting(_assignments(changes), "--set")
    if target.setting is None:
        return given
    named = np.isin(characteristics.names, list(_assignments(changes)))
    return np.where(named, given, target.setting)


def _warn_of_differences(target: Target, evaluations: Evaluations) -> None:
    """A replay gives what was recorded, or there is a reason to be told."""
    from safevar_sumo.showing import differences

    assert target.recorded is not None
    for one in differences(evaluations, target.recorded):
        click.echo(f"warning: {target.handle} of {target.source}: {one}; other versions or code than those of the study?", err=True)


def _draw(path: Path, study: Study, system: System, setting: FloatArray) -> None:
    from safevar_sumo.showing import compare, draw_comparison, write_figure

    write_figure(draw_comparison(compare(study, system, setting)), path)


def _assignments(changes: tuple[str, ...]) -> dict[str, float]:
    values = {}
    for change in changes:
        name, _, text = change.partition("=")
        try:
            values[name] = float(text)
        except ValueError:
            raise InputError("--set", repr(change), "NAME=VALUE with a number in the characteristic's unit") from None
    return values


def _write_trace(path: Path, run: Drives) -> None:
    """One row per simulation step of the only vehicle, units in the header."""
    import pandas as pd  # takes longer to load than the simulation

    trace = run.trace
    shown = trace.active[:, 0]
    acceleration = np.diff(trace.speed, axis=0, prepend=trace.speed[:1]) / trace.step
    columns: dict[str, FloatArray] = {
        "time [s]": trace.time[:, np.newaxis], "position [m]": trace.position, "speed [m/s]": trace.speed,
        "acceleration [m/s^2]": acceleration, "gap [m]": trace.gap, "ttc [s]": time_to_collision(run),
        "throttle [-]": trace.throttle, "brake [-]": trace.brake, "gear [-]": trace.gear}
    frame = pd.DataFrame({name: values[shown, 0] for name, values in columns.items()}).replace(np.inf, np.nan)
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            frame.to_csv(file, index=False, lineterminator="\n")
    except OSError as error:
        raise InputError("--trace", f"cannot write {path}: {error.strerror or error}", "a file in a directory that exists") from None
