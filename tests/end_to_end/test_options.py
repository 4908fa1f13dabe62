"""Options of `study`: bad ones are refused, a dry run writes nothing, a quiet one says nothing."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tests.end_to_end.processes import SAFEVAR, started
from tests.end_to_end.small import study

pytestmark = pytest.mark.usefixtures("small")


@pytest.mark.parametrize(("options", "told"), [
    (["--seed", "9"], "search.seed is 1 there and 9 here"),
])
def test_options_that_would_change_results_are_refused(copied: Path, options: list[str], told: str) -> None:
    before = {path: path.read_bytes() for path in copied.rglob("*.*")}
    assert told in study("--out", "out", *options, expect=2)
    assert {path: path.read_bytes() for path in copied.rglob("*.*")} == before


@pytest.mark.parametrize(("arguments", "told"), [
    (["--jobs", "0"], ("--jobs", "0")),
    (["--shard", "3/2"], ("--shard", "'3/2'", "K in 1..N")),
    (["--shard", "0/2"], ("--shard", "'0/2'")),
    (["--shard", "two"], ("--shard", "'two'")),
    (["--only", "nonsense"], ("--only", "'nonsense'", "ALGORITHM:RUN")),
    (["--only", "nsga2:2"], ("--only", "'nsga2:2'")),
    (["--only", "moea:0"], ("--only", "'moea:0'")),
    (["--cluster", "nowhere"], ("--cluster", "'nowhere'", "tcp://host:8786")),
    (["--cluster", ""], ("--cluster", "''")),
])
def test_bad_options_are_refused(arguments: list[str], told: tuple[str, ...]) -> None:
    errors = study("--out", "out", *arguments, expect=2)
    for part in told:
        assert part in errors
    assert not Path("out/runs").exists()


def test_a_dry_run_tells_what_it_would_take_and_writes_nothing() -> None:
    done = subprocess.run([*SAFEVAR, "study", "small.toml", "--dry-run"], capture_output=True, text=True, check=True)
    for word in ("nsga2, rs, safe_fuzzer", "900", "evaluations/s", "min", "MB"):
        assert word in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= 80
    assert not Path("results").exists()


def test_quiet_prints_nothing(copied: Path) -> None:
    process = started("study", "small.toml", "--out", "out", "--quiet", "--runs", "3", "--only", "rs:2")
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, output, errors) == (0, "", "")
