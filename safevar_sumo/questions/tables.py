"""The tables of answers: frames with units and meanings, and how readers see these tables as text,
HTML and LaTeX.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from itertools import product, takewhile
from typing import Any, NamedTuple

import pandas as pd

from safevar_sumo.errors import printable
from safevar_sumo.questions.bars import LEGEND, Bar
from safevar_sumo.questions.changes import NUMBER_PATTERN
from safevar_sumo.shipped import shipped_table
from safevar_sumo.terminal import WholeTable

LOW = "_low"
HIGH = "_high"
"""Ends of the names of two columns that hold the ends of the interval of a third column."""
LONG_TEXT = 60
"""Longer texts stand below a table on the terminal, unless a column of `LEAST_TEXT` has room
[characters].
"""
LEAST_TEXT = 36
MAX_LEAD_ROWS, MAX_LEAD_COLUMNS = 12, 6
"""Size of the table of one screen."""
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
        # LaTeX reads these as arguments of the line before.
        "[": "{[}",
        "]": "{]}",
        "*": "{*}",
        "\\": r"\textbackslash{}",
        "^": r"\textasciicircum{}",
        "~": r"\textasciitilde{}",
    }
)


class Column(NamedTuple):
    """A column of a table: its unit, its meaning, how its numbers are written for readers, whether
    readers see it or JSON and CSV alone have it, its heading, by default its name, and whether one
    screen leaves it to the details.
    """

    unit: str = ""
    meaning: str = ""
    number_format: str = ".4g"
    is_shown: bool = True
    head: str = ""
    is_detail: bool = False


Columns = dict[str, Column | str]
"""Columns by name; a text is the meaning of one without a unit."""
Rows = Sequence[tuple[Any, ...]]
"""The rows of a table."""


class Wide(NamedTuple):
    """How readers see a long table: one for each column of `values`, or pair of columns that hold
    the ends of an interval, in which a row stands for each combination of `labels` and a column for
    each value of `by`, which stands in its `head`.
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
    words
        What readers see in place of the texts that are its keys.
    lead_rows
        The places of the rows that one screen shows, the most important first; by default all.
    shown_whole
        The number of rows up to which one screen shows all of them.
    bars
        A bar for each row.
    """

    frame: pd.DataFrame
    title: str = ""
    columns: Mapping[str, Column] = field(default_factory=dict)
    wide: Wide | None = None
    words: Mapping[str, str] = field(default_factory=dict)
    lead_rows: Sequence[int] = ()
    shown_whole: int = 0
    bars: Sequence[Bar] = ()

    def with_rows(self, frame: pd.DataFrame) -> AnswerTable:
        """The table with other rows."""
        return replace(self, frame=frame)


class Frames(dict[str, pd.DataFrame]):
    """The frames of tables by name; `records` has the tables themselves."""

    def __init__(self, records: Mapping[str, AnswerTable]) -> None:
        super().__init__({name: table.frame for name, table in records.items()})
        self.records = records


def tabulate(
    title: str,
    columns: Mapping[str, Column | str],
    rows: pd.DataFrame | Iterable[Sequence[Any] | dict[str, Any]],
    **layout: Any,
) -> AnswerTable:
    """A table of an answer, whose `layout` are further attributes of `AnswerTable`.

    A column `x` whose interval stands in `x_low` and `x_high` is declared once; `columns` may name
    the ends, too.
    """
    named = {}
    for name, column in columns.items():
        named[name] = Column("", column) if isinstance(column, str) else column
    return AnswerTable(pd.DataFrame(rows, columns=list(named)), title, named, **layout)


def with_interval(name: str, column: Column) -> dict[str, Column]:
    """A column and the two that hold the ends of its interval."""
    low = column._replace(meaning=f"lower end of {name}")
    high = column._replace(meaning=f"upper end of {name}")
    return {name: column, f"{name}{LOW}": low, f"{name}{HIGH}": high}


def columns_from(table: Mapping[str, Any]) -> dict[str, Column]:
    """Columns as a file has them, in order."""
    columns = dict[str, Column]()
    for name, facts in table.items():
        described = {"meaning": facts} if isinstance(facts, str) else dict(facts)
        has_interval = described.pop("interval", False)
        column = Column(**described)
        columns |= with_interval(name, column) if has_interval else {name: column}
    return columns


def shipped_columns(command: str) -> dict[str, dict[str, Column]]:
    """The columns of a command's tables, by table."""
    tables = shipped_table("questions/columns.toml")[command]
    return {name: columns_from(table) for name, table in tables.items()}


