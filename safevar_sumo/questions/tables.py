"""The tables of answers: data frames with units and meanings, as text, as HTML or as LaTeX."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from itertools import product, takewhile
from typing import Any, NamedTuple

import pandas as pd

from safevar_sumo.errors import InputError, printable
from safevar_sumo.questions.bars import LEGEND, Bar
from safevar_sumo.questions.changes import NUMBER_PATTERN
from safevar_sumo.shipped import shipped_table
from safevar_sumo.terminal import ColumnOfTexts, WholeTable

LOW = "_low"
HIGH = "_high"
"""Suffixes of column names. The columns `x_low` and `x_high` hold the ends of the interval of the
column `x`.
"""
LONG_TEXT = 60
"""Number of characters above which a text is long. On the terminal, long texts stand below their
table, unless they fit beside the other columns.
"""
LEAST_TEXT = 36
"""Least width of a column of long texts beside other columns [characters]."""
MAX_LEAD_ROWS, MAX_LEAD_COLUMNS = 12, 6
"""Largest number of rows and of columns in the table that one screen shows."""
LATEX_PREAMBLE = (
    r"% In the preamble: \usepackage[T1]{fontenc} \usepackage{textcomp}"
    r" \usepackage{booktabs} \usepackage{graphicx}"
)
FIT_BEGIN = "\\resizebox{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}{!}{%\n"
LATEX_CODES = str.maketrans(
    {
        "{": r"\{",
        "}": r"\}",
        "$": r"\$",
        "&": r"\&",
        "#": r"\#",
        "%": r"\%",
        "_": r"\_",
        # At the beginning of a row, LaTeX reads [ or * as an argument of \\ in the row before.
        "[": "{[}",
        "]": "{]}",
        "*": "{*}",
        "\\": r"\textbackslash{}",
        "^": r"\textasciicircum{}",
        "~": r"\textasciitilde{}",
    }
)


class Column(NamedTuple):
    """A column of a table. `number_format` is the format in which readers see its numbers.
    `is_shown` is False for a column that only JSON and CSV have. `head` is the heading, by default
    the column's name. `is_detail` is True for a column that the table of one screen leaves out.
    """

    unit: str = ""
    meaning: str = ""
    number_format: str = ".4g"
    is_shown: bool = True
    head: str = ""
    is_detail: bool = False


Columns = dict[str, Column | str]
"""Columns by name. A text stands for a column without a unit: the text is its meaning."""
Rows = Sequence[tuple[Any, ...]]
"""The rows of a table."""
NamedColumns = dict[str, Column]


class Wide(NamedTuple):
    """How readers see a long table: as wide tables, one table for each name in `values`.

    Each combination of the values of the columns `labels` is a row of a wide table. Each value of
    the column `by` is a column, whose heading is the template `head` with this value. The cells are
    the values of the column x, or of x_low and x_high, for the name x in `values`.
    """

    labels: Sequence[str]
    by: str
    values: Sequence[str]
    head: str = "{}"


@dataclass(frozen=True)
class AnswerTable:
    """A table of an answer.

    Attributes
    ----------
    frame
        The rows.
    wide
        How readers see the table; None if readers see the rows as they are.
    words
        A text for readers by the text that stands in the cell.
    lead_rows
        Positions of the rows that one screen shows, the most important row first; () for all rows.
    shown_whole
        If the table has at most this number of rows, one screen shows all of them.
    bars
        A bar for each row, or no bars.
    """

    frame: pd.DataFrame
    title: str = ""
    columns: NamedColumns = field(default_factory=dict)
    wide: Wide | None = None
    words: Mapping[str, str] = field(default_factory=dict)
    lead_rows: Sequence[int] = ()
    shown_whole: int = 0
    bars: Sequence[Bar] = ()

    def with_rows(self, frame: pd.DataFrame) -> AnswerTable:
        """The same table, but with the rows of `frame`."""
        return replace(self, frame=frame)


AnswerTables = dict[str, AnswerTable]


class Frames(dict[str, pd.DataFrame]):
    """The data frames of an answer's tables by name; `records` holds the `AnswerTable` objects."""

    def __init__(self, records: Mapping[str, AnswerTable]) -> None:
        for name, table in records.items():
            if not isinstance(table, AnswerTable):
                raise InputError(
                    "tables",
                    f"the table {name!r} is a {type(table).__name__}",
                    "what tabulate(title, columns, rows) returns, with a meaning for each column",
                )
        super().__init__({name: table.frame for name, table in records.items()})
        self.records = records


