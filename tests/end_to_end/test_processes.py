"""Studies in processes of their own, killed, interrupted, starved and edited: the same bytes or a clear error, nothing left behind."""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pandas as pd
import psutil
import pytest

from safevar_sumo.results import load
from tests.end_to_end.processes import STUDY, ended, killed, left_of_group, solutions, started, study, until, workers_of, written
from tests.in_process import run

pytestmark = pytest.mark.usefixtures("small")
SLOW = pytest.mark.slow
OUT = Path("out")


def killed_and_resumed(times: int) -> None:
    """Kill the study so often, a moment after it has got further, and finish it."""
    moments = random.Random(4)
    for _ in range(times):
        before = written(OUT)
        process = started("study", "small.toml", "--out", "out", "--jobs", "1", "--batch", "1")
        until(lambda: written(OUT) > before, process)  # noqa: B023
        time.sleep(moments.uniform(0, 0.1))
        assert process.poll() is None, "the study is too short to be killed so often"
        killed(process)
        until(lambda: not left_of_group(process))  # noqa: B023
    assert not (OUT / "solutions.csv").exists()
    study("--out", "out")


def test_killed_and_resumed(whole: Path) -> None:
    killed_and_resumed(1)
    assert solutions("out") == solutions(whole)


@SLOW
def test_killed_a_hundred_times_at_random_moments_and_resumed() -> None:
    Path("small.toml").write_text(STUDY.replace("evaluations = 150", "evaluations = 400"))
    study("--out", "whole")
    killed_and_resumed(100)
    assert solutions("out") == solutions("whole")


def test_two_workers_that_are_killed_leave_the_same_bytes(whole: Path) -> None:
    moments, kills = random.Random(5), 0
    process = started("study", "small.toml", "--out", "out", "--jobs", "2", "--batch", "5", "--quiet")
    until(lambda: written(OUT) > 0, process)
    while process.poll() is None and kills < 2:
        for worker in moments.sample(workers := workers_of(process), k=min(1, len(workers))):
            worker.kill()
            kills += 1
        time.sleep(moments.uniform(0.2, 0.6))
    ended(process, 0)
    assert kills == 2
    assert solutions(OUT) == solutions(whole)
    assert Path("out/manifest.json").read_bytes() == (whole / "manifest.json").read_bytes()
    assert (load(OUT).evaluations["outcome"] != "simulator-error").all()


@SLOW
@pytest.mark.parametrize("goes_on", [False, True])
def test_workers_that_are_stopped_lose_nothing(goes_on: bool, whole: Path) -> None:
    Path("small.toml").write_text(STUDY + "time_limit = 20\n")
    process, moments = started("study", "small.toml", "--out", "out", "--jobs", "2", "--batch", "5"), random.Random(6)
    until(lambda: written(OUT) > 0, process)
    for _ in range(3):
        for worker in workers_of(process)[:1]:
            worker.suspend()
            time.sleep(moments.uniform(0.5, 1.5))
            if goes_on:
                worker.resume()
    process.communicate(timeout=300)
    assert solutions("out") == solutions(whole)
    assert not load("out").failures


@pytest.mark.parametrize("when", ["mid-run", *(pytest.param(moment, marks=SLOW) for moment in ("loading", 0.0, 0.15, 0.4, "twice"))])
def test_ctrl_c_ends_everything_with_code_130(when: float | str) -> None:
    process = started("study", "rain", "--out", "out", "--jobs", "1")
    if when == "loading":
        until(lambda: any("numpy" in one.path for one in psutil.Process(process.pid).memory_maps()), process)
    elif isinstance(when, str):
        until(lambda: written(OUT) > 0, process)
        loaded = " ".join(one.path for one in workers_of(process)[0].memory_maps())
        assert "libsumo" in loaded
        assert not any(name in loaded for name in ("pandas", "pyarrow", "matplotlib")), "a worker loads neither frames nor figures"
    else:
        until(lambda: len(workers_of(process)) > 0, process)
        time.sleep(when)
    os.killpg(process.pid, signal.SIGINT)
    if when == "twice":
        time.sleep(0.05)
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
    assert "interrupted" in ended(process, 130)


