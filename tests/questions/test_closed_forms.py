"""Two versions of a car before a wall, whose stop is a formula."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import safevar_sumo as sv
from tests.in_process import InlinePool, write
from tests.scenarios.test_simulated import STUDY

CARS = """
from typing import Annotated

import msgspec

from safevar_sumo.study import searched


class Car(msgspec.Struct, frozen=True):
    UNITS = {"decel": "m/s^2", "delay": "s"}
    OPTIONAL = ("delay",)
    speed: Annotated[float, searched(5.0, 30.0, "m/s", "speed")] = 15.0
    gap: float = 25.0

    def simulate(self, setting):
        way = self.speed * (0.5 + setting["delay"]) + self.speed**2 / 2 / setting["decel"]
        rest = self.gap - way
        if rest < 0:
            impact = (-2 * setting["decel"] * rest) ** 0.5
            return {"outcome": "collision", "safety_degree": -impact}
        return {"outcome": "stopped", "safety_degree": rest}
"""


@pytest.fixture
def car(coarse: None, in_tmp: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Its study, with few simulations of every search."""
    monkeypatch.setattr("safevar_sumo.questions.cases.LEAST_SIMULATIONS", 90)
    monkeypatch.setattr("safevar_sumo.questions.cases.USUAL_BUDGET", 90)
    write("cars.py", CARS)
    return STUDY.replace("models:Wall", "cars:Car")


def rest(
    decel: object, delay: object, speed: object = 15.0, gap: float = 25.0
) -> pd.Series:
    """What is left in front of the wall [m]."""
    return gap - speed * (0.5 + delay) - np.square(speed) / 2 / decel


@pytest.mark.parametrize(("is_worse", "least"), [(True, 3), (False, 4)])
def test_two_versions_are_counted_as_the_formula_says(
    car: str, is_worse: bool, least: int
) -> None:
    """One brakes with 8 m/s^2, the other with 6.5: the same changes of each are compared."""
    study = car.replace("[vehicle.", "parameters.gap = 40.0\n[vehicle.")
    write("hard.toml", study)
    write("soft.toml", study.replace("original = 8", "original = 6.5"))
    names = ["hard.toml", "soft.toml"][:: 1 if is_worse else -1]
    answer = sv.compare(
        *names, samples=64, limits=[f"decel >= {least}"], pool=InlinePool()
    )
    hard, soft = "ab" if is_worse else "ba"
    frame, numbers = answer.tables["settings"], answer.numbers
    assert frame["b_decel"].to_numpy() == pytest.approx(
        frame["decel"] + (1.5, -1.5)[is_worse]
    )
    assert frame[["decel", "b_decel"]].min(axis=None) >= least
    changes = frame.sort_index()[["decel", "delay"]].to_numpy() - [
        (6.5, 8.0)[is_worse],
        0.0,
    ]
    ratio = (
        changes[16:32] / changes[:16]
    )  # of the second setting of each line to its first
    assert ratio[:, 0] == pytest.approx(ratio[:, 1])
    assert set(ratio.ravel().round(9)) <= {0.5, 1.5}
    fails = {}
    for side, decel in ("a", frame["decel"]), ("b", frame["b_decel"]):
        left = rest(decel, frame["delay"], gap=40.0)
        degree = np.where(left < 0, -np.sqrt(np.abs(2 * decel * left)), left)
        assert frame[f"{side}_degree"].to_numpy() == pytest.approx(degree)
        fails[side] = left < 0.3
    counts = [numbers[f"only_{soft}_unsafe"], numbers["both"], numbers["neither"]]
    both = fails[soft] & fails[hard]
    assert counts == [(fails[soft] & ~both).sum(), both.sum(), (~fails[soft]).sum()]
    assert numbers["decision"] == ("do not release" if is_worse else "decide")
    assert f"Only vehicles with decel >= {least} were compared." in answer.verdict
    assert "The original vehicles of A and B differ (decel" in answer.verdict
    assert is_worse or "but needless braking was not measured" in answer.verdict
    assert answer.figure().axes
    assert (numbers["limits_shrunk"], numbers["limits_grown"]) == (
        is_worse,
        not is_worse,
    )
    assert numbers["p"] == pytest.approx(2 * 0.5**16), (
        "each of 16 lines is safer in one of both"
    )
    limits = answer.tables["limits"].set_index("characteristic")
    assert limits["change"].tolist() == ["the same", "shrunk" if is_worse else "grown"]
    for side, original in (hard, 8.0), (soft, 6.5):
        latest = min(1, (39.7 - 7.5 - 225 / 2 / original) / 15)
        weakest = max(least, 225 / 2 / 32.2)
        assert limits.loc["delay", f"{side}_high"] == pytest.approx(latest, abs=0.01)
        assert limits.loc["decel", f"{side}_low"] == pytest.approx(weakest, abs=0.01)
