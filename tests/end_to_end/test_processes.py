"""Studies in processes of their own, killed, interrupted, starved and edited: the same bytes or a
clear error, nothing left behind.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from safevar_sumo.campaign import batches
from safevar_sumo.campaign.pool import open_pool
from safevar_sumo.results import load_runs, write_whole
from tests.support.formulas import solutions
from tests.support.in_process import SLOW, refused, run, write
from tests.support.processes import (
    ended,
    has_loaded,
    killed,
    started,
    until,
    workers_of,
    written,
)
from tests.support.wall import MODELS, STUDY

Process = subprocess.Popen[str]
pytestmark = pytest.mark.usefixtures("small")
OUT = Path("out")


@SLOW
def test_killed_six_times_at_random_moments_and_resumed(whole: Path) -> None:
    moments = random.Random(4)
    for _ in range(6):
        before = written(OUT)
        process = started("study small.toml --out out --jobs 1", batch=1)
        until(lambda: written(OUT) > before, process)  # noqa: B023
        time.sleep(moments.uniform(0, 0.1))
        assert process.poll() is None, "the study is too short to be killed so often"
        killed(process)
    assert not (OUT / "solutions.csv").exists()
    run("study small.toml --quiet --out out")
    assert solutions(OUT) == solutions(whole)


def until_it_writes(process: Process) -> None:
    until(lambda: written(OUT) > 0, process)


def assert_ends_with_the_results(process: Process, whole: Path) -> None:
    """It leaves the bytes of a study that nothing has happened to, and no failed simulation."""
    ended(process, 0)
    assert solutions(OUT) == solutions(whole)
    assert (load_runs(OUT).evaluations["outcome"] != "simulator-error").all()


@SLOW
@pytest.mark.parametrize("when", ["mid-run", "loading", "twice"])
def test_ctrl_c_ends_everything_with_code_130(when: str) -> None:
    process = started("study rain --out out --jobs 1 --engine sumo")
    if when == "loading":
        until(lambda: has_loaded(process, "numpy"), process)
    else:
        until_it_writes(process)
        loaded = " ".join(one.path for one in workers_of(process.pid)[0].memory_maps())
        assert "libsumo" in loaded
        assert not any(
            name in loaded for name in ("pandas", "pyarrow", "matplotlib")
        ), "a worker loads neither frames nor figures"
    os.killpg(process.pid, signal.SIGINT)
    if when == "twice":
        time.sleep(0.05)
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
    assert "interrupted" in ended(process, 130)


@SLOW
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2"])
def test_a_signal_to_end_ends_everything_as_ctrl_c_does_and_leaves_nothing(
    name: str,
    in_tmp: Path,
) -> None:
    """Also signals of batch systems. The command says how to continue."""
    Path("temporary").mkdir()
    environment = {**os.environ, "TMPDIR": str(in_tmp / "temporary")}
    process = started("study rain --out out --jobs 1 --engine sumo", env=environment)
    until_it_writes(process)
    process.send_signal(signal.Signals[name])
    errors = ended(process, 130)
    assert "interrupted" in errors
    assert "run the same command again to continue" in errors
    assert "leaked" not in errors, "a remark on semaphores"
    assert not [*Path("temporary").iterdir()]


def one_killed_and_one_at_work(code: str) -> tuple[list[str], Process]:
    """Start a program twice, which prints a name and then waits for its input, and kill the first;
    returns both names and the second.
    """
    command = [sys.executable, "-c", code]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    both = [subprocess.Popen(command, text=True, **pipes) for _ in range(2)]
    names = [process.stdout.readline().strip() for process in both if process.stdout]
    both[0].kill()
    both[0].wait()
    return names, both[1]


def test_what_a_killed_write_left_is_removed_by_the_next_and_what_is_being_written_stays(
    in_tmp: Path,
) -> None:
    code = (
        "import sys\nfrom pathlib import Path\nfrom safevar_sumo.output import whole_file\nwith"
        " whole_file(Path('page.html')) as file:\n    file.write_text('half')\n    print(file.name,"
        " flush=True)\n    sys.stdin.read()\n"
    )
    names, writer = one_killed_and_one_at_work(code)
    before = time.time() - 60
    for name in (*names, ".page.0badcafe.tmp.html"):
        Path(name).touch()
        os.utime(name, (before, before))
    write_whole(Path("page.html"), "whole")
    assert sorted(path.name for path in in_tmp.glob(".page*")) == [names[1]]
    writer.communicate("", timeout=60)
    assert writer.returncode == 0
    assert Path("page.html").read_text() == "half"
    assert not [*in_tmp.glob(".page*")]


HOLDING = """
from safevar_sumo.output import temporary_folder
with temporary_folder() as folder:
    print(folder, flush=True)
    input()
