"""Results read back as tidy frames, without SUMO."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from safevar_sumo.errors import InputError
from safevar_sumo.results.imported import read_imported
from safevar_sumo.results.journal import read_journal
from safevar_sumo.results.store import MANIFEST, RUNS, evaluations_frame, read_manifest, solutions_frame

if TYPE_CHECKING:
    import pandas as pd


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
    """

    manifest: dict[str, Any]
    evaluations: pd.DataFrame
    solutions: pd.DataFrame
    finished: tuple[tuple[str, int], ...] = ()


def load(directory: str | Path) -> Results:
    """Read a results directory, finished or not.

    Raises
    ------
    InputError
        If it is none, or a file in it is damaged.
    """
    place = Path(directory)
    manifest = read_manifest(place)
    try:
        characteristics = tuple(manifest["study"]["vehicle"]["characteristics"])
    except (KeyError, TypeError):
        raise InputError(place / MANIFEST, "tells of no vehicle with characteristics", "what the command study has written") from None
    if "imported" in manifest:
        return Results(manifest, evaluations_frame(characteristics, []).assign(evaluation=0), read_imported(place, characteristics))
    everything, solved, positions = [], [], []
    for path in sorted((place / RUNS).glob("*-*.journal")):
        algorithm, _, run = path.stem.rpartition("-")
        if not run.isdecimal():
            continue
        places, evaluations, result = read_journal(path)
        if evaluations is None:
            continue
        order = sorted(range(len(places)), key=places.__getitem__)
        everything.append(((algorithm, int(run)), evaluations.take(order)))
        positions += [places[row] for row in order]
        if result is not None:
            row_of = {position: row for row, position in enumerate(places)}
            solved.append(((algorithm, int(run)), evaluations.take([row_of[position] for position in result])))
    frame = evaluations_frame(characteristics, everything)
    frame.insert(2, "evaluation", positions)
    return Results(manifest, frame, solutions_frame(characteristics, solved), tuple(key for key, _ in solved))
