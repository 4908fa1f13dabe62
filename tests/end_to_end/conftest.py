"""Fixtures of a small study and its results; no command outlives its test, however the test ends."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from safevar_sumo.study import load_study
from tests.end_to_end import processes
from tests.in_process import searched


@pytest.fixture(autouse=True)
def _nothing_left_running() -> Iterator[None]:
    yield
    for process in processes.running:
        if process.poll() is None:
            if os.name == "posix":
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()
            process.communicate()
    processes.running.clear()


@pytest.fixture
def small(in_tmp: Path) -> None:
    """Write the file of the small study to an empty working directory."""
    Path("small.toml").write_text(processes.STUDY)


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of the small study; no test may change them."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "small.toml").write_text(processes.STUDY)
    return searched(load_study(str(folder / "small.toml")), folder / "out")


@pytest.fixture
def copied(small: None, whole: Path) -> Path:
    """A copy of these results that a test may change."""
    shutil.copytree(whole, "out")
    return Path("out")
