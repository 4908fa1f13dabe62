"""A study that is killed, starved, damaged and interrupted still ends with the same bytes, or with a clear error."""

from __future__ import annotations

import json
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
from processes import SAFEVAR, ended, killed, left_of_group, started, until, workers_of, written

from safevar_sumo.computing import identity_of
from safevar_sumo.results import ResultsDirectory, load
from safevar_sumo.simulation import assemble
from safevar_sumo.study import load_study

STUDY = """
extends = "smoke"
name = "small"
[search]
algorithms = ["nsga2", "rs", "safe_fuzzer"]
evaluations = 150
"""


def study(*arguments: str, expect: int = 0) -> str:
    return ended(started("study", "small.toml", *arguments), expect)


def solutions(out: str | Path) -> bytes:
    return (Path(out) / "solutions.csv").read_bytes()


@pytest.fixture(autouse=True)
def _small(in_tmp: Path) -> None:
    Path("small.toml").write_text(STUDY)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of the study carried out in peace by one worker."""
    place = tmp_path_factory.mktemp("whole")
    (place / "small.toml").write_text(STUDY)
    ended(started("study", str(place / "small.toml"), "--out", str(place / "out"), "--jobs", "1"), 0)
    return place / "out"


@pytest.fixture
def copied(whole: Path) -> Path:
    """Those results, to be spoilt."""
    shutil.copytree(whole, "out")
    return Path("out")


def test_two_workers_leave_the_same_bytes(whole: Path) -> None:
    study("--out", "out", "--jobs", "2")
    assert solutions("out") == solutions(whole)
    assert Path("out/manifest.json").read_bytes() == (whole / "manifest.json").read_bytes()


def killed_and_resumed(times: int) -> None:
    """Kill the study so often, a moment after it has got further, and finish it."""
    moments, out = random.Random(4), Path("out")
    for _ in range(times):
        before = written(out)
        process = started("study", "small.toml", "--out", "out", "--jobs", "1", "--batch", "1")
        until(lambda: written(out) > before, process)  # noqa: B023
        time.sleep(moments.uniform(0, 0.1))
        assert process.poll() is None, "the study is too short to be killed so often"
        killed(process)
        until(lambda: not left_of_group(process))  # noqa: B023
    assert not (out / "solutions.csv").exists()
    study("--out", "out", "--jobs", "2")


def test_killed_at_random_moments_and_resumed(whole: Path) -> None:
    killed_and_resumed(5)
    assert solutions("out") == solutions(whole)


@pytest.mark.slow
def test_killed_a_hundred_times_at_random_moments_and_resumed() -> None:
    Path("small.toml").write_text(STUDY.replace("evaluations = 150", "evaluations = 400"))
    study("--out", "whole", "--jobs", "2")
    killed_and_resumed(100)
    assert solutions("out") == solutions("whole")


@pytest.mark.slow
@pytest.mark.parametrize("goes_on", [False, True])
def test_workers_that_are_stopped_lose_nothing(goes_on: bool, whole: Path) -> None:
    Path("small.toml").write_text(STUDY + "time_limit = 20\n")
    process, moments = started("study", "small.toml", "--out", "out", "--jobs", "2", "--batch", "5"), random.Random(6)
    until(lambda: written(Path("out")) > 0, process)
    for _ in range(3):
        for worker in workers_of(process)[:1]:
            worker.suspend()
            time.sleep(moments.uniform(0.5, 1.5))
            if goes_on:
                worker.resume()
    process.communicate(timeout=300)
    assert solutions("out") == solutions(whole)
    assert not load("out").failures


def test_workers_killed_at_random_moments(whole: Path) -> None:
    moments, out, kills = random.Random(5), Path("out"), 0
    process = started("study", "small.toml", "--out", "out", "--jobs", "2", "--batch", "5")
    until(lambda: written(out) > 0, process)
    while process.poll() is None and kills < 6:
        time.sleep(moments.uniform(0.2, 0.6))
        for worker in moments.sample(workers := workers_of(process), k=min(1, len(workers))):
            try:
                worker.kill()
                kills += 1
            except psutil.NoSuchProcess:
                continue
    ended(process, 0)
    assert kills >= 4
    assert solutions(out) == solutions(whole)
    assert (load(out).evaluations["outcome"] != "simulator-error").all()


def test_shards_one_after_the_other_and_the_rest(whole: Path) -> None:
    first, second = (started("study", "small.toml", "--out", "out", "--jobs", "1", "--shard", f"{k}/2") for k in (1, 2))
    ended(first, 0)
    ended(second, 0)
    assert not Path("out/solutions.csv").exists()
    assert len(load("out").solutions.groupby(["algorithm", "run"])) == 6
    before = written(Path("out"))
    study("--out", "out", "--jobs", "1")
    assert written(Path("out")) == before, "nothing was left to simulate"
    assert solutions("out") == solutions(whole)


def test_a_shard_without_a_run_has_nothing_to_do() -> None:
    process = started("study", "small.toml", "--out", "out", "--shard", "9/9", "--jobs", "1")
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")
    assert "No solution." in output


def test_one_run_alone_is_the_same_as_in_the_whole(whole: Path) -> None:
    study("--out", "out", "--only", "nsga2:1", "--jobs", "1")
    assert [path.name for path in Path("out/runs").glob("*-*")] == ["nsga2-01.journal"]
    found, every = load("out").solutions, load(whole).solutions
    expected = every[(every["algorithm"] == "nsga2") & (every["run"] == 1)]
    pd.testing.assert_frame_equal(found, expected.reset_index(drop=True))


def test_more_runs_extend_what_is_there(copied: Path) -> None:
    fewer = copied / "runs" / "rs-01.journal"
    stamp = fewer.stat().st_mtime_ns
    study("--out", "out", "--runs", "3", "--jobs", "2")
    frame = pd.read_csv("out/solutions.csv")
    assert set(frame["run"]) == {0, 1, 2}
    assert fewer.stat().st_mtime_ns == stamp
    study("--out", "alone", "--runs", "3", "--only", "rs:2", "--jobs", "1")
    expected = load("alone").solutions
    pd.testing.assert_frame_equal(load("out").solutions.query("algorithm == 'rs' and run == 2").reset_index(drop=True), expected)


@pytest.mark.parametrize(("options", "told"), [
    (["--seed", "9"], "search.seed is 1 there and 9 here"),
])
def test_options_that_would_change_results_are_refused(copied: Path, options: list[str], told: str) -> None:
    before = {path: path.read_bytes() for path in copied.rglob("*.*")}
    assert told in study("--out", "out", *options, expect=2)
    assert {path: path.read_bytes() for path in copied.rglob("*.*")} == before


def test_results_of_another_version_are_refused(copied: Path) -> None:
    manifest = json.loads((copied / "manifest.json").read_text())
    manifest["versions"]["libsumo"] = "1.20.0"
    (copied / "manifest.json").write_text(json.dumps(manifest))
    assert "version of libsumo is '1.20.0' there and '1.28.0' here" in study("--out", "out", expect=2)
    (copied / "manifest.json").unlink()
    (copied / "runs" / "original.journal").unlink()
    Path("small.toml").write_text(STUDY + "seed = 2\n")
    assert "belongs to another study, run or version" in study("--out", "out", expect=2)


def test_torn_tails_are_cut_off_with_a_warning(copied: Path, whole: Path) -> None:
    for name, lost in (("nsga2-00", 20), ("safe_fuzzer-01", 9000)):
        path = copied / "runs" / f"{name}.journal"
        os.truncate(path, path.stat().st_size - lost)
    with (copied / "runs" / "rs-00.journal").open("ab") as file:
        file.write(b"SVJ\n rubbish")
    told = study("--out", "out", "--jobs", "1", "--quiet")
    assert told.count("warning") == 3
    assert "nsga2-00.journal" in told
    assert solutions("out") == solutions(whole)


def test_damage_in_the_middle_names_file_and_offset(copied: Path) -> None:
    path = copied / "runs" / "rs-00.journal"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    told = study("--out", "out", expect=2)
    assert "rs-00.journal: is damaged at byte" in told
    assert path.read_bytes() == content


def test_a_run_in_the_hands_of_another_process_is_not_started_twice(whole: Path) -> None:
    chosen = load_study("small.toml")
    theirs = ResultsDirectory(Path("out"), chosen, identity_of(chosen, assemble(chosen))).journal("rs-00")
    told = study("--out", "out", "--jobs", "2", expect=1)
    assert "another process works on rs-00" in told
    assert len(load("out").solutions.groupby(["algorithm", "run"])) == 5
    theirs.close()
    study("--out", "out", "--jobs", "1")
    assert solutions("out") == solutions(whole)


def test_a_full_disk_is_told_and_what_was_written_stays_valid(whole: Path) -> None:
    def little_room() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (19_000, resource.RLIM_INFINITY))

    told = ended(started("study", "small.toml", "--out", "out", "--jobs", "1", preexec_fn=little_room), 1)
    assert "cannot be written: File too large; what was written before stays valid" in told
    assert len(told.strip().splitlines()) == 1
    frame = load("out").evaluations
    assert len(frame) > 50
    both = frame.merge(load(whole).evaluations, on=["algorithm", "run", "evaluation"], suffixes=("", "_whole"))
    assert len(both) == len(frame)
    assert np.array_equal(both["f_safe"], both["f_safe_whole"])
    study("--out", "out", "--jobs", "1")
    assert solutions("out") == solutions(whole)


def test_a_directory_that_is_taken_away_is_told() -> None:
    process = started("study", "small.toml", "--out", "out", "--jobs", "1")
    until(lambda: written(Path("out")) > 3000, process)
    shutil.rmtree("out")
    told = ended(process, 1)
    assert "out/" in told
    assert "cannot be" in told


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
    shutil.rmtree(cache)
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
    ("os._exit(7)", 2, "the worker process died (exit code 7)"),
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


@pytest.mark.parametrize(("arguments", "told"), [
    (["--jobs", "0"], ("--jobs", "0")),
    (["--shard", "3/2"], ("--shard", "'3/2'", "K in 1..N")),
    (["--shard", "0/2"], ("--shard", "'0/2'")),
    (["--shard", "two"], ("--shard", "'two'")),
    (["--only", "nonsense"], ("--only", "'nonsense'", "ALGORITHM:RUN")),
    (["--only", "nsga2:2"], ("--only", "'nsga2:2'")),
    (["--only", "moea:0"], ("--only", "'moea:0'")),
    (["--cluster", "nowhere"], ("--cluster", "'nowhere'", "tcp://host:8786")),
    (["--cluster", ""], ("--cluster", "''")),
])
def test_bad_options_are_refused(arguments: list[str], told: tuple[str, ...]) -> None:
    errors = study("--out", "out", *arguments, expect=2)
    for part in told:
        assert part in errors
    assert not Path("out/runs").exists()


def test_a_dry_run_tells_what_it_would_take_and_writes_nothing() -> None:
    done = subprocess.run([*SAFEVAR, "study", "small.toml", "--dry-run"], capture_output=True, text=True, check=True)
    for word in ("nsga2, rs, safe_fuzzer", "900", "evaluations/s", "min", "MB"):
        assert word in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= 80
    assert not Path("results").exists()


def test_quiet_prints_nothing(copied: Path) -> None:
    process = started("study", "small.toml", "--out", "out", "--quiet", "--runs", "3", "--only", "rs:2")
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, output, errors) == (0, "", "")
