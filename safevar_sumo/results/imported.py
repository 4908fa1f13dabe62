"""Results that were not found here: solutions from elsewhere in a results directory, without runs and evaluations."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations
from safevar_sumo.results.files import make_directory, refuse_other_than_file, write_whole
from safevar_sumo.results.manifest import FORMAT, MANIFEST, read_manifest
from safevar_sumo.results.store import RUNS, SOLUTIONS, solutions_frame
from safevar_sumo.study import Study, tables_of

if TYPE_CHECKING:
    import pandas as pd

UNKNOWN = "unknown"
"""Outcome of an imported solution that did not collide: how it ended is not told."""


def write_imported(path: Path, study: Study, solutions: Mapping[str, Evaluations], original: Mapping[str, float | None],
                   files: Mapping[str, str]) -> None:
    """Write a results directory of imported solutions.

    Parameters
    ----------
    path
        Is made if it does not exist; what an earlier import has left there is replaced.
    solutions
        By algorithm.
    original
        The original vehicle's metrics, by name.
    files
        The name of the file that the solutions come from, by algorithm.

    Raises
    ------
    InputError
        If the directory cannot be written or holds results of a campaign.
    """
    make_directory(path)
    if (path / RUNS).exists() or ((path / MANIFEST).exists() and "imported" not in read_manifest(path)):
        raise InputError("--out", f"{path} holds results of a campaign", "another directory")
    manifest: dict[str, Any] = {
        "format": FORMAT, "study": tables_of(study), "imported": {"files": dict(files)},
        "versions": {"safevar_sumo": version("safevar_sumo")}, "original": dict(original)}
    frame = solutions_frame(tuple(study.vehicle.characteristics), [((name, 0), found) for name, found in solutions.items()])
    write_whole(path / SOLUTIONS, frame.drop(columns="run").to_csv(index=False, lineterminator="\n"))
    write_whole(path / MANIFEST, json.dumps(manifest, indent=2, allow_nan=False) + "\n")


def read_imported(path: Path, characteristics: tuple[str, ...]) -> pd.DataFrame:
    """The imported solutions, without a run column.

    Raises
    ------
    InputError
        If the file is missing or damaged.
    """
    import pandas as pd

    file = path / SOLUTIONS
    numbers = [*characteristics, "f_safe", "f_diff", "f_num_diff", *METRICS]
    refuse_other_than_file(file)
    try:
        frame = pd.read_csv(file, dtype=str, keep_default_na=False)[["algorithm", *numbers, "outcome"]]
        found = frame.replace({name: {"": "nan"} for name in numbers}).astype(dict.fromkeys(numbers, float))
    except OSError as error:
        raise InputError(file, f"cannot be read: {error.strerror or error}", "what the command import has written") from None
    except (KeyError, ValueError) as error:
        raise InputError(file, f"is damaged: {str(error).splitlines()[0]}", "what the command import has written") from None
    always = [name for name in numbers if name not in METRICS]
    if not np.isfinite(found[always].to_numpy()).all():
        raise InputError(file, f"is damaged: no number in one of the columns {', '.join(always)}", "what the command import has written")
    return found.astype({"f_num_diff": int})
