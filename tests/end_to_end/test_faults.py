"""A study that is killed, starved and damaged still ends with the same bytes, or with a clear error."""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from safevar_sumo.results import load
from tests.end_to_end.processes import ended, killed, left_of_group, started, until, workers_of, written
from tests.end_to_end.small import STUDY, solutions, study

pytestmark = pytest.mark.usefixtures("small")


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
    killed_and_resumed(3)
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
