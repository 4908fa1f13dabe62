"""Results belong to the files that they were computed with, as a user edits them."""

from __future__ import annotations

import shutil
import subprocess
import time
from pathlib import Path

import pytest
from click.testing import CliRunner
from processes import ended, started, until, workers_of, written

from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError
from safevar_sumo.results import load
from safevar_sumo.shipped import NETWORKS

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


def study(*options: str, expect: int = 0) -> str:
    return ended(started("study", "mine.toml", "--out", "out", "--jobs", "1", *options), expect)


def edited(path: str, old: str, new: str) -> None:
    text = Path(path).read_text()
    assert old in text
    Path(path).write_text(text.replace(old, new))


def test_results_go_with_the_files_that_they_were_computed_with() -> None:
    study()
    before = Path("out/solutions.csv").read_bytes()
    edits = ("my_ads.py", "0.5", "0.65"), ("my_map.py", "9.0", "8.25"), ("my_net/traffic.rou.xml", "<route", "<!-- --><route")
    for path, old, new in edits:
        edited(path, old, new)
        told = CliRunner().invoke(commands, ["study", "mine.toml", "--out", "out"]).exception
        assert isinstance(told, InputError)
        assert f"{Path(path).name} has changed since" in str(told)
        assert "another --out, or the" in str(told)
        edited(path, new, old)
    Path("mine.toml").write_text(STUDY.replace('name = "mine"', 'name = "mine"\ntitle = "Another title"'))
    study()
    assert Path("out/solutions.csv").read_bytes() == before


def under_way() -> subprocess.Popen[str]:
    """A long study that has journalled something."""
    Path("mine.toml").write_text(STUDY.replace("evaluations = 30", "evaluations = 400"))
    process = started("study", "mine.toml", "--out", "out", "--jobs", "1", "--batch", "1")
    until(lambda: written(Path("out")) > 0, process)
    return process


@pytest.mark.slow
def test_files_that_are_edited_meanwhile_mix_nothing() -> None:
    process = under_way()
    edited("my_ads.py", "0.5", "0.65")
    before = written(Path("out"))
    until(lambda: written(Path("out")) > before + 500, process)
    workers_of(process)[0].kill()
    told = ended(process, 2)
    assert "safevar-sumo: my_ads.py: is not the file that this study began with" in told
    assert len(load("out").evaluations) > 1
    edited("my_ads.py", "0.65", "0.5")
    study()
    mixed = Path("out/solutions.csv").read_bytes()
    shutil.rmtree("out")
    study()
    assert Path("out/solutions.csv").read_bytes() == mixed


@pytest.mark.slow
def test_a_network_that_is_edited_meanwhile_mixes_nothing() -> None:
    process = under_way()
    edited("my_net/traffic.rou.xml", "<route", "<!-- --><route")
    assert "traffic.rou.xml: is not the file that this study began with" in ended(process, 2)


def test_of_two_studies_that_start_together_one_gets_the_directory() -> None:
    Path("other.toml").write_text('extends = "mine.toml"\nname = "other"\n')
    both = [started("study", name, "--out", "out", "--jobs", "1") for name in ("mine.toml", "other.toml")]
    outputs = [process.communicate(timeout=60) for process in both]
    assert sorted(process.returncode for process in both) == [0, 2], outputs
    assert "another study" in "".join(errors for _, errors in outputs)
    assert len(load("out").solutions) > 0


@pytest.mark.slow
def test_a_first_try_that_failed_leaves_the_directory_free() -> None:
    good = Path("my_net/network.edg.xml").read_text()
    Path("my_net/network.edg.xml").write_text('<edges><edge id="road" from="west" to="nowhere"/></edges>')
    assert "netconvert refuses the network" in study(expect=2)
    Path("my_net/network.edg.xml").write_text(good)
    start = time.monotonic()
    study()
    assert time.monotonic() - start < 30
