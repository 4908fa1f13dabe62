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


def evaluations_of(number: int, first: int = 0) -> Evaluations:
    """Collisions of different settings, from the first on."""
    values = np.full(number, -5.63)
    settings = np.tile(np.arange(first, first + number, dtype=float)[:, np.newaxis], 12)
    return Evaluations(settings=settings, outcome=np.full(number, "collision"), collision_speed=-values,
                       metrics=dict.fromkeys(METRICS, values), f_diff=values, f_num_diff=values)


def shown(study: Study, clock: list[float], *, terminal_width: int | None, quiet: bool = False) -> str:
    """What is printed by 500 evaluations, one hundred every ten seconds, of two algorithms in turn, and then a run that ends."""
    out = StringIO()
    console = Console(file=out, force_terminal=terminal_width is not None, width=terminal_width or 80, _environ={})
    with CampaignProgress(console, study, all_runs(study), quiet) as progress:
        for i in range(5):
            progress.evaluated(RunKey(("nsga2", "rs")[i % 2], 0), evaluations_of(100, 100 * i), 100)
            clock[0] += 10
        progress.finished(RunKey("nsga2", 0), 300)
    return out.getvalue()


def test_elsewhere_a_line_for_the_whole_study_every_30_seconds(study: Study, clock: list[float]) -> None:
    """6 runs of 1000 evaluations, 400 done, 10 a second: 5600 more take 560 s, whichever algorithms they belong to."""
    lines = shown(study, clock, terminal_width=None).splitlines()
    assert lines == ["rain: 10/s, 0:09:20 left, 400 collisions, runs 0/6, best SD -5.63"]


@pytest.mark.parametrize(("width", "ending"), [
    (120, "10/s, 0:08:00 left, 500 collisions, runs 1/6, best SD -5.63"),
    (80, "10/s, 0:08:00 left, 500 collisions, runs 1/6, best SD -5.63"),
    (55, "10/s, 0:08:00 left, 500 collisions"), (35, "10/s, 0:08:00 left"), (20, "10/s"),
])
def test_on_a_terminal_what_matters_fits_in_its_line_and_no_word_is_cut(
        width: int, ending: str, study: Study, clock: list[float]) -> None:
    """The run that ended early leaves 5300 evaluations in all, 500 of them done."""
    lines = [re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", line).rstrip() for line in shown(study, clock, terminal_width=width).splitlines()]
    last = [line for line in lines if "rain" in line][-1]
    assert last.endswith(ending)
    assert ("━" in last) == (width >= 50)
    assert max(map(len, lines)) <= width
    assert not [line for line in lines if "…" in line]


def test_what_comes_from_journals_counts_as_done_and_not_as_fast(study: Study, clock: list[float]) -> None:
    """A run of 1000 that was finished before, of 600 different settings; 500 settings of the next one; then 100 simulated in 20 s."""
    out = StringIO()
    with CampaignProgress(Console(file=out, width=80), study, all_runs(study), quiet=False) as progress:
        progress.evaluated(RunKey("nsga2", 0), evaluations_of(600), 0)
        progress.finished(RunKey("nsga2", 0), 1000)
        progress.evaluated(RunKey("nsga2", 1), evaluations_of(500), 0)
        progress.evaluated(RunKey("nsga2", 1), evaluations_of(100, 500), 100)
        clock[0] += 40
        progress.evaluated(RunKey("nsga2", 1), evaluations_of(100, 500), 100)  # the same once more: no other collisions
    assert out.getvalue() == "rain: 2/s, 0:28:40 left, 1200 collisions, runs 1/6, best SD -5.63\n"
