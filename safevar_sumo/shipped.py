"""Folders of the shipped studies and SUMO networks, the name of the program, and its command."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).resolve().parent
PROGRAM = "safevar-sumo"
"""The name of the installed program, with which its errors begin."""
PROGRAM_COMMAND = "python -m safevar_sumo"
"""The beginning of every command line of this package."""


def _find_folder(name: str) -> Path:
    """Find a folder with data: in the installed package, or beside the package in a checkout."""
    installed_folder = PACKAGE / name
    if installed_folder.is_dir():
        return installed_folder
    return PACKAGE.parent / name


def shipped_table(path: str) -> dict[str, Any]:
    """Read a TOML file of the package. `path` is its path in the package."""
    return tomllib.loads((PACKAGE / path).read_text(encoding="utf-8"))


STUDIES = _find_folder("studies")
STUDY_SCHEMA = STUDIES / "study.schema.json"
"""The JSON schema of study files, for editors. The first line of a shipped study names it."""
NETWORKS = _find_folder("sumo_nets")
