"""Two versions of a study have modules with the same names: each version runs its own code, in any
order, in one process and in workers.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import safevar_sumo as sv
from safevar_sumo.campaign.pool import open_pool
from safevar_sumo.sumo.matrix import drive_and_score
from tests.support.in_process import InlinePool, run
from tests.support.made_up import original_of, system_of

DRIVER = """
import importlib, pickle, sys, threading
from pathlib import Path
{top}

class Driver:
    UNITS = {{"brake": "m/s^2"}}
    version = "1"

    def simulate(self, setting):
{body}
        left = 17 - 100 / setting["brake"] + margin
        return {{"outcome": "stopped" if left > 0 else "collision", "safety_degree": left}}
"""
"""A vehicle has 17 m to brake, and a margin, which a helper module states."""
STUDY = """
name = "same"
title = "A standing car"
scenario.model = "{module}:Driver"
metrics.ttc_threshold = 1.5
search = {{ algorithms = ["rs"], population = 20, evaluations = 20, runs = 1, seed = 1 }}
[vehicle.characteristics]
brake = {{ unit = "m/s^2", original = 8, lower = 4, upper = 8 }}
"""
MARGINS = {"old": 2.0, "new": 0.2}
DEGREES = {"old": 6.5, "new": 4.7}
"""17 m without 100 / 8 m of braking are 4.5 m, and the margin is added."""
LATE = "        from helpers import MARGIN as margin"
FORMS = {
    "at the top": ("from helpers import MARGIN as margin", "", "helpers.py"),
    "late": ("", LATE, "helpers.py"),
    "importlib": (
        "",
        '        margin = importlib.import_module("helpers").MARGIN',
        "helpers.py",
    ),
    "a package": ("", LATE.replace("helpers", "parts.helpers"), "parts/helpers.py"),
    "by its dotted name": (
        "",
        "        import parts.helpers\n        margin = parts.helpers.MARGIN",
        "parts/helpers.py",
    ),
    "a thread": (
        "",
        "        found = []\n"
        '        work = lambda: found.append(importlib.import_module("helpers").MARGIN)\n'
        "        thread = threading.Thread(target=work)\n"
        "        thread.start()\n"
        "        thread.join()\n"
        "        (margin,) = found",
        "helpers.py",
    ),
    "a pickled class": (
        "",
        '        margin = pickle.loads(b"chelpers\\nMargin\\n.").MARGIN',
        "helpers.py",
    ),
    "a folder of its own": (
        'sys.path.insert(0, str(Path(__file__).parent / "parts"))',
        LATE,
        "parts/helpers.py",
    ),
}
"""How the driver imports its helper: lines at the top and in `simulate`, and the helper's file."""
Versions = Callable[..., dict[str, str]]


@pytest.fixture
def versions(in_tmp: Path) -> Versions:
    """Write the two versions, and return the paths of their studies."""

    def write_versions(form: str, package: str = "") -> dict[str, str]:
        top, body, file = FORMS[form]
        studies = {}
        for name, margin in MARGINS.items():
            folder = in_tmp / name
            helper = folder / package / file
            helper.parent.mkdir(parents=True)
            helper.write_text(
                f"MARGIN = {margin}\nclass Margin:\n    MARGIN = {margin}\n"
            )
            text = DRIVER.format(top=top, body=body)
            if package:
                (folder / package / "__init__.py").touch()
                text = text.replace("from helpers", "from .helpers")
            (folder / package / "driver.py").write_text(text)
            module = f"{package}.driver".strip(".")
            (folder / "study.toml").write_text(STUDY.format(module=module))
            studies[name] = str(folder / "study.toml")
        return studies

    return write_versions


def degree_of(study: str) -> float:
    """The safety degree of the original vehicle."""
    return float(sv.simulate(study).numbers["f_safe"])


def assert_alternating(studies: dict[str, str]) -> None:
    for name in ("old", "new", "old", "old", "new"):
        assert degree_of(studies[name]) == pytest.approx(DEGREES[name])


@pytest.mark.parametrize("form", FORMS)
def test_each_version_imports_its_own_helper(form: str, versions: Versions) -> None:
    assert_alternating(versions(form))


@pytest.mark.parametrize("form", ["at the top", "late"])
def test_relative_imports_stay_in_their_package(form: str, versions: Versions) -> None:
    assert_alternating(versions(form, package="driving"))


