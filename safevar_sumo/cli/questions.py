"""Commands that simulate many settings to answer a question, such as explain and tolerance."""

from __future__ import annotations

import json
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
from safevar_sumo.cli.program import commands, print_json, print_note
from safevar_sumo.errors import InputError
from safevar_sumo.questions.explain import ExplainOptions
from safevar_sumo.questions.options import Options
from safevar_sumo.questions.subject import answer_question
from safevar_sumo.questions.tolerance import ToleranceOptions
from safevar_sumo.results import make_directory, write_whole
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
    ExplainOptions,
    "DIR|STUDY",
    click.option("--full", is_flag=True, help="Print every explanation in full, not only the answer."),
    file_option("--out", "Write causes.json, causes.csv and a figure there.", metavar="DIR"),
)
def explain(
    source: str, full: bool, point: str | None, jobs: int | None, as_json: bool, out: Path | None, **values: OptionValue
) -> JsonAnswer:
    """Explain failures of results in DIR, or across the domain of STUDY: which changes cause them, how small a change
    is enough, why.
    """
    from safevar_sumo.questions.explain.compute import explain_failures
    from safevar_sumo.questions.figures import save
    from safevar_sumo.questions.model_spread import remarks_on_sets

    subject = load_results_or_study(source, point)
    if out is not None:
        make_directory(out)
    result = answer_question(explain_failures, subject, ExplainOptions(**values), jobs=jobs)
    for remark in remarks_on_sets(result.study) if result.across_fits else []:
        print_note(remark)
    answer = result.to_dict()
    if as_json:
        print_json(answer)
    else:
        print_answer(Console(), result.study, result.no_verdict, result.parts(source, point or "", full=full))
    if out is not None:
        write_whole(out / "causes.json", json.dumps(answer, indent=2, allow_nan=False) + "\n")
        write_whole(out / "causes.csv", result.to_frame().to_csv(index=False, lineterminator="\n"))
        save(result.figure(), out / "necessity.png")
        click.echo(f"Causes: {out}", err=as_json)
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
