"""Only what SUMO itself refuses, dies of or hangs on is a simulator-error; all else ends the study with its reason."""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from safevar_sumo.results import load
from tests.end_to_end.processes import SAFEVAR, ended, started, until, workers_of, written
from tests.end_to_end.small import solutions, study

pytestmark = pytest.mark.usefixtures("small")


SUMO_GOES_WRONG = """
import os
import signal
import time

import libsumo

heavy, end = float(os.environ["HEAVY"]), os.environ["END"]
set_mass = libsumo.vehicletype.setMass


def deadly(name, mass):
    if mass > heavy:
        if end == "exit":
            os._exit(3)
        if end == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if end == "refuse":
            raise libsumo.TraCIException("That is too heavy.")
        time.sleep(1000)
    set_mass(name, mass)


libsumo.vehicletype.setMass = deadly
"""


@pytest.mark.slow
@pytest.mark.parametrize(("end", "number", "why"), [
    ("refuse", 2, "SUMO failed: That is too heavy."), ("hang", 1, "the simulation took longer than 8 s"),
    ("exit", 2, "the worker process died (exit code 3)"), ("kill", 1, "the worker process died (exit code -9)")])
def test_settings_that_sumo_dies_of_are_recorded_and_left_out(end: str, number: int, why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("deadly.toml").write_text(
        'extends = "smoke"\nname = "deadly"\n[search]\nalgorithms = ["rs"]\nevaluations = 40\nruns = 1\n'
        + ("time_limit = 8.0\n" if end == "hang" else ""))
    ended(started("study", "deadly.toml", "--out", "healthy"), 0)
    healthy = load("healthy").evaluations
    masses = np.sort(healthy["mass"].unique())
    heavy = float(masses[-number - 1] + masses[-number]) / 2
    Path("patch").mkdir()
    Path("patch/sitecustomize.py").write_text(SUMO_GOES_WRONG)
    monkeypatch.setenv("PYTHONPATH", "patch")
    monkeypatch.setenv("HEAVY", str(heavy))
    monkeypatch.setenv("END", end)
    process = started("study", "deadly.toml", "--out", "out")
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    failed = healthy["mass"] > heavy
    assert f"{failed.sum()} settings could not be simulated" in output
    assert why in output
    results = load("out")
    assert np.array_equal(results.evaluations["outcome"] == "simulator-error", failed)
    assert {one.reason for one in results.failures} == {why}
    pd.testing.assert_frame_equal(results.evaluations[~failed], healthy[~failed])
    assert len(results.solutions) > 0
    assert (results.solutions["mass"] < heavy).all()
    before = solutions("out")
    journal = Path("out/runs/rs-00.journal")
    size = journal.stat().st_size
    os.truncate(journal, size - 1)
    ended(started("study", "deadly.toml", "--out", "out", "--quiet"), 0)
    assert journal.stat().st_size == size, "it was met again"
    assert solutions("out") == before
    assert why in subprocess.run([*SAFEVAR, "tables", "out"], capture_output=True, text=True, check=True).stdout
    monkeypatch.delenv("PYTHONPATH")
    ended(started("study", "deadly.toml", "--out", "out", "--retry-failed"), 0)
    assert solutions("out") == solutions("healthy")
    pd.testing.assert_frame_equal(load("out").evaluations, healthy)


@pytest.mark.slow
def test_an_outage_of_the_cache_ends_the_study_and_changes_no_byte(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = Path("cache").resolve()
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    process = started("study", "small.toml", "--out", "out", "--jobs", "2", "--batch", "3")
    until(lambda: written(Path("out")) > 3000, process)
    cache.rename("away")
    cache.write_text("")
    for worker in workers_of(process):
        worker.kill()
    assert "cannot write the cache of networks" in ended(process, 1)
    cache.unlink()
    study("--out", "out", "--jobs", "2")
    assert solutions("out") == solutions(whole)
    assert not load("out").failures


@pytest.mark.parametrize(("body", "code", "told"), [
    ("time.sleep(1000)", 2, "took longer than 2 s"),
    ("os.kill(os.getpid(), 9)", 2, "the worker process died (exit code -9)"),
    ("1 / 0", 2, "ZeroDivisionError"),
])
def test_an_ads_that_always_fails_ends_the_study_early_with_that_fault(body: str, code: int, told: str) -> None:
    Path("my_ads.py").write_text(
        f"import os\nimport time\nfrom safevar_sumo.ads import ScalarAds\n\n\nclass Bad(ScalarAds):\n    def drive(self, seen):\n"
        f"        {body}\n        return 0.0, 0.0\n")
    Path("bad.toml").write_text('extends = "small.toml"\nname = "bad"\n[ads]\nmodel = "my_ads:Bad"\n[search]\n'
                                + ("time_limit = 2\n" if "sleep" in body else ""))
    for options in ([], ["--dry-run"]) if "1 / 0" in body else ([],):
        start = time.monotonic()
        errors = ended(started("study", "bad.toml", "--out", "out", *options), code)
        assert told in errors
        assert len(errors.strip().splitlines()) <= 2
        assert time.monotonic() - start < 60
        assert "simulate bad.toml" in errors
