"""The commands as a user types them; a study carried out in parts, and gone on with after
damage.
"""

from __future__ import annotations

import json
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import safevar_sumo as sv
from safevar_sumo.results import FILES, load_runs, read_manifest
from tests.support.formulas import solutions
from tests.support.in_process import (
    SLOW,
    json_of,
    numbers_of,
    own_network,
    refused,
    run,
    write,
)
from tests.support.processes import written

pytestmark = pytest.mark.usefixtures("small")


@pytest.mark.parametrize("study", ["rain", "native"])
def test_trace_has_every_quantity_with_its_unit(study: str, in_tmp: Path) -> None:
    run(f"simulate {study} --trace trace.csv")
    frame = pd.read_csv("trace.csv")
    assert ", ".join(frame.columns) == (
        "time [s], position [m], speed [m/s], acceleration [m/s^2], gap [m], ttc [s], "
        "throttle [-], brake [-], gear [-], lateral [m], lateral speed [m/s], seen speed [m/s], "
        "seen gap [m], seen closing speed [m/s], seen lateral [m], seen lateral speed [m/s]"
    )
    assert frame.loc[frame["speed [m/s]"] < 1e-3, "ttc [s]"].isna().all(), (
        "a standing vehicle closes nothing"
    )
    assert frame["ttc [s]"].notna().any()
    step = np.diff(frame["time [s]"])
    assert np.allclose(step, step[0])
    assert np.allclose(
        np.diff(frame["speed [m/s]"]) / step, frame["acceleration [m/s^2]"][1:]
    )


@SLOW
def test_a_title_is_no_markup(in_tmp: Path) -> None:
    write("mine.toml", 'extends = "smoke"\nname = "mine"\ntitle = "[red]x[/blue] {$"\n')
    assert "[red]x[/blue]" in run("simulate mine.toml --details").stdout
    run("study mine.toml --evaluations 10 --runs 1 --algorithms rs --quiet")


@SLOW
def test_a_study_ends_with_a_summary(in_tmp: Path) -> None:
    assert "Next: python -m safevar_sumo explain smoke" in run("study smoke").stdout
    output = run("study smoke --details").stdout
    for part in (
        "NSGA-II",
        "None of the 8 tests of RQ1 can be significant: after Holm's correction, a test needs at",
    ):
        assert part in output
    assert "RQ1 over runs" not in output, "no test of so few runs can be significant"


@SLOW
@pytest.mark.usefixtures("pools_in_this_process")
def test_parts_and_one_run_are_the_same_as_in_the_whole(whole: Path) -> None:
    keys = [(name, run) for name in ("nsga2", "rs", "safe_fuzzer") for run in range(2)]
    for k in (0, 1):
        sv.run("small.toml", "out", only=keys[k::2])
    assert not Path("out/solutions.csv").exists()
    assert len(load_runs("out").solutions.groupby(["algorithm", "run"])) == 6
    before = written(Path("out"))
    run("study small.toml --quiet --out out")
    assert written(Path("out")) == before, "nothing was left to simulate"
    assert solutions(Path("out")) == solutions(whole)
    sv.run("small.toml", "alone", only=keys[1:2])
    assert [path.name for path in Path("alone/runs").glob("*-*")] == ["nsga2-01.jsonl"]
    expected = (
        load_runs(whole)
        .solutions.query("algorithm == 'nsga2' and run == 1")
        .reset_index(drop=True)
    )
    pd.testing.assert_frame_equal(load_runs("alone").solutions, expected)


@SLOW
def test_results_of_another_size_are_continued_with_a_warning(copied: Path) -> None:
    again = "study small.toml --quiet --out out"
    assert "warning" not in run(again).stderr
    longer = run(f"{again} --evaluations 160").stderr
    assert (
        "out: each run had 150 evaluations before and has 160 now: an id such as nsga2:0:0 may name"
        " another solution" in longer
    )
    assert "left out" not in longer
    fewer = run(f"{again} --evaluations 160 --runs 1 --algorithms nsga2,rs").stderr
    assert (
        "out: earlier runs are left out of the results: nsga2-01, rs-01, safe_fuzzer-00,"
        " safe_fuzzer-01" in fewer
    )
    assert "evaluations before" not in fewer


