"""Output on the terminal: text without markup and control characters, tables in which nothing is
cut off, and the progress of long work. Progress is a bar, or without a terminal a line every half
minute, with the time left.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from threading import Event, Thread
from typing import NamedTuple

from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import Measurement
from rich.progress import BarColumn, Progress as Bar, ProgressColumn, Task, TextColumn
from rich.table import Table
from rich.text import Text

from safevar_sumo.errors import printable

Progress = Callable[[str, int, int], None]
"""A function that shows progress. Its arguments are the phase, the number of simulations that are
done, and the total number of simulations of the command. The total is an estimate while the number
of rounds is unknown, and 0 if nothing is known.
"""
SECONDS_BETWEEN_LINES = 30.0
"""Time between two lines that show progress without a terminal [s]."""
MEASURED_SHARE = 0.25
"""The speed is measured over this last share of the time so far. Therefore a phase that was fast,
because the cache answered, is soon forgotten.
"""
STALLED_SHARE = 0.25
"""The time left is at least this share of the time since the last sign of progress: work that takes
longer than expected does not end at once.
"""
UNLIMITED_WIDTH = 1_000_000
"""A width at which no line is broken [characters]."""


class ColumnOfTexts(NamedTuple):
    """A column of a `WholeTable`: its head, whether it holds numbers, and its cells."""

    head: str
    is_number: bool
    texts: Sequence[str]


class WholeTable(Table):
    """A table of plain text in which nothing is cut off.

    In a narrow terminal, the table first breaks lines between words, then omits the padding, and
    last breaks words.
    """

    def __init__(self, title: str, columns: Sequence[ColumnOfTexts]) -> None:
        super().__init__()
        self._title_line = printable_text(title, "italic")
        for column in columns:
            self.add_column(
                printable_text(column.head),
                justify="right" if column.is_number else "left",
            )
        for row in zip(*[column.texts for column in columns], strict=True):
            self.add_row(*[printable_text(cell) for cell in row])

    def __rich_console__(
        self, console: Console, options: ConsoleOptions
    ) -> RenderResult:
        """Choose the widths of the columns for the width of the terminal, and draw the table."""
        # Rich would break a title at the width of its table.
        if self._title_line:
            yield self._title_line

        # The width of the longest word of each column, and the width of its longest text.
        word_widths = []
        text_widths = []
        count = len(self.columns)
        for column in self.columns:
            cells = (column.header, *column.cells)
            measures = [
                Measurement.get(console, options.update(width=UNLIMITED_WIDTH), cell)
                for cell in cells
            ]
            word_widths.append(max(measure.minimum for measure in measures))
            text_widths.append(max(measure.maximum for measure in measures))
            column.overflow = "fold"

        # If the table is too wide, columns share the space that the longest words leave.
        words = sum(word_widths)
        texts = sum(text_widths)
        space = options.max_width - count - 1
        if texts + 2 * count > space:
            spare = space - words - 2 * count
            if spare < 0:
                self.padding = 0
                spare += 2 * count
            for column, word_width, text_width in zip(
                self.columns, word_widths, text_widths, strict=True
            ):
                if spare >= 0:
                    share = (text_width - word_width) * spare // max(texts - words, 1)
                    column.width = word_width + share
        yield from super().__rich_console__(console, options)


def printable_text(text: object, style: str = "") -> Text:
    """Convert text for rich. White space becomes a space, and any other unprintable character a
    question mark.
    """
    letters = [_printable_letter(letter) for letter in str(text)]
    return Text("".join(letters), style)


def _printable_letter(letter: str) -> str:
    if letter.isprintable():
        return letter
    if letter.isspace():
        return " "
    return "?"


def print_text(console: Console, text: str) -> None:
    """Print a line of text without wrapping, and without interpreting markup."""
    console.print(printable(text), soft_wrap=True, markup=False, highlight=False)


def show_no_progress(phase: str, number: int, total: int) -> None:
    """Ignore progress."""


class Parts:
    """The progress of parts of a command that follow each other, such as its questions.

    `expected` has a number for each part: the part takes about as long as this number of
    simulations, and counts as so many. A part without a number, or with 0, counts its own.
    """

    def __init__(self, show: Progress, expected: Iterable[int] = ()) -> None:
        self._show = show
        self._expected = list(expected)
        self._before = 0
        self._whole = 0
        """Numbers of simulations of all parts before this part, and of this part."""

    def begin(self, name: str = "") -> Progress:
        """Begin the next part, and return the function that shows its progress. A `name` of the
        part stands before its phases.
        """
        self._before += self._whole
        expected = self._whole = self._expected.pop(0) if self._expected else 0
        later = sum(self._expected)

        def show_part(phase: str, number: int, total: int) -> None:
            # A part may take longer than its simulations, for example to start workers. Its
            # expected number is spread over its simulations, so that the announced total stays.
            self._whole = expected or total
            number = self._whole * number // max(total, 1)
            if name:
                phase = f"{name}: {phase}"
            self._show(phase, self._before + number, self._before + self._whole + later)

        return show_part


class Pace:
    """Estimates the time left of a command, from the times at which parts of its work were done."""

    def __init__(self) -> None:
        self._marks = deque[tuple[float, int]]()
        """The times [s] and the work done at these times, since the beginning of the measurement of
        the speed.
        """
        self._begin = 0.0
        self._left = 0

    def update(self, number: int, total: int) -> None:
        """Note how much work is done now, and how much work the command has."""
        time_now = time.monotonic()
        if not self._marks or number < self._marks[-1][1]:
            self._marks.clear()
            self._begin = time_now
        self._marks.append((time_now, number))
        self._left = total - number
        while len(self._marks) > 2 and self._marks[1][0] < time_now - MEASURED_SHARE * (
            time_now - self._begin
        ):
            self._marks.popleft()

    def seconds_left(self) -> float | None:
        """The estimated time left [s]; None before any work is done."""
        if not self._marks:
            return None
        start, number_at_start = self._marks[0]
        end, number = self._marks[-1]
        since = time.monotonic() - end
        if number == number_at_start:
            return None
        seconds = self._left * (end - start) / (number - number_at_start)
        return max(seconds - since, STALLED_SHARE * since)


class _TimeLeft(ProgressColumn):
    """The column of a bar with the time left."""

    def __init__(self, pace: Pace) -> None:
        super().__init__()
        self._pace = pace

    def render(self, task: Task | None = None) -> Text:
        seconds = self._pace.seconds_left()
        return Text(
            "" if seconds is None else f"{timedelta(seconds=math.ceil(seconds))} left"
        )


@contextmanager
def open_progress(
    progress: bool | Progress, console: Console | None = None
) -> Iterator[Progress]:
    """Yield the function that shows progress: `progress` itself if it is a function. If it is True,
    a function that moves a bar or prints lines. If it is False, a function that does nothing.
    """
    if progress is not True:
        yield progress or show_no_progress
        return

    console = console or Console(stderr=True)
    pace = Pace()
    time_left = _TimeLeft(pace)
    ended = Event()
    line = "searching"

    def show(phase: str, number: int, total: int) -> None:
        """Show the phase, the count and the time left."""
        nonlocal line
        pace.update(number, total)
        line = phase
        count = ""
        if total:
            count = f"{number:,} of {total:,}"
            line = f"{phase}: {count}"
        bar.update(
            task, description=phase, completed=number, total=total or None, count=count
        )

    def print_lines() -> None:
        while not ended.wait(SECONDS_BETWEEN_LINES) and not console.is_terminal:
            parts = (line, str(time_left.render()))
            print_text(console, ", ".join(part for part in parts if part))

    text = TextColumn("{task.description}", markup=False)
    count = TextColumn("{task.fields[count]}", markup=False)
    columns = (text, BarColumn(bar_width=None), count, time_left)
    lines = Thread(target=print_lines, name="progress", daemon=True)
    with Bar(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(line, total=None, count="")
        lines.start()
        try:
            yield show
        finally:
            ended.set()
            lines.join()
