"""The command that simulates a study once, or as often as a sweep has values."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.console import Console

from safevar_sumo.api.settings import evaluated
from safevar_sumo.api.simulation import Simulation, beside_the_original
from safevar_sumo.cli.completion import complete_changes, complete_study
from safevar_sumo.cli.display.simulation import print_matrix, print_simulation, print_sweep
from safevar_sumo.cli.options import read_changes, refuse_inputs, settings_of
from safevar_sumo.cli.program import commands
from safevar_sumo.cli.replay import Shown, showing_options
from safevar_sumo.cli.target import Target, now_option, replay_options, target_of
from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray
from safevar_sumo.results import record
from safevar_sumo.scenarios import tags
from safevar_sumo.study import check_writable
from safevar_sumo.sumo.matrix import at_every_point, named_point, point_record, remarks_of, vehicle_remarks
from safevar_sumo.sumo.system import System, assemble


@commands.command(name="simulate")
@click.argument("study", metavar="STUDY|DIR", shell_complete=complete_study)
@replay_options
@click.option("--set", "changes", multiple=True, metavar="NAME=VALUE", shell_complete=complete_changes,
              help="A characteristic's value in its unit, +10% of the original, or a sweep FROM..TO; may be repeated for others.")
@click.option("--no-filter", is_flag=True, help="Keep changes that are smaller than the filter's thresholds.")
@click.option("--beyond", is_flag=True, help="Take values beyond the domains too.")
@click.option("--trace", type=click.Path(path_type=Path), metavar="FILE.csv", help="Write the simulation step by step.")
@showing_options
@now_option
@click.option("--point", metavar="NAME", help="Of a study with a matrix: this point alone.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def simulate_command(study: str, solution: str | None, choice: str | None, changes: tuple[str, ...], no_filter: bool, beyond: bool,
                     trace: Path | None, point: str | None, as_json: bool, **shown: Any) -> None:
    """Simulate STUDY once, or a solution of the results directory DIR with the study as recorded there."""
    target, showing = target_of(study, solution, choice), Shown(**shown)
    system = assemble(target.study, target.source)
    if point is not None:
        system = named_point(system, point, "--point")
    swept = read_changes(changes, system.characteristics, beyond)
    base = system.characteristics.original if target.setting is None else target.setting
    asked = settings_of(swept, base, system.characteristics)
    _check_outputs(study, trace, showing)
    if any(len(values) > 1 for values in swept.values()):
        if trace is not None or showing.asked:
            raise InputError("--set", f"{' '.join(changes)} is a sweep", "one value for each with --trace, --plot, --animate or --gui")
        _sweep(target, system, asked, tuple(swept), not no_filter, as_json)
        return
    found = beside_the_original(target.study, system, asked[0], filtered=not no_filter)
    if target.recorded is not None and not changes:
        _warn_of_differences(target, found)
    if trace is not None:
        _write_trace(trace, found)
    if showing.asked:
        showing.show(target.study, system, found.evaluation.settings[0])
    _tell(target, system, found, as_json)


def _check_outputs(study: str, trace: Path | None, showing: Shown) -> None:
    if trace is not None:
        refuse_inputs(trace, "--trace", study)
        check_writable(trace, "--trace")
    if showing.asked:
        showing.check(study)
        if trace is not None and trace.resolve() in showing.files:
            raise InputError("--trace", f"{trace} is what --plot or --animate writes", "another file")


def _sweep(target: Target, system: System, asked: FloatArray, names: tuple[str, ...], filtered: bool, as_json: bool) -> None:
    settings = system.characteristics.filter(asked) if filtered else asked
    found = evaluated(target.study, np.concatenate([system.characteristics.original[np.newaxis], settings]))
    original, rows = found.take([0]), found.take(np.arange(1, len(found)))
    if as_json:
        told = [{"study": target.study.name, "vcs": dict(zip(system.characteristics.names, rows.settings[row].tolist(), strict=True)),
                 **record(rows, row)} for row in range(len(rows))]
        click.echo(json.dumps(told, indent=2, allow_nan=False))
    else:
        print_sweep(Console(), target.study, names, original, rows)
    back = int(np.count_nonzero((settings != asked).any(axis=1)))
    if back:
        click.echo(f"note: in {back} of {len(asked)} settings the filter put a change back that is too small; --no-filter keeps them",
                   err=True)


def _tell(target: Target, system: System, found: Simulation, as_json: bool) -> None:
    points = at_every_point(system, found.evaluation.settings) if system.matrix else []
    if as_json:
        replayed = {} if target.handle is None else {"solution": str(target.handle)}
        matrix = {"points": [point_record(one) for one in points]} if points else {}
        click.echo(json.dumps({**found.record(), **replayed, **matrix}, indent=2, allow_nan=False))
    else:
        print_simulation(Console(), found)
        print_matrix(Console(), points)
        Console().print(tags(system.points), soft_wrap=True, markup=False, highlight=False)
    remarks = [remark for one in system.points for remark in remarks_of(one.scenario)]
    for remark in dict.fromkeys([*remarks, *system.remarks, *vehicle_remarks(system)]):
        click.echo(f"note: {remark}", err=True)
    for name, value in found.put_back.items():
        click.echo(f"note: {name} = {value:g} is so near the original that the filter put {found.setting[name]:g} back; "
                   "--no-filter keeps it", err=True)


def _warn_of_differences(target: Target, found: Simulation) -> None:
    """A replay gives what was recorded, or there is a reason to be told."""
    from safevar_sumo.replay.comparison import differences

    assert target.recorded is not None
    for one in differences(found.evaluation, target.recorded):
        click.echo(f"warning: {target.handle} of {target.source}: {one}; other versions or code than those of the study?", err=True)


def _write_trace(path: Path, found: Simulation) -> None:
    """One row per simulation step, units in the header."""
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            found.trace.to_csv(file, index=False, lineterminator="\n")
    except OSError as error:
        raise InputError("--trace", f"cannot write {path}: {error.strerror or error}", "a file in a directory that exists") from None