@SLOW
def test_the_end_of_a_study_counts_what_was_simulated_and_quiet_prints_only_what_is_asked_for(
    whole: Path,
) -> None:
    simulated = len(load_runs(whole).evaluations)
    again = f"study small.toml --out {whole} --quiet"
    assert run(again).stdout == ""
    assert numbers_of(again)["evaluations"] == simulated
    assert "NSGA-II" in run(f"{again} --table algorithms").stdout


ADS = """
from safevar_sumo.ads import ScalarAds

from my_map import GAP


class Careful(ScalarAds):
    def drive(self, seen):
        return (0.0, 1.0) if abs(seen.lateral) < 2.5 and seen.gap < GAP else (0.5, 0.0)
"""
STUDY = """
extends = "smoke"
name = "mine"
[ads]
model = "my_ads:Careful"
[scenario]
files = ["table.txt", "near.txt", "far.txt"]
parameters = { network = "my_net" }
[search]
algorithms = ["rs"]
evaluations = 4
population = 2
runs = 1
[[matrix.tests]]
name = "as it is"
[[matrix.tests]]
name = "mine"
model = "my_test:Test"
parameters = { table = "table.txt" }
over = { where = ["near.txt", "far.txt"] }
"""
TEST = """
from pathlib import Path

from safevar_sumo.scenarios import PedestrianCrossing


class Test(PedestrianCrossing, frozen=True):
    table: str = ""
    where: str = ""

    def observe(self, world, step, memory):
        Path(self.where).read_bytes()
        return super().observe(world, step, memory)
"""


@SLOW
def test_code_and_named_files_count_and_every_command_that_simulates_results_refuses_by_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write("mine.toml", STUDY)
    own_network(Path("my_net"))
    files = {"my_ads.py": ADS, "my_map.py": "GAP = 9.0\n", "my_test.py": TEST}
    files |= {"table.txt": "1", "near.txt": "2", "far.txt": "3"}
    for name, text in files.items():
        write(name, text)
    Path("elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    run("study ../mine.toml --out ../out --quiet")
    assert {*files} <= {*read_manifest(Path("../out"))["files"]}
    run("study ../mine.toml --out ../out --runs 2 --quiet")
    listed = [
        path.relative_to("../out").as_posix()
        for path in Path("../out").rglob("*")
        if path.is_file()
    ]
    assert {row for row in FILES if any(fnmatch(name, row[0]) for name in listed)} == {
        *FILES
    }
    assert [
        name for name in listed if not any(fnmatch(name, row[0]) for row in FILES)
    ] == [], "a file that the manual does not list"
    Path("../far.txt").write_text("another")
    for typed in (
        "simulate ../out --solution most-severe",
        "explain ../out",
        "report ../out",
    ):
        refused(typed, "far.txt has changed since", "--as-it-is-now")
    done = run("rules ../out --samples 8 --json --as-it-is-now")
    assert (
        "warning: ../out: far.txt has changed since; simulated as it is now"
        in done.stderr
    )


@SLOW
def test_a_search_says_how_fast_an_original_collides(in_tmp: Path) -> None:
    weather = (
        'name = "fog"\nroad_friction = 1.0\nvisibility = 1.0\nrecognition_delay = 1.5'
    )
    write("late.toml", f'extends = "smoke"\n[weather]\n{weather}\n')
    searched = run("study late.toml --runs 1 --evaluations 10 --json")
    speed = sv.simulate("late.toml").collision_speed
    assert speed > 1
    breach = f"collides at {speed:.2f} m/s"
    assert f"the original vehicle itself {breach}: no change is" in searched.stderr
    assert json.loads(searched.stdout)["verdict"].startswith(
        f"The original vehicle is already unsafe: it {breach}."
    )
    demanded = "study smoke --runs 1 --evaluations 10 --unsafe 'ave_dece >= 2'"
    verdict = json_of(demanded)["verdict"]
    assert verdict.startswith(
        "The original vehicle is already unsafe: it has ave_dece "
    )
    assert verdict.endswith("A failure needs no change of the vehicle.")
