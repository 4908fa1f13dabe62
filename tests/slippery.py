"""Results of a small study on wet leaves, made in this process: collisions and near misses among 30 solutions."""

from __future__ import annotations

from pathlib import Path

from safevar_sumo.campaign import all_runs, run_campaign
from safevar_sumo.results import ResultsDirectory
from safevar_sumo.study import load_study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.workers.identity import identity_of
from tests.in_process import Here, Silent

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


def make_results(out: Path, title: str = "Crossing on wet leaves") -> Path:
    """Carry the study out and leave its results directory in `out`."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "slippery.toml").write_text(STUDY.format(title=title))
    study = load_study(str(out / "slippery.toml"))
    results = ResultsDirectory(out / "results", study, identity_of(study, assemble(study)))
    campaign = run_campaign(study, all_runs(study), results, Here(), Silent())
    results.finish(campaign.solutions)
    return results.path
