"""Progress of a study: a bar on a terminal, or else a line every half minute."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from safevar_sumo.campaign import RunKey
from safevar_sumo.records import Evaluations
from safevar_sumo.study import Study
from safevar_sumo.terminal import SECONDS_BETWEEN_LINES, print_text, show_stages

SETTLING_TIME = 5.0
"""Work before throughput is shown [s]: batches that end together make earlier values meaningless."""
BAR_WIDTH = 10
"""Width of the bar [characters]."""
MIN_TEXT_WIDTH = 26
"""Narrowest text beside the bar [characters]; if there is less space, the bar is left out."""


class CampaignProgress:
    """One bar for the whole study on a terminal, or else a line every half minute: throughput, time left, collisions."""

    def __init__(self, console: Console, study: Study, keys: list[RunKey], quiet: bool) -> None:
        self._console, self._quiet, self._name = console, quiet, study.name
        has_bar = console.is_terminal and not quiet
        self._text_width = console.width - len(study.name) - 1
        bar = [BarColumn(bar_width=BAR_WIDTH)] if self._text_width - BAR_WIDTH - 1 >= MIN_TEXT_WIDTH else []
        self._text_width -= len(bar) * (BAR_WIDTH + 1)
        self._bar = Progress(TextColumn("{task.description}", markup=False), *bar, TextColumn("{task.fields[summary]}", markup=False),
                             console=console, disable=not has_bar)
        self._tally = _Tally(run_count=len(keys), run_budget=study.search.evaluations)
        self._task = self._bar.add_task(study.name, total=self._tally.total, summary="waiting")
        self._last_line = time.monotonic()

    def __enter__(self) -> CampaignProgress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def evaluated(self, key: RunKey, evaluations: Evaluations, simulated: int) -> None:
        self._tally.add(key, evaluations, simulated)
        self._show()

    def finished(self, key: RunKey, asked: int) -> None:
        self._tally.close_run(key, asked)
        self._show()

    def warned(self, message: str) -> None:
        print_text(self._console, f"warning: {message}")

    def _show(self) -> None:
        if self._quiet:
            return
        tally = self._tally
        self._bar.update(self._task, completed=tally.done, total=tally.total, summary=tally.text(self._text_width))
        now = time.monotonic()
        if not self._console.is_terminal and now - self._last_line >= SECONDS_BETWEEN_LINES:
            self._last_line = now
            print_text(self._console, f"{self._name}: {tally.text()}")


class _Tally:
    """Progress of all runs of a study together."""

    def __init__(self, run_count: int, run_budget: int) -> None:
        self.done, self.total = 0, run_count * run_budget
        self._run_budget, self._run_count = run_budget, run_count
        self._finished_runs = self._timed_simulations = self._timed_evaluations = self._collisions = 0
        self._lowest_degree = np.inf
        self._start_time: float | None = None
        self._last_time = 0.0
        self._by_run: dict[RunKey, tuple[int, set[bytes]]] = {}  # number of evaluations, and settings that collide

    def add(self, key: RunKey, evaluations: Evaluations, simulated: int) -> None:
        """Count evaluations of a run; a setting that collides counts once per run, as in `status`."""
        self._last_time = time.monotonic()
        if simulated and self._start_time is None:
            self._start_time = self._last_time  # the first batch does not count, as it includes the start of the workers
        elif simulated:
            self._timed_simulations += simulated
            self._timed_evaluations += len(evaluations)
        self.done += len(evaluations)
        evaluation_count, colliding_settings = self._by_run.get(key, (0, set()))
        previous_count = len(colliding_settings)
        colliding_settings.update(setting.tobytes() for setting in evaluations.settings[evaluations.collided])
        self._by_run[key] = evaluation_count + len(evaluations), colliding_settings
        self._collisions += len(colliding_settings) - previous_count
        if evaluations.valid.any():
            self._lowest_degree = min(self._lowest_degree, float(np.min(evaluations.f_safe[evaluations.valid])))

    def close_run(self, key: RunKey, asked: int) -> None:
        """Count a run as finished after `asked` evaluations, which may be fewer than its budget."""
        evaluation_count, _ = self._by_run.pop(key, (0, set()))
        self._finished_runs += 1
        self.done += asked - evaluation_count
        self.total -= self._run_budget - asked

    def text(self, width: int | None = None) -> str:
        """The progress as text of at most `width` characters; what matters most comes first."""
        collisions = [] if np.isinf(self._lowest_degree) else [f"{self._collisions} collisions"]
        best = [] if np.isinf(self._lowest_degree) else [f"best SD {self._lowest_degree:.2f}"]
        rate = [f"{self._timed_simulations / self._seconds:.0f}/s"] if self._timed_simulations and self._seconds >= SETTLING_TIME else []
        text = ""
        for item in (*rate, self._time_left(), *collisions, f"runs {self._finished_runs}/{self._run_count}", *best):
            extended_text = f"{text}, {item}" if text else item
            if width is not None and len(extended_text) > width:
                break
            text = extended_text
        return text

    @property
    def _seconds(self) -> float:
        return 0.0 if self._start_time is None else self._last_time - self._start_time

    def _time_left(self) -> str:
        """Hours, minutes and seconds at the throughput of all runs together, after `SETTLING_TIME`."""
        if self.done >= self.total:
            return "0:00:00 left"
        if not self._timed_evaluations or self._seconds < SETTLING_TIME:
            return "time left not known yet"
        return f"{timedelta(seconds=round((self.total - self.done) * self._seconds / self._timed_evaluations))} left"


@contextmanager
def show_counting_bar(console: Console, label: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show a bar that counts up to `total`; yields the function that adds to the count."""
    done = 0
    with show_stages(console) as report_progress:
        report_progress(label, done, total)

        def add(count: int) -> None:
            nonlocal done
            done += count
            report_progress(label, done, total)

        yield add
