"""The commands as a user types them; a study carried out in parts, and gone on with after damage."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from safevar_sumo.results import load_runs
from tests.end_to_end.conftest import solutions, study, written
from tests.in_process import refused, run

pytestmark = pytest.mark.usefixtures("small")
SLOW = pytest.mark.slow


@pytest.mark.parametrize("study", ["rain", "lgsvl", "native"])
def test_trace_has_every_quantity_with_its_unit(study: str, in_tmp: Path) -> None:
    run("simulate", study, "--trace", "trace.csv")
    frame = pd.read_csv("trace.csv")
    assert list(frame.columns) == [
        "time [s]",
        "position [m]",
        "speed [m/s]",
        "acceleration [m/s^2]",
        "gap [m]",
        "ttc [s]",
        "throttle [-]",
        "brake [-]",
        "gear [-]",
        "lateral [m]",
        "lateral speed [m/s]",
        "seen speed [m/s]",
        "seen gap [m]",
        "seen closing speed [m/s]",
        "seen lateral [m]",
        "seen lateral speed [m/s]",
    ]
    assert frame.loc[frame["speed [m/s]"] < 1e-3, "ttc [s]"].isna().all(), "a standing vehicle closes nothing"
    assert frame["ttc [s]"].notna().any()
    step = np.diff(frame["time [s]"])
    assert np.allclose(step, step[0])
    assert np.allclose(np.diff(frame["speed [m/s]"]) / step, frame["acceleration [m/s^2]"][1:])


def test_a_title_is_no_markup(in_tmp: Path) -> None:
    Path("mine.toml").write_text('extends = "smoke"\nname = "mine"\ntitle = "[red]x[/blue] {$"\n')
    assert "[red]x[/blue]" in run("simulate", "mine.toml").stdout
    run("study", "mine.toml", "--evaluations", "10", "--runs", "1", "--algorithms", "rs", "--quiet")


@SLOW
def test_a_study_ends_with_a_summary(in_tmp: Path) -> None:
    output = run("study", "smoke").stdout
    for part in (
        "original_outcome: stopped",
        "NSGA-II",
        "RQ1 over runs",
        "RQ2 over runs",
        "too few runs for all 8 tests of RQ1 (8 are needed)",
        "Next: python -m safevar_sumo explain results/smoke, python -m safevar_sumo tolerance results/smoke",
    ):
        assert part in output


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
def test_results_of_another_size_are_continued_with_a_warning(copied: Path) -> None:
    assert "warning" not in study("--out", "out")
    longer = study("--out", "out", "--evaluations", "160")
    assert (
        "out: each run had 150 evaluations before and has 160 now: an id such as nsga2:0:0 may name another solution"
        in longer
    )
    assert "left out" not in longer
    fewer = study("--out", "out", "--evaluations", "160", "--runs", "1", "--algorithms", "nsga2,rs")
    assert "out: earlier runs are left out of the results: nsga2-01, rs-01, safe_fuzzer-00, safe_fuzzer-01" in fewer
    assert "evaluations before" not in fewer


@pytest.mark.slow
def test_torn_runs_are_continued(copied: Path, whole: Path) -> None:
    for name, lost in (("nsga2-00", 20), ("safe_fuzzer-01", 9000)):
        path = copied / "runs" / f"{name}.jsonl"
        os.truncate(path, path.stat().st_size - lost)
    study("--out", "out")
    assert solutions("out") == solutions(whole)


def test_a_dry_run_tells_what_it_would_take_and_writes_nothing() -> None:
    output = run("study", "small.toml", "--dry-run").stdout
    for word in ("nsga2, rs, safe_fuzzer", "900", "evaluations_per_second", " s "):
        assert word in output
    assert not Path("results").exists()


def test_an_ads_that_always_fails_ends_the_study_with_that_fault() -> None:
    Path("my_ads.py").write_text(
        "from safevar_sumo.ads import ScalarAds\n\n\nclass Bad(ScalarAds):\n"
        "    def drive(self, seen):\n        return 1 / 0\n"
    )
    Path("bad.toml").write_text('extends = "small.toml"\nname = "bad"\n[ads]\nmodel = "my_ads:Bad"\n')
    for options, command in (([], "check bad.toml"), (["--dry-run"], "simulate bad.toml")):
        refused(
            "study",
            "bad.toml",
            "--out",
            "out",
            *options,
            message=("ZeroDivisionError", f"it: python -m safevar_sumo {command}"),
        )
