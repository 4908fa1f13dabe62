"""The results directory of a study (the same study and seed give the same bytes), and tables of evaluations and
solutions.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.metrics import METRICS, PUBLISHED_SCORING, Scoring
from safevar_sumo.plugins import digest_of, file_by_name
from safevar_sumo.records import Evaluations, finite_or_none
from safevar_sumo.results.files import MANIFEST, RUNS, SOLUTIONS, journal_file, make_directory, write_whole
from safevar_sumo.results.journal import Head, Journal, JournalBusyError, files_read_later, read_journal
from safevar_sumo.results.manifest import (
    IDENTITY,
    LAYERS_OF_FILES,
    Difference,
    differences,
    identity_digest,
    manifest_of,
    read_manifest,
    relative_folders,
    search_extent_of,
    write_manifest,
)
from safevar_sumo.study import Study, user_code_names

if TYPE_CHECKING:
    import pandas as pd


class ResultsDirectory:
    """The directory that a campaign works in.

    Parameters
    ----------
    path
        The directory, made if it does not exist.
    study
        The study as it is run.
    identity
        Inputs of the study's results besides the study file; see `safevar_sumo.campaign.identity.identity_of`.
    scoring
        Metrics and objectives.

    Raises
    ------
    InputError
        If the directory cannot be written, holds other files, or belongs to another study or version.
    """

    def __init__(
        self,
        path: Path,
        study: Study,
        identity: Mapping[str, Any] = MappingProxyType({}),
        scoring: Scoring = PUBLISHED_SCORING,
    ) -> None:
        self.path, self._study, self.scoring = path, study, scoring
        self.manifest = {**manifest_of(study, identity), "folders": relative_folders(path, study)}
        if scoring != PUBLISHED_SCORING:
            self.manifest["scoring"] = msgspec.to_builtins(scoring)
        make_directory(path)
        self._refuse_another_study()
        self.inputs: dict[str, Any] = {layer: self.manifest.get(layer, {}) for layer in LAYERS_OF_FILES}
        """Digests, by layer, of the files that all workers must share."""
        self.inputs["sources"] = {**self.inputs["sources"], **_later_files(path, study)}

    def head(self, run: str) -> Head:
        """The head of the journal of a run, such as nsga2-03."""
        return Head(identity_digest(self.manifest), run, tuple(self._study.vehicle.characteristics))

    def journal(self, run: str) -> Journal:
        """Open and lock the journal of a run."""
        path = journal_file(self.path, run)
        try:
            return Journal(path, self.head(run))
        except JournalBusyError:
            read_journal(path, self.head(run))  # refuses the journal of another study
            raise

    def begin(self, original: Evaluations) -> None:
        """Write the manifest with the original vehicle's evaluation; remove a table of solutions that covers other
        runs.
        """
        self._refuse_another_study()  # which may have begun meanwhile
        manifest = {**self.manifest, "original": record(original, row=0)}
        earlier_manifest = read_manifest(self.path) if (self.path / MANIFEST).exists() else manifest
        write_manifest(self.path, manifest)
        if search_extent_of(earlier_manifest) != search_extent_of(manifest):
            try:
                (self.path / SOLUTIONS).unlink(missing_ok=True)
            except OSError as error:
                raise SafevarError(
                    f"{self.path / SOLUTIONS}: cannot be removed: {error.strerror}; it is outdated"
                ) from None

    def finish(self, solutions: Mapping[Any, Evaluations]) -> None:
        """Write the solutions of every run, by (algorithm, run)."""
        frame = solutions_frame(tuple(self._study.vehicle.characteristics), solutions.items())
        write_whole(self.path / SOLUTIONS, frame.to_csv(index=False, lineterminator="\n"))

    def _refuse_another_study(self) -> None:
        expected = another_directory(self.path)
        if not (self.path / MANIFEST).exists():
            other_files = sorted(
                name for path in self.path.iterdir() if (name := path.name) not in (RUNS, SOLUTIONS) and name[0] != "."
            )
            if (
                other_files and not (self.path / RUNS).exists()
            ):  # if there are journals, their owner decides whose directory this is
                raise InputError(
                    "out",
                    f"{self.path} holds other files: {other_files[0]}",
                    "an empty directory, or one of this study",
                )
            return
        stored = read_manifest(self.path)
        if "imported" in stored:
            raise InputError(self.path, "holds results of another study: they are imported", expected)
        for difference in input_differences(self.path, stored, self.manifest, self._study):
            raise InputError(
                self.path,
                f"holds results of another study: {difference.text}",
                f"{expected}, or {IDENTITY[difference.layer]}",
            )


def input_differences(
    directory: Path, stored: Mapping[str, Any], now: Mapping[str, Any], study: Study
) -> list[Difference]:
    """The differences between the stored inputs of a directory's results, with files that were first read later, and
    present inputs.
    """
    later = _later_files(directory, study)
    later_now = {name: digest for name in later if (digest := digest_of(file_by_name(name, study.origin.places)))}
    return list(
        differences(
            *(
                {**manifest, "sources": {**files, **manifest.get("sources", {})}}
                for manifest, files in ((stored, later), (now, later_now))
            )
        )
    )


def _later_files(directory: Path, study: Study) -> dict[str, str]:
    has_user_code = user_code_names(study) or any(":" in name for name in study.search.algorithms)
    return files_read_later(directory) if has_user_code else {}


def another_directory(path: Path) -> str:
    """A remedy that can be typed for results that a study cannot continue: the next free directory, such as
    results/two-2.
    """
    stem = path if path.name else path.resolve()
    free_path = next(candidate for number in count(2) if not (candidate := Path(f"{stem}-{number}")).exists())
    return f"another `out`, such as `out={shlex.quote(str(free_path))}`"


def solutions_frame(
    characteristics: tuple[str, ...], solutions: Iterable[tuple[tuple[str, int], Evaluations]]
) -> pd.DataFrame:
    """One row per solution of every run, in a fixed order; columns as in `evaluations_frame`."""
    frame = evaluations_frame(characteristics, solutions)
    columns = ["algorithm", "run", "f_safe", "f_diff", "f_num_diff", *characteristics]
    return frame.sort_values(columns, kind="stable", ignore_index=True)


def evaluations_frame(
    characteristics: tuple[str, ...], runs: Iterable[tuple[tuple[str, int], Evaluations]]
) -> pd.DataFrame:
    """One row per evaluation.

    Columns: algorithm, run, the characteristics' filtered values in the units of the study, f_safe, f_diff [fraction],
    f_num_diff, safety_degree [m or -m/s], tet [s], tit [s^2], ave_dece [m/s^2], further metrics, outcome.
    """
    import pandas as pd

    all_runs = list(runs)
    metrics = dict.fromkeys([*METRICS, *(name for _, evaluations in all_runs for name in evaluations.metrics)])
    empty = ("", 0), Evaluations.none(len(characteristics), metrics)  # all columns even without runs
    return pd.concat(
        [
            pd.DataFrame(
                {
                    "algorithm": np.full(len(evaluations), algorithm, dtype=object),
                    "run": np.full(len(evaluations), run),
                    **dict(zip(characteristics, evaluations.settings.T, strict=True)),
                    "f_safe": evaluations.f_safe,
                    "f_diff": evaluations.f_diff,
                    "f_num_diff": evaluations.f_num_diff.astype(int),
                    **evaluations.metrics,
                    "outcome": evaluations.outcome.astype(object),
                }
            )
            for (algorithm, run), evaluations in [empty, *all_runs]
        ],
        ignore_index=True,
    )


def record(evaluations: Evaluations, row: int) -> dict[str, Any]:
    """One evaluation as plain values; undefined values are None."""
    numbers = {
        "collision_speed": evaluations.collision_speed[row],
        **{name: values[row] for name, values in evaluations.metrics.items()},
        "f_safe": evaluations.f_safe[row],
        "f_diff": evaluations.f_diff[row],
    }
    return {
        "outcome": str(evaluations.outcome[row]),
        "collision": bool(evaluations.collided[row]),
        **{name: finite_or_none(value) for name, value in numbers.items()},
        "f_num_diff": int(evaluations.f_num_diff[row]),
    }
