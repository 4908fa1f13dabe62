"""Makes a command of a function: the function's signature and docstring give the command's options
and help.
"""

from __future__ import annotations

import inspect
import math
import os
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import click
from click.shell_completion import CompletionItem
from rich.console import Console

from safevar_sumo.cli.log import LOG_OPTIONS
from safevar_sumo.errors import InputError, check_name
from safevar_sumo.metrics.bound import COMPARISONS
from safevar_sumo.output import check_writable
from safevar_sumo.questions.answer import Answer, Contents, contents_of
from safevar_sumo.questions.ask import COMMON_OPTIONS
from safevar_sumo.questions.changes import NUMBER_PATTERN
from safevar_sumo.questions.options import Option, options_of
from safevar_sumo.questions.render import WIDTH, Form
from safevar_sumo.questions.subject import study_in, study_or_case
from safevar_sumo.study import study_names

GATE_EXIT_CODE = 3
DECIDE_EXIT_CODE = 4
"""Exit codes of a command: GATE if a condition of --fail-if holds or a limit is not kept, DECIDE if
a person has to decide.
"""
PICTURE_ENDINGS = (".png", ".pdf", ".svg")
LIBRARY_ONLY = ("pool", "progress")
"""Parameters that only the library's functions have. (A command always shows its progress.)"""
METAVARS = {
    "source": "STUDY|DIR",
    "subject": "STUDY|DIR",
    "case": "DIR",
    "results": "DIR",
    "directory": "DIR",
}
"""The names of positional parameters in the help. Other parameters have their own names."""
COMMON_NAMES = {
    "What to use": ("point", "ranges", "up_to", "as_it_is_now"),
    "How to simulate": ("jobs", "cluster", "simulations", "fresh", "verbose", "log"),
    "How to print": ("format", "json", "details", "table", "plot", "fail_if"),
}
"""Options that many commands have. If such an option has its usual meaning, the help only lists
it.
"""
ENDED_OPTIONS = {
    "check --ego": "no such option: no scenario is read from a file of OpenSCENARIO",
    "explain --limit": "--simulations N, or --quick",
    "import --original": "[published] of the study",
    "report --paper": "tables DIR --figures DIR",
    "simulate --fewest": "--solution fewest",
    "simulate --most-severe": "--solution most-severe",
    "simulate --no-filter": "no such option: `simulate` filters no change",
    "simulate --slower": "no such option: sumo-gui has a field for its delay",
    "simulate --smallest": "--solution smallest",
    "simulate --spread": "the page of `report`, which has the band, or simulate --fit K",
    "study --batch": "no such option: batches changed no result",
    "study --dry-run": "no such option: the bar of a search shows the time that is left",
    "study --only": "sv.run(study, only=...)",
    "study --shard": "sv.run(study, only=...), or --cluster",
    "tables --all": "--details",
    "tolerance --attack": "--simulations N, or --quick",
    "tolerance --by": "the command permit, or --up-to NAME=V",
    "tolerance --together": "no such option: joint limits are always part of the answer",
}
"""Options of earlier releases, with the text that says what replaces each option."""
CONDITION = re.compile(
    rf"\s*(?P<key>[^\s<>=]+)\s*(?P<comparison><=|>=|<|>)\s*(?P<limit>{NUMBER_PATTERN})\s*"
)


