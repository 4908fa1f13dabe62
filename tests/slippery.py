"""Results of a small study on wet leaves, made in this process: collisions and near misses among 30 solutions."""

from __future__ import annotations

from concurrent.futures import Future
from pathlib import Path

from safevar_sumo.campaign import all_runs, carry_out
from safevar_sumo.computing import evaluate_batch, identity_of
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import ResultsDirectory
from safevar_sumo.simulation import assemble
from safevar_sumo.study import load_study

STUDY = """
extends = "smoke"
name = "slippery"
title = "{title}"
[weather]
name = "wet leaves"
road_friction = 0.75
visibility = 1.0
recognition_delay = 0.15
[search]
algorithms = ["nsga2", "rs"]
population = 10
evaluations = 60
runs = 1
"""


class Here:
    """A pool that computes in this process, at once."""

    workers = 1

    def submit(self, study: bytes, settings: FloatArray) -> Future[Evaluations]:
        future: Future[Evaluations] = Future()
        future.set_result(evaluate_batch(study, settings))
        return future


class Silent:
    """An observer that nobody hears."""

    def evaluated(self, *_: object) -> None: ...
    def finished(self, *_: object) -> None: ...
    def warned(self, message: str) -> None: ...


def make_results(out: Path, title: str = "Crossing on wet leaves") -> Path:
    """Carry the study out and leave its results directory in `out`."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "slippery.toml").write_text(STUDY.format(title=title))
    study = load_study(str(out / "slippery.toml"))
    results = ResultsDirectory(out / "results", study, identity_of(study, assemble(study)))
    campaign = carry_out(study, all_runs(study), results, Here(), Silent())
    results.finish(campaign.solutions)
    return results.path