def plain(value: Any) -> Any:
    """A value as JSON has it, null where undefined."""
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
    """A value for readers; `-` where undefined."""
    # By the kind of value.
    value = plain(value)
    if value is None:
        return "-"
    if isinstance(value, bool):
        if value:
            return "yes"
        return "no"
    if isinstance(value, float):
        text = f"{value:{number_format}}"
        if "e+" in text:
            return f"{value:,.0f}"
        return text
    texts = []
    if isinstance(value, dict):
        for name, item in value.items():
            texts.append(f"{name} {cell_text(item, number_format)}")
        return ", ".join(texts) or "-"
    if isinstance(value, list):
        for item in value:
            texts.append(cell_text(item, number_format))
        is_interval = len(value) == 2 and not isinstance(value[0], dict)
        return (" to " if is_interval else "; ").join(texts) or "-"
    return str(value)


FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")
"""How cells begin that a spreadsheet calculates."""
SIGNED = re.compile(rf"{NUMBER_PATTERN}|[+-]inf")


def csv_cell(value: Any) -> Any:
    """A value as CSV has it: a list as words, and an apostrophe before a text that a spreadsheet
    would calculate.
    """
    if isinstance(value, list):
        value = " ".join(map(str, value))
    if not isinstance(value, str):
        return value
    if value.startswith(FORMULA_STARTS) and not SIGNED.fullmatch(value):
        value = f"'{value}"
    return printable(value)


def reader_tables(name: str, table: AnswerTable) -> Iterator[tuple[str, AnswerTable]]:
    """The tables that readers see in place of a table, by name: itself, or those that `Wide`
    describes.
    """
    frame = table.frame
    columns = table.columns
    wide = table.wide
    if wide is None or frame.empty:
        yield name, table
        return

    # A table for each value, with a column for each head.
    heads = frame[wide.by].unique()
    for value in wide.values:
        ends = ("",) if value in frame else (LOW, HIGH)
        value_columns = [f"{value}{end}" for end in ends]
        column = columns[value_columns[0]]
        reader_heads = {label: columns[label] for label in wide.labels}
        for head, end in product(heads, ends):
            text = table.words.get(str(head), wide.head.format(head))
            reader_heads[f"{text}{end}"] = column._replace(unit="")

        # A row for each combination of labels.
        rows = []
        for labels, group in frame.groupby(list(wide.labels), sort=False):
            by_head = group.set_index(wide.by)[value_columns].reindex(heads)
            rows.append((*labels, *by_head.to_numpy().ravel()))
        heading = table.title
        if len(wide.values) > 1:
            # A pair of columns differs in the first word: lowest and highest value.
            meanings = [columns[name].meaning.partition(" ") for name in value_columns]
            beginnings, _, endings = zip(*meanings, strict=True)
            heading += f": {' and '.join(beginnings)} {endings[0]}"
        yield (
            f"{name}-{value}",
            tabulate(heading, reader_heads, rows, words=table.words),
        )


class _ReaderColumn(NamedTuple):
    """A column as a reader sees it: columns of the frame, its heading with the unit, its meaning,
    and texts.
    """

    names: list[str]
    head: str
    meaning: str
    texts: list[str]
    is_number: bool

    @property
    def is_long(self) -> bool:
        """Whether its texts are too long for a narrow table."""
        return max(map(len, self.texts), default=0) > LONG_TEXT


def reader_columns(table: AnswerTable) -> Iterator[_ReaderColumn]:
    """The columns of a table for readers: an interval stands behind its value unless that is exact,
    or alone.
    """
    frame = table.frame
    for name in map(str, frame):
        base = re.sub(f"({LOW}|{HIGH})$", "", name)
        column = table.columns[name]
        ends = [f"{base}{LOW}", f"{base}{HIGH}"]
        is_end = base != name
        is_with_value = is_end and (base in frame or name == ends[1])
        if not column.is_shown or is_with_value:
            continue
        values = frame[ends if is_end else [name]]
        # A column that is undefined in every row is left out.
        if len(frame) and values.isna().all(axis=None):
            continue
        head = column.head or base.replace("_", " ")
        if column.unit not in ("", "-") and not column.unit.startswith("as "):
            head += f" [{column.unit}]"
        yield _ReaderColumn(
            list(filter(frame.__contains__, (name, *ends))),
            head,
            column.meaning,
            _texts_of(table, name, ends),
            pd.api.types.is_numeric_dtype(frame[name]),
        )