@SLOW
def test_sigterm_leaves_no_worker_behind() -> None:
    process = started("study", "rain", "--out", "out")
    until(lambda: written(OUT) > 0, process)
    process.terminate()
    process.communicate(timeout=20)
    until(lambda: not left_of_group(process))


@SLOW
def test_a_worker_that_hangs_does_not_outlive_a_killed_study() -> None:
    Path("my_ads.py").write_text(
        "import time\nfrom pathlib import Path\nfrom safevar_sumo.ads import ScalarAds\n\n\nclass Dozing(ScalarAds):\n"
        "    def drive(self, seen):\n        Path('dozing').touch()\n        time.sleep(1000)\n")
    Path("dozing.toml").write_text('extends = "small.toml"\nname = "dozing"\n[ads]\nmodel = "my_ads:Dozing"\n')
    process = started("study", "dozing.toml", "--out", "out")
    until(Path("dozing").exists, process)
    killed(process)
    until(lambda: not left_of_group(process))


@SLOW
def test_a_full_disk_is_told_and_what_was_written_stays_valid(whole: Path) -> None:
    def little_room() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (19_000, resource.RLIM_INFINITY))

    told = ended(started("study", "small.toml", "--out", "out", "--jobs", "1", preexec_fn=little_room), 1)
    assert "cannot be written: File too large; what was written before stays valid" in told
    assert len(told.strip().splitlines()) == 1
    frame = load("out").evaluations
    assert len(frame) > 50
    both = frame.merge(load(whole).evaluations, on=["algorithm", "run", "evaluation"], suffixes=("", "_whole"))
    assert np.array_equal(both["f_safe"], frame["f_safe"])
    assert np.array_equal(both["f_safe"], both["f_safe_whole"])
    study("--out", "out")
    assert solutions("out") == solutions(whole)


@SLOW
def test_a_directory_that_is_taken_away_is_told() -> None:
    process = started("study", "small.toml", "--out", "out", "--jobs", "1")
    until(lambda: written(OUT) > 3000, process)
    shutil.rmtree("out")
    told = ended(process, 1)
    assert "out/" in told
    assert "cannot be" in told


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


@SLOW
@pytest.mark.parametrize(("end", "number", "why"), [
    ("refuse", 2, "SUMO failed: That is too heavy."), ("hang", 1, "the simulation took longer than 8 s"),
    ("exit", 2, "the worker process died (exit code 3)"), ("kill", 1, "the worker process died (exit code -9)")])
