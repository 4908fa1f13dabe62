"""A small study of three algorithms, in this process or in other processes that tests start, watch
and kill; no command outlives its test, however the test ends.
"""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from safevar_sumo.api.simulation import load_study
from tests.support.in_process import searched, write
from tests.support.processes import (
    running,
)

STUDY = """
extends = "smoke"
name = "small"
[search]
algorithms = ["nsga2", "rs", "safe_fuzzer"]
evaluations = 150
"""


@pytest.fixture(autouse=True)
def _nothing_left_running() -> Iterator[None]:
    yield
    for process in running:
        if process.poll() is None:
            if os.name == "posix":
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()
            process.communicate()
    running.clear()


@pytest.fixture
def small(in_tmp: Path) -> None:
    """Write the file of the small study to an empty working directory."""
    write("small.toml", STUDY)


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of the small study; no test may change them."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "small.toml").write_text(STUDY)
    return searched(load_study(str(folder / "small.toml")), folder / "out")


@pytest.fixture
def copied(small: None, whole: Path) -> Path:
    """A copy of these results that a test may change."""
    shutil.copytree(whole, "out")
    return Path("out")
