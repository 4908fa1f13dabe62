"""Results whose simulator drives the original vehicle otherwise now are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from msgspec.structs import replace as replace_in

from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.questions.case import Results, load_cases
from safevar_sumo.questions.evaluator import Evaluator
from tests.support.in_process import InlinePool, searched, write

SIMULATOR = """
import os


class Wall:
    UNITS = {"decel": "m/s^2", "delay": "s"}

    def simulate(self, setting):
        decel = setting["decel"] * float(os.environ.get("GRIP", "1"))
        rest = 40 - 15 * setting["delay"] - 15**2 / 2 / decel
        return {"outcome": "stopped" if rest > 0 else "collision", "safety_degree": rest}
"""
STUDY = """
name = "wall"
title = "Brakes before a wall"
scenario.model = "walls:Wall"
metrics.ttc_threshold = 1.5
search = { algorithms = ["rs"], population = 4, evaluations = 8, runs = 1, seed = 1 }
[vehicle.characteristics]
decel = { unit = "m/s^2", original = 8, lower = 3, upper = 9 }
delay = { unit = "s", original = 0.5, lower = 0, upper = 1 }
"""


def test_a_simulator_that_drives_the_original_otherwise_now_is_refused(
    in_tmp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unless its runs are noisy, or at one point, which the results do not state."""
    write("walls.py", SIMULATOR)
    write("wall.toml", STUDY)
    study = load_study("wall.toml")
    (case,) = load_cases([searched(study, Path("results"))])
    noisy = replace_in(study, scenario=replace_in(study.scenario, repeats=2))
    at_point = replace_in(study, origin=replace_in(study.origin, point="a"))

    def compare(with_study: Results) -> None:
        evaluator = Evaluator(with_study.study, InlinePool())
        evaluator.refuse_other_original(with_study)

    compare(case)
    monkeypatch.setenv("GRIP", "0.5")
    with pytest.raises(InputError, match="the original vehicle had"):
        compare(case)
    for other in (noisy, at_point):
        compare(replace(case, study=other))
    compare(replace(case, has_runs=False))
