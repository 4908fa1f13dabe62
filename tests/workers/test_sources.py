"""Which files a study's results hang on: what other people's code is seen to read."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from safevar_sumo.plugins import digest_of
from safevar_sumo.study import load_study
from safevar_sumo.workers.batches import sources_of
from tests.in_process import Here

ADS = """
import json
import sqlite3
from pathlib import Path

import my_maps.rules
from my_space import roads
from safevar_sumo.ads import ScalarAds

HERE = Path(__file__).parent


class Mine(ScalarAds):
    def __init__(self, weights, table="", outside=""):
        self.gap = json.loads(Path(weights).read_text())["gap"]
        self.seen = not outside or Path(outside).read_text()

    def drive(self, seen):
        import my_lazy
        (HERE / "tiles" / "1.txt").read_bytes()
        (HERE / "both.txt").open("r+").close()
        sqlite3.connect(f"{(HERE / 'map.db').as_uri()}?mode=ro", uri=True).close()
        (HERE / "log.txt").write_text("written, then read")
        (HERE / "log.txt").read_text()
        return (0.0, 1.0) if seen.gap < self.gap else (0.5, 0.0)
"""
FILES = {
    "my_ads.py": ADS, "my_maps/__init__.py": "", "my_maps/rules.py": "import numpy\n", "my_maps/unused.py": "", "my_space/roads.py": "",
    "my_lazy.py": "X = 1\n", "weights.json": '{"gap": 9.0}', "tiles/1.txt": "tile", "tiles/2.txt": "another tile", "unused.py": "",
    "table.bin": "read by compiled code", "both.txt": "opened to be read and written", "map.db": ""}
STUDY = """
extends = "smoke"
[ads]
model = "my_ads:Mine"
parameters = { weights = "weights.json", table = "table.bin" }
"""
READ = {
    "my_ads.py", "my_maps/__init__.py", "my_maps/rules.py", "my_space/roads.py", "my_lazy.py", "weights.json", "tiles/1.txt", "table.bin",
    "both.txt", "map.db"}


@pytest.fixture
def place(in_tmp: Path) -> Path:
    """A study with its files, in a folder that is not the working directory."""
    for name, text in FILES.items():
        (in_tmp / "there" / name).parent.mkdir(exist_ok=True, parents=True)
        (in_tmp / "there" / name).write_text(text)
    (in_tmp / "there" / "mine.toml").write_text(STUDY)
    return in_tmp / "there"


def read(place: Path) -> dict[str, str]:
    return sources_of(load_study(place / "mine.toml"), Here())


def test_what_is_read_while_models_are_loaded_made_and_first_run_counts_wherever_the_command_is_started(
        place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = read(place)
    assert set(found) == READ
    monkeypatch.chdir(place / "tiles")
    assert read(place) == found
    shutil.copytree(place, place.parent / "copy")
    assert read(place.parent / "copy") == found, "no name holds where the study lies"


@pytest.mark.parametrize("name", ["my_ads.py", "my_maps/rules.py", "my_space/roads.py", "my_lazy.py", "tiles/1.txt", "table.bin", "map.db"])
def test_an_edit_of_whatever_was_read_is_seen(name: str, place: Path) -> None:
    before = read(place)
    (place / name).write_text((place / name).read_text().replace("9.0", "8.0").replace("0.5", "0.4") + "\n")
    if name.startswith("my_"):
        (place / name).write_text((place / name).read_text() + "\nY = 2\n")
    after = read(place)
    assert [one for one in after if after[one] != before.get(one)] == [name]


def test_a_file_from_elsewhere_is_named_by_its_last_two_parts(place: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    outside = tmp_path_factory.mktemp("outside") / "data.txt"
    outside.write_text("x")
    (place / "mine.toml").write_text(STUDY.replace('"weights.json"', f'"weights.json", outside = "{outside}"'))
    assert set(read(place)) - READ == {f"{outside.parent.name}/data.txt"}


def test_a_comment_a_docstring_and_ends_of_lines_are_no_difference(tmp_path: Path) -> None:
    texts = ('"""One."""\ndef f(x):\n    """Two."""\n    return x + 1\n', "# three\ndef f(x):\r\n    'four'\n    return (x + 1)  # five\n",
             "def f(x): return x + 2\n", "def f(x): return x + 2.0\n", "def f(x): 'one'; return 'one'\n")
    files = [tmp_path / f"{number}.py" for number in range(len(texts))]
    for file, text in zip(files, texts, strict=True):
        file.write_bytes(text.encode())
    one, other, *different = map(digest_of, files)
    assert one == other
    assert len({one, *different}) == 4
    (tmp_path / "a").write_bytes(b"one\r\ntwo\r\n")
    (tmp_path / "b").write_bytes(b"one\ntwo\n")
    assert digest_of(tmp_path / "a") == digest_of(tmp_path / "b")
