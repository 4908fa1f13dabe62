"""A study file and a module beside it, in a folder other than the working directory."""

from __future__ import annotations

from pathlib import Path

import pytest

from safevar_sumo.sumo.system import System
from tests.support.made_up import system_of
from tests.support.user_code import ADS, Mine


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of study and module; the working directory is another, empty folder."""
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "study").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    return tmp_path / "study"


@pytest.fixture
def mine(folder: Path) -> Mine:
    """Write mine.py and mine.toml, which extends smoke, and assemble the system."""

    def result(module: str, table: str = ADS) -> System:
        (folder / "mine.py").write_text(module)
        (folder / "mine.toml").write_text(f'extends = "smoke"\nname = "mine"\n{table}')
        return system_of(str(folder / "mine.toml"))

    return result
