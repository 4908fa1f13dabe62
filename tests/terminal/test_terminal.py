"""Progress as a person sees it, on a terminal of 80 columns and elsewhere."""

from __future__ import annotations

import re
from io import StringIO

import msgspec
import numpy as np
import pytest
from rich.console import Console

from safevar_sumo.campaign import RunKey, all_runs
from safevar_sumo.metrics import METRICS
from safevar_sumo.progress import CampaignProgress
from safevar_sumo.records import Evaluations
from safevar_sumo.study import Study, load_study


@pytest.fixture
def study() -> Study:
    rain = load_study("rain")
    return msgspec.structs.replace(rain, search=msgspec.structs.replace(rain.search, runs=2, evaluations=1000))


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """What the time is: change its only element."""
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    return now


def found(number: int) -> Evaluations:
    values = np.full(number, -5.63)
    return Evaluations(settings=np.zeros((number, 12)), outcome=np.full(number, "collision"), collision_speed=-values,
                       metrics=dict.fromkeys(METRICS, values), f_diff=values, f_num_diff=values)


def shown(study: Study, clock: list[float], *, terminal_width: int | None, quiet: bool = False) -> str:
    """What is printed by 400 evaluations, one hundred every ten seconds, and then a run that ends."""
    out = StringIO()
    console = Console(file=out, force_terminal=terminal_width is not None, width=terminal_width or 80, _environ={})
    with CampaignProgress(console, study, all_runs(study), quiet) as progress:
        for _ in range(5):
            progress.evaluated(RunKey("nsga2", 0), found(100), 100)
            clock[0] += 10
        progress.finished(RunKey("nsga2", 0), 500)
    return out.getvalue()


def test_elsewhere_a_line_for_every_algorithm_every_30_seconds(study: Study, clock: list[float]) -> None:
    lines = shown(study, clock, terminal_width=None).splitlines()
    assert lines == [
        "nsga2: runs 0/2, 10 evaluations/s, 0:02:40 left, best SD -5.63, collisions 400", "rs: runs 0/2, 0 evaluations/s, not begun",
        "safe_fuzzer: runs 0/2, 0 evaluations/s, not begun"]


@pytest.mark.parametrize(("width", "told"), [
    (120, "10/s, 0:01:40 left, 500 collisions, runs 1/2, best SD -5.63"), (80, "10/s, 0:01:40 left, 500 collisions, runs 1/2"),
    (50, "10/s, 0:01:40 left"), (30, "10/s, 0:01:40 left"), (20, "10/s"),
])
def test_on_a_terminal_what_matters_fits_in_its_line_and_no_word_is_cut(
        width: int, told: str, study: Study, clock: list[float]) -> None:
    """The run that ended early leaves one run of 1000."""
    lines = [re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", line).rstrip() for line in shown(study, clock, terminal_width=width).splitlines()]
    last = [line for line in lines if "nsga2" in line][-1]
    assert last.endswith(told)
    assert ("━" in last) == (width >= 50)
    assert max(map(len, lines)) <= width
    assert not [line for line in lines if "…" in line]


def test_quiet_says_nothing(study: Study, clock: list[float]) -> None:
    assert shown(study, clock, terminal_width=None, quiet=True) == ""
    assert shown(study, clock, terminal_width=80, quiet=True).strip("\n") == ""


def test_what_comes_from_journals_counts_as_done_and_not_as_fast(study: Study, clock: list[float]) -> None:
    out = StringIO()
    with CampaignProgress(Console(file=out, width=80), study, all_runs(study), quiet=False) as progress:
        progress.finished(RunKey("nsga2", 0), 1000)
        progress.evaluated(RunKey("nsga2", 1), found(500), 0)
        clock[0] += 40
        progress.evaluated(RunKey("nsga2", 1), found(100), 100)
    assert "nsga2: runs 1/2, 2 evaluations/s, 0:02:40 left, best SD -5.63, collisions 600" in out.getvalue()