"""


def test_a_temporary_folder_is_removed_once_its_process_was_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    names, holder = one_killed_and_one_at_work(HOLDING)
    folders = [Path(name) for name in names]
    with open_pool(1):
        assert len({*tmp_path.glob("safevar-*")} - {*folders}) == 1
        assert [folder.exists() for folder in folders] == [False, True]
    holder.communicate("", timeout=60)
    assert not [*tmp_path.glob("safevar-*")]


MANY = """
import sys
from pathlib import Path
import portalocker
from safevar_sumo.output import ALONE, LOCK, temporary_folder, whole_file

sys.stdin.read()  # until all processes have started
for number in range(30):
    with temporary_folder() as folder, (folder / LOCK).open("rb+") as lock:
        try:
            portalocker.lock(lock, ALONE)
            print("has no lock:", folder)
        except portalocker.AlreadyLocked:
            Path(folder, "0.txt").write_text("a worker's last words")
    with whole_file(Path("page.html")) as file:
        file.write_text("whole")
"""


def test_no_temporary_folder_in_use_is_removed_when_24_processes_work_at_once(
    in_tmp: Path,
) -> None:
    """Each process removes what killed processes have left, while all others begin."""
    Path("temporary").mkdir()
    environment = {**os.environ, "TMPDIR": str(in_tmp / "temporary")}
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", MANY],
            text=True,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        for _ in range(24)
    ]
    for process in processes:
        assert process.stdin
        process.stdin.close()
    for process in processes:
        assert process.stdout
        assert process.stdout.read() == ""
        assert process.wait() == 0
    assert not [*Path("temporary").iterdir()]
    assert [path.name for path in in_tmp.glob(".page*")] == []
    assert Path("page.html").read_text() == "whole"


@SLOW
def test_a_worker_that_hangs_does_not_outlive_a_killed_study() -> None:
    write(
        "my_ads.py",
        "import time\nfrom pathlib import Path\nfrom safevar_sumo.ads import ScalarAds\n\n\nclass"
        " Dozing(ScalarAds):\n    def drive(self, seen):\n        Path('dozing').touch()\n       "
        " time.sleep(1000)\n",
    )
    write(
        "dozing.toml",
        'extends = "small.toml"\nname = "dozing"\n[ads]\nmodel = "my_ads:Dozing"\n',
    )
    process = started("study dozing.toml --out out")
    until(Path("dozing").exists, process)
    killed(process)


@SLOW
@pytest.mark.parametrize(
    ("line", "why"),
    [
        (
            "time.sleep(1000)",
            "a batch took longer than the time limit, `search.time_limit`",
        ),
        ("ctypes.string_at(0)", "the worker process died (exit code -11)"),
    ],
)
def test_user_code_that_its_workers_die_of_is_an_error_with_its_line(
    line: str, why: str
) -> None:
    write(
        "my_ads.py",
        "import ctypes\nimport os\nimport time\nfrom safevar_sumo.ads import ScalarAds\n\n\nclass"
        " Deadly(ScalarAds):\n    def drive(self, seen):\n        if os.path.exists('now'):\n     "
        f"       {line}\n        return 0.5, 0.0\n",
    )
    write(
        "deadly.toml",
        'extends = "small.toml"\nname = "deadly"\n[ads]\nmodel ='
        ' "my_ads:Deadly"\n[search]\ntime_limit = 5.0\n',
    )
    process = started("study deadly.toml --out out --jobs 1", batch=1)
    until_it_writes(process)
    Path("now").touch()
    errors = ended(process, 2)
    assert (
        f"study 'deadly': two workers were lost at the same work, runs nsga2-00: {why} in"
        f" {Path('my_ads.py').resolve()}, line 10, probably" in errors
    )
    assert "in ads.model = 'my_ads:Deadly'" in errors


Start = Callable[..., tuple[Process, str]]


@pytest.fixture
def start(small: None) -> Iterator[Start]:
    """Starts a program of Dask's in a process group of its own, and waits until its log says
    something; returns the process and the log. All are ended with the test.
    """
    running = []

    def begin(program: str, said: str, *arguments: str) -> tuple[Process, str]:
        command = [
            sys.executable,
            "-m",
            f"distributed.cli.dask_{program}",
            *arguments,
            "--no-dashboard",
        ]
        environment = {
            **os.environ,
            "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0",
        }
        log = Path(f"{program}-{len(running)}.log")
        with log.open("w") as file:
            process = subprocess.Popen(
                command,
                stdout=file,
                stderr=file,
                text=True,
                start_new_session=True,
                env=environment,
            )
        running.append(process)
        until(lambda: said in log.read_text(), process)
        return process, log.read_text()

    yield begin
    for process in running:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.fixture
def address(start: Start) -> str:
    """The address of a scheduler."""
    said = "Scheduler at:"
    _, log = start("scheduler", said, "--host", "127.0.0.1", "--port", "0")
    return log.partition(said)[2].split()[0]


def worker(start: Start, address: str) -> Process:
    options = "--nthreads", "1", "--local-directory", "scratch", "--no-nanny"
    process, _ = start("worker", "Registered to", address, *options)
    return process


@SLOW
def test_two_workers_of_which_one_is_killed_leave_the_same_bytes(
    address: str, start: Start, whole: Path
) -> None:
    workers = [worker(start, address) for _ in range(2)]
    process = started(f"study small.toml --cluster {address} --out out", batch=1)
    until_it_writes(process)
    for one in workers:  # each loads the compiled vehicle, and computes
        until(lambda: has_loaded(one, "llvmlite"), process)  # noqa: B023
    assert process.poll() is None, "too late: the study is over"
    killed(workers[0])
    assert_ends_with_the_results(process, whole)
    assert workers[1].poll() is None


COUNTED = """
import os
import time

