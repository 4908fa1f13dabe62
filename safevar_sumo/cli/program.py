"""The program, its commands, its errors and its exit codes."""

from __future__ import annotations

import faulthandler
import importlib
import json
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn

import click

from safevar_sumo.errors import INTERRUPT_EXIT_CODE, InputError, SafevarError, did_you_mean
from safevar_sumo.shipped import PROGRAM, PROGRAM_COMMAND

if TYPE_CHECKING:
    from safevar_sumo.study import Study

COMMANDS_BY_GROUP = {
    "From a driving system to a decision": {
        "study": ("study", "Search a study; run the same command again to continue where it stopped."),
        "simulate": ("simulate", "Simulate a study once: how it ends, its safety metrics and objectives."),
        "explain": ("questions", "Explain failures: which changes cause them, how small a change is enough, and why."),
        "tolerance": ("questions", "Find how far each characteristic may go: alone, and all together."),
        "repair": ("ask", "Find the smallest change of the driving system that survives promised wear, and its price."),
        "risk": (
            "ask",
            "Estimate how likely an unsafe vehicle is if vehicles vary as the study specifies, and which "
            "characteristics decide it.",
        ),
        "report": ("handover", "Write one page about results: verdict, causes, replays, tables, figures."),
    },
    "More": {
        "status": (
            "study",
            "Show the progress of a study running in another process: runs, front, collisions, time left.",
        ),
        "evidence": ("handover", "Pack results, page and answers, so that anybody can compute every number again."),
        "verify": ("handover", "Compute what a pack of evidence claims again, and compare."),
        "export": ("handover", "Write a solution for CARLA, or as OpenSCENARIO and OpenDRIVE."),
        "check": (
            "catalogue",
            "Check your own driving system, vehicle, scenario, metric, objective, algorithm or TraCI controller.",
        ),
        "list": ("catalogue", "List studies, vehicles, ADSs, scenarios, weathers, algorithms, metrics and objectives."),
        "opinion": ("ask", "Check the minimal causes of failures with a second vehicle model."),
        "rules": ("ask", "Find rules, in physical units, that say where in the domain a study is unsafe."),
        "rating": (
            "ask",
            "Rate the crash avoidance (frontal collisions) of a vehicle and of a worn variant of it as Euro NCAP "
            "does in 2026.",
        ),
        "compare": (
            "ask",
            "Compare two studies or results, A and B: what is unsafe in one of them only, limits, ratings.",
        ),
        "tables": ("handover", "Answer the research questions as tables."),
        "figures": ("handover", "Draw the figures of results."),
    },
    "Published data": {
        "import": ("reference", "Import published CSV solutions as a results directory."),
        "validate": (
            "ask",
            "Compare a study with settings and metrics in the published package's CSV format, row by row.",
        ),
    },
}
"""Each command's module in this folder and its sentence in the help, by the title of its group, in the order of the
help.
"""
COMMANDS = {name: command for group in COMMANDS_BY_GROUP.values() for name, command in group.items()}
ARGUMENT = re.compile(r"`(\w+)(?:=([^`]+))?`")
"""An argument of a function of the library in an error, such as `method=monte_carlo`."""


