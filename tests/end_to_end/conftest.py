"""No command outlives its test, however that ended; a small study and its results are there for all."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.end_to_end import processes
from tests.end_to_end.small import STUDY


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
    """The file of the small study, in an empty working directory."""
    Path("small.toml").write_text(STUDY)


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of the small study carried out in peace by one worker; nobody changes them."""
    place = tmp_path_factory.mktemp("whole")
    (place / "small.toml").write_text(STUDY)
    processes.ended(processes.started("study", str(place / "small.toml"), "--out", str(place / "out"), "--jobs", "1"), 0)
    return place / "out"


@pytest.fixture
def copied(small: None, whole: Path) -> Path:
    """Those results, to be spoilt."""
    shutil.copytree(whole, "out")
    return Path("out")