from models import Wall


class Counted(Wall):
    @classmethod
    def open_worker(cls, worker):
        return open("numbers", "a").write(f"{worker}\\n")

    def simulate(self, setting):
        time.sleep(float(os.environ.get("SLOW", "0")))
        return super().simulate(setting)
"""


@SLOW
@pytest.mark.usefixtures("few_frames")
def test_questions_on_a_cluster_have_the_bytes_of_one_process(
    address: str, start: Start
) -> None:
    """A worker that dies is replaced, with its number; one with another file ends the command."""
    write("models.py", MODELS)
    write("counted.py", COUNTED)
    write("wall.toml", STUDY.replace("models:Wall", "counted:Counted"))
    workers = [worker(start, address) for _ in range(2)]
    for command in (
        "risk rain --samples 300",
        "rules wall.toml --samples 500",
        "tolerance wall.toml --simulations 300",
    ):
        alone = run(f"{command} --jobs 1 --fresh")
        there = run(f"{command} --cluster {address} --fresh")
        assert there.stdout == alone.stdout, command
    assert {*Path("numbers").read_text().split()} == {"0", "1"}
    run("study wall.toml --out walls")
    asked = "evidence walls --ask 'rules --samples 300'"
    run(f"{asked} --out 1.zip --jobs 1")
    run(f"{asked} --out 2.zip --cluster {address}")
    assert Path("1.zip").read_bytes() == Path("2.zip").read_bytes()

    # A worker dies at work.
    process = started(f"rules wall.toml --samples 900 --cluster {address} --json")
    time.sleep(3)
    killed(workers[0])
    process.wait(60)
    assert process.returncode == 0


@SLOW
def test_a_worker_with_another_file_ends_a_question(address: str, start: Start) -> None:
    write("models.py", MODELS)
    write("wall.toml", STUDY)
    worker(start, address)
    wrong = "safevar_sumo.campaign.batches"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(f"{wrong}.package_digest", lambda: "other")
        refused(f"risk wall.toml --cluster {address}", "has other code")
    with pytest.MonkeyPatch.context() as patch:
        now = batches.manifest_now

        def edited(*arguments: Any) -> Any:
            manifest = now(*arguments)
            return {**manifest, "versions": {**manifest["versions"], "numpy": "1.0"}}

        patch.setattr(f"{wrong}.manifest_now", edited)
        told = ("version of numpy was '1.0'", "a worker has another one")
        refused(f"risk wall.toml --cluster {address}", *told)
