"""Arguments and options that commands share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from safevar_sumo.output import check_writable

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def check_output(path: Path | None, flag: str, endings: tuple[str, ...]) -> None:
    """Refuse an output file with an unknown ending, or that cannot be written; names the flag."""
    if path is not None:
        check_writable(path, flag, endings)


def file_option(flag: str, help_text: str, *, metavar: str = "FILE", **options: Any) -> Decorator:
    """An option that names a file or directory to write."""
    return click.option(flag, type=click.Path(path_type=Path), metavar=metavar, help=help_text, **options)


directories_argument = click.argument("directories", nargs=-1, required=True, metavar="DIR...")
jobs_option = click.option(
    "--jobs", type=click.IntRange(1, 1024), help="Worker processes.  [default: the cores of this machine]"
)
point_option = click.option("--point", metavar="NAME", help="Only this point of the study's matrix.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
AS_IT_IS_NOW_KEY = "safevar_sumo.as_it_is_now"
"""Key of the flag --as-it-is-now in a command's context."""
as_it_is_now_option = click.option(
    "--as-it-is-now",
    is_flag=True,
    expose_value=False,
    callback=lambda context, _option, value: context.meta.update({AS_IT_IS_NOW_KEY: value}),
    help="If results were computed with other files or versions, simulate with the present ones and say so.",
)


def as_it_is_now() -> bool:
    """Whether the user gave the flag --as-it-is-now."""
    return bool(click.get_current_context().meta.get(AS_IT_IS_NOW_KEY))


def split_names(text: str) -> tuple[str, ...]:
    """Split names at commas."""
    return tuple(name.strip() for name in text.split(","))
