"""The command of a question, from the signature and the docstring of its function."""

from __future__ import annotations

import inspect
import math
import operator
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from safevar_sumo.cli.arguments import GATE_EXIT_CODE, check_output, complete_study
from safevar_sumo.errors import InputError
from safevar_sumo.questions.answer import FORMATS, Answer
from safevar_sumo.questions.ask import COMMON_OPTIONS, Option, Question
from safevar_sumo.questions.changes import NUMBER_PATTERN

OPERATORS = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}
CONDITION = re.compile(rf"\s*([^\s<>=]+)\s*(<=|>=|<|>)\s*({NUMBER_PATTERN})\s*")


def command_of(ask: Question) -> click.Command:
    """The command that asks a question; with exit code 3 if one of the user's limits is not kept, or a condition of
    --fail-if holds.
    """

    def run(
        form: str, as_json: bool, table: str | None, plot: Path | None, fail_if: tuple[str, ...], **values: Any
    ) -> None:
        form = "json" if as_json else form
        conditions = [_parse(text) for text in fail_if]
        check_output(plot, "--plot")
        subjects = [values.pop(name) for name in ("source", *ask.others)]
        answer = ask(*subjects, progress=True, **values)
        _print(answer, form, table)
        if plot is not None:
            from safevar_sumo.questions.figures import save

            save(answer.figure(), plot, "--plot")
        failures = [*answer.failures, *(text for condition in conditions for text in _fulfilments(answer, *condition))]
        for sentence in failures:
            click.echo(f"failed: {sentence}", err=True)
        if failures:
            click.get_current_context().exit(GATE_EXIT_CODE)

    metavar = "DIR" if ask.takes_results_only else "STUDY|DIR"
    parameters: list[click.Parameter] = [
        click.Argument(["source"], metavar=metavar, shell_complete=complete_study),
        *(click.Argument([name], metavar=name.upper(), shell_complete=complete_study) for name in ask.others),
        *map(_flag, ask.options),
        click.Option(["--point"], metavar="NAME", help=COMMON_OPTIONS["point"]),
        click.Option(["--as-it-is-now"], is_flag=True, help=COMMON_OPTIONS["as_it_is_now"]),
        click.Option(["--jobs"], type=click.IntRange(1, 1024), help=COMMON_OPTIONS["jobs"]),
        click.Option(
            ["--format", "form"], type=click.Choice(FORMATS), default="text", show_default=True, help="How to print."
        ),
        click.Option(["--json", "as_json"], is_flag=True, help="Short for --format json."),
        click.Option(["--table"], metavar="NAME", help="The table that --format csv prints.  [default: the first]"),
        click.Option(
            ["--plot"], type=click.Path(path_type=Path), metavar="FILE", help="Draw the answer: png, pdf or svg."
        ),
        click.Option(
            ["--fail-if"],
            multiple=True,
            metavar='"KEY > X"',
            help="End with exit code 3 if a number, or a table's column in any row, is so; may be repeated.",
        ),
    ]
    text = inspect.cleandoc(ask.compute.__doc__ or "").partition("\nParameters\n")[0]
    return click.Command(ask.name, params=parameters, callback=run, help=text)


def _flag(option: Option) -> click.Option:
    text = option.meaning + (f"  [{option.limits}]" if option.limits else "")
    return click.Option(
        [f"--{option.name.replace('_', '-')}"],
        type=option.kind,
        is_flag=option.kind is bool,
        multiple=option.is_repeated,
        default=option.default,
        show_default=option.default not in (None, (), False),
        metavar=option.metavar,
        help=text,
    )


def _print(answer: Answer, form: str, table: str | None) -> None:
    if form == "text":
        answer.print(Console())
    else:
        click.echo(answer.render(form, table), nl=False)


def _parse(text: str) -> tuple[str, str, float]:
    """The key, the operator and the limit of a condition."""
    match = CONDITION.fullmatch(text)
    if match is None or not math.isfinite(limit := float(match[3])):
        expected = '"KEY > X" with <, <=, > or >= and a number, such as "probability > 0.01"'
        raise InputError("--fail-if", repr(text), expected)
    return match[1], match[2], limit


def _fulfilments(answer: Answer, key: str, sign: str, limit: float) -> Iterator[str]:
    """A sentence for each number of the answer for which a condition holds; a note if no number is there."""
    values = answer.values(key)
    if None in values or not values:
        click.echo(f"note: --fail-if: {key} is {'undefined' if values else 'in no row'} here", err=True)
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float | None):
            raise InputError("--fail-if", f"{key} is no number", "the key of a number of the answer")
        if value is not None and OPERATORS[sign](value, limit):
            yield f"{key} = {value:g} {sign} {limit:g}"
