"""Progress as a person sees it, on a terminal of 80 columns and elsewhere."""

from __future__ import annotations

import re
import time
from io import StringIO

import msgspec
import pytest
from rich.console import Console

from safevar_sumo import progress
from safevar_sumo.analysis.evaluator import Evaluator
from safevar_sumo.api.running import CampaignProgress
from safevar_sumo.campaign import RunKey, RunProgress, all_runs
from safevar_sumo.progress import PartsProgress, open_progress
from safevar_sumo.study import Study, load_study
from tests.in_process import InlinePool


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


def state(algorithm: str, run: int, asked: int, replayed: int = 0) -> RunProgress:
    """A run whose settings all collide."""
    return RunProgress(RunKey(algorithm, run), asked, replayed, collisions=asked, best=-5.63)


def shown(study: Study, clock: list[float], width: int) -> list[str]:
    """What a terminal shows of 500 evaluations, 100 every ten seconds, of two algorithms in turn; then a run ends."""
    out = StringIO()
    console = Console(file=out, force_terminal=True, width=width, _environ={})
    with open_progress(True, console) as show:
        observer = CampaignProgress(show, study, all_runs(study))
        for i in range(5):
            clock[0] += 10
            observer.progressed([state(("nsga2", "rs")[i % 2], 0, 100 * (i // 2 + 1))])
        observer.finished(state("nsga2", 0, 300))
    return [re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", line).rstrip() for line in out.getvalue().splitlines()]


def test_elsewhere_a_line_shows_the_time_left_even_if_a_batch_takes_longer(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """25 of 100 in 10 s: the others take 30 s, of which 6 have passed."""
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", 0.02)
    out = StringIO()
    with open_progress(True, Console(file=out, width=20)) as show:
        for done in (0, 25):
            show("two characteristics at a time", done, 100)
            clock[0] += 10
        clock[0] -= 4
        while "left" not in out.getvalue().partition("25 of 100")[2]:
            time.sleep(0.01)
    assert "two characteristics at a time: 25 of 100, 0:00:24 left\n" in out.getvalue()


@pytest.mark.parametrize("width", [120, 80])
def test_on_a_terminal_all_fits_in_its_line(width: int, study: Study, clock: list[float]) -> None:
    """6 runs of 1000 evaluations, of which one ends after 300: 5300 in all, 500 of them done in 50 s."""
    lines = shown(study, clock, width)
    last = [line for line in lines if "rain" in line][-1]
    assert re.fullmatch(r"rain: runs 1/6, 500 collisions, best SD -5\.63 [━╸╺ ]+ 500/5300 0:08:00 left", last)
    assert max(map(len, lines)) <= width


def test_what_comes_from_journals_is_not_left_to_be_done(study: Study) -> None:
    """A finished run of 1000, of 600 different settings; 500 settings of the next run; then 100 simulated, and
    again.
    """
    shows: list[tuple[str, int, int]] = []
    observer = CampaignProgress(lambda *values: shows.append(values), study, all_runs(study))
    observer.finished(state("nsga2", 0, 1000, replayed=1000)._replace(collisions=600))
    for asked in (500, 600, 700):
        observer.progressed([state("nsga2", 1, asked, replayed=500)._replace(collisions=min(asked, 600))])
    assert shows[0] == ("rain: runs 0/6", 0, 6000)
    assert shows[-1] == ("rain: runs 1/6, 1200 collisions, best SD -5.63", 200, 4500)


def test_parts_have_one_counter_that_never_passes_its_end() -> None:
    shows: list[tuple[str, int, int]] = []
    parts = PartsProgress(lambda *values: shows.append(values), {"causes": 100, "stored": 50, "rules": 10})
    for part, stages in {
        "causes": (("a", 0, 20), ("a", 20, 20), ("b", 0, 20), ("b", 20, 20)),
        "stored": (),
        "rules": (("c", 0, 30), ("c", 15, 30), ("c", 30, 30)),
    }.items():
        show = parts.begin(part)
        for stage in stages:
            show(*stage)
    assert shows == [
        ("starting", 0, 160),
        ("causes: a", 0, 160),
        ("causes: a", 20, 160),
        ("causes: b", 20, 160),
        ("causes: b", 40, 160),
        ("rules: c", 40, 70),
        ("rules: c", 55, 70),
        ("rules: c", 70, 70),
    ]


def test_a_few_settings_in_a_long_matrix_are_several_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that the time left is known before the end."""
    shows: list[tuple[str, int, int]] = []
    study = load_study("euro_ncap_pedestrian")
    evaluator = Evaluator(study, InlinePool(), lambda *values: shows.append(values))
    evaluator.evaluate(evaluator.feasible_settings(32), "settings")
    assert len(shows) == 5
    assert shows[-1][1:] == (32, 32)
