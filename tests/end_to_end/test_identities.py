"""Results belong to the files that they were computed with, as a user edits them."""

from __future__ import annotations

import shutil
from fnmatch import fnmatch
from pathlib import Path

import pytest
from click.testing import CliRunner

from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError
from safevar_sumo.results import FILES, read_manifest
from safevar_sumo.shipped import NETWORKS
from tests.in_process import run

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
[scenario.parameters]
network = "my_net"
[search]
algorithms = ["rs"]
evaluations = 30
runs = 1
"""


@pytest.fixture(autouse=True)
def _mine(in_tmp: Path) -> None:
    Path("my_ads.py").write_text(ADS)
    Path("my_map.py").write_text("GAP = 9.0\n")
    Path("mine.toml").write_text(STUDY)
    shutil.copytree(NETWORKS / "pedestrian_crossing", "my_net")


def study() -> None:
    run("study", "mine.toml", "--out", "out", "--quiet")


def edited(path: str, old: str, new: str) -> None:
    text = Path(path).read_text()
    assert old in text
    Path(path).write_text(text.replace(old, new))


MATRIX = """
[scenario]
files = ["table.txt", "near.txt", "far.txt"]
[matrix]
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


def refused(*words: str) -> str:
    """What a command says that ends with code 2."""
    result = CliRunner().invoke(commands, words).exception
    assert isinstance(result, InputError), (words, result)
    return f"{result.problem}: {result.legal}"


@pytest.mark.slow
def test_code_and_named_files_count_and_every_command_that_simulates_results_refuses_by_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    Path("mine.toml").write_text(STUDY.replace("evaluations = 30", "evaluations = 4\npopulation = 2") + MATRIX)
    files = {"my_test.py": TEST, "table.txt": "1", "near.txt": "2", "far.txt": "3"}
    for name, text in files.items():
        Path(name).write_text(text)
    Path("elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    run("study", "../mine.toml", "--out", "../out", "--quiet")
    assert {*files, "my_ads.py", "my_map.py"} <= set(read_manifest(Path("../out"))["files"])
    run("study", "../mine.toml", "--out", "../out", "--runs", "2", "--quiet")
    listed = [path.relative_to("../out").as_posix() for path in Path("../out").rglob("*") if path.is_file()]
    assert {row for row in FILES if any(fnmatch(name, row[0]) for name in listed)} == {*FILES}
    assert [name for name in listed if not any(fnmatch(name, row[0]) for row in FILES)] == [], (
        "a file that the manual does not list"
    )
    for name, text in files.items():
        Path("..", name).write_text(f"{text}\n# a comment\n")
        assert f"{name} has changed since" in refused("study", "../mine.toml", "--out", "../out", "--runs", "3")
        Path("..", name).write_text(text)
    Path("../far.txt").write_text("another")
    for words in ("simulate ../out --most-severe", "explain ../out", "report ../out"):
        result = refused(*words.split())
        assert "far.txt has changed since" in result
        assert "--as-it-is-now" in result
    done = CliRunner().invoke(commands, ["rules", "../out", "--samples", "8", "--json", "--as-it-is-now"])
    assert done.exit_code == 0, done.exception
    assert "warning: ../out: far.txt has changed since; simulated as it is now" in done.stderr
