"""Results read back as tidy frames, without SUMO."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.results.frames import NOTHING
from safevar_sumo.results.imported import read_imported
from safevar_sumo.results.inputs import refuse_edited_table
from safevar_sumo.results.journal import read_journal
from safevar_sumo.results.manifest import MANIFEST, RUNS, owner, read_manifest
from safevar_sumo.results.store import SOLUTIONS, evaluations_frame, solutions_frame
from safevar_sumo.study import label_of

if TYPE_CHECKING:
    import pandas as pd


class Failure(NamedTuple):
    """A setting that could not be simulated: whose it was, its place in the run, and why."""

    algorithm: str
    run: int
    evaluation: int
    reason: str

    def __str__(self) -> str:
        return f"{self.algorithm}:{self.run}, evaluation {self.evaluation}: {self.reason}"


def failure_lines(failures: Sequence[Failure]) -> list[str]:
    """Failures told by their reasons: of each how many, and the first of them."""
    reasons: dict[str, list[Failure]] = {}
    for one in failures:
        reasons.setdefault(one.reason, []).append(one)
    return [str(found[0]) if len(found) == 1 else f"{found[0]} (and {len(found) - 1} more)" for found in reasons.values()]


class Results(NamedTuple):
    """What a results directory holds.

    Attributes
    ----------
    manifest
        The study as run, versions, seed, the original vehicle's evaluation.
    evaluations
        One row per simulated setting of every run, in the order in which the run asked for it first; columns of
        `safevar_sumo.results.evaluations_frame`, and `evaluation`, its place in that order from 0.
    solutions
        One row per solution of every finished run; the same columns but `evaluation`. Imported ones belong to no run.
    finished
        Algorithm and number of every finished run.
    failures
        Every setting that could not be simulated.
    """

    manifest: dict[str, Any]
    evaluations: pd.DataFrame
    solutions: pd.DataFrame
    finished: tuple[tuple[str, int], ...] = ()
    failures: tuple[Failure, ...] = ()


def load(directory: str | Path) -> Results:
    """Read a results directory, finished or not: what its manifest's study asks for.

    Raises
    ------
    InputError
        If it is none, or a file in it is damaged or belongs to another study.
    """
    place = Path(directory)
    manifest = read_manifest(place)
    try:
        characteristics = tuple(manifest["study"]["vehicle"]["characteristics"])
        search = manifest["study"]["search"]
        wanted = [(name, run) for name in dict.fromkeys(map(label_of, search["algorithms"])) for run in range(search["runs"])]
        budget = int(search["evaluations"])
    except (KeyError, TypeError, ValueError):
        raise InputError(place / MANIFEST, "tells of no characteristics or of no search", "what the command study has written") from None
    again = "the same import again" if "imported" in manifest else "the same study again, which writes it from the journals"
    refuse_edited_table(place / SOLUTIONS, manifest, f"the file as it was, or {again}")
    if "imported" in manifest:
        return Results(manifest, evaluations_frame(characteristics, []).assign(evaluation=0), read_imported(place, characteristics))
    everything, solved, positions, failures = [], [], [], []
    study = owner(manifest)
    for algorithm, run in wanted:
        path = place / RUNS / f"{algorithm}-{run:02d}.journal"
        content = read_journal(path, study, path.stem) if path.exists() else NOTHING
        if content.evaluations is None:
            continue
        asked = sorted((position, row) for row, position in enumerate(content.positions) if 0 <= position < budget)
        evaluations = content.evaluations.take([row for _, row in asked])
        everything.append(((algorithm, run), evaluations))
        positions += [position for position, _ in asked]
        failures += [Failure(algorithm, run, asked[row][0], evaluations.reason(row)) for row in np.flatnonzero(evaluations.failed).tolist()]
        result = content.result(budget)
        if result is not None:
            solved.append(((algorithm, run), content.by_position(result.positions)))
    frame = evaluations_frame(characteristics, everything)
    frame.insert(2, "evaluation", positions)
    return Results(manifest, frame, solutions_frame(characteristics, solved), tuple(key for key, _ in solved), tuple(failures))
