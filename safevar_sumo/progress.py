"""Progress of long work: one bar on a terminal, elsewhere a line every half minute; both with the time left."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from threading import Event, Thread

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, Task, TextColumn
from rich.progress import Progress as Bar
from rich.text import Text

Progress = Callable[[str, int, int], None]
"""A function that shows progress, called with the stage, the amount done in it, and its total; first with nothing done.
"""
SECONDS_BETWEEN_LINES = 30.0
"""Interval of the lines that show progress without a terminal [s]."""
SETTLING_TIME = 2.0
"""Work before the time left is shown [s]: batches that end together make earlier estimates meaningless."""


def show_no_progress(stage: str, done: int, total: int) -> None:
    """Show no progress."""


class _TimeLeft(ProgressColumn):
    """The time left in the stage under way, at its mean speed so far."""

    def __init__(self) -> None:
        super().__init__()
        self._done, self._total, self._start, self._last = 0, 0, 0.0, 0.0

    def update(self, done: int, total: int) -> None:
        self._done, self._total, self._last = done, total, time.monotonic()
        if done == 0:
            self._start = self._last

    def render(self, task: Task | None = None) -> Text:
        worked = self._last - self._start
        if not self._done or worked < SETTLING_TIME:
            return Text("-:--:-- left")
        seconds = (self._total - self._done) * worked / self._done - (time.monotonic() - self._last)
        return Text(f"{timedelta(seconds=max(round(seconds), 0))} left")


@contextmanager
def open_progress(progress: bool | Progress, console: Console | None = None) -> Iterator[Progress]:
    """Yield the function to call: `progress` itself, or one that moves a bar or prints lines (True) or does nothing."""
    if progress is not True:
        yield progress or show_no_progress
        return
    console = console or Console(stderr=True)
    time_left, ended, line = _TimeLeft(), Event(), "starting"

    def show(stage: str, done: int, total: int) -> None:
        nonlocal line
        line = f"{stage}: {done} of {total}"
        time_left.update(done, total)
        bar.update(task, description=stage, completed=done, total=total)

    def print_lines() -> None:
        while not ended.wait(SECONDS_BETWEEN_LINES) and not console.is_terminal:
            console.print(f"{line}, {time_left.render()}", soft_wrap=True, markup=False, highlight=False)

    stage = TextColumn("{task.description}", markup=False)
    columns = (stage, BarColumn(bar_width=None), MofNCompleteColumn(), time_left)
    lines = Thread(target=print_lines, name="progress", daemon=True)
    with Bar(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(line, total=None)
        lines.start()
        try:
            yield show
        finally:
            ended.set()
            lines.join()