def tabulate(
    title: str,
    columns: Mapping[str, Column | str],
    rows: pd.DataFrame | Iterable[Sequence[Any] | dict[str, Any]],
    **layout: Any,
) -> AnswerTable:
    """A table of an answer with exactly the columns of `columns`, in this order. `layout` holds
    further attributes of `AnswerTable`.
    """
    named = {}
    for name, column in columns.items():
        named[name] = Column("", column) if isinstance(column, str) else column
    return AnswerTable(pd.DataFrame(rows, columns=list(named)), title, named, **layout)


def with_interval(name: str, column: Column) -> NamedColumns:
    """The column `name`, and two columns for the lower and upper end of its interval."""
    low = column._replace(meaning=f"lower end of {name}")
    high = column._replace(meaning=f"upper end of {name}")
    return {name: column, f"{name}{LOW}": low, f"{name}{HIGH}": high}


def columns_from(table: Mapping[str, Any]) -> NamedColumns:
    """The columns that a TOML table declares. The value of a name is the column's meaning, or a
    table of attributes of `Column`; there, `interval = true` adds columns for an interval.
    """
    columns = NamedColumns()
    for name, facts in table.items():
        described = {"meaning": facts} if isinstance(facts, str) else dict(facts)
        has_interval = described.pop("interval", False)
        column = Column(**described)
        columns |= with_interval(name, column) if has_interval else {name: column}
    return columns


def shipped_columns(command: str) -> dict[str, NamedColumns]:
    """The columns of a shipped command's tables, by the name of the table."""
    tables = shipped_table("questions/columns.toml")[command]
    return {name: columns_from(table) for name, table in tables.items()}


