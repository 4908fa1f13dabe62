"""What a study's identity tells, and workers that have other files than the campaign; every step on
the disk fails once, and the campaign goes on to the same bytes.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
import portalocker
import pytest

from safevar_sumo import output
from safevar_sumo.api.simulation import load_study
from safevar_sumo.campaign.evaluation import Task
from safevar_sumo.campaign.inputs import files_of
from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.plugins.process import record_opened
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.results import load_runs, manifest, read_manifest
from safevar_sumo.study import Study
from safevar_sumo.sumo.system import assemble
from tests.support import formulas
from tests.support.formulas import FormulaPool
from tests.support.in_process import SLOW, own_network, refused, rewrite, run


@SLOW
def test_a_file_that_changes_while_a_study_runs_ends_it_before_a_run_counts_as_finished(
    tmp_path: Path,
) -> None:
    own_network(tmp_path / "mine")
    search = {"algorithms": ["rs"], "evaluations": 20, "runs": 1}
    study = load_study(
        "smoke",
        scenario={"parameters": {"network": str(tmp_path / "mine")}},
        search=search,
    )
    traffic = tmp_path / "mine" / "traffic.rou.xml"

    class Edited(FormulaPool):
        def evaluate(self, task: Task, settings: FloatArray) -> Evaluations:
            if len(self.received) == 1:  # the original vehicle
                traffic.write_text(traffic.read_text() + "<!-- -->")
            return super().evaluate(task, settings)

    with pytest.raises(
        InputError,
        match=r"traffic\.rou\.xml has changed since: it was changed meanwhile",
    ):
        formulas.carried_out(study, tmp_path / "out", Edited())
    assert not load_runs(tmp_path / "out").finished


ADS = """
import json
from pathlib import Path

import my_maps.rules
from my_space import roads
from safevar_sumo.ads import ScalarAds


class Mine(ScalarAds):
    def __init__(self, weights):
        self.gap = json.loads(Path(weights).read_text())["gap"]

    def drive(self, seen):
        import my_lazy
        return (0.0, 1.0) if seen.gap < self.gap else (0.5, 0.0)
"""
FILES = {
    "my_ads.py": ADS,
    "my_maps/__init__.py": "",
    "my_maps/rules.py": "import numpy\nimport my_helper\n",
    "my_maps/table.txt": "",
    "my_space/roads.py": "",
    "my_lazy.py": "X = 1\n",
    "my_helper.py": "",
    "weights.json": '{"gap": 9.0}',
    "tiles/1.txt": "tile",
    "tiles/2.txt": "another tile",
}
UNUSED = {"unused.py": "", "json/mine.py": "", "log.txt": "", "tiles/.hidden": ""}
STUDY = """
extends = "smoke"
[ads]
model = "my_ads:Mine"
parameters = { weights = "weights.json" }
files = ["weights.json", "tiles"]
"""


@pytest.fixture
def place(in_tmp: Path) -> Path:
    """A study with its files, in a folder that is not the working directory."""
    for name, text in {**FILES, **UNUSED}.items():
        (in_tmp / "there" / name).parent.mkdir(exist_ok=True, parents=True)
        (in_tmp / "there" / name).write_text(text)
    (in_tmp / "there" / "mine.toml").write_text(STUDY)
    return in_tmp / "there"


def test_imported_modules_whole_packages_and_named_files_count_wherever_the_command_is_started(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def files(place: Path) -> dict[str, str]:
        study = load_study(place / "mine.toml")
        return files_of(study, assemble(study))

    result = files(place)
    network = {name for name in result if name.startswith("pedestrian_crossing/")}
    assert {
        "pedestrian_crossing/traffic.rou.xml",
        "pedestrian_crossing/scenario.sumocfg",
    } <= network
    assert set(result) - network == set(FILES)
    monkeypatch.chdir(place / "tiles")
    assert files(place) == result
    shutil.copytree(place, place.parent / "copy")
    assert files(place.parent / "copy") == result, "no name holds where the study lies"


HIDDEN = """
import json
from pathlib import Path

from safevar_sumo.ads import ScalarAds

HERE = Path(__file__).parent
SCALE = json.loads((HERE / "scale.json").read_text())


class Hidden(ScalarAds):
    gap = None

    def drive(self, seen):
        import helper

        if self.gap is None:
            (HERE / "log.txt").write_text("it drives")
            self.gap = float(open(HERE / "gap.txt").read()) * SCALE
        return (0.0, 1.0) if seen.gap < self.gap + helper.MORE else (0.5, 0.0)