@pytest.mark.parametrize("directory", MARGINS)
def test_the_working_directory_and_a_script_have_modules_of_the_same_name(
    directory: str, versions: Versions, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A script in one version's folder has imported its helper, before both versions run."""
    studies = versions("late")
    monkeypatch.chdir(directory)
    monkeypatch.syspath_prepend(os.getcwd())
    helper = importlib.import_module("helpers")
    path = sys.path[:]
    try:
        assert_alternating(studies)
        assert sys.modules["helpers"] is helper
        assert MARGINS[directory] == helper.MARGIN
        assert sys.path == path
        assert "driver" not in sys.modules
    finally:
        del sys.modules["helpers"]


def test_a_system_that_was_assembled_first_runs_its_own_code_later(
    versions: Versions,
) -> None:
    studies = versions("importlib")
    systems = {name: system_of(path) for name, path in studies.items()}
    for name in ("old", "new", "old"):
        system = systems[name]
        results = drive_and_score(system, original_of(system))
        assert results.f_safe[0] == pytest.approx(DEGREES[name])


@pytest.mark.parametrize("form", ["late", "importlib", "at the top"])
def test_an_edited_helper_counts_at_the_next_call(
    form: str, versions: Versions
) -> None:
    """The edit keeps the length of the file, and happens in the second of its first import."""
    study = versions(form)["old"]
    helper = Path("old/helpers.py")
    for margin in (2.0, 0.2, 2.0):
        helper.write_text(f"MARGIN = {margin}\n")
        assert degree_of(study) == pytest.approx(4.5 + margin)
        (evaluated,) = sv.evaluate(study, [{}], pool=InlinePool()).f_safe
        assert evaluated == pytest.approx(4.5 + margin)


OPENS = """
class Driver:
    UNITS = {"brake": "m/s^2"}
    version = "1"
    worker = None

    @classmethod
    def open_worker(cls, worker):
        from helpers import MARGIN
        return MARGIN

    def simulate(self, setting):
        left = 17 - 100 / setting["brake"] + self.worker
        return {"outcome": "stopped" if left > 0 else "collision", "safety_degree": left}
"""


def test_a_kept_worker_is_that_of_its_version(versions: Versions) -> None:
    """Both files have the same time, as after a checkout."""
    studies = versions("late")
    for name in MARGINS:
        driver = Path(name, "driver.py")
        driver.write_text(OPENS)
        os.utime(driver, (1e9, 1e9))
    assert_alternating(studies)
    Path("new/helpers.py").write_text("MARGIN = 1.5\n")
    assert degree_of(studies["new"]) == pytest.approx(6.0)


THREAD = '''
import threading, time

class Driver:
    UNITS = {"brake": "m/s^2"}
    version = "1"
    worker = None

    @classmethod
    def open_worker(cls, worker):
        """Wait in the background, while the other version may be driving."""
        found = []

        def work():
            time.sleep(0.5)
            from helpers import MARGIN
            found.append(MARGIN)

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        return thread, found

    def simulate(self, setting):
        thread, found = self.worker
        thread.join()
        left = 17 - 100 / setting["brake"] + found[0]
        return {"outcome": "stopped" if left > 0 else "collision", "safety_degree": left}
'''


def test_processes_belong_to_one_version(
    versions: Versions, worker_processes: None
) -> None:
    """Also a thread that imports later finds its own version there. Each process has a number."""
    studies = versions("late")
    for name in MARGINS:
        Path(name, "driver.py").write_text(THREAD)
    with open_pool(1) as pool:
        answer = sv.compare(studies["old"], studies["new"], simulations=200, pool=pool)
        assert sorted(pool._started) == [0, 1]
    assert answer.numbers["decision"] == "do not release"
    degrees = answer.numbers["a_degree"], answer.numbers["b_degree"]
    assert degrees == pytest.approx((6.5, 4.7))


def test_code_that_differs_without_an_effect_is_named(versions: Versions) -> None:
    studies = versions("importlib")
    command = f"compare {studies['old']} {studies['new']} --simulations 200"
    note = "The code of A and B differs in helpers.py, but every simulated vehicle has"
    assert note not in run(command, expect=3).stdout.replace("\n", " ")
    helper = Path("new/helpers.py")
    helper.write_text("MARGIN = 2.0  # as before\nclass Margin:\n    MARGIN = 2.0\n")
    assert note in run(command).stdout
    helper.write_text(Path("old/helpers.py").read_text())
    assert note not in run(command).stdout
