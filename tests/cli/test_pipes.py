"""A named pipe in the place of a file is refused by its name: who opened it would wait for ever."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from safevar_sumo.cli.program import commands
from safevar_sumo.errors import InputError
from safevar_sumo.shipped import STUDIES

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="POSIX alone has named pipes")


@pytest.mark.parametrize("arguments", [
    "validate sun pipe", "calibrate sun pipe", "calibrate sun", "calibrate mine.toml pipe", "import sun --out published --nsga2 pipe",
    "import sun --out published --rs pipe", "study pipe", "simulate pipe", "simulate mine.toml", "tables stored", "status stored",
    "simulate smoke --trace pipe", "simulate smoke --plot pipe.png", "simulate smoke --animate pipe.gif", "tolerance smoke --plot pipe.png",
    "risk smoke --plot pipe.svg", "validate sun sun.csv --plot pipe.png", "replicate stored --published stored --out pipe"])
def test_a_pipe_is_refused_by_its_name(arguments: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stored").mkdir()
    for pipe in ("pipe", "pipe.png", "pipe.gif", "pipe.svg", "stored/manifest.json", "sun-calibrated.toml"):
        os.mkfifo(tmp_path / pipe)
    shutil.copy(STUDIES / "sun.toml", "sun.csv")
    (tmp_path / "mine.toml").write_text('extends = "pipe"\nname = "mine"\n')
    error = CliRunner().invoke(commands, arguments.split()).exception
    assert isinstance(error, InputError)
    assert "is no regular file" in str(error)
