"""Writes the results directory of a study, or of imported solutions, and makes tables of
evaluations and solutions. The same study and seed give the same bytes.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from importlib.metadata import version
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import msgspec
import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import METRICS, PUBLISHED_SCORING, Scoring
from safevar_sumo.output import read_file
from safevar_sumo.records import Evaluations, JsonObject, csv_text, finite_or_none
from safevar_sumo.results.identity import (
    FORMAT,
    IDENTITY,
    identity_digest,
    manifest_differences,
    search_extent_of,
)
from safevar_sumo.results.journal import journal_head, open_and_lock, read_journal
from safevar_sumo.results.manifest import (
    MANIFEST,
    RUNS,
    SOLUTIONS,
    disk_errors,
    journal_file,
    make_directory,
    read_manifest,
    run_name,
    write_manifest,
    write_whole,
)
from safevar_sumo.study import Study, convert_table, tables_of

if TYPE_CHECKING:
    import pandas as pd

RunName = tuple[str, int]
"""An algorithm, and the number of a run."""
NO_RUN: RunName = ("", 0)
"""The name that stands for a run where evaluations belong to no run."""
RunKeyT = TypeVar("RunKeyT", bound=RunName)
"""The type of the keys by which a caller names its runs: a `RunName`, or a subtype."""


MACHINE_ROUNDING = 1e-6
"""Largest difference, relative or absolute, that another machine may cause in the results of the
original vehicle.
"""


class ResultsDirectory:
    """The directory that a campaign works in.

    Parameters
    ----------
    path
        The directory; it is made if it does not exist.
    study
        The study, with the options with which it is run.
    manifest
        The study's manifest; see `safevar_sumo.campaign.inputs.manifest_now`.
    scoring
        Metrics and objectives.
    run_names
        Names of the runs that are to be carried out.

    Raises
    ------
    SafevarError
        If the directory cannot be written; if it, or a journal in it, belongs to another study or
        version; or if another process works on one of the runs. Nothing in the directory is changed
        before such an error.
    """

    def __init__(
        self,
        path: Path,
        study: Study,
        manifest: JsonObject,
        scoring: Scoring = PUBLISHED_SCORING,
        run_names: Collection[str] = (),
    ) -> None:
        self.path = path
        self._study = study
        folders = [
            os.path.relpath(folder, path.resolve()) for folder in study.origin.places
        ]
        self.manifest = {**manifest, "folders": folders}
        if scoring != PUBLISHED_SCORING:
            self.manifest["scoring"] = msgspec.to_builtins(scoring)

        # Raises an error if the directory has results of another study.
        make_directory(path)
        self._earlier_manifest()

        # Journals that the runs cannot continue are refused before anything is changed.
        for key, journal, head in stored_journals(path, self.manifest):
            read_journal(journal, head, head_only=True)
            if run_name(*key) in run_names:
                open_and_lock(journal).close()

    def begin(self, original: Evaluations) -> None:
        """Write the manifest, with the evaluation of the original vehicle. Remove a table of
        solutions that belongs to other runs or another number of evaluations.
        """
        # Another process may have written results since the directory was opened.
        earlier_manifest = self._earlier_manifest()
        original_record = record(original)
        if self._study.scenario.repeats == 1:
            refuse_other_original(
                self.path, earlier_manifest.get("original", {}), original_record
            )
        write_manifest(self.path, {**self.manifest, "original": original_record})
        if earlier_manifest and (
            search_extent_of(earlier_manifest) != search_extent_of(self.manifest)
        ):
            file = self.path / SOLUTIONS
            with disk_errors(file, "removed"):
                file.unlink(missing_ok=True)

    def finish(self, solutions: Mapping[RunKeyT, Evaluations]) -> None:
        """Write the table of the solutions of all runs; `solutions` has the solutions of each run,
        by its algorithm and number.
        """
        frame = solutions_frame(self._study.domains, solutions.items())
        write_whole(self.path / SOLUTIONS, csv_text(frame))

    def extent_remarks(self, names: Collection[str]) -> list[str]:
        """Remarks on earlier results in the directory: their runs had another number of
        evaluations, or they have runs that are not among `names`, the runs of the study now.
        """
        earlier_manifest = self._earlier_manifest()
        if not earlier_manifest:
            return []
        remarks = []
        budget = self._study.search.evaluations
        old_budget = earlier_manifest["study"]["search"]["evaluations"]
        if old_budget != budget:
            remarks.append(
                f"{self.path}: each run had {old_budget} evaluations before and has {budget} now:"
                " an id such as nsga2:0:0 may name another solution than in earlier output and"
                " reports"
            )
        stored = {path.stem for path in (self.path / RUNS).glob("*.jsonl")}
        if other_runs := ", ".join(sorted(stored - {*names})):
            remarks.append(
                f"{self.path}: earlier runs are left out of the results: {other_runs}"
            )
        return remarks

    def _earlier_manifest(self) -> JsonObject:
        """The manifest of earlier results in the directory; empty if there are none. Raises an
        error if they belong to another study.
        """
        if not (self.path / MANIFEST).exists():
            return {}
        stored = read_manifest(self.path)
        problem = "holds results of another study"
        if "imported" in stored:
            raise InputError(
                self.path, f"{problem}: they are imported", "another `out`"
            )
        for layer, text, _ in manifest_differences(stored, self.manifest):
            raise InputError(
                self.path, f"{problem}: {text}", f"another `out`, or {IDENTITY[layer]}"
            )
        return stored


def stored_journals(
    directory: Path, manifest: JsonObject
) -> Iterator[tuple[RunName, Path, JsonObject]]:
    """Yield the existing journals of a manifest's study: the algorithm and number of the run, the
    journal's file, and the head that the file must have.
    """
    study = convert_table(manifest["study"], Study)
    characteristics = list(study.domains)
    digest = identity_digest(manifest)
    for algorithm, run in product(study.search.labels, range(study.search.runs)):
        name = run_name(algorithm, run)
        path = journal_file(directory, name)
        if path.exists():
            yield (algorithm, run), path, journal_head(digest, name, characteristics)


def solutions_frame(
    characteristics: Collection[str],
    solutions: Iterable[tuple[RunName, Evaluations]],
) -> pd.DataFrame:
    """A table with a row for each solution of each run, in a fixed order. It has the columns of
    `evaluations_frame`.
    """
    return in_order(evaluations_frame(characteristics, solutions), characteristics)


def in_order(solutions: pd.DataFrame, characteristics: Collection[str]) -> pd.DataFrame:
    """The rows of a table of solutions, in the order of `solutions.csv`."""
    columns = ["algorithm", "run", "f_safe", "f_diff", "f_num_diff", *characteristics]
    return solutions.sort_values(columns, kind="stable", ignore_index=True)


def evaluations_frame(
    characteristics: Collection[str],
    runs: Iterable[tuple[RunName, Evaluations]],
) -> pd.DataFrame:
    """A table with a row for each evaluation of each run.

    Columns: algorithm, run, the characteristics' filtered values in the units of the study, f_safe,
    f_diff [fraction], f_num_diff, safety_degree [m or -m/s], tet [s], tit [s^2], ave_dece [m/s^2],
    further metrics, outcome.
    """
    import pandas as pd

    all_runs = list(runs)
    metrics = list(METRICS)
    for _, evaluations in all_runs:
        metrics += evaluations.metrics
    # Without runs the frame has all columns, too.
    empty = Evaluations.none(len(characteristics), metrics)
    frames = [
        pd.DataFrame(
            {
                "algorithm": np.full(len(evaluations), algorithm, object),
                "run": np.full(len(evaluations), run),
                **dict(zip(characteristics, evaluations.settings.T, strict=True)),
                "f_safe": evaluations.f_safe,
                "f_diff": evaluations.f_diff,
                "f_num_diff": evaluations.f_num_diff.astype(int),
                **evaluations.metrics,
                "outcome": evaluations.outcome.astype(object),
            }
        )
        for (algorithm, run), evaluations in [(NO_RUN, empty), *all_runs]
    ]
    return pd.concat(frames, ignore_index=True)


def record(evaluations: Evaluations) -> JsonObject:
    """The evaluation in one row, as plain values by name; an undefined value is None."""
    numbers = {
        "collision_speed": evaluations.collision_speed[0],
        **evaluations.first_metrics,
        "f_safe": evaluations.f_safe[0],
        "f_diff": evaluations.f_diff[0],
    }
    return {
        "outcome": str(evaluations.outcome[0]),
        "collision": bool(evaluations.collided[0]),
        **{name: finite_or_none(value) for name, value in numbers.items()},
        "f_num_diff": int(evaluations.f_num_diff[0]),
    }


def refuse_other_original(directory: Path, stored: JsonObject, now: JsonObject) -> None:
    """Refuse to continue results if the simulator drives the original vehicle in another way now.
    `stored` and `now` are results of the original vehicle, as of `record`.

    Raises
    ------
    InputError
        About the first result that differs by more than `MACHINE_ROUNDING`.
    """
    for name, old in stored.items():
        new = now.get(name, old)
        if isinstance(old, str) or isinstance(new, str):
            is_same = old == new
        else:
            # An undefined value is None, which becomes NaN.
            values = np.array([old, new], float)
            is_same = np.allclose(
                values[0], values[1], MACHINE_ROUNDING, MACHINE_ROUNDING, equal_nan=True
            )
        if not is_same:
            raise InputError(
                directory,
                f"the original vehicle had {name} = {old}, and has {new} now",
                "what the simulator read and ran at that time; or another `out`",
            )


UNKNOWN = "unknown"
"""Outcome of an imported solution that did not collide."""


def write_imported(
    path: Path,
    study: Study,
    solutions: Mapping[str, Evaluations],
    original: dict[str, float | None],
    files: dict[str, str],
) -> None:
    """Write a results directory of imported solutions; it replaces an earlier import.

    Parameters
    ----------
    path
        The directory, made if it does not exist.
    solutions
        Solutions by algorithm.
    original
        The original vehicle's metrics, by name.
    files
        Name of the solutions' file, by algorithm.

    Raises
    ------
    InputError
        If the directory cannot be written, or holds results of a campaign.
    """
    make_directory(path)
    if (path / RUNS).exists():
        raise InputError(path, "holds results of a campaign", "another directory")

    runs = (
        ((algorithm, 0), evaluations) for algorithm, evaluations in solutions.items()
    )
    frame = solutions_frame(study.vehicle.characteristics, runs).drop(columns="run")
    manifest = {
        "format": FORMAT,
        "study": tables_of(study),
        "imported": {"files": files},
        "versions": {"safevar_sumo": version("safevar_sumo")},
        "original": original,
    }
    write_whole(path / SOLUTIONS, csv_text(frame))
    write_manifest(path, manifest)


def read_imported(path: Path, characteristics: Collection[str]) -> pd.DataFrame:
    """The table of imported solutions, which has no column `run`.

    Raises
    ------
    InputError
        If the file is missing or damaged.
    """
    import pandas as pd

    file = path / SOLUTIONS
    numbers: dict[str, type] = dict.fromkeys(
        [*characteristics, "f_safe", "f_diff", "f_num_diff", *METRICS], float
    )
    numbers["f_num_diff"] = int
    try:
        frame = pd.read_csv(
            BytesIO(read_file(file)),
            keep_default_na=False,
            na_values=[""],
            float_precision="round_trip",
        )
        return frame[["algorithm", *numbers, "outcome"]].astype(numbers)
    except (OSError, KeyError, ValueError) as error:
        raise InputError(
            file,
            f"holds no imported solutions: {str(error).splitlines()[0]}",
            "what the command `import` has written",
        ) from None
