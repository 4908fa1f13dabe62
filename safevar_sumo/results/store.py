"""A results directory: `manifest.json`, the runs' journals and `solutions.csv`, the same for the same study and seed."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterable, Mapping
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.metrics import METRICS
from safevar_sumo.records import Evaluations
from safevar_sumo.results.journal import Journal
from safevar_sumo.study import Study, tables_of

if TYPE_CHECKING:
    import pandas as pd

MANIFEST, SOLUTIONS, RUNS = "manifest.json", "solutions.csv", "runs"
VERSIONED = ("safevar_sumo", "libsumo", "deap", "numpy")
FREE_OPTIONS = ("runs", "algorithms")
"""Keys of a study's search table that may change between two calls into the same directory."""


class ResultsDirectory:
    """The directory that a campaign works in.

    Parameters
    ----------
    path
        Is made if it does not exist.
    study
        The study as it is run, options applied.
    network
        Fingerprint of the network that it is run on.

    Raises
    ------
    InputError
        If the directory cannot be written or belongs to another study or version.
    """

    def __init__(self, path: Path, study: Study, network: str = "") -> None:
        self.path, self._study = path, study
        self._manifest: dict[str, Any] = {
            "study": tables_of(study),
            "seed": study.search.seed,
            "network": network,
            "versions": {name: version(name) for name in VERSIONED},
        }
        make_directory(path)
        self._refuse_another_study()

    def journal(self, run: str) -> Journal:
        """Open and lock the journal of a run, such as nsga2-03."""
        fixed = {key: value for key, value in self._manifest["study"]["search"].items() if key not in FREE_OPTIONS}
        study = {**self._manifest["study"], "search": fixed}
        identity = json.dumps([study, self._manifest["versions"], self._manifest["network"]], sort_keys=True)
        return Journal(self.path / RUNS / f"{run}.journal", sha256(identity.encode()).hexdigest(), run)

    def begin(self, original: Evaluations) -> None:
        """Write the manifest, with the original vehicle's evaluation."""
        manifest = {**self._manifest, "original": record(original, 0)}
        write_whole(self.path / MANIFEST, json.dumps(manifest, indent=2, allow_nan=False) + "\n")

    def finish(self, solutions: Mapping[Any, Evaluations]) -> None:
        """Write the solutions of every run, by (algorithm, run)."""
        frame = solutions_frame(tuple(self._study.vehicle.characteristics), solutions.items())
        write_whole(self.path / SOLUTIONS, frame.to_csv(index=False, lineterminator="\n"))

    def _refuse_another_study(self) -> None:
        file = self.path / MANIFEST
        if not file.exists():
            return
        stored = read_manifest(self.path)
        differs = (_difference(stored["study"], self._manifest["study"])
                   or _difference(stored["versions"], self._manifest["versions"], "version of")
                   or _difference(stored.get("network"), self._manifest["network"], "fingerprint of the network"))
        if differs:
            raise InputError(self.path, f"holds results of another study: {differs}", "another --out, or the same study and options")


def make_directory(path: Path) -> None:
    """Make a directory for results, if there is none.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise InputError("--out", f"cannot write to {path}: {error.strerror}", "a directory that can be written") from None


def write_whole(path: Path, text: str) -> None:
    """Write a file as a whole or not at all."""
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".tmp")
        try:
            with open(handle, "w", encoding="utf-8", newline="") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(temporary, 0o644)
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise
    except OSError as error:
        raise SafevarError(f"{path}: cannot be written: {error.strerror}; what was written before stays valid") from None


def read_manifest(directory: Path) -> dict[str, Any]:
    """The manifest of a results directory.

    Raises
    ------
    InputError
        If there is none, or the file is something else.
    """
    file = directory / MANIFEST
    legal = "a directory that the command study has written"
    try:
        manifest = json.loads(file.read_text(encoding="utf-8"))
        if isinstance(manifest["study"], dict) and isinstance(manifest["versions"], dict):
            return dict(manifest)
    except FileNotFoundError:
        raise InputError(directory, f"is no results directory: there is no {MANIFEST}", legal) from None
    except OSError as error:
        raise InputError(file, f"cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, RecursionError):
        pass
    raise InputError(file, "is not a manifest of this program", legal)


def solutions_frame(characteristics: tuple[str, ...], solutions: Iterable[tuple[tuple[str, int], Evaluations]]) -> pd.DataFrame:
    """One row per solution of every run, in a fixed order; columns as in `evaluations_frame`."""
    frame = evaluations_frame(characteristics, solutions)
    columns = ["algorithm", "run", "f_safe", "f_diff", "f_num_diff", *characteristics]
    return frame.sort_values(columns, kind="stable", ignore_index=True)


def evaluations_frame(characteristics: tuple[str, ...], runs: Iterable[tuple[tuple[str, int], Evaluations]]) -> pd.DataFrame:
    """One row per evaluation.

    Columns: algorithm, run, the characteristics' filtered values in their table units, f_safe, f_diff [fraction],
    f_num_diff, safety_degree [m or -m/s], tet [s], tit [s^2], ave_dece [m/s^2], outcome.
    """
    import pandas as pd

    frames = [_frame("", 0, characteristics, Evaluations.none(len(characteristics), METRICS))]
    frames += [_frame(algorithm, run, characteristics, found) for (algorithm, run), found in runs]
    return pd.concat(frames, ignore_index=True)


def _frame(algorithm: str, run: int, characteristics: tuple[str, ...], found: Evaluations) -> pd.DataFrame:
    import pandas as pd

    return pd.DataFrame({
        "algorithm": np.full(len(found), algorithm, dtype=object), "run": np.full(len(found), run),
        **dict(zip(characteristics, found.settings.T, strict=True)), "f_safe": found.f_safe, "f_diff": found.f_diff,
        "f_num_diff": found.f_num_diff.astype(int), **found.metrics, "outcome": found.outcome.astype(object)})


def record(evaluations: Evaluations, row: int) -> dict[str, Any]:
    """One evaluation as plain values; what is undefined is None."""
    numbers = {
        "collision_speed": evaluations.collision_speed[row],
        **{name: values[row] for name, values in evaluations.metrics.items()},
        "f_safe": evaluations.f_safe[row], "f_diff": evaluations.f_diff[row]}
    return {
        "outcome": str(evaluations.outcome[row]), "collision": bool(evaluations.collided[row]),
        **{name: None if np.isnan(value) else float(value) for name, value in numbers.items()},
        "f_num_diff": int(evaluations.f_num_diff[row])}


def _difference(stored: Any, new: Any, key: str = "") -> str:
    """The first key in which two studies differ, told with both values; free options do not count."""
    if isinstance(stored, dict) and isinstance(new, dict):
        for name in sorted({*stored, *new}):
            inner = f"{key}.{name}" if key else name
            if inner in [f"search.{option}" for option in FREE_OPTIONS]:
                continue
            told = _difference(stored.get(name), new.get(name), inner)
            if told:
                return told
        return ""
    return "" if stored == new else f"{key} is {stored!r} there and {new!r} here"
