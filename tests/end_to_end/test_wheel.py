"""The wheel carries studies and networks: every command works from anywhere, without the
checkout.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, unpacked into a directory of its own; its dependencies are those of the tests."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("safevar_sumo", "studies", "sumo_nets"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--outdir", str(folder), str(source)],
        check=True,
        capture_output=True,
    )
    wheel = next(folder.glob("*.whl"))
    subprocess.run(
        [
            sys.executable,
            "-m",
            "pip",
            "install",
            "--quiet",
            "--no-deps",
            "--target",
            str(folder / "site"),
            str(wheel),
        ],
        check=True,
        capture_output=True,
    )
    return folder / "site"


def run(site: Path, cwd: Path, *arguments: str) -> str:
    environment = {**os.environ, "PYTHONPATH": str(site)}
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=cwd,
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    ).stdout


def test_every_module_study_and_network_is_in_the_wheel(site: Path) -> None:
    kept = {
        path.relative_to(ROOT)
        for folder in ("safevar_sumo", "studies", "sumo_nets")
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    inside = {
        Path("safevar_sumo") / path if path.parts[0] != "safevar_sumo" else path for path in kept
    }
    assert {path for path in inside if not (site / path).is_file()} == set()


def test_commands_work_from_an_empty_directory(site: Path, tmp_path: Path) -> None:
    assert str(site) in run(
        site, tmp_path, "-c", "import safevar_sumo; print(safevar_sumo.__file__)"
    )
    assert (
        json.loads(run(site, tmp_path, "-m", "safevar_sumo", "simulate", "lgsvl", "--json"))[
            "numbers"
        ]["outcome"]
        == "stopped"
    )
    run(
        site, tmp_path, "-m", "safevar_sumo", "study", "smoke", "--runs", "1", "--evaluations", "20"
    )
    assert (tmp_path / "results/smoke/solutions.csv").is_file()
