"""MetaDrive's learned driver, a simulator of a study, and what docs/simulators.md says of it and of
CARLA.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
from mypy import api

from tests.in_process import json_of, run
from tests.manual import ROOT, files_of

PAGE = "docs/simulators.md"
pytestmark = pytest.mark.slow
if os.environ.get("SAFEVAR_METADRIVE") != "required":
    pytest.importorskip("panda3d")  # MetaDrive's engine; MetaDrive itself takes seconds to import


@pytest.mark.usefixtures("worker_processes")
def test_repeats_are_bit_equal_in_any_order_and_in_a_new_process() -> None:
    assert "metadrive_expert: passed" in run("check", "metadrive_expert", "--vehicles", "4").stdout


@pytest.mark.usefixtures("in_tmp")
def test_the_page_says_what_the_driver_does() -> None:
    page = (ROOT / PAGE).read_text().partition("<!-- learned driver -->")[2]
    rows = re.findall(r"^\| `(\S+) = (\S+)` \| (\S+) \| (\S+) \| (\S+) \|$", page, re.M)
    assert rows
    for name, value, *degrees in rows:
        answer = json_of("simulate", "metadrive_expert", "--set", f"{name}={value}")
        points = answer["tables"]["points"]["rows"]
        found = [point["safety_degree"] for point in points]
        assert found == pytest.approx([*map(float, degrees)], abs=0.05), name
    Path("left.toml").write_text(files_of(PAGE)["left.toml"])
    assert json_of("simulate", "left.toml")["numbers"]["safety_degree"] < 0.2


@pytest.mark.usefixtures("in_tmp")
def test_a_short_study_finds_that_worn_brakes_are_enough() -> None:
    short = "--algorithms nsga2 --runs 1 --evaluations 40"
    printed = run("study", "metadrive_expert", *short.split()).stdout
    assert re.search(r"With 1 change.* collides at .*: max_brake_force 150 -> [67]", printed)


def test_the_calls_of_the_page_fit_the_client_of_carla(in_tmp: Path) -> None:
    """Of all calls only that is a fault which is misspelt here."""
    carla = pytest.importorskip("carla")
    Path("carla").symlink_to(Path(carla.__file__).parent)  # which does not say that it has types
    source = files_of(PAGE)["my_carla.py"]
    Path("my_carla.py").write_text(source.replace(".load_world(", ".load_wurld("))
    printed = api.run(["--strict", "--config-file=", "my_carla.py"])[0]
    faults = re.findall("^my_carla.*error: (.*?);", printed, re.M)
    assert faults == ['"Client" has no attribute "load_wurld"']
