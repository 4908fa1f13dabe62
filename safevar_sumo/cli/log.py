"""Shows what the package logs: on standard error (`-v`, `-vv`), and in a file (`--log FILE`).

All modules log below the name `safevar_sumo`. Without these options nothing is shown.
"""

from __future__ import annotations

import logging
import os
import platform
import shlex
import sys
import time
from pathlib import Path

import click

from safevar_sumo.errors import InputError
from safevar_sumo.shipped import PACKAGE, PROGRAM

ROOT = logging.getLogger(PACKAGE.name)
"""The logger above those of all modules."""
WARNINGS = logging.getLogger(f"{PACKAGE.name}.warnings")
"""The logger of warnings, which the program prints in any case."""
FORMAT = "%(asctime)s %(process)d %(name)s: %(message)s"
LIBRARIES = ("libsumo", "numpy", "deap")
"""Libraries whose versions the first line names, besides Python and the package."""
LOGGER = logging.getLogger(__name__)


class _StandardError(logging.Handler):
    """A handler that writes to standard error, above a bar of progress. It leaves out warnings,
    because the program prints them itself.
    """

    def emit(self, record: logging.LogRecord) -> None:
        if record.name != WARNINGS.name:
            click.echo(self.format(record), err=True)


def _show(ctx: click.Context, _param: click.Parameter, count: int) -> None:
    """Log to standard error: stages and lost workers with `-v`, single batches with `-vv`."""
    if count:
        _add(ctx, _StandardError(), logging.INFO if count == 1 else logging.DEBUG)


def _append(ctx: click.Context, _param: click.Parameter, path: Path | None) -> None:
    """Log everything to a file, after what it already has."""
    if path is None:
        return
    try:
        handler = logging.FileHandler(path, encoding="utf-8")
    except OSError as error:
        raise InputError(
            "--log",
            f"{path} cannot be written: {error.strerror or error}",
            "a file that can be written",
        ) from None
    _add(ctx, handler, logging.DEBUG)


def _add(ctx: click.Context, handler: logging.Handler, level: int) -> None:
    """Add a handler until the command ends, and log which command has begun."""
    handler.setLevel(level)
    handler.setFormatter(logging.Formatter(FORMAT))
    earlier_level = ROOT.level
    ROOT.addHandler(handler)
    ROOT.setLevel(min(level, earlier_level or level))
    begin = time.monotonic()

    def end() -> None:
        handler.handle(_record(f"ended after {time.monotonic() - begin:.1f} s"))
        ROOT.removeHandler(handler)
        ROOT.setLevel(earlier_level)
        handler.close()

    ctx.call_on_close(end)
    # Modules that this import loads could be replaced by files in the working directory.
    from importlib.metadata import version

    versions = [f"{name} {version(name)}" for name in (PACKAGE.name, *LIBRARIES)]
    versions.append(f"Python {platform.python_version()}")
    handler.handle(_record(f"began: {PROGRAM} {shlex.join(sys.argv[1:])}"))
    handler.handle(_record(f"in {os.getcwd()} with {', '.join(versions)}"))


def _record(message: str) -> logging.LogRecord:
    return LOGGER.makeRecord(LOGGER.name, logging.INFO, __file__, 0, message, (), None)


LOG_OPTIONS = (
    click.Option(
        ["-v", "--verbose"],
        count=True,
        expose_value=False,
        callback=_show,
        help="Show on standard error when each stage ends, and which workers are lost. With -vv,"
        " show each batch of simulations as well.",
    ),
    click.Option(
        ["--log"],
        type=click.Path(path_type=Path, dir_okay=False),
        metavar="FILE",
        expose_value=False,
        callback=_append,
        help="Append the command, versions and all that -vv shows to this file. Default: no file.",
    ),
)
"""The options of every command about its log."""
