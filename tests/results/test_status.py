"""A study is looked at from outside while it runs: what its journals hold, and nothing is changed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
from click.testing import CliRunner

import safevar_sumo as sv
from safevar_sumo.analysis.research_questions.case import load_cases
from safevar_sumo.cli.program import commands
from safevar_sumo.results import status


def contents(place: Path) -> dict[str, tuple[bytes, int]]:
    return {str(path): (path.read_bytes(), path.stat().st_mtime_ns) for path in sorted(place.rglob("*")) if path.is_file()}


def test_a_finished_study_is_told_as_its_journals_hold_it(slippery: Path) -> None:
    assert sv.status is status
    before = contents(slippery)
    told, (case,) = status(slippery), load_cases([slippery])
    assert contents(slippery) == before
    assert told.finished
    assert told.share == 1
    assert told.simulated == len(case.evaluations)
    for run in told.runs:
        group = case.evaluations[(case.evaluations["algorithm"] == run.algorithm) & (case.evaluations["run"] == run.run)]
        assert run.collisions == (group["outcome"] == "collision").sum()
        assert run.best == group["f_safe"].min()
    assert sorted(told.points[:, 0].tolist()) == sorted(case.evaluations["f_safe"].tolist())


def test_a_study_under_way(slippery: Path, tmp_path: Path) -> None:
    shutil.copytree(slippery, tmp_path / "it")
    nsga2, rs = tmp_path / "it/runs/nsga2-00.journal", tmp_path / "it/runs/rs-00.journal"
    rs.unlink()
    nsga2.write_bytes(nsga2.read_bytes()[:len(nsga2.read_bytes()) * 2 // 3])  # torn, as while somebody writes
    told = status(tmp_path / "it")
    assert [run.state for run in told.runs] == ["begun", "waiting"]
    assert 0 < told.runs[0].simulated < 60
    assert 0 < told.share < 0.5
    done = CliRunner().invoke(commands, ["status", str(tmp_path / "it")])
    assert "nsga2:0 " in done.output
    assert "Front so far" in done.output
    assert "simulator" in done.output, "a collision is a failure too, but counted on its own"
    assert "failures" not in done.output
    assert "% done" in done.output
    lines = CliRunner(env={"COLUMNS": "80"}).invoke(commands, ["status", str(tmp_path / "it")]).output.splitlines()
    assert max(map(len, lines)) <= 80
    assert "collisions" in "".join(lines), "no word is cut in two"


def test_a_study_of_which_nothing_is_done_yet(slippery: Path, tmp_path: Path) -> None:
    tmp_path.joinpath("it").mkdir()
    shutil.copy(slippery / "manifest.json", tmp_path / "it")
    assert status(tmp_path / "it").share == 0
    assert "Nothing simulated yet" in CliRunner().invoke(commands, ["status", str(tmp_path / "it")]).output


def test_watching_ends_with_the_study_and_json_is_json(slippery: Path) -> None:
    done = CliRunner().invoke(commands, ["status", str(slippery), "--watch"])
    assert done.exit_code == 0
    assert "Finished." in done.output
    told = json.loads(CliRunner().invoke(commands, ["status", str(slippery), "--json"]).output)
    assert told["finished"] is True
    assert np.isfinite(told["runs"][0]["best"])


def test_an_edited_table_is_told(slippery: Path, tmp_path: Path) -> None:
    shutil.copytree(slippery, tmp_path / "it")
    file = tmp_path / "it/solutions.csv"
    file.write_text(file.read_text().replace("nsga2,0,", "nsga2,1,", 1))
    done = CliRunner().invoke(commands, ["status", str(tmp_path / "it"), "--json"])
    assert done.exit_code == 0
    assert f"{file} was edited" in done.stderr
    json.loads(done.stdout)
