"""What docs/simulators.md says of MetaDrive's learned driver and of CARLA."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from mypy import api

from tests.support.in_process import SLOW, json_of, run, write
from tests.support.needs import need_library
from tools.manual import ROOT, files_of

PAGE = "docs/simulators.md"
pytestmark = SLOW
need_library("panda3d")  # MetaDrive's engine; MetaDrive itself takes seconds to import


@pytest.fixture
def page(in_tmp: Path) -> str:
    """The text below the class of the page, whose files are in the working directory."""
    write("curve.toml", files_of(PAGE)["curve.toml"])
    write("my_metadrive.py", (ROOT / "examples/metadrive/my_metadrive.py").read_text())
    return (ROOT / PAGE).read_text().partition("<!-- learned driver -->")[2]


@pytest.mark.usefixtures("page", "worker_processes")
def test_repeats_are_bit_equal_in_any_order_and_in_a_new_process() -> None:
    assert "curve.toml passed all checks" in run("check curve.toml --vehicles 4").stdout


def test_the_page_says_what_the_driver_does(page: str) -> None:
    rows = re.findall(r"^\| `(\S+) = (\S+)`.* \| (\S+) \|$", page, re.MULTILINE)
    assert rows
    for name, value, degree in rows:
        answer = json_of(f"simulate curve.toml --set {name}={value}")
        found = answer["numbers"]["safety_degree"]
        assert found == pytest.approx(float(degree), abs=0.05), name


def test_the_calls_of_the_page_fit_the_client_of_carla(in_tmp: Path) -> None:
    """Of all calls only that is a fault which is misspelt here."""
    carla = need_library("carla")
    Path("carla").symlink_to(
        Path(carla.__file__).parent
    )  # which does not say that it has types
    source = (ROOT / "examples/carla/my_carla.py").read_text()
    write("my_carla.py", source.replace(".load_world(", ".load_wurld("))
    printed = api.run(["--strict", "--config-file=", "my_carla.py"])[0]
    faults = re.findall("^my_carla.*error: (.*?);", printed, re.MULTILINE)
    assert faults == ['"Client" has no attribute "load_wurld"']