def plain(value: Any) -> Any:
    """A value that JSON can hold; None if the value is undefined or infinite."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return list(map(plain, value))
    if hasattr(value, "item"):
        value = value.item()
    if value is pd.NA or (isinstance(value, float) and not math.isfinite(value)):
        return None
    return value


def cell_text(value: Any, number_format: str = ".4g") -> str:
    """A value as a text; `-` if it is undefined, infinite or empty. Two numbers are an interval."""
    value = plain(value)
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return _decimal_text(value, number_format)
    if isinstance(value, dict):
        texts = [
            f"{name} {cell_text(item, number_format)}" for name, item in value.items()
        ]
        return ", ".join(texts) or "-"
    if isinstance(value, list):
        return _list_text(value, number_format)
    return str(value)


def _decimal_text(number: float, number_format: str) -> str:
    """A finite number as a text. A large number is written in full, whatever its format."""
    text = f"{number:{number_format}}"
    if "e+" in text:
        return f"{number:,.0f}"
    return text


def _list_text(values: list[Any], number_format: str) -> str:
    """A list as a text; `-` if it is empty. Two numbers are an interval."""
    texts = [cell_text(value, number_format) for value in values]
    is_interval = len(values) == 2 and not isinstance(values[0], dict | str)
    separator = " to " if is_interval else "; "
    return separator.join(texts) or "-"


FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")
"""A spreadsheet reads a cell that begins with one of these characters as a formula."""
ZERO_TEXT = re.compile(r"-?0(\.0+)?")
SIGNED = re.compile(rf"{NUMBER_PATTERN}|[+-]inf")


def csv_cell(value: Any) -> Any:
    """A value for a CSV file. A list becomes words with blanks between them. A text that a
    spreadsheet would calculate as a formula gets an apostrophe in front.
    """
    if isinstance(value, list):
        value = " ".join(map(str, value))
    if not isinstance(value, str):
        return value
    if value.startswith(FORMULA_STARTS) and not SIGNED.fullmatch(value):
        value = f"'{value}"
    return printable(value)


def reader_tables(name: str, table: AnswerTable) -> Iterator[tuple[str, AnswerTable]]:
    """Yield the name and the table of each table that readers see in place of `table`: the table
    itself, or the wide tables that `table.wide` describes.
    """
    frame = table.frame
    columns = table.columns
    wide = table.wide
    if wide is None or frame.empty:
        yield name, table
        return

    # Make a table for each name in `values`, with one or two columns for each value of `by`.
    by_values = frame[wide.by].unique()
    for value in wide.values:  # noqa: PD011 - a field
        ends = ("",) if value in frame else (LOW, HIGH)
        value_columns = [f"{value}{end}" for end in ends]
        column = columns[value_columns[0]]
        columns_of_reader = {label: columns[label] for label in wide.labels}
        for by_value, end in product(by_values, ends):
            head = table.words.get(str(by_value), wide.head.format(by_value))
            columns_of_reader[f"{head}{end}"] = column._replace(unit="")

        # Make a row for each combination of the labels' values; a missing cell is NaN.
        rows = []
        for labels, group in frame.groupby(list(wide.labels), sort=False):
            cells = group.set_index(wide.by)[value_columns].reindex(by_values)
            rows.append((*labels, *cells.to_numpy().ravel()))
        heading = table.title
        if len(wide.values) > 1:
            meanings = [columns[name].meaning for name in value_columns]
            heading += f": {' and '.join(meanings)}"
        yield (
            f"{name}-{value}",
            tabulate(heading, columns_of_reader, rows, words=table.words),
        )


class _ReaderColumn(NamedTuple):
    """A column as a reader sees it. `names` are the columns of the frame that it shows: a value,
    the ends of an interval, or both. `head` is the heading with the unit; `texts` are the cells.
    """

    names: list[str]
    head: str
    meaning: str
    texts: list[str]
    is_number: bool

    @property
    def is_long(self) -> bool:
        """Whether a text of the column is too long for a narrow table."""
        return max(map(len, self.texts), default=0) > LONG_TEXT

    @property
    def is_zero(self) -> bool:
        """Whether all cells are 0 or undefined, as far as a reader sees."""
        return all(text == "-" or ZERO_TEXT.fullmatch(text) for text in self.texts)


def reader_columns(table: AnswerTable) -> Iterator[_ReaderColumn]:
    """Yield the columns of a table as readers see them: a value and its interval in one column,
    such as `3 (2 to 4)`. The text is the value alone if the interval has no width.
    """
    frame = table.frame
    for name in map(str, frame):
        base = re.sub(f"({LOW}|{HIGH})$", "", name)
        column = table.columns[name]
        ends = [f"{base}{LOW}", f"{base}{HIGH}"]
        is_end = base != name
        is_shown_elsewhere = is_end and (base in frame or name == ends[1])
        if not column.is_shown or is_shown_elsewhere:
            continue
        values = frame[ends if is_end else [name]]
        # A column that is undefined in every row is left out.
        if len(frame) and values.isna().all(axis=None):
            continue
        head = column.head or base.replace("_", " ")
        # A unit such as "as characteristic" says that the unit differs between rows.
        if column.unit not in ("", "-") and not column.unit.startswith("as "):
            head += f" [{column.unit}]"
        # A column that is itself an end is there once.
        shown = [part for part in dict.fromkeys((name, *ends)) if part in frame]
        yield _ReaderColumn(
            shown,
            head,
            column.meaning,
            _texts_of(table, name, ends),
            pd.api.types.is_numeric_dtype(frame[name]),
        )


def _texts_of(table: AnswerTable, name: str, ends: list[str]) -> list[str]:
    """The cells of the column `name` as texts for readers. If the frame has the columns `ends`, the
    texts have the interval between them.
    """
    frame = table.frame
    number_format = table.columns[name].number_format
    texts = []
    for value in frame[name]:
        text = cell_text(value, number_format)
        texts.append(table.words.get(text, text))
    if ends[0] not in frame:
        return texts
    is_exact = frame[ends[0]] == frame[ends[1]]
    for row, (low, high) in enumerate(frame[ends].itertuples(index=False)):
        interval = _interval_text(low, high, number_format)
        if name in ends:
            texts[row] = interval
        elif not is_exact.iloc[row] and texts[row] != "-":
            texts[row] += f" ({interval})"
    return texts


def lead_table(table: AnswerTable, max_rows: int) -> AnswerTable:
    """The part of a table that one screen shows: at most `max_rows` of the most important rows, and
    at most `MAX_LEAD_COLUMNS` columns. A column is left out if all its cells are equal, undefined
    or 0. The first column stays in a table of several rows, because it names the rows.
    """
    rows = table.lead_rows or range(len(table.frame))
    lead = table.frame.iloc[list(rows)[:max_rows]]
    names = list[str]()
    number = 0
    for column in reader_columns(table.with_rows(lead)):
        is_same = len(lead) > 1 and len(set(column.texts)) == 1
        says_something = not is_same and not column.is_zero
        is_detail = table.columns[column.names[0]].is_detail
        is_label = not names and len(lead) > 1
        if not is_detail and (is_label or says_something) and number < MAX_LEAD_COLUMNS:
            names += column.names
            number += 1
    return replace(table, frame=lead[names], bars=())


def _interval_text(low: Any, high: Any, number_format: str) -> str:
    """An interval as a text for readers. An end may be undefined: `from 2`, `up to 4`, or `-`."""
    texts = cell_text(low, number_format), cell_text(high, number_format)
    if low == high:
        return texts[0]
    forms = {(True, True): "-", (True, False): "up to {1}", (False, True): "from {0}"}
    return forms.get((texts[0] == "-", texts[1] == "-"), "{0} to {1}").format(*texts)


def terminal_tables(table: AnswerTable, width: int) -> Iterator[WholeTable | str]:
    """Yield a table for a terminal of `width` characters as tables and lines. If the columns do not
    fit beside each other, several tables share the columns. Each of these tables begins with the
    columns of text that name the rows. Long texts stand below the tables, a line for each row.
    """
    # The first column names the rows. Any other column of zeros says nothing.
    all_columns = [
        column
        for number, column in enumerate(reader_columns(table))
        if not number or not column.is_zero
    ]
    columns = [column for column in all_columns if not column.is_long]
    long_columns = [column for column in all_columns if column.is_long]
    has_numbers = any(column.is_number for column in columns)
    if long_columns and len(columns) < 2 and not has_numbers:
        # Each row fits into a line: a table would not say more.
        yield table.title
        yield from _lines_of_rows([*columns, *long_columns])
        return
    least_width = _least_table_width(columns)
    for column in long_columns:
        least_width += max(_least_width(column), LEAST_TEXT)
    if least_width <= width:
        columns = all_columns
        long_columns = []

    blocks = _blocks(columns, width)
    bars = [bar.blocks for bar in table.bars]
    if bars and columns:
        ranges = _ReaderColumn([], LEGEND["text"], "", bars, is_number=False)
        blocks.insert(0, [columns[0], ranges])
    title = table.title
    for block in blocks:
        columns_of_texts = [
            ColumnOfTexts(item.head, item.is_number, item.texts) for item in block
        ]
        yield WholeTable(title, columns_of_texts)
        title = ""
    for column in long_columns:
        for label, text in zip(columns[0].texts, column.texts, strict=True):
            yield f"{label}: {text}"


def _lines_of_rows(columns: Sequence[_ReaderColumn]) -> Iterator[str]:
    """Yield a line for each row: its first cell, a colon, and its other cells. Empty cells are left
    out.
    """
    cells = [column.texts for column in columns]
    for label, *texts in zip(*cells, strict=True):
        text = " ".join(cell for cell in texts if cell)
        yield ": ".join(part for part in (label, text) if part)


def _blocks(columns: Sequence[_ReaderColumn], width: int) -> list[list[_ReaderColumn]]:
    """Share columns among tables for a terminal of `width` characters. Each table begins with the
    labels: the columns of text before the first column of numbers.
    """
    labels = list(takewhile(lambda column: not column.is_number, columns))
    if _least_table_width(labels) > width:
        labels = labels[:1]
    blocks = []
    block = list(labels)
    for column in columns[len(labels) :]:
        has_values = len(block) > len(labels)
        if has_values and _least_table_width([*block, column]) > width:
            blocks.append(block)
            block = list(labels)
        block.append(column)
    if block:
        blocks.append(block)
    return blocks


def _least_table_width(columns: Sequence[_ReaderColumn]) -> int:
    """The least width of a table that breaks no word, with its lines [characters]."""
    return 1 + sum(_least_width(column) for column in columns)


def _least_width(column: _ReaderColumn) -> int:
    """The least width of a column that breaks no word, with a line beside it [characters]."""
    words = " ".join([column.head, *column.texts]).split()
    return 1 + max((len(word) for word in words), default=0)


def html_table(table: AnswerTable) -> str:
    """A table as HTML with a caption; "" without rows or columns. The cells of columns of text have
    the CSS class `label`.
    """
    # Each cell states its heading in `data-head`: on a phone the heading stands beside the cell.
    heads = ""
    rows = [""] * len(table.frame)
    for column in reader_columns(table):
        css = "" if column.is_number else ' class="label"'
        head = escape(column.head)
        heads += f'<th scope="col"{css} title="{escape(column.meaning)}">{head}</th>'
        for row, text in enumerate(column.texts):
            rows[row] += f'<td{css} data-head="{head}">{escape(text)}</td>'

    if not heads or not rows:
        return ""
    title = escape(table.title)
    legend = ""
    if table.bars:
        legend = f" <small>({LEGEND['html']})</small>"
        head = f'<th scope="col" class="label" title="{LEGEND["html"]}">range</th>'
        heads = f"{head}{heads}"
        for row, bar in enumerate(table.bars):
            cell = f'<td class="label" data-head="range">{bar.svg}</td>'
            rows[row] = f"{cell}{rows[row]}"
    body = "\n".join(f"<tr>{row}</tr>" for row in rows)
    html = (
        f"<table><caption>{title}{legend}</caption><thead><tr>{heads}</tr></thead>"
        f"<tbody>\n{body}\n</tbody></table>"
    )
    return f'<div class="wide" role="region" tabindex="0" aria-label="{title}">{html}</div>'


def latex_table(label: str, table: AnswerTable) -> str:
    """A table as LaTeX with the package booktabs, shrunk if it is wider than a line."""
    readable = pd.DataFrame()
    alignment = ""
    for column in reader_columns(table):
        readable[column.head] = column.texts
        text_alignment = "p{6cm}" if column.is_long else "l"
        alignment += "r" if column.is_number else text_alignment
    style = readable.style.hide().format(_escaped_for_latex)
    style = style.format_index(_escaped_for_latex, axis=1)
    latex = style.to_latex(
        hrules=True,
        column_format=alignment,
        caption=_escaped_for_latex(table.title),
        label=f"tab:{label}",
        position="htbp",
    )
    return latex.replace(r"\begin{tabular}", FIT_BEGIN + r"\begin{tabular}").replace(
        r"\end{tabular}", r"\end{tabular}}"
    )


def latex_notes(texts: Iterable[str]) -> str:
    """Texts as small paragraphs."""
    notes = ""
    for text in map(_escaped_for_latex, texts):
        notes += f"\\noindent{{\\footnotesize {text}\\par}}\n"
    return notes


def _escaped_for_latex(text: object) -> str:
    """Plain text as LaTeX, with superscripts and minus signs."""
    escaped = re.sub(
        r"\\textasciicircum\{\}(-?\d+)",
        r"\\textsuperscript{\1}",
        str(text).translate(LATEX_CODES),
    )
    return re.sub(r"(?<![\w)-])-(?=\.?\d)", r"\\textminus{}", escaped)
