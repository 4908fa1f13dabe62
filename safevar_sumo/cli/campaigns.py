"""Commands that simulate, and what there is to simulate."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import msgspec
import numpy as np
import pandas as pd
from rich.console import Console

from safevar_sumo import terminal
from safevar_sumo.ads import ADS
from safevar_sumo.analysis import agreement, plot_agreement, read_reference
from safevar_sumo.calibration import calibrate, calibration_comment
from safevar_sumo.campaign import RunKey, algorithm_of, all_runs, carry_out, forecast
from safevar_sumo.cli.program import commands
from safevar_sumo.computing import available_cores, cluster_pool, local_pool
from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.metrics import METRICS, time_to_collision
from safevar_sumo.records import FloatArray, Run
from safevar_sumo.results import ResultsDirectory, record
from safevar_sumo.scenarios import SCENARIOS, WEATHERS
from safevar_sumo.search import ALGORITHMS
from safevar_sumo.simulation import Engine, assemble, score, simulate
from safevar_sumo.study import Study, check_writable, load_study, study_names, write_study
from safevar_sumo.validation import evaluate_all
from safevar_sumo.vehicles import VEHICLES, CharacteristicSet


@commands.command()
@click.argument("study")
@click.option("--runs", type=click.IntRange(min=1), help="Runs of each algorithm.")
@click.option("--evaluations", type=click.IntRange(min=1), help="Simulations of each run.")
@click.option("--algorithms", help="Which algorithms, separated by commas.")
@click.option("--seed", type=click.IntRange(min=0, max=2**63 - 1), help="Seed of the whole study.")
@click.option("--batch", type=click.IntRange(min=1),
              help="Settings per SUMO simulation; never changes a result.  [default: the population's size]")
@click.option("--out", type=click.Path(path_type=Path), help="Directory of the results.  [default: results/STUDY]")
@click.option("--jobs", type=click.IntRange(min=1), help="Worker processes.  [default: the cores of this machine]")
@click.option("--cluster", metavar="ADDRESS", help="Compute on the workers of this Dask scheduler instead.")
@click.option("--only", metavar="ALGORITHM:RUN", help="This run alone, the first run is 0.")
@click.option("--shard", metavar="K/N", help="Every N-th run, from the K-th (1..N): for job arrays that share --out.")
@click.option("--quiet", is_flag=True, help="Print errors and warnings alone.")
@click.option("--dry-run", is_flag=True, help="Tell what would run, how long and how much disk it would take.")
def study(study: str, batch: int | None, out: Path | None, jobs: int | None, cluster: str | None, only: str | None, shard: str | None,
          quiet: bool, dry_run: bool, **options: Any) -> None:
    """Search STUDY; the same command again goes on where it was stopped."""
    chosen = _with_options(load_study(study), **options)
    assemble(chosen)
    for name in chosen.search.algorithms:
        algorithm_of(name, chosen)
    keys = _selected(all_runs(chosen), only, shard)
    limit = chosen.search.time_limit
    with cluster_pool(cluster, limit) if cluster is not None else local_pool(jobs or available_cores(), limit) as pool:
        if dry_run:
            terminal.print_forecast(Console(), chosen, len(keys), forecast(chosen, len(keys), pool, batch))
            return
        results = ResultsDirectory(out or Path("results") / chosen.name, chosen)
        with terminal.CampaignProgress(Console(stderr=True), chosen, keys, quiet) as progress:
            campaign = carry_out(chosen, keys, results, pool, progress, batch)
    if campaign.busy:
        raise SafevarError(f"another process works on {', '.join(map(str, campaign.busy))}: the same command later finishes the study")
    if keys == all_runs(chosen):
        results.finish(campaign.solutions)
    if not quiet:
        terminal.print_summary(Console(), chosen, campaign, results.path)
        Console().print(f"Results: {results.path}", soft_wrap=True)


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
    system = assemble(chosen)
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
        terminal.print_evaluation(Console(), chosen, result, system.characteristics)


@commands.command()
@click.argument("study")
@click.argument("reference", type=click.Path(path_type=Path), metavar="REFERENCE.csv")
@click.option("--jobs", type=click.IntRange(min=1), help="Worker processes.  [default: the cores of this machine]")
@click.option("--plot", type=click.Path(path_type=Path), metavar="FILE.png", help="Draw here against reference.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def validate(study: str, reference: Path, jobs: int | None, plot: Path | None, as_json: bool) -> None:
    """Compare STUDY with settings and metrics in the published package's CSV format."""
    chosen = load_study(study)
    system = assemble(chosen)
    data = read_reference(reference, system.characteristics)
    if data.skipped:
        click.echo(f"warning: {reference}: {data.skipped} rows with values outside the domains are left out", err=True)
    settings = np.concatenate([system.characteristics.original[np.newaxis], data.settings])
    with (local_pool(jobs or available_cores(), chosen.search.time_limit) as pool,
          terminal.counted(Console(stderr=True), "settings", len(np.unique(settings, axis=0))) as done):
        evaluations = evaluate_all(chosen, settings, pool, done)
    here = evaluations.take(np.arange(1, len(settings)))
    result = agreement(data, here, chosen.published, evaluations.take([0]))
    if plot is not None:
        plot_agreement(plot, f"{chosen.title}\nagainst {reference.name}", system.characteristics, data, here)
    if as_json:
        click.echo(json.dumps(result.to_dict(), indent=2, allow_nan=False))
    else:
        terminal.print_agreement(Console(), chosen, result)


