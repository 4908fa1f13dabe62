"""Commands that simulate many settings to answer a question: explain, opinion, tolerance, risk, rules."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from safevar_sumo.analysis.explain import ExplainOptions
from safevar_sumo.analysis.opinion import OpinionOptions
from safevar_sumo.analysis.options import Options
from safevar_sumo.analysis.risk import RiskOptions
from safevar_sumo.analysis.rules import RulesOptions
from safevar_sumo.analysis.subject import study_in
from safevar_sumo.analysis.tolerance import ToleranceOptions
from safevar_sumo.cli.arguments import PICTURE_ENDINGS, check_output
from safevar_sumo.cli.program import commands
from safevar_sumo.cli.target import (
    CommandFunction,
    add_flags,
    as_it_is_now_option,
    jobs_option,
    json_option,
    load_results_or_study,
    point_option,
)
from safevar_sumo.errors import InputError
from safevar_sumo.progress import open_progress
from safevar_sumo.results import make_directory, write_whole
from safevar_sumo.terminal import print_answer


def add_question(
    options: type[Options], metavar: str, *further_decorators: Callable[[CommandFunction], CommandFunction]
) -> Callable[[CommandFunction], click.Command]:
    """Decorator of a question's command: adds flags for its options, and flags that all questions share."""

    def add(command: CommandFunction) -> click.Command:
        decorators: list[Callable[[CommandFunction], CommandFunction]] = [
            click.argument("source", metavar=metavar),
            add_flags(options),
            point_option,
            as_it_is_now_option,
            jobs_option,
            json_option,
            *further_decorators,
        ]
        for decorator in reversed(decorators):
            command = decorator(command)
        return commands.command(name=options.question)(command)

    return add


def _compute_with_bar(compute: Callable[..., Any], subject: Any, options: Options, jobs: int | None) -> Any:
    """Compute a result; a bar on the terminal shows the progress."""
    with open_progress(True) as progress:
        return compute(subject, options, jobs=jobs, progress=progress)


def _to_json(result: Any) -> str:
    return json.dumps(result.to_dict(), indent=2, allow_nan=False)


def _print(result: Any, as_json: bool) -> None:
    if as_json:
        click.echo(_to_json(result))
    else:
        print_answer(Console(), result.study, result.no_verdict, result.sentences())


def _plot_option(help_text: str) -> Callable[[CommandFunction], CommandFunction]:
    return click.option("--plot", type=click.Path(path_type=Path), metavar="FILE", help=help_text)


@add_question(
    ExplainOptions,
    "DIR|STUDY",
    click.option("--full", is_flag=True, help="Print every explanation in full, not only the answer."),
    click.option(
        "--out",
        type=click.Path(path_type=Path),
        metavar="DIR",
        help="Write causes.json, causes.csv and a figure there.",
    ),
)
def explain(
    source: str, full: bool, point: str | None, jobs: int | None, as_json: bool, out: Path | None, **values: Any
) -> None:
    """Explain failures of results in DIR, or across the domain of STUDY: which changes cause them, how small a change
    is enough, why.
    """
    from safevar_sumo.analysis.explain.compute import explain_failures
    from safevar_sumo.analysis.explain.sentences import print_explained
    from safevar_sumo.analysis.figures import save

    subject = load_results_or_study(source, point)
    if out is not None:
        make_directory(out)
    result = _compute_with_bar(explain_failures, subject, ExplainOptions(**values), jobs)
    if as_json:
        click.echo(_to_json(result))
    else:
        print_explained(Console(), source, result, point or "", full=full)
    if out is not None:
        write_whole(out / "causes.json", _to_json(result) + "\n")
        write_whole(out / "causes.csv", result.to_frame().to_csv(index=False, lineterminator="\n"))
        save(result.figure(), out / "necessity.png")
        click.echo(f"Causes: {out}", err=as_json)


@add_question(
    OpinionOptions,
    "DIR",
    click.option("--solutions", "lists", multiple=True, hidden=True, help="Another name of --solution."),
    click.argument("handles", nargs=-1, metavar=""),
)
def opinion(
    source: str,
    lists: tuple[str, ...],
    handles: tuple[str, ...],
    point: str | None,
    jobs: int | None,
    as_json: bool,
    **values: Any,
) -> None:
    """Check the minimal causes of failures of results in DIR with a second vehicle model."""
    from safevar_sumo.analysis.opinion.compute import ask_for_opinions

    texts = (*values.pop("solutions"), *lists, *handles)
    options = OpinionOptions(solutions=tuple(name.strip() for text in texts for name in text.split(",")), **values)
    result = _compute_with_bar(ask_for_opinions, load_results_or_study(source, point, results_only=True), options, jobs)
    if as_json:
        for note in result.notes:
            click.echo(f"note: {note}", err=True)
    _print(result, as_json)


@add_question(ToleranceOptions, "STUDY|DIR", _plot_option("Draw the profiles to this file: png, pdf or svg."))
def tolerance(
    source: str, point: str | None, jobs: int | None, as_json: bool, plot: Path | None, **values: Any
) -> None:
    """Find how far each characteristic of STUDY may go: alone, in pairs, and all together."""
    from safevar_sumo.analysis.figures import save
    from safevar_sumo.analysis.tolerance.compute import find_tolerances

    subject = load_results_or_study(source, point)
    if plot is not None:
        check_output(plot, "--plot", PICTURE_ENDINGS)
    result = _compute_with_bar(find_tolerances, subject, ToleranceOptions(**values), jobs)
    _print(result, as_json)
    if plot is not None:
        save(result.figure(), plot, "--plot")


@add_question(RiskOptions, "STUDY|DIR", _plot_option("Draw the sensitivity indices to this file: png, pdf or svg."))
def risk(source: str, point: str | None, jobs: int | None, as_json: bool, plot: Path | None, **values: Any) -> None:
    """Estimate how likely an unsafe outcome is if vehicles vary as defined in STUDY's [variation], and which
    characteristics decide it.
    """
    from safevar_sumo.analysis.figures import save
    from safevar_sumo.analysis.risk.compute import estimate_risk

    options, subject = RiskOptions(**values), load_results_or_study(source, point)
    study = study_in(subject)
    if plot is not None:
        check_output(plot, "--plot", PICTURE_ENDINGS)
        if study.correlations:
            raise InputError(
                "--plot",
                "sensitivity indices of correlated characteristics are not defined",
                "a study without correlations",
            )
        if options.requires_rare_method:
            raise InputError(
                "--plot", "a method for rare failures computes no sensitivity indices to draw", "--method auto"
            )
    result = _compute_with_bar(estimate_risk, subject, options, jobs)
    if study.correlations:
        click.echo("note: no sensitivity indices: they are not defined for correlated characteristics", err=True)
    if result.errors:
        click.echo(f"warning: {result.errors} vehicles could not be simulated and are left out", err=True)
    _print(result, as_json)
    if plot is not None:
        save(result.figure(), plot, "--plot")


@add_question(RulesOptions, "STUDY|DIR")
def rules(source: str, point: str | None, jobs: int | None, as_json: bool, **values: Any) -> None:
    """Find rules, in physical units, that describe the unsafe settings of STUDY, from evenly spread settings instead of
    a search.
    """
    from safevar_sumo.analysis.rules.compute import find_rules

    result = _compute_with_bar(find_rules, load_results_or_study(source, point), RulesOptions(**values), jobs)
    if as_json and result.remark:
        click.echo(f"note: {result.remark}", err=True)
    _print(result, as_json)
