"""Commands that simulate many settings to answer a question: explain, tolerance, risk, rules."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from safevar_sumo.analysis.explain.options import ExplainOptions
from safevar_sumo.analysis.risk.options import RiskOptions
from safevar_sumo.analysis.rules.options import RulesOptions
from safevar_sumo.analysis.tolerance.options import ToleranceOptions
from safevar_sumo.cli.options import PICTURES, check_output
from safevar_sumo.cli.program import commands
from safevar_sumo.cli.target import jobs_option, json_option, now_option, options_of, point_option, results_or_study, study_at_point
from safevar_sumo.errors import InputError
from safevar_sumo.results import make_directory, write_whole


@commands.command()
@click.argument("place", metavar="DIR|STUDY")
@options_of(ExplainOptions)
@click.option("--full", is_flag=True, help="Print every explanation in full, not the answer alone.")
@point_option
@now_option
@jobs_option
@json_option
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Write causes.json, causes.csv and a picture there.")
def explain(place: str, full: bool, point: str | None, jobs: int | None, as_json: bool, out: Path | None, **given: Any) -> None:
    """Explain failures of results in DIR, or all over the domain of STUDY: which changes did it, how little is enough, why."""
    from safevar_sumo.analysis.explain.compute import explain_failures
    from safevar_sumo.analysis.explain.render import print_explained
    from safevar_sumo.analysis.figures import necessity_figure, save
    from safevar_sumo.terminal import stages

    source = results_or_study(place, point)
    if out is not None:
        make_directory(out)
    with stages(Console(stderr=True)) as progress:
        told = explain_failures(source, **ExplainOptions(**given).keywords(), jobs=jobs, progress=progress)
    records = json.dumps(told.records(), indent=2, allow_nan=False)
    if as_json:
        click.echo(records)
    else:
        print_explained(Console(), place, told, point or "", full=full)
    if out is not None:
        write_whole(out / "causes.json", records + "\n")
        write_whole(out / "causes.csv", told.frame().to_csv(index=False, lineterminator="\n"))
        save(necessity_figure(told), out / "necessity.png")
        click.echo(f"Causes: {out}", err=as_json)


@commands.command()
@click.argument("place", metavar="STUDY|DIR")
@options_of(ToleranceOptions)
@point_option
@now_option
@jobs_option
@json_option
@click.option("--plot", type=click.Path(path_type=Path), metavar="FILE",
              help="Draw the profiles here: png, pdf or svg; with --pairs, the worst pairs in a second file beside it.")
def tolerance(place: str, point: str | None, jobs: int | None, as_json: bool, plot: Path | None, **given: Any) -> None:
    """Find how far each characteristic of STUDY may go: alone, in pairs, and all together."""
    from safevar_sumo.analysis.figures import pairs_figure, profiles_figure, save
    from safevar_sumo.analysis.tolerance.compute import find_tolerances
    from safevar_sumo.analysis.tolerance.render import print_tolerance
    from safevar_sumo.terminal import stages

    options, chosen = ToleranceOptions(**given), study_at_point(place, point)
    second = None if plot is None else plot.with_stem(f"{plot.stem}-pairs")
    for path in (plot, second if options.pairs else None):
        if path is not None:
            check_output(path, "--plot", PICTURES)
    with stages(Console(stderr=True)) as progress:
        told = find_tolerances(chosen, **options.keywords(), jobs=jobs, progress=progress)
    if as_json:
        click.echo(json.dumps(told.record(), indent=2, allow_nan=False))
    else:
        print_tolerance(Console(), told)
    if plot is not None and second is not None:
        save(profiles_figure(told), plot, "--plot")
        if told.pairs:
            save(pairs_figure(told), second, "--plot")


@commands.command()
@click.argument("place", metavar="STUDY|DIR")
@options_of(RiskOptions)
@point_option
@now_option
@jobs_option
@json_option
@click.option("--plot", type=click.Path(path_type=Path), metavar="FILE", help="Draw what decides here: png, pdf or svg.")
def risk(place: str, point: str | None, jobs: int | None, as_json: bool, plot: Path | None, **given: Any) -> None:
    """Estimate how likely an unsafe outcome is when vehicles vary as STUDY says under [variation], and what decides."""
    from safevar_sumo.analysis.figures import save, sensitivity_figure
    from safevar_sumo.analysis.risk.compute import estimate_risk
    from safevar_sumo.analysis.risk.render import print_risk
    from safevar_sumo.terminal import stages

    chosen = study_at_point(place, point)
    if plot is not None:
        check_output(plot, "--plot", PICTURES)
        if chosen.correlations:
            raise InputError("--plot", "sensitivity indices of correlated characteristics are not defined", "a study without correlations")
    with stages(Console(stderr=True)) as progress:
        told = estimate_risk(chosen, **RiskOptions(**given).keywords(), jobs=jobs, progress=progress)
    if told.sensitivity is None:
        click.echo("note: characteristics are correlated, for which sensitivity indices are not defined: there are none", err=True)
    if told.errors:
        click.echo(f"warning: {told.errors} vehicles could not be simulated and are left out", err=True)
    if as_json:
        click.echo(json.dumps(told.record(), indent=2, allow_nan=False))
    else:
        print_risk(Console(), told)
    if plot is not None:
        save(sensitivity_figure(told), plot, "--plot")


@commands.command()
@click.argument("place", metavar="STUDY|DIR")
@options_of(RulesOptions)
@point_option
@now_option
@jobs_option
@json_option
def rules(place: str, point: str | None, jobs: int | None, as_json: bool, **given: Any) -> None:
    """Find rules that tell where STUDY is unsafe, in physical units, from settings spread evenly and never from what a search found."""
    from safevar_sumo.analysis.rules.compute import find_rules
    from safevar_sumo.analysis.rules.render import print_rules
    from safevar_sumo.terminal import stages

    with stages(Console(stderr=True)) as progress:
        told = find_rules(study_at_point(place, point), **RulesOptions(**given).keywords(), jobs=jobs, progress=progress)
    if as_json:
        if told.remark:
            click.echo(f"note: {told.remark}", err=True)
        click.echo(json.dumps(told.records(), indent=2, allow_nan=False))
    else:
        print_rules(Console(), told)