def test_settings_that_sumo_dies_of_are_recorded_and_left_out(end: str, number: int, why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("deadly.toml").write_text(
        'extends = "smoke"\nname = "deadly"\n[search]\nalgorithms = ["rs"]\nevaluations = 40\nruns = 1\n'
        + ("time_limit = 8.0\n" if end == "hang" else ""))
    run("study", "deadly.toml", "--out", "healthy")
    healthy = load("healthy").evaluations
    masses = np.sort(healthy["mass"].unique())
    heavy = float(masses[-number - 1] + masses[-number]) / 2
    Path("patch").mkdir()
    Path("patch/sitecustomize.py").write_text(SUMO_GOES_WRONG)
    for name, value in (("PYTHONPATH", "patch"), ("HEAVY", str(heavy)), ("END", end)):
        monkeypatch.setenv(name, value)
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
    assert (results.solutions["mass"] < heavy).all()
    before = solutions("out")
    journal = Path("out/runs/rs-00.journal")
    size = journal.stat().st_size
    os.truncate(journal, size - 1)
    ended(started("study", "deadly.toml", "--out", "out", "--quiet"), 0)
    assert journal.stat().st_size == size, "it was met again"
    assert solutions("out") == before
    assert why in run("tables", "out").stdout
    monkeypatch.delenv("PYTHONPATH")
    run("study", "deadly.toml", "--out", "out", "--retry-failed")
    assert solutions("out") == solutions("healthy")
    pd.testing.assert_frame_equal(load("out").evaluations, healthy)


@SLOW
def test_an_outage_of_the_cache_ends_the_study_and_changes_no_byte(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = Path("cache").resolve()
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    process = started("study", "small.toml", "--out", "out", "--jobs", "2", "--batch", "3")
    until(lambda: written(OUT) > 3000, process)
    cache.rename("away")
    cache.write_text("")
    for worker in workers_of(process):
        worker.kill()
    assert "cannot write the cache of networks" in ended(process, 1)
    cache.unlink()
    study("--out", "out")
    assert solutions("out") == solutions(whole)
    assert not load("out").failures


@SLOW
@pytest.mark.parametrize(("body", "told"), [
    ("time.sleep(1000)", "took longer than 2 s"), ("os.kill(os.getpid(), 9)", "the worker process died (exit code -9)")])
def test_an_ads_that_always_hangs_or_dies_ends_the_study_early_with_that_fault(body: str, told: str) -> None:
    Path("my_ads.py").write_text(
        f"import os\nimport time\nfrom safevar_sumo.ads import ScalarAds\n\n\nclass Bad(ScalarAds):\n    def drive(self, seen):\n"
        f"        {body}\n        return 0.0, 0.0\n")
    Path("bad.toml").write_text('extends = "small.toml"\nname = "bad"\n[ads]\nmodel = "my_ads:Bad"\n[search]\ntime_limit = 2\n')
    errors = ended(started("study", "bad.toml", "--out", "out"), 2)
    assert told in errors
    assert len(errors.strip().splitlines()) <= 2
    assert "simulate bad.toml" in errors


GENTLE = """
from safevar_sumo.ads import ScalarAds


class Gentle(ScalarAds):
    def drive(self, seen):
        return (0.0, 1.0) if abs(seen.lateral) < 2.5 and seen.gap < 9.0 else (0.5, 0.0)
"""


@SLOW
def test_files_that_are_edited_meanwhile_mix_nothing() -> None:
    Path("my_ads.py").write_text(GENTLE)
    Path("mine.toml").write_text('extends = "smoke"\nname = "mine"\n[ads]\nmodel = "my_ads:Gentle"\n[search]\nalgorithms = ["rs"]\n'
                                 "evaluations = 400\nruns = 1\n")

    def under_way(*extra: str) -> subprocess.Popen[str]:
        return started("study", "mine.toml", "--out", "out", "--jobs", "1", *extra)

    process = under_way("--batch", "1")
    until(lambda: written(OUT) > 0, process)
    Path("my_ads.py").write_text(GENTLE.replace("0.5", "0.65"))
    before = written(OUT)
    until(lambda: written(OUT) > before + 500, process)
    workers_of(process)[0].kill()
    assert "safevar-sumo: my_ads.py: is not the file that this study began with" in ended(process, 2)
    assert len(load("out").evaluations) > 1
    Path("my_ads.py").write_text(GENTLE)
    ended(under_way(), 0)
    mixed = solutions("out")
    shutil.rmtree("out")
    ended(under_way(), 0)
    assert solutions("out") == mixed


@SLOW
def test_of_two_studies_that_start_together_one_gets_the_directory() -> None:
    Path("other.toml").write_text('extends = "small.toml"\nname = "other"\n')
    both = [started("study", name, "--out", "out", "--jobs", "1") for name in ("small.toml", "other.toml")]
    outputs = [process.communicate(timeout=60) for process in both]
    assert sorted(process.returncode for process in both) == [0, 2], outputs
    assert "another study" in "".join(errors for _, errors in outputs)
    assert len(load("out").solutions) > 0
