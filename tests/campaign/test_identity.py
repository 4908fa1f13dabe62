"""What a study's identity tells, and workers that have other files than the campaign; every step on the disk fails
once, and the campaign goes on to the same bytes.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from safevar_sumo import output
from safevar_sumo.campaign import all_runs, run_campaign
from safevar_sumo.campaign.evaluation import Task, evaluate_batch, network_digests
from safevar_sumo.campaign.identity import identity_of, source_digests
from safevar_sumo.errors import InputError, SafevarError
from safevar_sumo.results import ResultsDirectory, journal, load_runs, manifest
from safevar_sumo.results.manifest import IDENTITY
from safevar_sumo.shipped import NETWORKS
from safevar_sumo.study import Study, load_study
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import CharacteristicSet
from tests.campaign.formulas import EventLog, FormulaPool
from tests.in_process import InlinePool


def test_names_and_defaults_are_resolved_to_numbers() -> None:
    study = load_study("rain")
    identity = identity_of(study, assemble(study))
    assert set(identity) <= set(IDENTITY)
    assert json.dumps(identity, allow_nan=False)
    assert identity["resolved"]["weather"]["road_friction"] == 1
    given = load_study("rain", ads={"parameters": {}}).ads.parameters
    resolved = identity["resolved"]["ads"]["parameters"]
    assert set(resolved) >= set(given)
    assert "duration" in identity["resolved"]["scenario"]["parameters"], "a default"
    assert not {"title", "published", "spread"} & set(identity["resolved"])
    assert not {"runs", "algorithms", "evaluations", "time_limit"} & set(identity["resolved"]["search"])


def test_a_network_that_changes_between_two_batches_is_noticed(tmp_path: Path) -> None:
    shutil.copytree(NETWORKS / "lead_vehicle_stopped", tmp_path / "mine")
    study = load_study("native", scenario={"parameters": {"network": str(tmp_path / "mine")}})
    packed_task = Task(study=study, inputs={"network": network_digests(assemble(study))}).packed
    original = CharacteristicSet.of(study).original[None]
    evaluate_batch(packed_task, original)
    traffic = tmp_path / "mine" / "traffic.rou.xml"
    traffic.write_text(traffic.read_text() + "<!-- -->")
    with pytest.raises(InputError, match=r"traffic\.rou\.xml: is not the file"):
        evaluate_batch(packed_task, original)


ADS = """
import json
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
        (HERE / "log.txt").write_text("written, then read")
        (HERE / "log.txt").read_text()
        return (0.0, 1.0) if seen.gap < self.gap else (0.5, 0.0)
"""
FILES = {
    "my_ads.py": ADS,
    "my_maps/__init__.py": "",
    "my_maps/rules.py": "import numpy\n",
    "my_maps/unused.py": "",
    "my_space/roads.py": "",
    "my_lazy.py": "X = 1\n",
    "weights.json": '{"gap": 9.0}',
    "tiles/1.txt": "tile",
    "tiles/2.txt": "another tile",
    "unused.py": "",
    "table.bin": "read by compiled code",
    "both.txt": "opened to be read and written",
}
STUDY = """
extends = "smoke"
[ads]
model = "my_ads:Mine"
parameters = { weights = "weights.json", table = "table.bin" }
"""
READ = {
    "my_ads.py",
    "my_maps/__init__.py",
    "my_maps/rules.py",
    "my_space/roads.py",
    "my_lazy.py",
    "weights.json",
    "tiles/1.txt",
    "table.bin",
    "both.txt",
}


@pytest.fixture
def place(in_tmp: Path) -> Path:
    """A study with its files, in a folder that is not the working directory."""
    for name, text in FILES.items():
        (in_tmp / "there" / name).parent.mkdir(exist_ok=True, parents=True)
        (in_tmp / "there" / name).write_text(text)
    (in_tmp / "there" / "mine.toml").write_text(STUDY)
    return in_tmp / "there"


def read(place: Path) -> dict[str, str]:
    return source_digests(load_study(place / "mine.toml"), InlinePool())


def test_what_is_read_while_models_are_loaded_made_and_first_run_counts_wherever_the_command_is_started(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = read(place)
    assert set(result) == READ
    monkeypatch.chdir(place / "tiles")
    assert read(place) == result
    shutil.copytree(place, place.parent / "copy")
    assert read(place.parent / "copy") == result, "no name holds where the study lies"


KINDS = (errno.EIO, errno.ENOSPC, errno.EINTR, 0)
"""Errors that a step fails with; 0 is a write of half of what was to be written, and no error elsewhere."""
MOST_STEPS = 500


class Disk:
    """Lets the `fails`-th step on the disk fail, and with `stays` all after it."""

    def __init__(self, fails: int, kind: int, *, stays: bool = False) -> None:
        self._fails, self._kind, self._stays, self.steps = fails, kind, stays, 0

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
        self._inner, self._disk = inner, disk

    def write(self, content: Any) -> int:
        half = self._disk.step() and isinstance(content, memoryview) and len(content) > 1
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


@pytest.fixture(scope="module")
def tiny() -> Study:
    search = {"algorithms": ["nsga2", "rs"], "population": 10, "evaluations": 20, "runs": 1}
    return load_study("smoke", search=search)


def carried_out(study: Study, path: Path) -> bytes:
    results = ResultsDirectory(path, study)
    results.finish(run_campaign(study, all_runs(study), results, FormulaPool(), EventLog()).solutions)
    return (path / "solutions.csv").read_bytes()


def broken(study: Study, path: Path, disk: Disk) -> bool:
    """Carry the study out on a disk that fails; whether it ended with an error."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (manifest, journal, output):
            patch.setattr(module, "open", disk.open, raising=False)
        for name in ("fsync", "replace", "mkdir", "open", "unlink"):
            patch.setattr(os, name, disk.failing(getattr(os, name)))
        try:
            carried_out(study, path)
        except SafevarError:
            return True
        return False


@pytest.mark.slow
@pytest.mark.parametrize("stays", [False, True])
def test_every_step_on_the_disk_may_fail(stays: bool, tiny: Study, tmp_path: Path) -> None:
    expected, errors = carried_out(tiny, tmp_path / "whole"), 0
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
