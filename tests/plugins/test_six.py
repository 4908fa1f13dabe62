"""One member of every kind from a folder outside the package: a study and its tables."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from safevar_sumo.results import load
from tests.in_process import run


@pytest.fixture(autouse=True)
def _six(in_tmp: Path) -> None:
    shutil.copytree(Path(__file__).parent / "six", "six")


def test_members_from_outside_are_simulated_and_scored() -> None:
    told = json.loads(run("simulate", "six/mine.toml", "--set", "grip=5", "--json").stdout)
    assert told["jerk"] > 0
    assert told["mean_change"] == pytest.approx(3 / 8 / 3)


@pytest.mark.slow
def test_members_from_outside_are_searched_and_tabulated() -> None:
    run("study", "six/mine.toml", "--out", "out", "--runs", "1", "--evaluations", "20", "--quiet")
    solutions = load("out").solutions
    assert set(solutions["algorithm"]) == {"nsga2", "Halving"}
    assert np.isfinite(solutions[["jerk", "mean_change"]].to_numpy()).all()
    assert solutions["f_diff"].max() <= 1 / 2 + 1e-9, "the weight of mass halves its changes"
    for question in ("rq1", "rq2"):
        rows = json.loads(run("tables", "out", "--rq", question, "--format", "json").stdout)
        assert "jerk" in {row["metric"] for row in rows}
