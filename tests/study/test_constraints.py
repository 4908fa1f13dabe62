"""Constraints among characteristics: what every command reports satisfies them, and what cannot be
satisfied is refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import safevar_sumo as sv
from safevar_sumo.api.simulation import load_study
from safevar_sumo.errors import InputError
from safevar_sumo.search import ALGORITHMS
from safevar_sumo.vehicles import region_of
from tests.support.in_process import SLOW, json_of, rows_of, run, write
from tests.support.made_up import SUN

BOUND = """
extends = "smoke"
[search]
algorithms = ["nsga2", "rs", "safe_fuzzer", "surrogate"]
runs = 1
evaluations = 60
population = 10
[[constraints]]
sum = { mass = 1, maxBrakeTorque = -1 }
unit = "kg"
at_least = 700
at_most = 1100
[[constraints]]
sum = { tireFric = 1, radius = -0.5 }
unit = "-"
at_least = -16.4
[[constraints]]
sum = { tireFric = 1, mass = 0.002 }
unit = "-"
at_most = 9.2
"""


def is_feasible(values: Mapping[str, float]) -> bool:
    """The region of `BOUND`, written once more; what is not there is the original's."""
    by = {**SUN.named(SUN.original), **values}
    return (
        700 - 1e-6 <= by["mass"] - by["maxBrakeTorque"] <= 1100 + 1e-6
        and by["tireFric"] - 0.5 * by["radius"] >= -16.4 - 1e-6
        and by["tireFric"] + 0.002 * by["mass"] <= 9.2 + 1e-6
    )


def settings_in(answer: Any) -> Iterator[dict[str, float]]:
    """Every mapping of an answer whose keys are characteristics."""
    if isinstance(answer, dict):
        if (
            answer
            and set(answer) <= set(SUN.names)
            and all(isinstance(value, float) for value in answer.values())
        ):
            yield answer
        for value in answer.values():
            yield from settings_in(value)
    elif isinstance(answer, list):
        for value in answer:
            yield from settings_in(value)


@pytest.fixture
def bound(in_tmp: Path) -> Path:
    write("bound.toml", BOUND)
    return in_tmp


@SLOW
@pytest.mark.usefixtures("coarse")
def test_every_setting_that_a_command_reports_is_feasible(bound: Path) -> None:
    """The region is given in closed form; without constraints a fifth of the domain lies in it."""
    run("study bound.toml --quiet --out out")
    frame = sv.load("out").evaluations
    assert set(frame["algorithm"]) == set(ALGORITHMS)
    assert len(frame) > 150
    assert all(is_feasible(row) for row in frame[list(SUN.names)].to_dict("records"))
    below = "--unsafe below=2.5 --fits 0"
    explained = json_of(f"explain out {below} --top 2 --quick")
    tolerance = json_of(
        f"tolerance bound.toml {below} --characteristics tireFric,mass,maxBrakeTorque"
    )
    boundaries = [cause["boundary"] for cause in rows_of(explained, "causes")]
    alone = [
        {row["characteristic"]: row[end]}
        for row in rows_of(tolerance, "limits")
        for end in ("alone_low", "alone_high")
    ]
    assert boundaries
    assert len(alone) == 6
    reported = [*settings_in(explained), *alone]
    assert [values for values in reported if not is_feasible(values)] == []
    for question in (
        "tolerance bound.toml --fits 0 --characteristics mass",
        "rules bound.toml --samples 200",
        "risk bound.toml --samples 200",
    ):
        words = " ".join(run(f"{question} --unsafe below=2.5").stdout.split())
        assert "satisfies the constraints of the study" in words, question
        assert "mass - maxBrakeTorque at least 700 kg" in words, question


def test_random_settings_of_a_narrow_region_are_as_many_as_asked_for_and_all_feasible() -> (
    None
):
    region = region_of(load_study("rain_realistic"))
    lower = region.characteristics.lower
    upper = region.characteristics.upper
    rng = np.random.default_rng(1)
    drawn = region.draw_feasible(
        lambda some: rng.uniform(lower, upper, (some, len(lower))), 200, filtered=True
    )
    assert len(np.unique(drawn, axis=0)) == 200
    assert region.feasible(region.characteristics.filter(drawn)).all()


def test_an_unfeasible_setting_is_simulated_only_where_that_is_asked_for(
    bound: Path,
) -> None:
    with pytest.raises(
        InputError, match="violates a constraint: mass - maxBrakeTorque = 540 kg"
    ):
        sv.simulate("bound.toml", {"mass": 2040})
    assert sv.simulate("bound.toml", {"mass": 2040}, beyond=True).outcome
    with pytest.raises(InputError, match="violates a constraint"):
        sv.evaluate("bound.toml", pd.DataFrame({"mass": [2404, 2040]}), jobs=1)
    assert (
        "or any with --beyond"
        in run("simulate bound.toml --set mass=2040", expect=2).stderr
    )