"""


@SLOW
@pytest.mark.parametrize("workers", ["in this process", "processes"])
def test_what_user_code_imports_while_it_runs_counts_and_what_it_opens_is_named(
    workers: str, in_tmp: Path, request: pytest.FixtureRequest
) -> None:
    if workers == "processes":
        request.getfixturevalue("worker_processes")
    there = in_tmp / "there"
    there.mkdir()
    for name, text in {
        "hidden.py": HIDDEN,
        "helper.py": "MORE = 1.0\n",
        "gap.txt": "8.0",
        "scale.json": "1.0",
    }.items():
        (there / name).write_text(text)
    search = "population = 5\nevaluations = 20\nruns = 1\nalgorithms = ['rs']\n"
    (there / "it.toml").write_text(
        f'extends = "smoke"\n[ads]\nmodel = "hidden:Hidden"\n[search]\n{search}'
    )
    command = f"study {there / 'it.toml'} --jobs 1 --quiet --out"
    message = (
        "user code reads gap.txt, scale.json, which no `files` of the study names: edits go"
        " unnoticed"
    )
    for _ in range(2):
        assert message in run(f"{command} out").stderr, (
            "also if the check is not needed again"
        )
    assert {"hidden.py", "helper.py"} <= set(read_manifest(Path("out"))["files"])
    assert not {"gap.txt", "log.txt"} & set(read_manifest(Path("out"))["files"])
    run("rules out --samples 20")
    rewrite(there / "it.toml", ("[search]", 'files = ["gap.txt"]\n[search]'))
    assert "user code reads scale.json, which" in run(f"{command} other").stderr
    rewrite(there / "it.toml", ('files = ["gap.txt"]\n', ""))
    (there / "helper.py").write_text("MORE = 2.0\n")
    refused(f"{command} out", "helper.py has changed since", "another --out")
    refused("rules out --samples 20", "helper.py has changed since")
    assert (
        "helper.py has changed since"
        in run("rules out --samples 20 --as-it-is-now").stderr
    )
    (there / "helper.py").unlink()
    refused("rules out --samples 20", "helper.py no longer exists")


KINDS = (errno.EIO, errno.ENOSPC, errno.EINTR, 0)
"""Errors that a step fails with; 0 is a write of half of what was to be written, and no error
elsewhere.
"""
MOST_STEPS = 500


class Disk:
    """Lets the `fails`-th step on the disk fail, and with `stays` all after it."""

    def __init__(self, fails: int, kind: int, *, stays: bool = False) -> None:
        self._fails = fails
        self._kind = kind
        self._stays = stays
        self.steps = 0

    def step(self) -> bool:
        """One step; raises if it fails, or tells that it is to be done by half."""
        self.steps += 1
        if self.steps == self._fails or (self._stays and self.steps > self._fails):
            if self._kind:
                raise OSError(self._kind, os.strerror(self._kind))
            return True
        return False

    def failing(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def called(*arguments: Any, **options: Any) -> Any:
            self.step()
            return function(*arguments, **options)

        return called

    def open(self, *arguments: Any, **options: Any) -> Any:
        self.step()
        return File(open(*arguments, **options), self)


class File:
    """A file whose steps may fail."""

    def __init__(self, inner: Any, disk: Disk) -> None:
        self._inner = inner
        self._disk = disk

    def write(self, content: Any) -> int:
        half = (
            self._disk.step() and isinstance(content, memoryview) and len(content) > 1
        )
        return int(self._inner.write(content[: len(content) // 2] if half else content))

    def truncate(self, size: int) -> int:
        self._disk.step()
        return int(self._inner.truncate(size))

    def __enter__(self) -> File:
        return self

    def __exit__(self, *_: object) -> None:
        self._inner.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)


def carried_out(study: Study, path: Path) -> bytes:
    formulas.carried_out(study, path)
    return formulas.solutions(path)


def broken(study: Study, path: Path, disk: Disk) -> bool:
    """Carry the study out on a disk that fails; whether it ended with an error."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (manifest, portalocker.utils, output):
            patch.setattr(module, "open", disk.open, raising=False)
        for name in ("fsync", "replace", "mkdir", "open", "unlink"):
            patch.setattr(os, name, disk.failing(getattr(os, name)))
        try:
            carried_out(study, path)
        except SafevarError:
            return True
        return False


@SLOW
@pytest.mark.parametrize("stays", [False, True])
def test_every_step_on_the_disk_may_fail(stays: bool, tmp_path: Path) -> None:
    search = {
        "algorithms": ["nsga2", "rs"],
        "population": 10,
        "evaluations": 20,
        "runs": 1,
    }
    tiny = load_study("smoke", search=search)
    expected = carried_out(tiny, tmp_path / "whole")
    errors = 0
    for number in range(1, MOST_STEPS):
        disk = Disk(number, KINDS[number % len(KINDS)], stays=stays)
        out = tmp_path / str(number)
        failed = broken(tiny, out, disk)
        errors += failed
        if (out / "manifest.json").exists():
            load_runs(out)
        if not failed:
            assert (out / "solutions.csv").read_bytes() == expected
        assert carried_out(tiny, out) == expected
        assert not [path for path in out.rglob("*.tmp*") if not failed]
        if disk.steps < number:
            break
    assert number < MOST_STEPS - 1, "no step is left that has not failed"
    assert errors > 15


def test_what_libraries_read_in_folders_of_the_system_is_no_file_of_the_user(
    in_tmp: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Such as lists of fonts and time zones; a user's file elsewhere is."""
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "gap.txt"
    elsewhere.write_text("8.0")
    cached = platformdirs.user_cache_path() / "fonts.txt"
    cached.parent.mkdir(parents=True, exist_ok=True)
    cached.write_text("Arial")
    paths = [
        elsewhere,
        cached,
        Path(np.__file__),
        Path(os.__file__),
        Path("/etc/hosts"),
    ]
    code = (
        f"for path in {[str(path) for path in paths]}:\n    open(path, 'rb').close()\n"
    )
    with record_opened([]) as opened:
        exec(compile(code, str(in_tmp / "mine.py"), "exec"))
    assert opened == [elsewhere.as_posix()]
