"""Ctrl-C, SIGTERM and kill -9 leave no process behind."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import psutil
import pytest

from tests.end_to_end.processes import ended, killed, left_of_group, started, until, workers_of, written

pytestmark = pytest.mark.usefixtures("small")


@pytest.mark.parametrize("when", ["loading", 0.0, 0.15, 0.4, "mid-run", "twice"])
def test_ctrl_c_ends_everything_with_code_130(when: float | str) -> None:
    process = started("study", "rain", "--out", "out")
    if when == "loading":
        until(lambda: any("numpy" in one.path for one in psutil.Process(process.pid).memory_maps()), process)
    elif isinstance(when, str):
        until(lambda: written(Path("out")) > 0, process)
    else:
        until(lambda: len(workers_of(process)) > 0, process)
        time.sleep(when)
    os.killpg(process.pid, signal.SIGINT)
    if when == "twice":
        time.sleep(0.05)
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
    assert "interrupted" in ended(process, 130)


def test_workers_load_sumo_and_neither_frames_nor_figures() -> None:
    process = started("study", "rain", "--out", "out", "--jobs", "1")
    until(lambda: written(Path("out")) > 0, process)
    (worker,) = workers_of(process)
    loaded = " ".join(one.path for one in worker.memory_maps())
    process.terminate()
    process.communicate(timeout=20)
    assert "libsumo" in loaded
    assert not any(name in loaded for name in ("pandas", "pyarrow", "matplotlib"))


def test_sigterm_leaves_no_worker_behind() -> None:
    process = started("study", "rain", "--out", "out")
    until(lambda: written(Path("out")) > 0, process)
    process.terminate()
    process.communicate(timeout=20)
    until(lambda: not left_of_group(process))


def test_a_worker_that_hangs_does_not_outlive_a_killed_study() -> None:
    Path("my_ads.py").write_text(
        "import time\nfrom pathlib import Path\nfrom safevar_sumo.ads import ScalarAds\n\n\nclass Dozing(ScalarAds):\n"
        "    def drive(self, seen):\n        Path('dozing').touch()\n        time.sleep(1000)\n")
    Path("dozing.toml").write_text('extends = "small.toml"\nname = "dozing"\n[ads]\nmodel = "my_ads:Dozing"\n')
    process = started("study", "dozing.toml", "--out", "out")
    until(Path("dozing").exists, process)
    killed(process)
    until(lambda: not left_of_group(process))
