"""A study carried out in parts, gone on with after damage, and with options that are refused."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pandas as pd
import pytest

from safevar_sumo.campaign.identity import identity_of
from safevar_sumo.results import ResultsDirectory, load_runs
from safevar_sumo.results.manifest import write_manifest
from safevar_sumo.study import load_study
from safevar_sumo.sumo.system import assemble
from tests.end_to_end.processes import STUDY, solutions, study, written
from tests.in_process import refused, run

pytestmark = pytest.mark.usefixtures("small")


@pytest.mark.slow
def test_shards_and_one_run_are_the_same_as_in_the_whole(whole: Path) -> None:
    for k in (1, 2):
        study("--out", "out", "--shard", f"{k}/2")
    assert not Path("out/solutions.csv").exists()
    assert len(load_runs("out").solutions.groupby(["algorithm", "run"])) == 6
    before = written(Path("out"))
    study("--out", "out", "--batch", "7")
    assert written(Path("out")) == before, "nothing was left to simulate"
    assert solutions("out") == solutions(whole)
    assert "No solution." in run("study", "small.toml", "--out", "none", "--shard", "9/9").stdout
    study("--out", "alone", "--only", "nsga2:1")
    assert [path.name for path in Path("alone/runs").glob("*-*")] == ["nsga2-01.jsonl"]
    expected = load_runs(whole).solutions.query("algorithm == 'nsga2' and run == 1").reset_index(drop=True)
    pd.testing.assert_frame_equal(load_runs("alone").solutions, expected)


@pytest.mark.slow
def test_more_runs_extend_what_is_there(copied: Path) -> None:
    fewer = copied / "runs" / "rs-01.jsonl"
    stamp = fewer.stat().st_mtime_ns
    done = run("study", "small.toml", "--quiet", "--out", "out", "--runs", "3")
    assert (done.stdout, done.stderr) == ("", "")
    assert set(pd.read_csv("out/solutions.csv")["run"]) == {0, 1, 2}
    assert fewer.stat().st_mtime_ns == stamp
    study("--out", "alone", "--runs", "3", "--only", "rs:2")
    extended = load_runs("out").solutions.query("algorithm == 'rs' and run == 2").reset_index(drop=True)
    pd.testing.assert_frame_equal(extended, load_runs("alone").solutions)


def test_results_of_another_size_are_continued_with_a_warning(copied: Path) -> None:
    assert "warning" not in study("--out", "out")
    longer = study("--out", "out", "--evaluations", "160")
    assert (
        "out: each run had 150 evaluations before and has 160 now: an id such as nsga2:0:0 may name another solution"
        in longer
    )
    assert "left out" not in longer
    fewer = study("--out", "out", "--evaluations", "160", "--runs", "1", "--algorithms", "nsga2,rs")
    assert "out: 4 earlier runs left out of the results: nsga2-01, rs-01, safe_fuzzer-00, safe_fuzzer-01" in fewer
    assert "evaluations before" not in fewer


@pytest.mark.slow
def test_a_run_in_the_hands_of_another_process_is_not_started_twice(whole: Path) -> None:
    chosen = load_study("small.toml")
    theirs = ResultsDirectory(Path("out"), chosen, identity_of(chosen, assemble(chosen))).journal("rs-00")
    assert "another process works on rs-00" in study("--out", "out", expect=1)
    assert len(load_runs("out").solutions.groupby(["algorithm", "run"])) == 5
    theirs.close()
    study("--out", "out")
    assert solutions("out") == solutions(whole)


def test_results_of_another_version_or_seed_are_refused_and_left_alone(copied: Path) -> None:
    before = {path: path.read_bytes() for path in copied.rglob("*.*")}
    assert "search.seed was 1 and is 9 now" in study("--out", "out", "--seed", "9", expect=2)
    assert {path: path.read_bytes() for path in copied.rglob("*.*")} == before
    manifest = json.loads((copied / "manifest.json").read_text())
    manifest["versions"]["libsumo"] = "1.20.0"
    write_manifest(copied, manifest)
    assert "version of libsumo was '1.20.0' and is '1.28.0' now" in study("--out", "out", expect=2)
    (copied / "manifest.json").unlink()
    (copied / "runs" / "original.jsonl").unlink()
    Path("small.toml").write_text(STUDY + "seed = 2\n")
    assert "belongs to another study or version" in study("--out", "out", expect=2)


def test_torn_tails_are_cut_off_with_a_warning_and_damage_in_the_middle_names_its_place(
    copied: Path, whole: Path
) -> None:
    for name, lost in (("nsga2-00", 20), ("safe_fuzzer-01", 9000)):
        path = copied / "runs" / f"{name}.jsonl"
        os.truncate(path, path.stat().st_size - lost)
    with (copied / "runs" / "rs-00.jsonl").open("ab") as file:
        file.write(b'{"evaluation":[7, rubbish')
    result = study("--out", "out")
    assert result.count("warning") == 3
    assert "nsga2-00.jsonl" in result
    assert solutions("out") == solutions(whole)
    path = copied / "runs" / "rs-00.jsonl"
    path.write_bytes(content := path.read_bytes().replace(b'"outcome":', b'"outcome', 1))
    assert "rs-00.jsonl: is damaged in line 2" in study("--out", "out", expect=2)
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--jobs", "0"], ("--jobs", "0")),
        (["--shard", "3/2"], ("--shard", "'3/2'", "K in 1..N")),
        (["--shard", "0/2"], ("--shard", "'0/2'")),
        (["--only", "nonsense"], ("--only", "'nonsense'", "ALGORITHM:RUN")),
        (["--only", "nsga2:2"], ("--only", "'nsga2:2'")),
        (["--cluster", "nowhere"], ("--cluster", "'nowhere'", "tcp://host:8786")),
        (["--cluster", ""], ("--cluster", "''")),
    ],
)
def test_bad_options_are_refused(arguments: list[str], expected: tuple[str, ...]) -> None:
    refused("study", "small.toml", "--out", "out", *arguments, message=expected)
    assert not Path("out/runs").exists()


def test_a_shard_without_runs_is_told() -> None:
    output = run("study", "small.toml", "--out", "out", "--only", "rs:1", "--shard", "2/2", "--quiet")
    assert output.stderr == "warning: --shard 2/2 selects none of the runs\n"


def test_an_interval_is_refused_without_watching(copied: Path) -> None:
    refused("status", "out", "--every", "1", message=("--every", "1 without --watch", "together with --watch"))


def test_a_dry_run_tells_what_it_would_take_and_writes_nothing() -> None:
    output = run("study", "small.toml", "--dry-run").stdout
    for word in ("nsga2, rs, safe_fuzzer", "900", "evaluations/s", " s ", "kB"):
        assert word in output
    assert max(map(len, output.splitlines())) <= 80
    assert not Path("results").exists()


def test_an_ads_that_always_fails_ends_the_study_with_that_fault() -> None:
    Path("my_ads.py").write_text(
        "from safevar_sumo.ads import ScalarAds\n\n\nclass Bad(ScalarAds):\n"
        "    def drive(self, seen):\n        return 1 / 0\n"
    )
    Path("bad.toml").write_text('extends = "small.toml"\nname = "bad"\n[ads]\nmodel = "my_ads:Bad"\n')
    for options in ([], ["--dry-run"]):
        refused("study", "bad.toml", "--out", "out", *options, message=("ZeroDivisionError", "simulate bad.toml"))
