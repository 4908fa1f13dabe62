"""Verdicts of `tolerance` about vehicles in closed form: what is said where hardly any vehicle
counts, where only some characteristics have limits, and where no vehicle meets a criterion.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.support.in_process import json_of, refused, rows_of, run, write

SHARES = """
class Shares:
    UNITS = {"front": "-", "rear": "-", "engine": "-"}
    version = "1"

    def simulate(self, setting):
        degree = 5 - abs(setting["front"] - 0.6) * 20 - abs(setting["rear"] - 0.3) * 2
        degree -= setting["engine"]
        return {"outcome": "stopped" if degree > 0 else "collision", "safety_degree": degree}
"""
SHARES_STUDY = """
name = "shares"
title = "Shares of the braking"
scenario.model = "shares:Shares"
metrics.ttc_threshold = 1.5
search = { algorithms = ["rs"], population = 20, evaluations = 40, runs = 1, seed = 1 }
[vehicle.characteristics]
front = { unit = "-", original = 0.6, lower = 0, upper = 1 }
rear = { unit = "-", original = 0.3, lower = 0, upper = 1 }
engine = { unit = "-", original = 0.1, lower = 0, upper = 1 }
[[constraints]]
sum = { front = 1, rear = 1, engine = 1 }
at_least = LEAST
at_most = MOST
"""


def write_shares(least: float, most: float) -> None:
    """Write a study of three shares whose sum is between two values."""
    write("shares.py", SHARES)
    text = SHARES_STUDY.replace("LEAST", str(least)).replace("MOST", str(most))
    write("shares.toml", text)


@pytest.mark.parametrize(
    "command",
    ["check", "explain", "tolerance", "risk", "rules"],
)
def test_constraints_that_hardly_any_vehicle_satisfies_are_refused_alike(
    command: str, in_tmp: Path
) -> None:
    write_shares(0.999, 1.001)
    refused(
        f"{command} shares.toml",
        "fewer than 2 in 1,000 random settings satisfy them",
        "one characteristic less, whose value your class computes from the others",
    )


@pytest.mark.parametrize("flags", ["--quick", "--simulations 300"])
def test_no_limit_is_printed_where_hardly_any_vehicle_was_tested(
    flags: str, in_tmp: Path
) -> None:
    write_shares(0.9975, 1.0025)
    answer = json_of(f"tolerance shares.toml {flags}", expect=3)
    assert "No joint limits can be given" in answer["verdict"]
    assert "Keep " not in answer["verdict"]
    assert "No single characteristic was found" not in answer["verdict"]
    assert answer["numbers"]["box"] is False
    for row in rows_of(answer, "limits"):
        assert "Keep " not in row["sentence"]
        for end in ("alone_low", "alone_high", "together_low", "together_high"):
            assert row[end] is None, (row["characteristic"], end)


def test_limits_with_a_wider_constraint_hold_for_every_vehicle_that_satisfies_it(
    in_tmp: Path,
) -> None:
    write_shares(0.9, 1.1)
    rows = rows_of(json_of("tolerance shares.toml --quick"), "limits")
    low = np.array([row["together_low"] for row in rows])
    high = np.array([row["together_high"] for row in rows])
    vehicles = np.random.default_rng(3).uniform(low, high, (200_000, 3))
    total = vehicles.sum(axis=1)
    vehicles = vehicles[(total >= 0.9) & (total <= 1.1)]
    front, rear, engine = vehicles.T
    degree = 5 - np.abs(front - 0.6) * 20 - np.abs(rear - 0.3) * 2 - engine
    assert len(vehicles) > 1000
    assert degree.min() >= 0


WALL = """
class Wall:
    UNITS = {"mass": "kg", "force": "N"}
    version = "1"

    def simulate(self, setting):
        deceleration = setting["force"] / setting["mass"]
        left = 35 - 15**2 / (2 * deceleration)
        if left > 0:
            return {"outcome": "stopped", "safety_degree": left}
        return {"outcome": "collision", "safety_degree": -((-2 * deceleration * left) ** 0.5)}
"""
WALL_STUDY = """
name = "wall"
title = "A standing truck"
scenario.model = "wall:Wall"
metrics.ttc_threshold = 1.5
search = { algorithms = ["rs"], population = 20, evaluations = 40, runs = 1, seed = 1 }
[vehicle.characteristics]
mass = { unit = "kg", original = 2000, lower = 1500, upper = 2200 }
force = { unit = "N", original = 12000, lower = 4000, upper = 12000 }
"""


@pytest.mark.parametrize("question", ["risk", "explain"])
def test_collisions_are_named_where_no_vehicle_meets_the_criterion(
    question: str, in_tmp: Path
) -> None:
    """A question that samples vehicles, and one that searches; the remark is that of any other."""
    write("wall.py", WALL)
    write("wall.toml", WALL_STUDY)
    command = f"{question} wall.toml --simulations 200 --details"
    told = "simulated vehicles collide, although no vehicle is unsafe by the criterion"
    with_criterion = run(f"{command} --unsafe 'safety_degree < -40'", expect=None)
    assert told in " ".join(with_criterion.stdout.split())
    assert told not in " ".join(run(command, expect=None).stdout.split())
