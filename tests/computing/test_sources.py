"""Which files of code a study brings with it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from safevar_sumo.computing.sources import digest_of, foreign_code, package_code

FILES = {
    "my_ads.py": "import numpy\nimport json\nimport my_maps.germany as map\nfrom my_maps import rules\nimport safevar_sumo.ads\n",
    "my_maps/__init__.py": "",
    "my_maps/germany.py": "from . import roads\nfrom .signs import stop\n",
    "my_maps/roads.py": "def later():\n    import my_weights\n",
    "my_maps/signs.py": "import importlib\nimportlib.import_module('my_plugin')\n",
    "my_maps/rules.py": "import my_maps\nimport not_there\n",
    "my_maps/unused.py": "",
    "my_weights.py": "import my_ads\n",
    "my_plugin.py": "this is no Python",
    "unused.py": "",
}


@pytest.fixture(autouse=True)
def _files(in_tmp: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(in_tmp))
    for name, text in FILES.items():
        (in_tmp / name).parent.mkdir(exist_ok=True)
        (in_tmp / name).write_text(text)
    yield
    assert not {name for name in sys.modules if name.startswith("my_")}, "nothing of it was loaded"


def test_what_a_model_imports_from_beside_it_is_followed() -> None:
    found = foreign_code(["my_ads"], [])
    assert set(found) == set(FILES) - {"unused.py", "my_maps/unused.py"}
    assert found["my_weights.py"] == digest_of(Path("my_weights.py"))


def test_a_model_of_the_package_brings_nothing() -> None:
    assert foreign_code([], [{"gap": 3.0, "name": "no file"}]) == {}


def test_a_parameter_that_is_a_file_counts_with_its_content() -> None:
    Path("weights.bin").write_bytes(b"\0\1")
    one = foreign_code([], [{"nested": ["weights.bin"]}])
    Path("weights.bin").write_bytes(b"\0\2")
    assert list(one) == ["weights.bin"]
    assert foreign_code([], [{"nested": ["weights.bin"]}]) != one


def test_line_ends_are_no_difference() -> None:
    Path("a").write_bytes(b"one\r\ntwo\r\n")
    Path("b").write_bytes(b"one\ntwo\n")
    assert digest_of(Path("a")) == digest_of(Path("b"))


def test_an_installed_model_brings_its_own_package_alone(tmp_path: Path) -> None:
    found = foreign_code(["click.core"], [])
    assert "click/core.py" in found
    assert {name.partition("/")[0] for name in found} == {"click"}


def test_the_package_counts_with_what_can_change_a_result() -> None:
    rooms = {name.partition("/")[0] for name in package_code()}
    assert {"vehicles", "ads", "scenarios", "metrics", "search", "simulation"} <= rooms
    assert not rooms & {"cli", "terminal", "analysis", "report", "results", "__main__.py"}