class LazyCommands(click.Group):
    """The group of all commands; it loads a command's module, which takes long, only when the command is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        with _exit_on_interrupt():
            module, _ = COMMANDS.get(name, ("ask" if ":" in name else "", ""))
            if module == "ask":
                from safevar_sumo.cli.ask import command_of
                from safevar_sumo.questions.ask import find_question

                return command_of(find_question(name))
            if module:
                importlib.import_module(f"safevar_sumo.cli.{module}")
        return super().get_command(ctx, name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Suggest the nearest command if the name is unknown."""
        if args and args[0] not in COMMANDS and not args[0].startswith("-") and ":" not in args[0]:
            ctx.fail(f"there is no command {args[0]!r}{did_you_mean(args[0], COMMANDS)}")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Call a command; an error of the library, which names its arguments, then names the flags that set them."""
        try:
            return super().invoke(ctx)
        except InputError as error:
            command = self.get_command(ctx, str(ctx.invoked_subcommand))
            parameters = command.params if command else []
            flags = {option.name: option.opts[-1] for option in parameters if isinstance(option, click.Option)}
            if isinstance(error.source, str):  # a path is no argument
                error.source = flags.get(error.source, error.source)
            to_flag = partial(_to_flag, flags)
            error.problem, error.legal = (ARGUMENT.sub(to_flag, text) for text in (error.problem, error.legal))
            raise

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        for title, group in COMMANDS_BY_GROUP.items():
            with formatter.section(title):
                formatter.write_dl([(name, sentence) for name, (_, sentence) in group.items()])


def _to_flag(flags: dict[str, str], argument: re.Match[str]) -> str:
    """The flag that sets an argument, with its value unless the flag takes none; other words as they are."""
    name, value = argument.groups()
    if name not in flags:
        return argument[0]
    return flags[name] if value in (None, "True") else f"{flags[name]} {value}"


@click.group(cls=LazyCommands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="safevar_sumo")
def commands() -> None:
    """Search for the smallest variations of a vehicle that make its automated driving system unsafe, on SUMO.

    STUDY is the name of a study (see: list) or the path of a study file.
    """


def main() -> None:
    """Run the program.

    Its exit code is 0, 1 (failed, or `check` has findings), 2 (bad input), 3 (`--fail-if`, or a limit is not kept) or
    130 (interrupted).
    """
    warnings.showwarning = lambda message, *_, **__: print_warning(message)  # without its file and line
    with suppress(AttributeError, OSError, ValueError):  # standard error is no file
        faulthandler.enable()  # if compiled code crashes, its line is printed
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
        _exit_with_error(f"{error.strerror or error}{f': {error.filename}' if error.filename else ''}", 1)
    except ValueError:
        if not sys.stdout.closed:
            raise
        _exit_with_error("user code has closed standard output", 1)
    sys.exit(code if isinstance(code, int) else 0)


def _error_in_two_lines(error: click.ClickException) -> str:
    """Put an error of click into the form of this program's errors."""
    command = " ".join([PROGRAM_COMMAND, *(word for word in sys.argv[1:2] if word in COMMANDS)])
    return f"{' '.join(error.format_message().split())}\nexpected: see {command} --help"


@contextmanager
def _exit_on_interrupt() -> Iterator[None]:
    """End the program on Ctrl-C while modules load: compiled modules would swallow the exception. Later, Ctrl-C raises
    it.
    """

    def exit_at_once(*_: object) -> None:
        os.write(2, f"{PROGRAM}: interrupted\n".encode())
        os._exit(INTERRUPT_EXIT_CODE)

    in_main_thread = threading.current_thread() is threading.main_thread()
    previous_handler = signal.signal(signal.SIGINT, exit_at_once) if in_main_thread else None
    try:
        yield
    finally:
        if in_main_thread:
            signal.signal(signal.SIGINT, previous_handler or signal.default_int_handler)


def _exit_with_error(message: str, code: int) -> NoReturn:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # another Ctrl-C must change neither exit code nor message
    click.echo(f"{PROGRAM}: {message}", err=True)
    sys.exit(code)


def print_json(value: Any) -> None:
    """Print a value as JSON."""
    click.echo(json.dumps(value, indent=2, allow_nan=False))


def print_note(message: object) -> None:
    """Print a note to standard error."""
    click.echo(f"note: {message}", err=True)


def print_warning(message: object) -> None:
    """Print a warning to standard error."""
    click.echo(f"warning: {message}", err=True)


def print_remarks(study: Study, further_remarks: Iterable[str] = ()) -> None:
    """Print the remarks on a study, such as a key that has no effect, to standard error."""
    for remark in (*study.origin.remarks, *further_remarks):
        print_note(remark)
