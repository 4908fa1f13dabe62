"""The results directory of a study (the same study and seed give the same bytes), and tables of evaluations and solutions."""

from __future__ import annotations

import shlex
import time
from collections.abc import Iterable, Mapping
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.metrics import METRICS, PUBLISHED_SCORING, Scoring
from safevar_sumo.records import Evaluations, finite_or_none
from safevar_sumo.results.files import (
    MANIFEST,
    RUNS,
    SOLUTIONS,
    journal_file,
    make_directory,
    read_late_files,
    record_late_file,
    sync_directory,
    write_folders,
    write_whole,
)
from safevar_sumo.results.journal import Journal, JournalBusyError, owner_of
from safevar_sumo.results.manifest import (
    DIGESTS_KEY,
    digest_of_table,
    first_difference,
    make_inputs_comparable,
    manifest_of,
    owner_digest,
    read_manifest,
    search_extent_of,
    write_manifest,
)
from safevar_sumo.study import Study

if TYPE_CHECKING:
    import pandas as pd

SECONDS_TO_CLAIM = 10.0
"""Time within which another process writes the owner into a new journal [s]."""


class ResultsDirectory:
    """The directory that a campaign works in.

    Parameters
    ----------
    path
        The directory, made if it does not exist.
    study
        The study as it is run.
    identity
        Inputs of the study's results besides the study file; see `safevar_sumo.workers.identity.identity_of`.
    scoring
        Metrics and objectives.

    Raises
    ------
    InputError
        If the directory cannot be written, holds other files, or belongs to another study or version.
    """

    def __init__(self, path: Path, study: Study, identity: Mapping[str, Any] = MappingProxyType({}),
                 scoring: Scoring = PUBLISHED_SCORING) -> None:
        self.path, self._study, self.scoring = path, study, scoring
        self.manifest = manifest_of(study, identity)
        if scoring != PUBLISHED_SCORING:
            self.manifest["scoring"] = msgspec.to_builtins(scoring)
        make_directory(path)
        self._source_digests: dict[str, str] = dict(self.manifest.get("sources", {}))
        self._refuse_another_study()

    @property
    def inputs(self) -> dict[str, Any]:
        """Digests, by layer, of the files that all workers must share; `sources` include files that were read after the study began."""
        return {"network": self.manifest.get("network", {}), "sources": self._source_digests}

    def record_late_files(self, files: Mapping[str, str]) -> None:
        """Record files that user code has read since the study began; must be called before evaluations that use the files are journalled.

        Raises
        ------
        InputError
            If a file has changed since it was first read.
        """
        for name, digest in files.items():
            stored_digest = self._source_digests.get(name) or read_late_files(self.path).get(name, digest)
            if stored_digest != digest:
                raise InputError(name, "is not the file that this study began with: it was changed meanwhile",
                                 f"the file as it was, and the same command; or {another_directory(self.path)}")
            if name not in self._source_digests:
                record_late_file(self.path, name, digest)
                self._source_digests[name] = digest

    def journal(self, run: str) -> Journal:
        """Open and lock the journal of a run, such as nsga2-03."""
        path = journal_file(self.path, run)
        try:
            return Journal(path, owner_digest(self.manifest), run)
        except JournalBusyError:
            self._refuse_another_owner(path)
            raise

    def begin(self, original: Evaluations) -> None:
        """Write the manifest with the original vehicle's evaluation; remove a table of solutions that covers other runs."""
        manifest = {**self.manifest, "original": record(original, row=0)}
        earlier_manifest = read_manifest(self.path) if (self.path / MANIFEST).exists() else manifest
        is_outdated = search_extent_of(earlier_manifest) != search_extent_of(manifest)
        if not is_outdated and DIGESTS_KEY in earlier_manifest:
            manifest[DIGESTS_KEY] = earlier_manifest[DIGESTS_KEY]
        write_manifest(self.path, manifest)
        write_folders(self.path, self._study)
        if is_outdated:
            self._remove(self.path / SOLUTIONS)

    def finish(self, solutions: Mapping[Any, Evaluations]) -> None:
        """Write the solutions of every run, by (algorithm, run)."""
        frame = solutions_frame(tuple(self._study.vehicle.characteristics), solutions.items())
        text = frame.to_csv(index=False, lineterminator="\n")
        write_whole(self.path / SOLUTIONS, text)
        write_manifest(self.path, {**read_manifest(self.path), DIGESTS_KEY: {SOLUTIONS: digest_of_table(text)}})

    def _refuse_another_study(self) -> None:
        """Refuse results of another study; else take over the digests of files that were read after the study began."""
        if not (self.path / MANIFEST).exists():
            other_files = sorted(name for path in self.path.iterdir() if (name := path.name) not in (RUNS, SOLUTIONS) and name[0] != ".")
            if other_files and not (self.path / RUNS).exists():  # if there are journals, their owner decides whose directory this is
                raise InputError("out", f"{self.path} holds other files: {other_files[0]}", "an empty directory, or one of this study")
            return
        stored_manifest, late_files = read_manifest(self.path), read_late_files(self.path)
        if "imported" not in stored_manifest and late_files:
            folders = self._study.origin.places
            stored_manifest, self.manifest["sources"] = make_inputs_comparable(stored_manifest, self._source_digests, late_files, folders)
        problem, remedy = ("they are imported", "") if "imported" in stored_manifest else first_difference(stored_manifest, self.manifest)
        self._source_digests = {**self.manifest.get("sources", {}), **late_files}
        if problem:
            expected = f"{another_directory(self.path)}, or {remedy}" if remedy else another_directory(self.path)
            raise InputError(self.path, f"holds results of another study: {problem}", expected)

    def _refuse_another_owner(self, path: Path) -> None:
        """Wait until the process that holds a journal has written its owner; refuse another study."""
        deadline = time.monotonic() + SECONDS_TO_CLAIM
        while (owner := owner_of(path)) is None and time.monotonic() < deadline:
            time.sleep(SECONDS_TO_CLAIM / 1000)
        if owner != owner_digest(self.manifest):
            raise InputError(self.path, "is in use by another study that is running now", another_directory(self.path))

    def _remove(self, path: Path) -> None:
        try:
            path.unlink(missing_ok=True)
            sync_directory(self.path)
        except OSError as error:
            raise SafevarError(f"{path}: cannot be removed: {error.strerror}; it is outdated") from None