class _Command(click.Command):
    """A command that refuses options of earlier releases, and an option that is given twice
    although it has one value.

    `--help` explains the command's own options, and `--help-all` also explains common options.
    """

    def format_options(
        self, ctx: click.Context, formatter: click.HelpFormatter
    ) -> None:
        """Write the command's own options, and then a list of common options without
        explanations.
        """
        if ctx.meta.get("all"):
            super().format_options(ctx, formatter)
            return

        options = {
            option.name: option
            for option in self.get_params(ctx)
            if isinstance(option, click.Option)
        }
        # A common option with another meaning in this command is explained like the command's own.
        meanings = {name: option.meaning for name, option in COMMON_OPTIONS.items()}
        lines = []
        for title, names in COMMON_NAMES.items():
            flags = []
            for name in names:
                meaning = meanings.get(name, "")
                if name in options and str(options[name].help).startswith(meaning):
                    flags.append(options.pop(name).opts[0])
            if flags:
                lines.append((title, ", ".join(flags)))
        records = [option.get_help_record(ctx) for option in options.values()]
        # An option that is hidden has no record.
        shown_records = [record for record in records if record is not None]
        with formatter.section("Options"):
            formatter.write_dl(shown_records, col_max=16)

        if lines:
            with formatter.section(
                "Options of many commands (--help-all explains them)"
            ):
                formatter.write_dl(lines)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Refuse options of earlier releases and options that are given twice, before the
        parsing.
        """
        counts = Counter(word.partition("=")[0] for word in args)
        for word in counts:
            if instead := ENDED_OPTIONS.get(f"{self.name} {word}"):
                raise InputError(word, "is an option of releases before 0.5", instead)
        for option in self.params:
            takes_one = isinstance(option, click.Option) and not (
                option.multiple or option.is_flag
            )
            if takes_one and counts[option.opts[0]] > 1:
                raise InputError(option.opts[0], "is given twice", "it once")
        return super().parse_args(ctx, args)


def _explain_all(ctx: click.Context, _param: click.Parameter, is_asked: bool) -> None:
    if is_asked:
        ctx.meta["all"] = True
        click.echo(ctx.get_help())
        ctx.exit()


HELP_ALL = click.Option(
    ["--help-all"],
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_explain_all,
    help="Explain all options and exit.",
)


def _give_answer(
    call: Callable[..., Answer],
    declared: Contents | None,
    /,
    *,
    format: Form = "text",
    json: bool = False,
    details: bool = False,
    table: Annotated[str | None, "NAME"] = None,
    plot: Annotated[Path | None, "FILE"] = None,
    fail_if: Annotated[tuple[str, ...], '"KEY > X"'] = (),
    **values: Any,
) -> None:
    """Print the answer, and end with its exit code.

    Parameters
    ----------
    format
        Form in which the answer is printed.
    json
        Print the answer as JSON, with all numbers and tables.
    details
        Print all sentences, tables and numbers. Default: one screen.
    table
        Print only this table of the answer. The line "More:" of an answer names the tables.
    plot
        Draw the answer into this file. The name ends in .png, .pdf or .svg.
    fail_if
        End with exit code 3 if this condition holds, such as "probability > 0.01"; may be repeated.
        The name is that of a number in --json.
    """
    # A condition or table that the answer cannot have is refused before hours of simulation.
    conditions = [_parse(text) for text in fail_if]
    if declared:
        keys = [condition.key for condition in conditions]
        _check_names(declared, values, keys, table)
    if plot is not None:
        check_writable(plot, "plot", PICTURE_ENDINGS)

    # Standard output has nothing but the answer, so that other programs can read it.
    if json:
        format = "json"
    with nullcontext() if format == "text" else prints_to_standard_error():
        answer = call(table=table, **values)
    if format != "text" or table or not values.get("quiet"):
        _print(answer, format, table, details=details)
    if plot is not None:
        from safevar_sumo.questions.figures import save

        save(answer.figure(), plot, "plot")
    _exit_on_failures(answer, conditions)


def command_of(name: str, function: Callable[..., Any]) -> click.Command:
    """Make the command that calls a function.

    The command prints the function's answer or text. The exit code of an answer is 3 if a user's
    limit is not kept or a condition of --fail-if holds, 4 if a person has to decide, and 1 if the
    answer's number `passed` is false.
    """
    signature = inspect.signature(function)
    positional = [
        parameter
        for parameter in signature.parameters.values()
        if parameter.kind is not parameter.KEYWORD_ONLY
    ]
    options = {
        name: option
        for name, option in options_of(function).items()
        if name not in LIBRARY_ONLY
    }
    constants = {}
    if "progress" in signature.parameters:
        constants = {"progress": True}

    def call(**values: Any) -> Any:
        """Call the function with the values of the command line."""
        subjects: list[Any] = []
        for parameter in positional:
            value = values.pop(parameter.name)
            subjects += value if parameter.kind is parameter.VAR_POSITIONAL else [value]
        return function(
            *subjects,
            **{name: option.check(values[name]) for name, option in options.items()},
            **constants,
        )

    def print_text(**values: Any) -> None:
        click.echo(call(**values))

    arguments = [_argument(parameter) for parameter in positional]
    flags = [_flag(option) for name, option in options.items() if name != "table"]
    callback = print_text
    if "Answer" in str(signature.return_annotation):
        flags += [_flag(option) for option in options_of(_give_answer).values()]
        callback = partial(_give_answer, call, contents_of(function))
    return _Command(
        name,
        params=[*arguments, *flags, *LOG_OPTIONS, HELP_ALL],
        callback=callback,
        help=inspect.cleandoc(function.__doc__ or "").partition("\nParameters\n")[0],
    )


def _check_names(
    declared: Contents,
    values: Mapping[str, Any],
    keys: Sequence[str],
    table: str | None,
) -> None:
    """Refuse keys of conditions, and the name of a table, that no answer of the command can
    have.
    """
    # Some answers, such as that of `simulate`, also have the metrics of their study.
    if keys and ... in declared.numbers:
        declared = declared.in_study(names_in_study(values))
    for key in keys:
        declared.check_key(key)
    if table is not None:
        check_name("table", f"there is no table {table!r}", table, declared.tables)


class _Condition(NamedTuple):
    """A condition of --fail-if: the key of a number of the answer, a comparison (a key of
    `COMPARISONS`), and a limit.
    """

    key: str
    comparison: str
    limit: float


def _exit_on_failures(answer: Answer, conditions: Sequence[_Condition]) -> None:
    """End with the exit code of the answer. Print the reasons for the code, unless the verdict
    states them already.
    """
    failures = list(answer.failures)
    for condition in conditions:
        failures += _fulfilments(answer, condition)
    for sentence in failures:
        if sentence not in answer.verdict:
            click.echo(f"failed: {sentence}", err=True)
    code = 0
    if answer.numbers.get("decision") == "decide":
        code = DECIDE_EXIT_CODE
    if answer.numbers.get("passed") is False:
        code = 1
    if failures:
        code = GATE_EXIT_CODE
    click.get_current_context().exit(code)


def names_in_study(values: Mapping[str, Any]) -> list[str]:
    """The names of the measures of the study that a command simulates."""
    # The import takes long, and most commands do not need it.
    from safevar_sumo.sumo import assemble

    study = study_in(
        study_or_case(values["source"], as_it_is_now=values["as_it_is_now"])
    )
    return list(assemble(study).measuring.measures)


@contextmanager
def prints_to_standard_error() -> Iterator[None]:
    """Within the block, redirect standard output to standard error, also of user code, SUMO and
    workers. Standard output then has the answer alone.
    """
    sys.stdout.flush()
    standard_output = os.dup(1)
    os.dup2(2, 1)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(standard_output, 1)
        os.close(standard_output)


def _argument(parameter: inspect.Parameter) -> click.Argument:
    """Make the positional argument of a command from a parameter of its function."""
    is_repeated = parameter.kind is parameter.VAR_POSITIONAL
    metavar = METAVARS.get(parameter.name, parameter.name.upper())
    return click.Argument(
        [parameter.name],
        nargs=-1 if is_repeated else 1,
        required=parameter.default is parameter.empty,
        metavar=f"{metavar}..." if is_repeated else metavar,
        shell_complete=_complete_study,
    )


def _complete_study(
    _ctx: click.Context, _param: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Complete the name of a study, a file or a directory."""
    names = [
        CompletionItem(name) for name in study_names() if name.startswith(incomplete)
    ]
    return [*names, CompletionItem(incomplete, type="file")]


