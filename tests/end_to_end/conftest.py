"""No command outlives its test, however that ended."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import processes
import pytest


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
