"""Every example runs as it is: the commands of its page, in a copy of its folder."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest

from tests.support.in_process import SLOW, run
from tools.manual import ROOT
from tools.pages import run_page

EXAMPLES = sorted(path.parent.name for path in ROOT.glob("examples/*/README.md"))
ELSEWHERE = {"carla", "metadrive"}
"""Examples that tests/scenarios/test_metadrive.py tries: they need CARLA's client or MetaDrive."""


def test_the_list_of_examples_is_whole() -> None:
    page = (ROOT / "examples/README.md").read_text("utf-8")
    assert sorted(re.findall(r"\((\w+)/README.md\)", page)) == EXAMPLES


@SLOW
@pytest.mark.usefixtures("pools_in_this_process")
@pytest.mark.parametrize("name", [name for name in EXAMPLES if name not in ELSEWHERE])
def test_an_example_runs_as_it_is(name: str, in_tmp: Path) -> None:
    shutil.copytree(ROOT / "examples" / name, in_tmp, dirs_exist_ok=True)
    for _ in run_page(f"examples/{name}/README.md", options_of_tests=True):
        pass
    for workflow in in_tmp.glob("*.yml"):
        for command in re.findall("python -m safevar_sumo (.*)", workflow.read_text()):
            run("", *shlex.split(command))
