"""The program that all commands belong to, and its exit codes."""

from __future__ import annotations

import io
import os
import signal
import sys

import click

from safevar_sumo.errors import SafevarError

INTERRUPTED = 130


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="safevar_sumo")
def commands() -> None:
    """Search the smallest variations of a vehicle that make its automated driving system unsafe, on SUMO.

    STUDY is the name of a study (see: list) or the path of a study file.
    """


def main() -> None:
    """Run the program; its exit code is 0, 1 (failed), 2 (bad input) or 130 (interrupted)."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        code = commands.main(standalone_mode=False, prog_name="safevar-sumo")
        sys.stdout.flush()
    except click.exceptions.Abort:
        _fail("interrupted", INTERRUPTED)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except SafevarError as error:
        _fail(str(error), error.exit_code)
    except KeyboardInterrupt:
        _fail("interrupted", INTERRUPTED)
    except BrokenPipeError:
        _drop_output()
        sys.exit(1)
    except OSError as error:
        _drop_output()
        _fail(f"{error.strerror or error}{f': {error.filename}' if error.filename else ''}", 1)
    sys.exit(code if isinstance(code, int) else 0)


def _drop_output() -> None:
    """Nobody takes what is left to be printed; the interpreter must not try again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(message: str, code: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it is over: another Ctrl-C changes neither code nor message
    click.echo(f"safevar-sumo: {message}", err=True)
    sys.exit(code)
