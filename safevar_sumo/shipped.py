"""The data that ships with the code: studies and SUMO networks; and how the program is called."""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).resolve().parent
RUN = "python -m safevar_sumo"
"""Begins every command of this package."""


def _folder(name: str) -> Path:
    """In an installed package the folder lies inside it, in a checkout beside it."""
    inside = PACKAGE / name
    return inside if inside.is_dir() else PACKAGE.parent / name


STUDIES = _folder("studies")
NETWORKS = _folder("sumo_nets")
