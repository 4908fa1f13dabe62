"""Folders of the shipped studies and SUMO networks, the program's name, and the command that starts
it.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).resolve().parent
PROGRAM = "safevar-sumo"
"""Name of the installed program, at the start of its errors."""
PROGRAM_COMMAND = "python -m safevar_sumo"
"""Start of every command line of this package."""


def _find_folder(name: str) -> Path:
    """Find a data folder in the installed package or, in a checkout, beside it."""
    installed_folder = PACKAGE / name
    if installed_folder.is_dir():
        return installed_folder
    return PACKAGE.parent / name


def shipped_table(path: str) -> dict[str, Any]:
    """A TOML file of the package, by its path in it."""
    return tomllib.loads((PACKAGE / path).read_text(encoding="utf-8"))


STUDIES = _find_folder("studies")
STUDY_SCHEMA = STUDIES / "study.schema.json"
"""The JSON schema of study files, for editors; the shipped studies name it in their first line."""
NETWORKS = _find_folder("sumo_nets")
