"""What the whole is for: in every study a short search finds settings that are less safe than the original."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

from safevar_sumo.study import study_names
from tests.end_to_end.test_commands import run

LONG = ("euro_ncap_car_to_car", "euro_ncap_pedestrian", "wear")


@pytest.mark.parametrize("study", [pytest.param(name, marks=pytest.mark.slow) if name in LONG else name for name in study_names()])
def test_a_short_search_finds_less_safe_settings(study: str, in_tmp: Path) -> None:
    run("study", study, "--algorithms", "nsga2", "--runs", "1", "--evaluations", "400", "--out", "out", "--quiet")
    original = json.loads(Path("out/manifest.json").read_text())["original"]
    solutions = pd.read_csv("out/solutions.csv")
    assert solutions["f_safe"].min() < 0.8 * original["safety_degree"]
    if study == "rain":
        assert (solutions["outcome"] == "collision").any()
