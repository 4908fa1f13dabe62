"""The subject of a command: a study, or a results directory and its solutions."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import fields
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from safevar_sumo.analysis.options import Option, Options
from safevar_sumo.analysis.subject import study_in
from safevar_sumo.errors import InputError
from safevar_sumo.records import FloatArray
from safevar_sumo.results import SolutionId, choose_handle, row_of_handle
from safevar_sumo.study import Study

if TYPE_CHECKING:
    from safevar_sumo.analysis.research_questions.case import Case


CommandFunction = Callable[..., Any]


class CommandTarget(NamedTuple):
    """A study and its name in errors; if a solution is to be replayed, its handle, setting and row of the results."""

    study: Study
    source: str
    handle: SolutionId | None = None
    setting: FloatArray | None = None
    row: dict[str, Any] | None = None


def replay_options(command: CommandFunction) -> CommandFunction:
    """Add the options that choose a solution of a results directory."""
    for option in (
        click.option(
            "--smallest", "choice", flag_value="smallest", help="Replay the unsafe solution with the smallest changes."
        ),
        click.option(
            "--fewest", "choice", flag_value="fewest", help="Replay the unsafe solution with the fewest changes."
        ),
        click.option("--most-severe", "choice", flag_value="most_severe", help="Replay the most severe solution."),
        click.option(
            "--solution",
            metavar="ALG:RUN:N",
            help="Replay solution N of a run in a results directory; N counts from 0.",
        ),
    ):
        command = option(command)
    return command


def load_target(source: str, solution: str | None, choice: str | None) -> CommandTarget:
    """Load the subject of a command: a study by name or path, or a results directory.

    Raises
    ------
    InputError
        If there is no such study, directory or solution.
    """
    if solution is not None and choice is not None:
        raise InputError(
            "--solution", f"{solution!r} and --{choice.replace('_', '-')} both choose a solution", "one of them"
        )
    if solution is None and choice is None:
        return CommandTarget(study_in(_load_subject(source)), source)
    case = load_results_or_study(source, results_only=True)
    assert not isinstance(case, Study)
    requested_handle = None if solution is None else SolutionId.parse(solution)
    handle = requested_handle or choose_handle(case.solutions, case.unsafe, str(choice), source)
    row = case.solutions.iloc[row_of_handle(case.solutions, handle)]
    setting = row[list(case.characteristics.names)].to_numpy(dtype=float)
    return CommandTarget(
        study=case.study,
        source=source,
        handle=handle,
        setting=setting,
        row={str(name): value for name, value in row.items()},
    )


jobs_option = click.option(
    "--jobs", type=click.IntRange(1, 1024), help="Worker processes.  [default: the cores of this machine]"
)
point_option = click.option("--point", metavar="NAME", help="Only this point of the study's matrix.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
AS_IT_IS_NOW_KEY = "safevar_sumo.as_it_is_now"
"""Key of the flag --as-it-is-now in a command's context; functions that read results directories look it up."""


def _store_flag(context: click.Context, _option: click.Parameter, value: bool) -> None:
    context.meta[AS_IT_IS_NOW_KEY] = value


as_it_is_now_option = click.option(
    "--as-it-is-now",
    is_flag=True,
    expose_value=False,
    callback=_store_flag,
    help="If results were computed with other files or versions, simulate with the present ones and say so.",
)


def as_it_is_now() -> bool:
    """Whether the user gave the flag --as-it-is-now."""
    return bool(click.get_current_context().meta.get(AS_IT_IS_NOW_KEY))


def add_flags(question: type[Options]) -> Callable[[CommandFunction], CommandFunction]:
    """Decorator that adds the flags of a question's options; the command makes them by `question(**keywords)`."""

    def add(command: CommandFunction) -> CommandFunction:
        for field in reversed(fields(question)):
            command = _add_flag(
                question.flags()[field.name], field.name, field.default, question.definitions()[field.name]
            )(command)
        return command

    return add


def _add_flag(flag: str, name: str, default: Any, option: Option) -> Callable[[CommandFunction], CommandFunction]:
    if option.kind is bool:
        return click.option(flag, name, is_flag=True, default=default, help=option.help)
    if option.form != "one":
        return click.option(
            flag,
            name,
            multiple=option.form == "repeated",
            metavar=option.metavar,
            help=option.help,
            callback=lambda _context, _option, value: _split_names(value) if option.form == "commas" else value,
        )
    (low_is_open, high_is_open), show_default = option.is_open, default is not None
    click_type: click.ParamType[Any] = click.STRING
    if option.kind is int:
        click_type = click.IntRange(option.low, option.high)  # type: ignore[arg-type]
    elif option.kind is float:
        click_type = click.FloatRange(option.low, option.high, min_open=low_is_open, max_open=high_is_open)
    return click.option(
        flag,
        name,
        type=click_type,
        default=default,
        show_default=show_default,
        metavar=option.metavar,
        help=option.help,
    )


def _split_names(text: str | None) -> tuple[str, ...] | None:
    """Split names at commas."""
    return None if text is None else tuple(name.strip() for name in text.split(","))


def load_results_or_study(source: str, point: str | None = None, *, results_only: bool = False) -> Study | Case:
    """Load a results directory or, unless `results_only`, a study by name or path; `point` restricts it to a point of
    its matrix.

    A note says which runs of a results directory are unfinished.

    Raises
    ------
    InputError
        If there is no such study or results directory, or it has no such point.
    """
    subject = _load_subject(source, point, results_only=results_only)
    if not isinstance(subject, Study) and subject.shortfall:
        click.echo(f"note: {subject.shortfall}", err=True)
    return subject


def _load_subject(source: str, point: str | None = None, *, results_only: bool = False) -> Study | Case:
    from safevar_sumo.analysis.subject import at_point, study_or_case
    from safevar_sumo.sumo.matrix import study_at

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        subject = study_or_case(source, as_it_is_now=as_it_is_now(), results_only=results_only)
    for warning in caught:
        click.echo(f"warning: {warning.message}", err=True)
    if point is None:
        return subject
    if isinstance(subject, Study):
        return study_at(subject, point, source="--point")
    return at_point(subject, point)
