"""Imported results: a results directory with solutions of another program, but without runs and evaluations."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations
from safevar_sumo.results.files import MANIFEST, RUNS, SOLUTIONS, make_directory, write_whole
from safevar_sumo.results.journal import FORMAT
from safevar_sumo.results.manifest import read_manifest, write_manifest
from safevar_sumo.results.store import solutions_frame
from safevar_sumo.study import Study, refuse_other_than_file, tables_of

if TYPE_CHECKING:
    import pandas as pd

UNKNOWN = "unknown"
"""Outcome of an imported solution that did not collide."""


def write_imported(
    path: Path,
    study: Study,
    solutions: Mapping[str, Evaluations],
    original: Mapping[str, float | None] | None,
    files: Mapping[str, str],
) -> dict[str, int]:
    """Write a results directory of imported solutions; returns the numbers of earlier solutions that they replace, by
    algorithm.

    Parameters
    ----------
    path
        The directory, made if it does not exist. It keeps solutions of other algorithms from an earlier import of the
        same study.
    solutions
        Solutions by algorithm.
    original
        The original vehicle's metrics, by name; None keeps the metrics of an earlier import.
    files
        Name of the solutions' file, by algorithm.

    Raises
    ------
    InputError
        If the directory cannot be written, or holds results of a campaign or of another study.
    """
    import pandas as pd

    make_directory(path)
    tables, characteristics = tables_of(study), tuple(study.vehicle.characteristics)
    earlier_manifest = _earlier_manifest(path, tables)
    frame = solutions_frame(
        characteristics, [((algorithm, 0), evaluations) for algorithm, evaluations in solutions.items()]
    )
    frame = frame.drop(columns="run")
    replaced_counts: dict[str, int] = {}
    if earlier_manifest:
        stored = read_imported(path, characteristics)
        is_replaced = stored["algorithm"].isin(list(solutions))
        replaced_counts = {
            str(name): int(count) for name, count in stored["algorithm"][is_replaced].value_counts().items()
        }
        frame = pd.concat([stored[~is_replaced], frame], ignore_index=True)
        frame = frame.sort_values(
            ["algorithm", "f_safe", "f_diff", "f_num_diff", *characteristics], kind="stable", ignore_index=True
        )
    manifest: dict[str, Any] = {
        "format": FORMAT,
        "study": tables,
        "imported": {"files": {**earlier_manifest.get("imported", {}).get("files", {}), **files}},
        "versions": {"safevar_sumo": version("safevar_sumo")},
        "original": dict(earlier_manifest.get("original", {}) if original is None else original),
    }
    write_whole(path / SOLUTIONS, frame.to_csv(index=False, lineterminator="\n"))
    write_manifest(path, manifest)
    return replaced_counts


def _earlier_manifest(path: Path, study: dict[str, Any]) -> dict[str, Any]:
    """The manifest of an earlier import of the study; empty if there is none."""
    if not (path / RUNS).exists() and not (path / MANIFEST).exists():
        return {}
    manifest = read_manifest(path) if (path / MANIFEST).exists() else {}
    if (path / RUNS).exists() or "imported" not in manifest:
        raise InputError(path, "holds results of a campaign", "another directory")
    if manifest["study"] != study:
        raise InputError(
            path,
            f"holds solutions of another study or another version of it, {manifest['study'].get('name')!r}",
            "another directory",
        )
    return manifest


def read_imported(path: Path, characteristics: tuple[str, ...]) -> pd.DataFrame:
    """The imported solutions, without a run column.

    Raises
    ------
    InputError
        If the file is missing or damaged.
    """
    import pandas as pd

    file = path / SOLUTIONS
    numeric_columns = [*characteristics, "f_safe", "f_diff", "f_num_diff", *METRICS]
    refuse_other_than_file(file)
    try:
        frame = pd.read_csv(file, dtype=str, keep_default_na=False)[["algorithm", *numeric_columns, "outcome"]]
        table = frame.replace({name: {"": "nan"} for name in numeric_columns}).astype(
            dict.fromkeys(numeric_columns, float)
        )
    except OSError as error:
        raise InputError(
            file, f"cannot be read: {error.strerror or error}", "what the command `import` has written"
        ) from None
    except (KeyError, ValueError) as error:
        raise InputError(
            file, f"is damaged: {str(error).splitlines()[0]}", "what the command `import` has written"
        ) from None
    required_columns = [name for name in numeric_columns if name not in METRICS]
    if not np.isfinite(table[required_columns].to_numpy()).all():
        raise InputError(
            file,
            f"is damaged: a value in the columns {', '.join(required_columns)} is missing or infinite",
            "what the command `import` has written",
        )
    return table.astype({"f_num_diff": int})
