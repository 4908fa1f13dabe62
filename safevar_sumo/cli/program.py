"""The command-line program: its commands, its error messages and its exit codes."""

from __future__ import annotations

import faulthandler
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NoReturn

import click

from safevar_sumo.cli.log import WARNINGS
from safevar_sumo.errors import (
    INTERRUPT_EXIT_CODE,
    INTERRUPTS,
    Hint,
    InputError,
    SafevarError,
    did_you_mean,
    printable,
    settable_interrupts,
)
from safevar_sumo.shipped import PROGRAM, PROGRAM_COMMAND

COMMANDS_BY_GROUP = {
    "Find, explain and limit failures": {
        "study": "api.study:study",
        "simulate": "replay.simulate:show_simulation",
        "explain": "questions.explain:explain",
        "tolerance": "questions.tolerance:tolerance",
        "risk": "questions.risk:risk",
        "report": "report.page:report",
    },
    "Further questions": {
        "rules": "questions.rules:rules",
        "compare": "questions.compare:compare",
        "permit": "questions.permit:permit",
        "repair": "questions.repair:repair",
    },
    "Hand results over": {
        "evidence": "report.evidence:evidence",
        "verify": "report.evidence:verify",
        "export": "replay.export:export",
    },
    "Check your own code": {
        "check": "questions.catalogue:check",
        "list": "questions.catalogue:list_models",
    },
    "Published data": {
        "import": "reference.rows:import_published",
        "validate": "reference.agreement:validate",
        "tables": "questions.research_questions.answer:tables",
    },
}
"""The function of each command. Groups and commands are in the order of the help."""
COMMANDS = {
    name: function
    for group in COMMANDS_BY_GROUP.values()
    for name, function in group.items()
}
ENDED_COMMANDS = {
    "rating": "study euro_ncap_pedestrian, and Euro NCAP's own calculator for its points"
}
"""Commands of earlier releases, with the text that says what replaces each command."""
ARGUMENT = re.compile(r"`(\w+)(?:=([^`]+))?`")
"""An argument of a library function in the text of an error, such as `engine=sumo`."""


class LazyCommands(click.Group):
    """The group of all commands. A command's function is imported only when the command is called,
    because the import takes long.
    """

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """Import the function of a command, and make its command. None if the name is unknown."""
        with _exit_on_interrupt():
            # A name module:Name is a question of the user's own.
            if ":" in name:
                from safevar_sumo.questions.ask import find_question

                function: Callable[..., Any] = find_question(name)
            elif name in COMMANDS:
                function = command_function(name)
            else:
                return None
            from safevar_sumo.cli.command import command_of

            return command_of(name, function)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Refuse an unknown command. The error names the nearest command, or what replaces the
        command.
        """
        name = args[0]
        if name in ENDED_COMMANDS:
            raise InputError(
                name, "a command of releases before 0.5", ENDED_COMMANDS[name]
            )
        if name not in COMMANDS and not name.startswith("-") and ":" not in name:
            ctx.fail(f"there is no command {name!r}{did_you_mean(name, COMMANDS)}")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Call a command. An error of the library names arguments: the error is changed to name the
        flags that set these arguments.
        """
        try:
            return super().invoke(ctx)
        except InputError as error:
            command = self.get_command(ctx, str(ctx.invoked_subcommand))
            parameters = command.params if command else []
            long_flags = {
                option.name: option.opts[-1]
                for option in parameters
                if isinstance(option, click.Option)
            }
            # The source of an error may also be a path: only a text may name an argument.
            if isinstance(error.source, str):
                error.source = long_flags.get(error.source, error.source)
            convert = partial(_flag_of, long_flags)
            error.problem = ARGUMENT.sub(convert, error.problem)
            error.legal = ARGUMENT.sub(convert, error.legal)
            raise

    def format_commands(
        self, ctx: click.Context, formatter: click.HelpFormatter
    ) -> None:
        """Write the commands in groups, each with the first paragraph of its docstring."""
        for title, group in COMMANDS_BY_GROUP.items():
            with formatter.section(title):
                formatter.write_dl(
                    [
                        (name, first_paragraph(function))
                        for name, function in group.items()
                    ]
                )


def command_function(command: str) -> Callable[..., Any]:
    """Import and return the function of a command."""
    function: Callable[..., Any] = resolve_name(f"safevar_sumo.{COMMANDS[command]}")
    return function


def first_paragraph(function_name: str) -> str:
    """The first paragraph of a function's docstring. The text is read from the file, because an
    import takes long.
    """
    module, _, name = function_name.partition(":")
    path = Path(__file__).parents[1] / module.replace(".", "/")
    file = path.with_suffix(".py")
    if not file.exists():
        file = path / "__init__.py"
    docstring = re.search(
        rf'^def {name}\(.*?"""(.*?)(?:\n\n|""")',
        file.read_text(encoding="utf-8"),
        re.DOTALL | re.MULTILINE,
    )
    assert docstring is not None
    return " ".join(docstring[1].split())


