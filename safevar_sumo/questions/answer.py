"""What every question returns: a verdict, numbers and tables; and the one renderer of them in every format."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING, Any, NamedTuple

import pandas as pd
from rich.console import Console

from safevar_sumo.errors import InputError, unknown_name
from safevar_sumo.questions.research_questions.formats import escaped_for_latex
from safevar_sumo.records import JsonObject
from safevar_sumo.study import Study
from safevar_sumo.terminal import WholeTable, print_parts, print_text, printable_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOW, HIGH = "_low", "_high"
"""Ends of the names of two columns that hold the ends of the interval of a third column."""
FORMATS = ("text", "json", "csv", "latex", "html")
MAX_ROWS = 200
"""Number of rows up to which readers see a table; JSON and CSV have them all."""
WIDTH = 80
"""Width of text that is not printed to a terminal [characters]."""


class Column(NamedTuple):
    """A column of a table: its unit, its meaning, and how its numbers are written for readers, or whether JSON and CSV
    alone have it.
    """

    unit: str
    meaning: str
    number_format: str = ".4g"
    is_shown: bool = True


def tabulate(title: str, columns: Mapping[str, Column], rows: pd.DataFrame | Iterable[Sequence[Any]]) -> pd.DataFrame:
    """A table of an answer: a frame whose `attrs` hold its title and its columns' units and meanings.

    A column `x` whose interval stands in `x_low` and `x_high` is declared once; `columns` may name the ends, too.
    """
    named = dict(columns)
    frame = pd.DataFrame(rows, columns=[*named])
    frame.attrs = {"title": title, "columns": named}
    return frame


def with_interval(name: str, column: Column) -> dict[str, Column]:
    """A column and the two that hold the ends of its interval."""
    ends = {
        f"{name}{end}": column._replace(meaning=f"{word} end of {name}")
        for end, word in ((LOW, "lower"), (HIGH, "upper"))
    }
    return {name: column, **ends}


@dataclass(frozen=True, kw_only=True, repr=False)
class Answer:
    """The answer to a question about a study.

    Attributes
    ----------
    question
        The command that asks it.
    study
        The study that was examined.
    verdict
        One or two sentences: what, how far, how sure.
    numbers
        Values by name; NaN or None where undefined.
    tables
        Frames by name, made by `tabulate`.
    failures
        Sentences that say which of the user's limits are not kept; the command then ends with exit code 3.
    command
        The command line that gives this answer.
    draw
        Draws the answer; by default the values of the first table with their intervals.
    """

    question: str
    study: Study
    verdict: str
    numbers: JsonObject
    tables: dict[str, pd.DataFrame]
    failures: tuple[str, ...] = ()
    command: str = ""
    draw: Callable[[Answer], Figure] | None = field(default=None, compare=False)

    def to_dict(self) -> JsonObject:
        """Plain values: question, study, verdict, numbers, and of each table its columns and rows; null where
        undefined.
        """
        tables = {
            name: {
                "columns": {
                    name: {"unit": unit, "meaning": text} for name, (unit, text, *_) in _columns(frame).items()
                },
                "rows": [_plain(row) for row in frame.to_dict("records")],
            }
            for name, frame in self.tables.items()
        }
        head = {"question": self.question, "study": self.study.name, "verdict": self.verdict}
        return {**head, "numbers": _plain(self.numbers), "tables": tables}

    def table(self, name: str | None = None) -> pd.DataFrame:
        """A table by name, the first one by default.

        Raises
        ------
        InputError
            If the answer has no such table.
        """
        if name is None:
            return next(iter(self.tables.values()), pd.DataFrame())
        if name not in self.tables:
            raise unknown_name("table", f"there is no table {name!r}", name, self.tables)
        return self.tables[name]

    def render(self, form: str, table: str | None = None) -> str:
        """The answer as text, JSON, LaTeX or HTML; one table of it as CSV."""
        if form == "json":
            return json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n"
        if form == "csv":
            return self.table(table).to_csv(index=False, lineterminator="\n")
        if form == "latex":
            return "\n".join(_latex(f"{self.question}-{name}", frame) for name, frame in self._short_tables.items())
        if form == "html":
            sentences = [f"<p>{escape(text)}</p>" for text in (self.verdict, self._long_tables) if text]
            return "\n".join([sentences[0], *map(_html, self._short_tables.values()), *sentences[1:]])
        console = Console(width=WIDTH, no_color=True, force_terminal=False)
        with console.capture() as capture:
            self.print(console)
        return capture.get()

    def print(self, console: Console) -> None:
        """Print the verdict, the tables and the numbers."""
        print_text(console, self.verdict)
        print_parts(console, map(_terminal_table, self._short_tables.values()))
        if self._long_tables:
            print_text(console, self._long_tables)
        print_text(console, "; ".join(f"{name}: {_text(value)}" for name, value in self.numbers.items()))

    @property
    def _short_tables(self) -> dict[str, pd.DataFrame]:
        return {name: frame for name, frame in self.tables.items() if len(frame) <= MAX_ROWS}

    @property
    def _long_tables(self) -> str:
        """The tables that readers do not see, in a sentence."""
        long = [f"{name} ({len(frame):,} rows)" for name, frame in self.tables.items() if len(frame) > MAX_ROWS]
        return f"By --format csv --table NAME: {', '.join(long)}." if long else ""

    def _repr_html_(self) -> str:
        return self.render("html")

    def __repr__(self) -> str:
        return f"<Answer {self.question} {self.study.name}: {self.verdict}>"

    def figure(self) -> Figure:
        """The answer as a figure."""
        return (self.draw or _draw_intervals)(self)

    def values(self, key: str) -> list[Any]:
        """The numbers under a key: a number's name, with an index if it is a list (`interval.1`), or
        `table.column`, a value for each row.

        Raises
        ------
        InputError
            If there is no such number.
        """
        name, _, rest = key.partition(".")
        if not rest and name in self.numbers:
            return [self.numbers[name]]
        value = self.numbers.get(name)
        if isinstance(value, list | tuple) and rest.isdecimal() and int(rest) < len(value):
            return [value[int(rest)]]
        if name in self.tables and rest in self.tables[name]:
            return list(_plain(self.tables[name][rest].tolist()))
        known = [*self.numbers, *(f"{table}.{column}" for table, frame in self.tables.items() for column in frame)]
        raise unknown_name("fail_if", f"the answer has no number {key!r}", key, known)


def _columns(frame: pd.DataFrame) -> dict[str, Column]:
    return dict(frame.attrs.get("columns", {}))


def _plain(value: Any) -> Any:
    """A value as JSON has it, null where undefined."""
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if hasattr(value, "item"):
        value = value.item()
    is_undefined = value is pd.NA or (isinstance(value, float) and not math.isfinite(value))
    return None if is_undefined else value


def _text(value: Any, number_format: str = ".4g") -> str:
    """A value for readers; `-` where undefined."""
    value = _plain(value)
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:{number_format}}"
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(inner, number_format)}" for name, inner in value.items()) or "-"
    if isinstance(value, list):
        is_interval = len(value) == 2 and not isinstance(value[0], dict)
        return (" to " if is_interval else "; ").join(_text(inner, number_format) for inner in value) or "-"
    return str(value)


class _ReaderColumn(NamedTuple):
    """A column as a reader sees it: its heading with the unit, its meaning, and texts."""

    head: str
    meaning: str
    texts: list[str]
    is_number: bool


def reader_columns(frame: pd.DataFrame) -> Iterator[_ReaderColumn]:
    """The columns of a table for readers: an interval stands in brackets behind its value."""
    columns = _columns(frame)
    for name in map(str, frame):
        base = name.removesuffix(LOW).removesuffix(HIGH)
        if base != name and base in frame:
            continue
        if len(frame) and frame[name].isna().all():  # undefined in every row
            continue
        column = columns.get(name, Column("", ""))
        if not column.is_shown:
            continue
        texts = [_text(value, column.number_format) for value in frame[name]]
        if f"{name}{LOW}" in frame:
            ends = zip(frame[f"{name}{LOW}"], frame[f"{name}{HIGH}"], strict=True)
            intervals = (_text([low, high], column.number_format) for low, high in ends)
            pairs = zip(texts, intervals, strict=True)
            texts = [text if text == "-" else f"{text} ({interval})" for text, interval in pairs]
        unit = "" if column.unit in ("", "-") else f" [{column.unit}]"
        is_number = pd.api.types.is_numeric_dtype(frame[name])
        yield _ReaderColumn(f"{name.replace('_', ' ')}{unit}", column.meaning, texts, is_number)


def _terminal_table(frame: pd.DataFrame) -> WholeTable:
    columns = list(reader_columns(frame))
    table = WholeTable(title=frame.attrs.get("title", ""))
    for column in columns:
        table.add_column(printable_text(column.head), justify="right" if column.is_number else "left")
    for cells in zip(*(column.texts for column in columns), strict=True):
        table.add_row(*cells)
    return table


def _html(frame: pd.DataFrame) -> str:
    """A table with a caption, in which a screen reader finds the headings; texts have the class `label`."""
    columns = list(reader_columns(frame))
    classes = ["" if column.is_number else ' class="label"' for column in columns]
    heads = "".join(
        f'<th scope="col"{css} title="{escape(column.meaning)}">{escape(column.head)}</th>'
        for css, column in zip(classes, columns, strict=True)
    )
    rows = (
        "".join(f"<td{css}>{escape(cell)}</td>" for css, cell in zip(classes, cells, strict=True))
        for cells in zip(*(column.texts for column in columns), strict=True)
    )
    body = "\n".join(f"<tr>{row}</tr>" for row in rows)
    title = escape(frame.attrs.get("title", ""))
    table = f"<table><caption>{title}</caption><thead><tr>{heads}</tr></thead><tbody>\n{body}\n</tbody></table>"
    return f'<div class="wide" role="region" tabindex="0" aria-label="{title}">{table}</div>' if body else ""


def _latex(label: str, frame: pd.DataFrame) -> str:
    """A booktabs table; in the preamble: booktabs."""
    readable = pd.DataFrame({column.head: column.texts for column in reader_columns(frame)})
    style = readable.style.hide().format(escape="latex").format_index(escape="latex", axis=1)
    alignment = "".join("r" if column.is_number else "l" for column in reader_columns(frame))
    caption = escaped_for_latex(frame.attrs.get("title", ""))
    return style.to_latex(hrules=True, column_format=alignment, caption=caption, label=f"tab:{label}", position="htbp")


def _draw_intervals(answer: Answer) -> Figure:
    """The numbers of the first table with their intervals, a row for each of its rows."""
    from safevar_sumo.questions.figures import BLUE, FONT_SIZE, escape_dollars, new_figure

    frame = answer.table()
    names = [name for name in map(str, frame) if f"{name}{LOW}" in frame and frame[name].notna().any()]
    if not names or frame.empty:
        raise InputError("plot", "the answer has nothing to draw", "the answer as a table")
    size = (max(2.6 * len(names), 5.2), 1.1 + 0.35 * len(frame))
    figure, axes = new_figure(f"{answer.study.name}: {frame.attrs['title']}", 1, len(names), size, sharey=True)
    places = range(len(frame), 0, -1)
    for axis, name in zip(axes[0], names, strict=True):
        value, low, high = (frame[f"{name}{end}"].to_numpy(float) for end in ("", LOW, HIGH))
        axis.errorbar(value, places, xerr=[value - low, high - value], fmt="o", color=BLUE, capsize=2, markersize=4)
        axis.set_xlabel(escape_dollars(name.replace("_", " ")))
    labels = [escape_dollars(str(label)) for label in frame.iloc[:, 0]]
    axes[0][0].set_yticks(places, labels, fontsize=FONT_SIZE - 1)
    return figure
