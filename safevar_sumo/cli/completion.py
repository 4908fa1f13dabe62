"""What the shell completes: names of studies and of their characteristics, files."""

from __future__ import annotations

from pathlib import Path

import click
from click.shell_completion import CompletionItem

from safevar_sumo.errors import SafevarError
from safevar_sumo.study import load_study, study_names


def complete_study(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Names of studies, and files or directories."""
    names = [CompletionItem(name) for name in study_names() if name.startswith(incomplete)]
    return [*names, CompletionItem(incomplete, type="file")]


def complete_changes(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """The characteristics of the study that stands before, each with its sign of equality and its domain."""
    study = str(ctx.params.get("study") or next(iter(ctx.args), ""))  # an option without its value yet keeps arguments unparsed
    if not study or Path(study).is_dir():
        return []
    try:
        characteristics = load_study(study).vehicle.characteristics
    except SafevarError:
        return []
    return [CompletionItem(f"{name}=", help=f"{row.lower:g} to {row.upper:g}" + (f" {row.unit}" if row.unit != "-" else ""))
            for name, row in characteristics.items() if name.startswith(incomplete)]
