"""Progress of work that goes through stages, each with so many settings to simulate."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

SECONDS_BETWEEN_LINES = 30.0


@contextmanager
def stages(console: Console) -> Iterator[Callable[[str, int, int], None]]:
    """A bar on a terminal, a line now and then elsewhere; yields what to call with the stage, what is done and how much there is."""
    columns = (TextColumn("{task.description}", markup=False), BarColumn(bar_width=20), MofNCompleteColumn(), TimeRemainingColumn())
    spoke = time.monotonic()
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("starting", total=None)

        def done(stage: str, number: int, total: int) -> None:
            nonlocal spoke
            if number == 0:
                bar.reset(task, description=stage, total=total)
            bar.update(task, completed=number)
            if not console.is_terminal and time.monotonic() - spoke >= SECONDS_BETWEEN_LINES:
                spoke = time.monotonic()
                console.print(f"{stage}: {number} of {total}", markup=False, highlight=False, soft_wrap=True)

        yield done