def another_directory(path: Path) -> str:
    """A remedy that can be typed for results that a study cannot continue: the next free directory, such as results/two-2."""
    stem = path if path.name else path.resolve()
    free_path = next(candidate for number in count(2) if not (candidate := Path(f"{stem}-{number}")).exists())
    return f"another `out`, such as `out={shlex.quote(str(free_path))}`"


def solutions_frame(characteristics: tuple[str, ...], solutions: Iterable[tuple[tuple[str, int], Evaluations]]) -> pd.DataFrame:
    """One row per solution of every run, in a fixed order; columns as in `evaluations_frame`."""
    frame = evaluations_frame(characteristics, solutions)
    columns = ["algorithm", "run", "f_safe", "f_diff", "f_num_diff", *characteristics]
    return frame.sort_values(columns, kind="stable", ignore_index=True)


def evaluations_frame(characteristics: tuple[str, ...], runs: Iterable[tuple[tuple[str, int], Evaluations]]) -> pd.DataFrame:
    """One row per evaluation.

    Columns: algorithm, run, the characteristics' filtered values in the units of the study, f_safe, f_diff [fraction],
    f_num_diff, safety_degree [m or -m/s], tet [s], tit [s^2], ave_dece [m/s^2], further metrics, outcome.
    """
    import pandas as pd

    all_runs = list(runs)
    metrics = dict.fromkeys([*METRICS, *(name for _, evaluations in all_runs for name in evaluations.metrics)])
    frames = [_frame_of_run("", 0, characteristics, Evaluations.none(len(characteristics), metrics))]  # all columns even without runs
    frames += [_frame_of_run(algorithm, run, characteristics, evaluations) for (algorithm, run), evaluations in all_runs]
    return pd.concat(frames, ignore_index=True)


def _frame_of_run(algorithm: str, run: int, characteristics: tuple[str, ...], evaluations: Evaluations) -> pd.DataFrame:
    import pandas as pd

    return pd.DataFrame({
        "algorithm": np.full(len(evaluations), algorithm, dtype=object), "run": np.full(len(evaluations), run),
        **dict(zip(characteristics, evaluations.settings.T, strict=True)), "f_safe": evaluations.f_safe, "f_diff": evaluations.f_diff,
        "f_num_diff": evaluations.f_num_diff.astype(int), **evaluations.metrics, "outcome": evaluations.outcome.astype(object)})


def record(evaluations: Evaluations, row: int) -> dict[str, Any]:
    """One evaluation as plain values; undefined values are None."""
    numbers = {
        "collision_speed": evaluations.collision_speed[row],
        **{name: values[row] for name, values in evaluations.metrics.items()},
        "f_safe": evaluations.f_safe[row], "f_diff": evaluations.f_diff[row]}
    return {
        "outcome": str(evaluations.outcome[row]), "collision": bool(evaluations.collided[row]),
        **{name: finite_or_none(value) for name, value in numbers.items()},
        "f_num_diff": int(evaluations.f_num_diff[row])}
