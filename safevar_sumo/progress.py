"""Progress: bars on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from safevar_sumo.campaign import RunKey
from safevar_sumo.records import Evaluations
from safevar_sumo.study import Study

SECONDS_BETWEEN_LINES = 30.0
BAR = 10
"""Letters that a bar takes."""
LEAST_ROOM = 26
"""Letters beside the bar, below which there is none."""


class CampaignProgress:
    """Bars on a terminal, a line now and then elsewhere: what is done, how fast, what was found, how long yet."""

    def __init__(self, console: Console, study: Study, keys: list[RunKey], quiet: bool) -> None:
        self._console, self._quiet = console, quiet
        shown = console.is_terminal and not quiet
        self._room = console.width - max(map(len, study.search.labels)) - 1
        bar = [BarColumn(bar_width=BAR)] if self._room - BAR - 1 >= LEAST_ROOM else []
        self._room -= len(bar) * (BAR + 1)
        self._bar = Progress(TextColumn("{task.description}", markup=False), *bar, TextColumn("{task.fields[told]}", markup=False),
                             console=console, disable=not shown)
        self._lines = {}
        for name in study.search.labels:
            runs = sum(key.algorithm == name for key in keys)
            if runs:
                task = self._bar.add_task(name, total=runs * study.search.evaluations, told="waiting")
                self._lines[name] = _Line(name, runs, study.search.evaluations, task)
        self._asked: dict[RunKey, int] = {}
        self._spoke = time.monotonic()

    def __enter__(self) -> CampaignProgress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def evaluated(self, key: RunKey, evaluations: Evaluations, simulated: int) -> None:
        self._asked[key] = self._asked.get(key, 0) + len(evaluations)
        self._lines[key.algorithm].take_in(evaluations, simulated)
        self._tell(self._lines[key.algorithm])

    def finished(self, key: RunKey, asked: int) -> None:
        self._lines[key.algorithm].close_run(asked, self._asked.pop(key, 0))
        self._tell(self._lines[key.algorithm])

    def warned(self, message: str) -> None:
        self._console.print(f"warning: {message}", soft_wrap=True, markup=False, highlight=False)

    def _tell(self, line: _Line) -> None:
        self._bar.update(line.task, completed=line.done, total=line.total, told=line.told_within(self._room))
        now = time.monotonic()
        if not self._console.is_terminal and not self._quiet and now - self._spoke >= SECONDS_BETWEEN_LINES:
            self._spoke = now
            for one in self._lines.values():
                self._console.print(f"{one.name}: {one.told()}", soft_wrap=True, highlight=False)


class _Line:
    """How far the runs of one algorithm are."""

    def __init__(self, name: str, runs: int, evaluations: int, task: TaskID) -> None:
        self.name, self.task = name, task
        self.done, self.total = 0, runs * evaluations
        self._evaluations, self._runs = evaluations, runs
        self._finished = self._simulated = self._collisions = 0
        self._best = np.inf
        self._first = self._last = 0.0

    def take_in(self, evaluations: Evaluations, simulated: int) -> None:
        self._last = time.monotonic()
        if self._first:
            self._simulated += simulated
        else:
            self._first = self._last  # what came first took nobody knows how long
        self.done += len(evaluations)
        self._collisions += int(np.count_nonzero(evaluations.collided))
        if evaluations.valid.any():
            self._best = min(self._best, float(np.min(evaluations.f_safe[evaluations.valid])))

    def close_run(self, asked: int, seen: int) -> None:
        """A run that ends early asks for less than its budget; one from a finished journal was never seen."""
        self._finished += 1
        self.done += asked - seen
        self.total -= self._evaluations - asked

    def told_within(self, room: int) -> str:
        """In no more than so many letters, without what has no place: what comes first matters most."""
        found = [] if np.isinf(self._best) else [f"{self._collisions} collisions"]
        best = [] if np.isinf(self._best) else [f"best SD {self._best:.2f}"]
        told = ""
        for part in (f"{self._rate():.0f}/s", self._left(), *found, f"runs {self._finished}/{self._runs}", *best):
            longer = f"{told}, {part}" if told else part
            if len(longer) > room:
                break
            told = longer
        return told

    def told(self) -> str:
        """In a line of its own."""
        found = "" if np.isinf(self._best) else f", best SD {self._best:.2f}, collisions {self._collisions}"
        return f"runs {self._finished}/{self._runs}, {self._rate():.0f} evaluations/s, {self._left()}{found}"

    def _left(self) -> str:
        """Hours, minutes and seconds, as far as there is a telling."""
        rate = self._rate()
        if not rate and self.done < self.total:
            return "time left not known yet" if self.done else "not begun"
        return f"{timedelta(seconds=round((self.total - self.done) / rate) if rate else 0)} left"

    def _rate(self) -> float:
        """Evaluations per second while this algorithm's runs are under way."""
        return self._simulated / (self._last - self._first) if self._last > self._first else 0.0


@contextmanager
def counted(console: Console, what: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar that counts up to `total`; yields what to call with every number that is done."""
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=console, disable=not console.is_terminal)
    with bar:
        task = bar.add_task(what, total=total)
        yield lambda number: bar.update(task, advance=number)


@contextmanager
def counted_trials(console: Console, total: int) -> Iterator[Callable[[float], None]]:
    """A bar that counts trials; yields what to call after each with the lowest cost so far."""
    columns = (TextColumn("trials"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.fields[told]}"))
    spoke = time.monotonic()
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("trials", total=total, told="")

        def done(best: float) -> None:
            nonlocal spoke
            bar.update(task, advance=1, told=f"lowest cost {best:.4f}")
            if not console.is_terminal and time.monotonic() - spoke >= SECONDS_BETWEEN_LINES:
                spoke = time.monotonic()
                console.print(f"trial {bar.tasks[0].completed:.0f} of {total}, lowest cost {best:.4f}", highlight=False)

        yield done
