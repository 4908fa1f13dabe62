"""Commands that hand results on: `export` for other simulators."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from safevar_sumo.cli.arguments import as_it_is_now_option, load_target, point_option
from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError
from safevar_sumo.sumo.matrix import system_at_point
from safevar_sumo.sumo.system import assemble


@commands.command()
@click.argument("directory", metavar="RESULTS")
@click.option("--solution", required=True, metavar="ALG:RUN:N", help="The solution to export; N counts from 0.")
@point_option
@click.option("--to", required=True, type=click.Choice(["carla", "openscenario"]), help="What reads it.")
@click.option("--out", required=True, type=click.Path(path_type=Path), metavar="DIR", help="A new directory.")
@as_it_is_now_option
def export(directory: str, solution: str, point: str | None, to: str, out: Path) -> None:
    """Write a solution's simulation for CARLA (a script and the vehicle's values), or as OpenSCENARIO and OpenDRIVE."""
    from safevar_sumo.replay import export as files
    from safevar_sumo.replay.comparison import compare_setting

    if out.exists() or out.is_symlink():
        raise InputError("--out", f"{out} exists", "a new directory")
    subject = load_target(directory, solution, None)
    assert subject.setting is not None
    system = assemble(subject.study, directory)
    values = dict(zip(system.characteristics.names, subject.setting.tolist(), strict=True))
    physics = files.carla_physics(values, directory) if to == "carla" else {}
    at_point = system if point is None else system_at_point(system, point, source="--point")
    comparison = compare_setting(subject.study, at_point, np.array(subject.setting))
    files.export(comparison, to, out, solution, physics)
    click.echo(f"{to}: {out}")
