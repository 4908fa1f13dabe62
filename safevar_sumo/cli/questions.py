"""Commands that simulate many settings to answer a question, such as tolerance."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from rich.console import Console

from safevar_sumo.cli.arguments import (
    CommandFunction,
    Decorator,
    JsonAnswer,
    OptionValue,
    add_flags,
    as_it_is_now_option,
    check_output,
    fail,
    file_option,
    gated,
    jobs_option,
    json_option,
    load_results_or_study,
    point_option,
)
from safevar_sumo.cli.program import commands, print_json
from safevar_sumo.errors import InputError
from safevar_sumo.questions.options import Options
from safevar_sumo.questions.subject import answer_question
from safevar_sumo.questions.tolerance import ToleranceOptions
from safevar_sumo.terminal import print_answer


def add_question(
    options: type[Options], metavar: str, *further_decorators: Decorator
) -> Callable[[CommandFunction], click.Command]:
    """Decorator of a question's command: adds flags for its options, and flags that all questions share."""

    def add(command: CommandFunction) -> click.Command:
        decorators: list[Decorator] = [
            click.argument("source", metavar=metavar),
            add_flags(options),
            point_option,
            as_it_is_now_option,
            jobs_option,
            json_option,
            gated,
            *further_decorators,
        ]
        for decorator in reversed(decorators):
            command = decorator(command)
        return commands.command(name=options.question)(command)

    return add


def _show(result: Any, as_json: bool | None, plot: Path | None = None) -> JsonAnswer:
    """Print an answer, unless `as_json` is None, and draw its figure to a file, if one is named; returns the answer's
    JSON.
    """
    answer: JsonAnswer = result.to_dict()
    if as_json:
        print_json(answer)
    elif as_json is not None:
        print_answer(Console(), result.study, result.no_verdict, result.sentences())
    if plot is not None:
        from safevar_sumo.questions.figures import save

        save(result.figure(), plot, "--plot")
    return answer


@add_question(
    ToleranceOptions,
    "STUDY|DIR",
    file_option("--plot", "Draw the profiles to this file: png, pdf or svg."),
    click.option(
        "--format",
        "format_name",
        type=click.Choice(["text", "csv", "latex", "markdown"]),
        default="text",
        show_default=True,
        help="Print only the limits sheet, in this format; text prints the whole answer.",
    ),
)
def tolerance(
    source: str,
    point: str | None,
    jobs: int | None,
    as_json: bool,
    plot: Path | None,
    format_name: str,
    **values: OptionValue,
) -> JsonAnswer:
    """Find how far each characteristic of STUDY may go: alone, and all together."""
    from safevar_sumo.questions.tolerance.compute import find_tolerances

    if as_json and format_name != "text":
        raise InputError("--format", f"{format_name}, and --json", "one of them")
    subject = load_results_or_study(source, point)
    check_output(plot, "--plot")
    result = answer_question(find_tolerances, subject, ToleranceOptions(**values), jobs=jobs)
    for sentence in result.broken_limits:
        fail(sentence)
    if format_name == "text":
        return _show(result, as_json, plot)
    click.echo(result.sheet.render(format_name), nl=False)
    return _show(result, None, plot)
