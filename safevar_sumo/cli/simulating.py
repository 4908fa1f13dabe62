"""What commands that simulate many settings of a study have in common: their options, and what they are asked about."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import click

from safevar_sumo.cli.ranges import Within
from safevar_sumo.options import Option, Options
from safevar_sumo.results.imported import UNKNOWN
from safevar_sumo.study import Study

if TYPE_CHECKING:
    from safevar_sumo.analysis import Case

jobs_option = click.option("--jobs", type=click.IntRange(1, 1024), help="Worker processes.  [default: the cores of this machine]")
point_option = click.option("--point", metavar="NAME", help="Of a study with a matrix: ask about this point of it alone.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
Command = Callable[..., Any]
AS_IT_IS_NOW = "safevar_sumo.as_it_is_now"
"""Where the context of a command keeps that flag, for whatever of it reads a results directory."""


def _keep(context: click.Context, _option: click.Parameter, value: bool) -> None:
    context.meta[AS_IT_IS_NOW] = value


now_option = click.option(
    "--as-it-is-now", is_flag=True, expose_value=False, callback=_keep,
    help="Simulate with the files and versions that are there now where results were computed with others, and say so.")


def as_it_is_now() -> bool:
    """Whether the command that runs was given that flag."""
    return bool(click.get_current_context().meta.get(AS_IT_IS_NOW))


def options_of(question: type[Options]) -> Callable[[Command], Command]:
    """The flags of a question's options; the command's keywords make the record, `question(**keywords)`."""
    def add(command: Command) -> Command:
        for one in reversed(fields(question)):
            command = _flag(question.flags()[one.name], one.name, one.default, question.described()[one.name])(command)
        return command

    return add


def _flag(flag: str, name: str, default: Any, option: Option) -> Callable[[Command], Command]:
    if option.kind is bool:
        return click.option(flag, name, is_flag=True, default=default, help=option.help)
    if option.form != "one":
        return click.option(flag, name, multiple=option.form == "repeated", metavar=option.metavar, help=option.help,
                            callback=lambda _context, _option, value: _names(value) if option.form == "commas" else value)
    (low_open, high_open), shows = option.is_open, default is not None
    kind: click.ParamType[Any] = click.STRING
    if option.kind is int:
        kind = click.IntRange(option.low, option.high)  # type: ignore[arg-type]
    elif option.kind is float:
        kind = Within(option.low, option.high, min_open=low_open, max_open=high_open)
    return click.option(flag, name, type=kind, default=default, show_default=shows, metavar=option.metavar, help=option.help)


def _names(text: str | None) -> tuple[str, ...] | None:
    """Names between commas."""
    return None if text is None else tuple(name.strip() for name in text.split(","))


def results_or_study(place: str, point: str | None = None) -> Study | Case:
    """The case in a results directory, or a study by name or path; at one point of its matrix if one is named.

    Raises
    ------
    InputError
        If it is neither, or has no such point.
    """
    from safevar_sumo.api.results import study_or_case

    with warnings.catch_warnings(record=True) as changed:
        warnings.simplefilter("always", UserWarning)
        found = study_or_case(place, as_it_is_now=as_it_is_now())
    for one in changed:
        click.echo(f"warning: {one.message}", err=True)
    if point is None:
        return found
    if isinstance(found, Study):
        return _at(found, point)
    return replace(found, study=_at(found.study, point), solutions=found.solutions.assign(outcome=UNKNOWN))


def _at(study: Study, point: str) -> Study:
    from safevar_sumo.simulation import study_at

    return study_at(study, point, "--point")


def study_of(place: str, point: str | None = None) -> Study:
    """The study that is named, or the one that a results directory records; raises as `results_or_study`."""
    source = results_or_study(place, point)
    return source if isinstance(source, Study) else source.study
