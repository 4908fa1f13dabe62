"""Text of a user's as it is: no markup, no control characters; and tables in which nothing is cut off."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from safevar_sumo.vehicles import Characteristic


class WholeTable(Table):
    """A table whose first column keeps its words, the names; what else does not fit goes on in the next line."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for column in self.columns:
            column.overflow = "fold"
        wide = options.update(width=1_000_000)
        excess = Measurement.get(console, wide, self).maximum - options.max_width
        if excess > 0:
            first = self.columns[0]
            cells = [Measurement.get(console, wide, cell) for cell in (first.header, *first.cells)]
            words, natural = (max(sizes) for sizes in zip(*cells, strict=True))
            first.width = max(words, natural - excess)
        yield from super().__rich_console__(console, options)


def plain(text: object, style: str = "") -> Text:
    """For a rich table or line; what cannot be printed becomes a question mark, or a space if it is one."""
    return Text("".join(sign if sign.isprintable() else " " if sign.isspace() else "?" for sign in str(text)), style)


def print_meanings(console: Console, members: Iterable[Characteristic]) -> None:
    """What characteristics are, a line for each that the study has words for."""
    table = Table.grid(padding=(0, 2))
    for member in members:
        if member.words:
            table.add_row(plain(member.name), plain(member.words))
    if table.row_count:
        console.print(table)
