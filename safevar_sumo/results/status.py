"""How far a study is, read from its journals while it runs: nothing is locked, nothing is written."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.results.journal import read_journal
from safevar_sumo.results.manifest import MANIFEST, RUNS, owner, read_manifest
from safevar_sumo.study import label_of


class RunStatus(NamedTuple):
    """How far one run is: different settings simulated, how many of them collided or could not be simulated, its least
    safety degree.

    `best` is in m, or -m/s, None before the first simulation; `state` is waiting, begun or finished.
    """

    algorithm: str
    run: int
    state: str
    simulated: int
    collisions: int
    simulator_errors: int
    best: float | None


class Status(NamedTuple):
    """How far a study is; `budget` is what a run may simulate at the most, `points` what was found: (f_safe, f_diff, f_num_diff)."""

    study: str
    title: str
    budget: int
    runs: tuple[RunStatus, ...]
    points: np.ndarray

    @property
    def finished(self) -> bool:
        return all(run.state == "finished" for run in self.runs)

    @property
    def simulated(self) -> int:
        """Of all runs."""
        return sum(run.simulated for run in self.runs)

    @property
    def share(self) -> float:
        """Of the work that is done: what a finished run did not need counts as done."""
        done = sum(self.budget if run.state == "finished" else min(run.simulated, self.budget) for run in self.runs)
        return done / max(self.budget * len(self.runs), 1)

    def record(self) -> dict[str, Any]:
        """As `status --json` prints it."""
        return {"study": self.study, "finished": self.finished, "share": self.share, "simulated": self.simulated, "budget": self.budget,
                "runs": [run._asdict() for run in self.runs]}


def status(directory: str | Path) -> Status:
    """Look at a results directory, whether anybody works on it or not.

    Parameters
    ----------
    directory
        What the command `study` or `run` writes to.

    Returns
    -------
    Status
        How far every run is, and what was found so far.

    Raises
    ------
    InputError
        If it is none, holds imported solutions, or a journal is damaged or another study's.
    """
    place = Path(directory)
    manifest = read_manifest(place)
    if "imported" in manifest:
        raise InputError(place, "holds imported solutions, which have no runs", "results of the command study")
    try:
        study, search = manifest["study"], manifest["study"]["search"]
        keys = [(label, run) for label in dict.fromkeys(map(label_of, search["algorithms"])) for run in range(search["runs"])]
        budget, name, title = int(search["evaluations"]), str(study["name"]), str(study["title"])
    except (KeyError, TypeError, ValueError):
        raise InputError(place / MANIFEST, "tells of no study with a search", "what the command study has written") from None
    of = owner(manifest)
    looked = [_run(place / RUNS / f"{algorithm}-{run:02d}.journal", of, algorithm, run, budget) for algorithm, run in keys]
    return Status(name, title, budget, tuple(one for one, _ in looked), np.concatenate([points for _, points in looked]))


def _run(path: Path, of: str, algorithm: str, run: int, budget: int) -> tuple[RunStatus, np.ndarray]:
    content = read_journal(path, of, path.stem) if path.exists() else None
    found = content.within(budget) if content is not None else None
    if content is None or found is None:
        return RunStatus(algorithm, run, "waiting" if content is None else "begun", 0, 0, 0, None), np.zeros((0, 3))
    valid = found.take(found.valid)
    state = "finished" if content.result(budget) is not None else "begun"
    best = float(np.min(valid.f_safe)) if len(valid) else None
    return (RunStatus(algorithm, run, state, len(found), int(np.count_nonzero(found.collided)), int(np.count_nonzero(found.failed)), best),
            np.stack([valid.f_safe, valid.f_diff, valid.f_num_diff], axis=1))