class _Path(click.Path):
    """A path on the command line that must not be empty."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> Any:
        if value == "":
            raise InputError(str(param and param.name), "''", "a path")
        return super().convert(value, param, ctx)


def _flag(option: Option) -> click.Option:
    """Make the option of a command from an option of its function."""
    kind: Any = option.kind
    if option.choices:
        kind = click.Choice(option.choices)
    elif kind is Path:
        kind = _Path(path_type=Path)
    is_required = option.default is inspect.Parameter.empty
    meaning = option.meaning
    if option.limits:
        meaning += f"  [{option.limits}]"
    return click.Option(
        [option.flag, option.name],
        type=kind,
        is_flag=option.kind is bool,
        multiple=option.is_repeated,
        show_default=option.default
        not in (None, (), False, "", inspect.Parameter.empty),
        metavar=option.metavar,
        help=meaning,
        **({"required": True} if is_required else {"default": option.default}),
    )


def _print(answer: Answer, form: str, table: str | None, *, details: bool) -> None:
    """Print an answer, or one of its tables. If the answer lacks the table, print the whole answer
    before the error: its simulations may have taken long.
    """
    try:
        if table:
            answer = answer.only(table)
    except InputError:
        _print(answer, "json" if form == "csv" else form, None, details=True)
        raise
    if form == "text":
        width = None if sys.stdout.isatty() or os.environ.get("COLUMNS") else WIDTH
        answer.print(Console(width=width), details=details)
    else:
        click.echo(answer.render(form), nl=False)


def _parse(text: str) -> _Condition:
    """Parse a condition of --fail-if."""
    match = CONDITION.fullmatch(text)
    limit = float(match["limit"]) if match else math.nan
    if match is None or not math.isfinite(limit):
        raise InputError(
            "fail_if",
            repr(text),
            '"KEY > X" with <, <=, > or >= and a number, such as "probability > 0.01"',
        )
    return _Condition(match["key"], match["comparison"], limit)


def _fulfilments(answer: Answer, condition: _Condition) -> Iterator[str]:
    """Yield a sentence for each number of the answer that fulfils a condition. If the answer has no
    such number, print a note.
    """
    key = condition.key
    values = answer.values(key)
    if None in values or not values:
        state = "undefined" if values else "in no row"
        click.echo(f"note: --fail-if: {key} is {state} here", err=True)
    rows = [""] * len(values)
    table = key.rpartition(".")[0]
    # The first column of a table names the row.
    if table in answer.tables:
        rows = [f" in the row {row}" for row in answer.tables[table].iloc[:, 0]]
    for value, row in zip(values, rows, strict=True):
        if isinstance(value, bool) or not isinstance(value, int | float | None):
            raise InputError(
                "fail_if", f"{key} is no number", "the key of a number of the answer"
            )
        if value is None:
            continue
        if COMPARISONS[condition.comparison](value, condition.limit):
            yield f"{key} = {value:g} {condition.comparison} {condition.limit:g}{row}"
