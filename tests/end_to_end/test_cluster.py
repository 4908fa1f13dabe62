"""A study on a real Dask scheduler with real worker processes, on loopback."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest

from safevar_sumo.errors import InputError
from safevar_sumo.results import load
from safevar_sumo.workers import cluster
from tests.end_to_end.processes import ended, killed, solutions, started, until, written
from tests.in_process import refused

Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start(small: None) -> Iterator[Start]:
    """Starts a program of Dask's in a process group of its own; all are ended with the test."""
    running: list[subprocess.Popen[str]] = []

    def begin(program: str, *arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", f"distributed.cli.dask_{program}", *arguments, "--no-dashboard"]
        environment = {**os.environ, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
        with open(f"{program}-{len(running)}.log", "w") as log:
            running.append(subprocess.Popen(command, stdout=log, stderr=log, text=True, start_new_session=True, env=environment))
        return running[-1]

    yield begin
    for process in running:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.fixture
def scheduler(start: Start) -> tuple[subprocess.Popen[str], str]:
    """A scheduler and its address."""
    process = start("scheduler", "--host", "127.0.0.1", "--port", "0")
    log = Path("scheduler-0.log")
    until(lambda: "Scheduler at:" in log.read_text(), process)
    return process, next(line.split()[-1] for line in log.read_text().splitlines() if "Scheduler at:" in line)


def worker(start: Start, address: str, *options: str) -> subprocess.Popen[str]:
    return start("worker", address, "--nthreads", "1", "--local-directory", "scratch", *options)


def busy(process: subprocess.Popen[str]) -> bool:
    """Whether a worker has loaded SUMO, so has computed."""
    return any("libsumo" in one.path for one in psutil.Process(process.pid).memory_maps())


@pytest.mark.slow
def test_two_workers_of_which_one_is_killed_leave_the_same_bytes(
        scheduler: tuple[subprocess.Popen[str], str], start: Start, whole: Path) -> None:
    _, address = scheduler
    workers = [worker(start, address, "--no-nanny") for _ in range(2)]
    until(lambda: all("Registered to" in Path(f"worker-{i}.log").read_text() for i in (1, 2)), workers[0])
    process = started("study", "small.toml", "--cluster", address, "--out", "out")
    until(lambda: written(Path("out")) > 4000 and all(busy(one) for one in workers), process)
    assert process.poll() is None, "too late: the study is over"
    killed(workers[0])
    ended(process, 0)
    assert workers[1].poll() is None
    assert solutions("out") == solutions(whole)
    assert (load("out").evaluations["outcome"] != "simulator-error").all()


@pytest.mark.slow
def test_a_simulation_that_hangs_is_stopped_on_a_cluster_too(scheduler: tuple[subprocess.Popen[str], str], start: Start) -> None:
    Path("my_ads.py").write_text(
        "import time\nfrom safevar_sumo.ads import ScalarAds\n\n\nclass Dozing(ScalarAds):\n    def drive(self, seen):\n"
        "        time.sleep(1000)\n")
    Path("dozing.toml").write_text(
        'extends = "smoke"\nname = "dozing"\n[ads]\nmodel = "my_ads:Dozing"\n'
        '[search]\nalgorithms = ["rs"]\nruns = 1\nevaluations = 10\ntime_limit = 2\n')
    _, address = scheduler
    worker(start, address, "--nanny")
    errors = ended(started("study", "dozing.toml", "--cluster", address, "--out", "out"), 2)
    assert "workers of the cluster died" in errors


@pytest.mark.slow
def test_a_scheduler_that_dies_ends_the_study_and_what_was_written_stays(
        scheduler: tuple[subprocess.Popen[str], str], start: Start) -> None:
    process, address = scheduler
    worker(start, address, "--no-nanny")
    command = started("study", "small.toml", "--cluster", address, "--out", "out")
    until(lambda: written(Path("out")) > 4000, command)
    killed(process)
    errors = ended(command, 1)
    assert errors.startswith("safevar-sumo: the cluster does not answer any more")
    assert len(errors.splitlines()) == 1
    assert len(load("out").evaluations) >= 10


def test_an_address_that_nobody_answers_is_told_in_time(in_tmp: Path) -> None:
    began = time.monotonic()
    refused("study", "smoke", "--cluster", "tcp://127.0.0.1:9", "--out", "out", told=("--cluster: nobody answers at 'tcp://127.0.0.1:9'",))
    assert time.monotonic() - began < 15
    assert not Path("out").exists()


def test_an_encrypted_scheduler_needs_certificates_from_the_configuration() -> None:
    with pytest.raises(InputError, match=r"certificates in Dask's configuration"), cluster.cluster_pool("tls://127.0.0.1:9", 9.0):
        pass


def test_a_worker_with_other_versions_computes_nothing() -> None:
    with pytest.raises(cluster.PoolLostError, match=r"1\.20\.0"):
        cluster._evaluate_within(9.0, {"libsumo": "1.20.0"}, b"", np.zeros((1, 12)))
