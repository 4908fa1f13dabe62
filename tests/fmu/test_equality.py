"""FMUs of the shipped driving system and vehicle give the same results as the originals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import psutil
import pytest

import safevar_sumo as sv
from safevar_sumo.study import load_study
from safevar_sumo.sumo.matrix import evaluate
from safevar_sumo.sumo.system import assemble

SETTINGS = 200
SIMULATIONS = 10_000
MOST_MEMORY = 20e6
"""Largest growth of the memory of all processes over these simulations [bytes]."""


def memory() -> int:
    """Memory of this process and its child processes [bytes]."""
    me = psutil.Process()
    return sum(process.memory_info().rss for process in (me, *me.children(recursive=True)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["exported_aeb", "exported_vehicle"])
def test_an_exported_model_drives_as_the_original(made: Path, name: str) -> None:
    native, fmu = (assemble(load_study(str(made / f"{one}.toml"))) for one in ("native_aeb", name))
    rng, members = np.random.default_rng(5), native.characteristics
    drawn = rng.uniform(members.lower, members.upper, (SETTINGS, len(members)))
    settings = members.filter(members.original + 0.6 * (drawn - members.original))
    expected, results = evaluate(native, settings), evaluate(fmu, settings)
    assert 20 < np.sum(expected.outcome == "collision") < 180
    np.testing.assert_array_equal(results.outcome, expected.outcome)
    for metric, values in expected.metrics.items():
        np.testing.assert_allclose(results.metrics[metric], values, rtol=0, atol=1e-9, err_msg=metric)
    traces = [
        sv.simulate(str(made / f"{one}.toml"), {"mass": 1900.0, "reactionTime": 0.2}).trace
        for one in ("native_aeb", name)
    ]
    assert list(traces[0]) == list(traces[1])
    np.testing.assert_allclose(traces[1].to_numpy(), traces[0].to_numpy(), rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["small", "cart"])
def test_ten_thousand_simulations_leave_nothing_behind(made: Path, name: str) -> None:
    system = assemble(load_study(str(made / f"{name}.toml")))
    members = system.characteristics
    settings = members.filter(np.random.default_rng(6).uniform(members.lower, members.upper, (SETTINGS, len(members))))
    first = evaluate(system, settings).f_safe
    for _ in range(2):  # fills caches
        evaluate(system, settings)
    before = memory()
    for _ in range(SIMULATIONS // SETTINGS):
        last = evaluate(system, settings).f_safe
    print(f"{name}: {(memory() - before) / 1e6:.1f} MB")
    assert memory() - before < MOST_MEMORY
    np.testing.assert_array_equal(last, first)
