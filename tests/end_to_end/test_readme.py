"""The README true to the letter: its example files, put where it says, do what it says."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
from test_commands import run

README = (Path(__file__).parents[2] / "README.md").read_text()


def block(language: str) -> str:
    """The only code block of a language."""
    found = re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)
    assert len(found) == 1
    return str(found[0])


def test_the_users_own_ads_of_the_readme_is_searched(in_tmp: Path) -> None:
    code = block("python")
    assert len(code.splitlines()) <= 20
    Path("my_ads.py").write_text(code)
    Path("mine.toml").write_text(block("toml"))
    run("study", "mine.toml", "--algorithms", "nsga2", "--evaluations", "100", "--runs", "1")
    solutions = pd.read_csv("results/mine/solutions.csv")
    assert len(solutions) > 0
    assert set(solutions["outcome"]) <= {"stopped", "passed", "collision", "timeout"}


def test_every_command_of_the_readme_exists() -> None:
    commands = set(re.findall(r"python -m safevar_sumo ([a-z]+)", README))
    listed = run("--help").stdout
    assert {"study", "simulate", "list", "validate", "calibrate"} <= commands
    for command in commands:
        assert re.search(rf"^  {command}\b", listed, flags=re.MULTILINE), command
