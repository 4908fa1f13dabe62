"""Shipped data (studies and SUMO networks), and the command that starts the program."""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).resolve().parent
PROGRAM_COMMAND = "python -m safevar_sumo"
"""Start of every command line of this package."""


def _folder(name: str) -> Path:
    """A data folder: in the installed package, or beside the package in a checkout."""
    installed_folder = PACKAGE / name
    return installed_folder if installed_folder.is_dir() else PACKAGE.parent / name


STUDIES = _folder("studies")
NETWORKS = _folder("sumo_nets")
