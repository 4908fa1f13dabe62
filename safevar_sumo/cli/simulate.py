"""The command that simulates a study once."""

from __future__ import annotations

import json
from pathlib import Path

import click
import numpy as np
from rich.console import Console

from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import time_to_collision
from safevar_sumo.records import Drives, FloatArray
from safevar_sumo.results import record
from safevar_sumo.simulation import Engine, assemble, score, simulate
from safevar_sumo.study import load_study
from safevar_sumo.terminal.simulation import print_evaluation


@commands.command(name="simulate")
@click.argument("study")
@click.option("--set", "changes", multiple=True, metavar="NAME=VALUE", help="A characteristic's value, in its unit; may be repeated.")
@click.option("--no-filter", is_flag=True, help="Keep changes that are smaller than the filter's thresholds.")
@click.option("--trace", type=click.Path(path_type=Path), metavar="FILE.csv", help="Write the run, step by step.")
@click.option("--gui", is_flag=True, help="Show it in sumo-gui.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def simulate_command(study: str, changes: tuple[str, ...], no_filter: bool, trace: Path | None, gui: bool, as_json: bool) -> None:
    """Simulate STUDY once."""
    chosen = load_study(study)
    system = assemble(chosen, study)
    setting = system.characteristics.setting(_assignments(changes), "--set")[np.newaxis]
    if not no_filter:
        setting = system.characteristics.filter(setting)
    run = simulate(system, setting, Engine.GUI if gui else Engine.LIBSUMO)
    if trace is not None:
        _write_trace(trace, run)
    values = dict(zip(system.characteristics.names, setting[0].tolist(), strict=True))
    result = {"study": chosen.name, "vcs": values, **record(score(system, setting, run), 0)}
    if as_json:
        click.echo(json.dumps(result, indent=2, allow_nan=False))
    else:
        print_evaluation(Console(), chosen, result, system.characteristics)


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