def _flag_of(flags: dict[str, str], argument: re.Match[str]) -> str:
    """The flag that sets an argument, followed by its value unless the flag takes none. A word that
    is no argument stays.
    """
    name, value = argument.groups()
    if name not in flags:
        return argument[0]
    # An argument that is true is a flag without a value: `beyond=True` becomes --beyond.
    if value in (None, "True"):
        return flags[name]
    return f"{flags[name]} {value}"


@click.group(cls=LazyCommands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="safevar_sumo")
def commands() -> None:
    """Find the smallest changes of a vehicle, such as worn tyres or weak brakes, that make its
    automated driving system unsafe. The vehicle drives in simulations with SUMO or with a simulator
    of your own.

    STUDY is the name of a study (`list studies` prints all names) or the path of a study file. DIR
    is a directory with results of the command `study`.
    """


def run_command_line() -> None:
    """Run the program.

    Its exit code is 0, 1 (failed, or `check` has findings), 2 (bad input), 3 (`--fail-if`, or a
    limit is not kept), 4 (a person has to decide) or 130 (interrupted).
    """
    # A warning becomes one line, without its place in the code. Each signal to end, such as
    # SIGTERM, is an interruption like Ctrl-C.
    warnings.showwarning = _show_warning
    for interrupt in _heeded_interrupts():
        signal.signal(interrupt, signal.default_int_handler)
    # After a crash of compiled code, Python prints the line of the crash. This fails if standard
    # error is no file.
    with suppress(AttributeError, OSError, ValueError):
        faulthandler.enable()

    try:
        code = commands.main(standalone_mode=False, prog_name=PROGRAM)
        sys.stdout.flush()
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        sys.exit(error.exit_code)
    except click.ClickException as error:
        _exit_with_error(_error_in_two_lines(error), error.exit_code)
    except SafevarError as error:
        _exit_with_error(str(error), error.exit_code)
    except (KeyboardInterrupt, click.exceptions.Abort):
        _exit_with_error("interrupted", INTERRUPT_EXIT_CODE)
    except OSError as error:
        message = str(error.strerror or error)
        if error.filename:
            message += f": {error.filename}"
        _exit_with_error(message, 1)
    except ValueError:
        if not sys.stdout.closed:
            raise
        _exit_with_error("user code has closed standard output", 1)
    sys.exit(code if isinstance(code, int) else 0)


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Print a warning as one line, and log it. A hint is printed as a note."""
    text = printable(str(message))
    if isinstance(message, Hint):
        click.echo(f"note: {text}", err=True)
        return
    click.echo(f"warning: {text}", err=True)
    WARNINGS.warning(text)


def _error_in_two_lines(error: click.ClickException) -> str:
    """Convert an error of click to the form of this program's errors."""
    command = PROGRAM_COMMAND
    if len(sys.argv) > 1 and sys.argv[1] in COMMANDS:
        command += f" {sys.argv[1]}"
    return f"{' '.join(error.format_message().split())}\nexpected: see {command} --help"


@contextmanager
def _exit_on_interrupt() -> Iterator[None]:
    """Within the block, which loads modules, Ctrl-C ends the program at once: compiled modules
    would swallow a KeyboardInterrupt. After the block, Ctrl-C raises a KeyboardInterrupt.
    """

    def exit_at_once(*_: object) -> None:
        os.write(2, f"{PROGRAM}: interrupted\n".encode())
        os._exit(INTERRUPT_EXIT_CODE)

    handlers = {}
    for interrupt in _heeded_interrupts():
        handlers[interrupt] = signal.signal(interrupt, exit_at_once)
    try:
        yield
    finally:
        for interrupt, handler in handlers.items():
            # None stands for a handler that Python has not set, and that Python cannot set again.
            signal.signal(interrupt, handler or signal.default_int_handler)


def _heeded_interrupts() -> Iterator[signal.Signals]:
    """The interrupts that this thread may handle, except those that the caller of the program lets
    it ignore, as `nohup` does.
    """
    for interrupt in settable_interrupts():
        if signal.getsignal(interrupt) is not signal.SIG_IGN:
            yield interrupt


def _exit_with_error(message: str, code: int) -> NoReturn:
    """Print an error, and end the program with this exit code."""
    # A second Ctrl-C would change the exit code and the message.
    for interrupt in INTERRUPTS:
        signal.signal(interrupt, signal.SIG_IGN)
    click.echo(f"{PROGRAM}: {printable(message)}", err=True)
    sys.exit(code)
