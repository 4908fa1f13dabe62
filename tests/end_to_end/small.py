"""A small study of three algorithms that many tests carry out in processes of its own."""

from __future__ import annotations

from pathlib import Path

from tests.end_to_end.processes import ended, started

STUDY = """
extends = "smoke"
name = "small"
[search]
algorithms = ["nsga2", "rs", "safe_fuzzer"]
evaluations = 150
"""


def study(*arguments: str, expect: int = 0) -> str:
    return ended(started("study", "small.toml", *arguments), expect)


def solutions(out: str | Path) -> bytes:
    return (Path(out) / "solutions.csv").read_bytes()