def _texts_of(table: AnswerTable, name: str, ends: list[str]) -> list[str]:
    """The cells of a column for readers, with the interval between its ends if there is one."""
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
    """The rows and columns of a table that one screen shows: at most so many of the most important
    rows, and no column that says the same in each of them, or nothing.
    """
    rows = table.lead_rows or range(len(table.frame))
    lead = table.frame.iloc[list(rows)[:max_rows]]
    names = list[str]()
    number = 0
    for column in reader_columns(table.with_rows(lead)):
        is_same = len(lead) > 1 and len(set(column.texts)) == 1
        says_something = not is_same and not set(column.texts) <= {"-", "0"}
        is_detail = table.columns[column.names[0]].is_detail
        is_label = not names and len(lead) > 1
        if not is_detail and (is_label or says_something) and number < MAX_LEAD_COLUMNS:
            names += column.names
            number += 1
    return replace(table, frame=lead[list(dict.fromkeys(names))], bars=())


def _interval_text(low: Any, high: Any, number_format: str) -> str:
    """An interval, of which an end may be missing, for readers."""
    texts = cell_text(low, number_format), cell_text(high, number_format)
    if low == high:
        return texts[0]
    forms = {(True, True): "-", (True, False): "up to {1}", (False, True): "from {0}"}
    return forms.get((texts[0] == "-", texts[1] == "-"), "{0} to {1}").format(*texts)


def terminal_tables(table: AnswerTable, width: int) -> Iterator[WholeTable | str]:
    """The table; columns that do not fit stand in further tables, in which the first columns of
    text are repeated, and long texts in lines of their own.
    """
    # Long texts stand below a table.
    all_columns = list(reader_columns(table))
    columns = list[_ReaderColumn]()
    long_columns = list[_ReaderColumn]()
    least_width = 1
    for column in all_columns:
        (long_columns if column.is_long else columns).append(column)
        least_width += max(_least_width(column), LEAST_TEXT * column.is_long)
    title = table.title
    has_numbers = any(column.is_number for column in columns)
    if long_columns and len(columns) < 2 and not has_numbers:
        yield title  # lines say it all
        cells = [column.texts for column in (*columns, *long_columns)]
        for label, *texts in zip(*cells, strict=True):
            yield ": ".join(filter(None, (label, " ".join(filter(None, texts)))))
        return
    if least_width <= width:
        columns = all_columns
        long_columns = []

    # Blocks that fit into the width, each with the labels.
    labels = list(takewhile(lambda column: not column.is_number, columns))
    if 1 + sum(map(_least_width, labels)) > width:
        labels = labels[:1]
    blocks = [list(labels)]
    for column in columns[len(labels) :]:
        block_width = 1 + sum(map(_least_width, [*blocks[-1], column]))
        if len(blocks[-1]) > len(labels) and block_width > width:
            blocks.append(list(labels))
        blocks[-1].append(column)

    # Bars, blocks, and long texts.
    bars = [bar.blocks for bar in table.bars]
    if bars and columns:
        yield WholeTable(
            title,
            [(labels[0].head, False, labels[0].texts), (LEGEND["text"], False, bars)],
        )
        title = ""
    for block in filter(None, blocks):
        heads_and_texts = [(item.head, item.is_number, item.texts) for item in block]
        yield WholeTable(title, heads_and_texts)
        title = ""
    for column in long_columns:
        for label, text in zip(columns[0].texts, column.texts, strict=True):
            yield f"{label}: {text}"


def _least_width(column: _ReaderColumn) -> int:
    """The width of a column whose words are whole, with a line beside it [characters]."""
    words = " ".join([column.head, *column.texts]).split()
    return 1 + max(map(len, words), default=0)


def html_table(table: AnswerTable) -> str:
    """A table with a caption, in which a screen reader finds the headings; texts have the class
    `label`.
    """
    # Heads and cells, with the head that a phone shows beside each cell.
    heads = ""
    rows = [""] * len(table.frame)
    for column in reader_columns(table):
        css = "" if column.is_number else ' class="label"'
        head = escape(column.head)
        heads += f'<th scope="col"{css} title="{escape(column.meaning)}">{head}</th>'
        for row, text in enumerate(column.texts):
            rows[row] += f'<td{css} data-head="{head}">{escape(text)}</td>'

    # Bars in a column of their own.
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
    """A booktabs table that fits into the line."""
    # Cells and columns by kind.
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