@commands.command(name="calibrate")
@click.argument("study")
@click.argument("references", type=click.Path(path_type=Path), nargs=-1, metavar="[REFERENCE.csv]...")
@click.option("--trials", type=click.IntRange(min=1), default=400, show_default=True, help="How many sets of parameters are tried.")
@click.option("--seed", type=click.IntRange(min=0, max=2**63 - 1), default=1, show_default=True, help="Seed of the search.")
@click.option("--jobs", type=click.IntRange(min=1), help="Worker processes.  [default: the cores of this machine]")
@click.option("--out", type=click.Path(path_type=Path), metavar="FILE.toml", help="Study file to write.  [default: STUDY-calibrated.toml]")
def calibrate_command(study: str, references: tuple[Path, ...], trials: int, seed: int, jobs: int | None, out: Path | None) -> None:
    """Fit what STUDY declares under [calibration] to the published values and to half of the rows of reference files."""
    chosen = load_study(study)
    system = assemble(chosen)
    target = out or Path(f"{chosen.name}-calibrated.toml")
    check_writable(target)
    data = {path.name: read_reference(path, system.characteristics) for path in references}
    with (local_pool(jobs or available_cores(), chosen.search.time_limit) as pool,
          terminal.trials(Console(stderr=True), trials) as done):
        found = calibrate(chosen, data, pool, trials, seed, done)
    write_study(target, found.study, calibration_comment(found, chosen, references, trials, seed))
    terminal.print_calibration(Console(), chosen, found)
    Console().print(f"Study file: {target}", soft_wrap=True)


@commands.command(name="list")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def list_command(as_json: bool) -> None:
    """List studies, vehicles, ADSs, scenarios, weathers, algorithms and metrics."""
    studies = [load_study(name) for name in study_names()]
    if as_json:
        click.echo(json.dumps(_catalogue(studies), indent=2))
    else:
        _print_catalogue(Console(), studies)


def _with_options(study: Study, algorithms: str | None, **numbers: int | None) -> Study:
    """The study with a command's options in place of its own search table."""
    changes: dict[str, Any] = {name: value for name, value in numbers.items() if value is not None}
    if algorithms is not None:
        changes["algorithms"] = list(dict.fromkeys(name.strip() for name in algorithms.split(",")))
    return msgspec.structs.replace(study, search=msgspec.structs.replace(study.search, **changes))


def _selected(keys: list[RunKey], only: str | None, shard: str | None) -> list[RunKey]:
    """The runs that a command asks for."""
    if only is not None:
        algorithm, _, run = only.rpartition(":")
        keys = [key for key in keys if key.algorithm == algorithm and str(key.run) == run]
        if not keys:
            raise InputError("--only", repr(only), "ALGORITHM:RUN, an algorithm of the study and a run from 0 to less than --runs")
    if shard is not None:
        first, _, number = shard.partition("/")
        if not (first.isdecimal() and number.isdecimal() and 1 <= int(first) <= int(number)):
            raise InputError("--shard", repr(shard), "K/N, with K in 1..N")
        keys = keys[int(first) - 1::int(number)]
    return keys


