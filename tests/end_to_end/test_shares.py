"""A study carried out in parts: by two workers, in shards, run by run, with more runs, beside somebody else."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from safevar_sumo.results import ResultsDirectory, load
from safevar_sumo.study import load_study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.workers.identity import identity_of
from tests.end_to_end.processes import ended, started, written
from tests.end_to_end.small import solutions, study

pytestmark = pytest.mark.usefixtures("small")


def test_two_workers_leave_the_same_bytes(whole: Path) -> None:
    study("--out", "out", "--jobs", "2")
    assert solutions("out") == solutions(whole)
    assert Path("out/manifest.json").read_bytes() == (whole / "manifest.json").read_bytes()


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


def test_a_run_in_the_hands_of_another_process_is_not_started_twice(whole: Path) -> None:
    chosen = load_study("small.toml")
    theirs = ResultsDirectory(Path("out"), chosen, identity_of(chosen, assemble(chosen))).journal("rs-00")
    told = study("--out", "out", "--jobs", "2", expect=1)
    assert "another process works on rs-00" in told
    assert len(load("out").solutions.groupby(["algorithm", "run"])) == 5
    theirs.close()
    study("--out", "out", "--jobs", "1")
    assert solutions("out") == solutions(whole)
