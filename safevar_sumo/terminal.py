"""Text on the terminal: users' text without markup and control characters; tables in which nothing
is cut off; and the progress of long work, as a bar or elsewhere a line every half minute, with the
time left.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from threading import Event, Thread
from typing import Self

from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import Measurement
from rich.progress import BarColumn, Progress as Bar, ProgressColumn, Task, TextColumn
from rich.table import Table
from rich.text import Text

Progress = Callable[[str, int, int], None]
"""A function that shows progress, called with the phase, the amount done in it, and its total, 0
where it is unknown; first with nothing done.
"""
SECONDS_BETWEEN_LINES = 30.0
"""Interval of the lines that show progress without a terminal [s]."""
SETTLING_TIME = 2.0
"""Work before the time left is shown [s]: batches that end together make earlier estimates
meaningless.
"""
UNLIMITED_WIDTH = 1_000_000
"""Width in which no line is broken [characters]."""


class Phase(str):
    """The name of a phase of something larger, which knows what share of the whole is done; a text,
    as users' functions take one.
    """

    share: float

    def __new__(cls, name: str, share: float) -> Self:
        phase = super().__new__(cls, name)
        phase.share = share
        return phase


class WholeTable(Table):
    """A table of plain text that cuts nothing off.

    In a narrow terminal it breaks lines between words; then it goes without padding; only then it
    breaks words. Each column has a head, whether it holds numbers, and its cells.
    """

    def __init__(self, title: str, columns: Iterable[tuple[str, bool, Sequence[str]]]) -> None:
        super().__init__()
        self._title_line = printable_text(title, "italic")
        heads, are_numbers, cells = zip(*columns, strict=True)
        for head, is_number in zip(heads, are_numbers, strict=True):
            self.add_column(printable_text(head), justify="right" if is_number else "left")
        for row in zip(*cells, strict=True):
            self.add_row(*map(printable_text, row))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if self._title_line:
            yield self._title_line  # rich breaks a title where its table ends

        # Widths that columns need for their longest word and for all text.
        sizes = []
        count = len(self.columns)
        for column in self.columns:
            cells = (column.header, *column.cells)
            measures = [
                Measurement.get(console, options.update(width=UNLIMITED_WIDTH), cell)
                for cell in cells
            ]
            sizes.append(
                (
                    max(measure.minimum for measure in measures),
                    max(measure.maximum for measure in measures),
                )
            )
            column.overflow = "fold"

        # If not all fits, the space is shared.
        words, whole = (sum(size) for size in zip(*sizes, strict=True))
        space = options.max_width - count - 1  # beside the lines
        if whole + 2 * count > space:
            if words + 2 * count > space:
                self.padding = 0
            spare = space - words - (0 if words + 2 * count > space else 2 * count)
            for column, (longest_word, full_width) in zip(self.columns, sizes, strict=True):
                if spare >= 0:
                    column.width = longest_word + (full_width - longest_word) * spare // max(
                        whole - words, 1
                    )
        yield from super().__rich_console__(console, options)


def printable_text(text: object, style: str = "") -> Text:
    """Make text printable by rich: white space becomes a space, any other unprintable character a
    question mark.
    """
    return Text(
        "".join(
            letter if letter.isprintable() else " " if letter.isspace() else "?"
            for letter in str(text)
        ),
        style,
    )


def print_text(console: Console, text: str) -> None:
    """Print a line of text without wrapping and markup."""
    console.print(text, soft_wrap=True, markup=False, highlight=False)


def show_no_progress(phase: str, done: int, total: int) -> None:
    """Show no progress."""


def show_within(
    progress: Progress, whole: str, earlier: float, width: float, phase: str, done: int, total: int
) -> None:
    """Show a phase of something larger, which is named before it: it begins when a share `earlier`
    of that is done, and is a share `width` of it.
    """
    share = share_done(phase, done, total) or 0.0
    progress(Phase(f"{whole}: {phase}", earlier + width * share), done, total)


def share_done(phase: str, done: int, total: int) -> float | None:
    """The share that is done of the whole, or of a phase that is the whole; None if unknown."""
    if isinstance(phase, Phase):
        return phase.share
    return done / total if total else None


class _Pace(ProgressColumn):
    """The mean speed of the phase under way, and the time left at that speed: of a phase of several
    or of a round it says so, and a phase that has ended has none.
    """

    def __init__(self) -> None:
        super().__init__()
        self._done = 0
        self._total = 0
        self._last = 0.0
        self._of = ""
        self._begun: tuple[int, float] | None = None
        """What was done when the phase began, such as by an earlier command, and the time [s]."""

    def update(self, phase: str, done: int, total: int) -> None:
        self._of = ""
        if isinstance(phase, Phase):
            self._of = " of this round" if ", round " in phase else " of this phase"
        is_new = self._begun is None or done == 0 or done < self._done or not self._total
        self._done = done
        self._total = total
        self._last = time.monotonic()
        if is_new:
            self._begun = done, self._last

    def render(self, task: Task | None = None) -> Text:
        if not self._total or self._done >= self._total:
            return Text("")
        done_before, start = self._begun or (0, 0.0)
        done = self._done - done_before
        worked = self._last - start
        if done <= 0 or worked < SETTLING_TIME:
            return Text(f"-:--:-- left{self._of}")
        seconds = (self._total - self._done) * worked / done - (time.monotonic() - self._last)
        left = timedelta(seconds=max(math.ceil(seconds), 1))
        return Text(f"{done / worked:.3g}/s, {left} left{self._of}")


@contextmanager
def open_progress(progress: bool | Progress, console: Console | None = None) -> Iterator[Progress]:
    """Yield the function to call: `progress` itself, or one that moves a bar or prints lines (True)
    or does nothing.
    """
    if progress is not True:
        yield progress or show_no_progress
        return

    # A bar on a terminal, lines elsewhere.
    console = console or Console(stderr=True)
    pace = _Pace()
    ended = Event()
    line = "searching"

    def show(phase: str, done: int, total: int) -> None:
        nonlocal line
        line = f"{phase}: {done} of {total}" if total else f"{phase}: {done}"
        pace.update(phase, done, total)
        count = f"{done}/{total}" if total else f"{done}" if done else ""
        share = share_done(phase, done, total)
        whole = None if share is None else 1.0
        bar.update(task, description=phase, completed=share or 0.0, total=whole, count=count)

    def print_lines() -> None:
        while not ended.wait(SECONDS_BETWEEN_LINES) and not console.is_terminal:
            print_text(console, ", ".join(filter(None, (line, str(pace.render())))))

    text = TextColumn("{task.description}", markup=False)
    count = TextColumn("{task.fields[count]}", markup=False)
    columns = (text, BarColumn(bar_width=None), count, pace)
    lines = Thread(target=print_lines, name="progress", daemon=True)
    with Bar(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(line, total=None, count="")
        lines.start()
        try:
            yield show
        finally:
            ended.set()
            lines.join()