def _assignments(changes: tuple[str, ...]) -> dict[str, float]:
    values = {}
    for change in changes:
        name, _, text = change.partition("=")
        try:
            values[name] = float(text)
        except ValueError:
            raise InputError("--set", repr(change), "NAME=VALUE with a number in the characteristic's unit") from None
    return values


def _write_trace(path: Path, run: Run) -> None:
    """One row per simulation step of the only vehicle, units in the header."""
    trace = run.trace
    shown = trace.active[:, 0]
    acceleration = np.diff(trace.speed, axis=0, prepend=trace.speed[:1]) / trace.step
    columns: dict[str, FloatArray] = {
        "time [s]": trace.time[:, np.newaxis], "position [m]": trace.position, "speed [m/s]": trace.speed,
        "acceleration [m/s^2]": acceleration, "gap [m]": trace.gap, "ttc [s]": time_to_collision(run),
        "throttle [-]": trace.throttle, "brake [-]": trace.brake, "gear [-]": trace.gear}
    frame = pd.DataFrame({name: values[shown, 0] for name, values in columns.items()}).replace(np.inf, np.nan)
    try:
        frame.to_csv(path, index=False, lineterminator="\n")
    except OSError as error:
        raise InputError("--trace", f"cannot write {path}: {error.strerror or error}", "a file in a directory that exists") from None


def _catalogue(studies: list[Study]) -> dict[str, Any]:
    vehicles: dict[str, list[dict[str, Any]]] = {}
    for one in studies:
        vehicles.setdefault(one.vehicle.model, [
            {"name": member.name, "unit": member.unit, "original": member.original, "lower": member.lower, "upper": member.upper,
             "threshold": member.threshold} for member in CharacteristicSet.of(one.vehicle.characteristics)])
    return {
        "studies": [{"name": one.name, "title": one.title, "vehicle": one.vehicle.model, "ads": one.ads.model,
                     "scenario": one.scenario.model, "weather": _weather_name(one)} for one in studies],
        "vehicles": [{"name": name, "characteristics": vehicles.get(name, [])} for name in VEHICLES],
        "ads": [_described(name, cls) for name, cls in ADS.items()],
        "scenarios": [_described(name, cls) for name, cls in SCENARIOS.items()],
        "weathers": [msgspec.to_builtins(weather) for weather in WEATHERS.values()],
        "algorithms": [_described(name, cls) for name, cls in ALGORITHMS.items()],
        "metrics": [_described(name, metric) for name, metric in METRICS.items()],
    }


def _weather_name(study: Study) -> str:
    return study.weather if isinstance(study.weather, str) else study.weather.name


def _described(name: str, what: Callable[..., Any]) -> dict[str, str]:
    """Its name, and the first sentence of its docstring."""
    return {"name": name, "description": (what.__doc__ or "").strip().partition("\n")[0]}


def _print_catalogue(console: Console, studies: list[Study]) -> None:
    catalogue = _catalogue(studies)
    terminal.print_names(console, "Studies", [tuple(row.values()) for row in catalogue["studies"]],
                         ("name", "title", "vehicle", "ADS", "scenario", "weather"))
    for vehicle in catalogue["vehicles"]:
        rows = [(row["name"], row["unit"], *(f"{row[key]:g}" for key in ("original", "lower", "upper", "threshold")))
                for row in vehicle["characteristics"]]
        heads = ("characteristic", "unit", "original", "lower", "upper", "threshold")
        terminal.print_names(console, f"Vehicle {vehicle['name']}", rows, heads)
    weathers = [(row["name"], f"{row['road_friction']:g}", f"{row['visibility']:g}") for row in catalogue["weathers"]]
    terminal.print_names(console, "Weathers", weathers, ("name", "road friction", "visibility"))
    for title, key in (("ADSs", "ads"), ("Scenarios", "scenarios"), ("Algorithms", "algorithms"), ("Metrics", "metrics")):
        terminal.print_names(console, title, [(row["name"], row["description"]) for row in catalogue[key]], ("name", "what"))
