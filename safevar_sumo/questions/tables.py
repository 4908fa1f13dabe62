"""The tables of answers: frames with units and meanings, and how readers see them as text, HTML and
LaTeX.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from itertools import takewhile
from typing import Any, NamedTuple

import pandas as pd

from safevar_sumo.errors import printable
from safevar_sumo.questions.bars import LEGEND
from safevar_sumo.questions.changes import NUMBER_PATTERN
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
LATEX_PREAMBLE = "% In the preamble: " + " ".join(
    rf"\usepackage{name}"
    for name in ("[T1]{fontenc}", "{textcomp}", "{booktabs}", "{graphicx}")
)
FIT_BEGIN = "\\resizebox{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}{!}{%\n"
LATEX_CODES = str.maketrans(
    {
        **{character: "\\" + character for character in "{}$&#%_"},
        **{
            character: f"{{{character}}}" for character in "[]*"
        },  # LaTeX reads these as arguments of the line before
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

    unit: str
    meaning: str
    number_format: str = ".4g"
    is_shown: bool = True
    head: str = ""
    is_detail: bool = False


Columns = dict[str, Column | str]
"""Columns by name; a text is the meaning of one without a unit."""
Rows = Sequence[tuple[Any, ...]]
"""The rows of a table."""
Frames = dict[str, pd.DataFrame]
"""Tables by name."""


class Wide(NamedTuple):
    """How readers see a long table: one for each column of `values`, or pair of columns that hold
    the ends of an interval, in which a row stands for each combination of `labels` and a column for
    each value of `by`, which stands in its `head`.
    """

    labels: Sequence[str]
    by: str
    values: Sequence[str]
    head: str = "{}"


def tabulate(
    title: str,
    columns: Mapping[str, Column | str],
    rows: pd.DataFrame | Iterable[Sequence[Any] | dict[str, Any]],
    *,
    wide: Wide | None = None,
    words: Mapping[str, str] | None = None,
) -> pd.DataFrame:
    """A table of an answer: a frame whose `attrs` hold its title and its columns' units and
    meanings.

    A column `x` whose interval stands in `x_low` and `x_high` is declared once; `columns` may name
    the ends, too. Readers see the `words` in place of the texts that are their keys.
    """
    named = {
        name: Column("", column) if isinstance(column, str) else column
        for name, column in columns.items()
    }
    frame = pd.DataFrame(rows, columns=[*named])
    frame.attrs = {"title": title, "columns": named, "wide": wide, "words": words or {}}
    return frame


def with_interval(name: str, column: Column) -> dict[str, Column]:
    """A column and the two that hold the ends of its interval."""
    low = column._replace(meaning=f"lower end of {name}")
    high = column._replace(meaning=f"upper end of {name}")
    return {name: column, f"{name}{LOW}": low, f"{name}{HIGH}": high}


def columns_of(frame: pd.DataFrame) -> dict[str, Column]:
    return dict(frame.attrs.get("columns", {}))


def plain(value: Any) -> Any:
    """A value as JSON has it, null where undefined."""
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if hasattr(value, "item"):
        value = value.item()
    is_undefined = value is pd.NA or (
        isinstance(value, float) and not math.isfinite(value)
    )
    return None if is_undefined else value


def cell_text(value: Any, number_format: str = ".4g") -> str:
    """A value for readers; `-` where undefined."""
    # By the kind of value.
    value = plain(value)
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        text = f"{value:{number_format}}"
        return f"{value:,.0f}" if "e+" in text else text
    if isinstance(value, dict):
        return (
            ", ".join(
                f"{name} {cell_text(inner, number_format)}"
                for name, inner in value.items()
            )
            or "-"
        )
    if isinstance(value, list):
        is_interval = len(value) == 2 and not isinstance(value[0], dict)
        separator = " to " if is_interval else "; "
        return separator.join(cell_text(inner, number_format) for inner in value) or "-"
    return str(value)


FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")
"""How cells begin that a spreadsheet calculates."""
SIGNED = re.compile(rf"{NUMBER_PATTERN}|[+-]inf")


def csv_cell(value: Any) -> Any:
    """A value as CSV has it: a list as words, and an apostrophe before a text that a spreadsheet
    would calculate.
    """
    value = " ".join(map(str, value)) if isinstance(value, list) else value
    if not isinstance(value, str):
        return value
    is_formula = value.startswith(FORMULA_STARTS) and not SIGNED.fullmatch(value)
    return printable(f"'{value}" if is_formula else value)


def reader_tables(name: str, frame: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """The tables that readers see in place of a frame, by name: itself, or those that `Wide`
    describes.
    """
    wide = frame.attrs.get("wide")
    columns = columns_of(frame)
    if wide is None or frame.empty:
        yield name, frame
        return

    # A table for each value, with a column for each head.
    heads = frame[wide.by].unique()
    title = frame.attrs["title"]
    words = frame.attrs["words"]
    names = [words.get(str(head), wide.head.format(head)) for head in heads]
    for value in wide.values:
        ends = ("",) if value in frame else (LOW, HIGH)
        of_value = [f"{value}{end}" for end in ends]
        column = columns[of_value[0]]
        shown = {label: columns[label] for label in wide.labels}
        shown |= {
            f"{name}{end}": column._replace(unit="") for name in names for end in ends
        }

        # A row for each combination of labels.
        rows = []
        for labels, group in frame.groupby([*wide.labels], sort=False):
            by_head = group.set_index(wide.by)[of_value].reindex(heads)
            rows.append((*labels, *by_head.to_numpy().ravel()))
        heading = (
            title
            if len(wide.values) == 1
            else f"{title}: {_meaning_of([columns[end] for end in of_value])}"
        )
        yield f"{name}-{value}", tabulate(heading, shown, rows, words=words)


def _meaning_of(ends: Sequence[Column]) -> str:
    """What a column means, or a pair of them that differ in the first word: `lowest and highest
    value`.
    """
    firsts = [column.meaning.partition(" ")[0] for column in ends]
    return f"{' and '.join(firsts)} {ends[0].meaning.partition(' ')[2]}"


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


def reader_columns(frame: pd.DataFrame) -> Iterator[_ReaderColumn]:
    """The columns of a table for readers: an interval stands behind its value unless that is exact,
    or alone.
    """
    columns = columns_of(frame)
    words = frame.attrs.get("words", {})
    for name in map(str, frame):
        base = re.sub(f"({LOW}|{HIGH})$", "", name)
        column = columns.get(name, Column("", ""))
        ends = [f"{base}{LOW}", f"{base}{HIGH}"]
        is_end = base != name
        is_with_value = is_end and (base in frame or name == ends[1])
        if not column.is_shown or is_with_value:
            continue
        of_column = ends if is_end else [name]
        if len(frame) and frame[of_column].isna().all(
            axis=None
        ):  # undefined in every row
            continue
        texts = [cell_text(value, column.number_format) for value in frame[name]]
        texts = [words.get(text, text) for text in texts]
        if ends[0] in frame:
            pairs = frame[ends].itertuples(index=False)
            intervals = [
                _interval_text(low, high, column.number_format) for low, high in pairs
            ]
            if is_end:
                texts = intervals
            else:
                behind = zip(
                    texts, intervals, frame[ends[0]] == frame[ends[1]], strict=True
                )
                texts = [
                    text if exact or text == "-" else f"{text} ({interval})"
                    for text, interval, exact in behind
                ]
        has_unit = column.unit not in ("", "-") and not column.unit.startswith("as ")
        unit = f" [{column.unit}]" if has_unit else ""
        is_number = pd.api.types.is_numeric_dtype(frame[name])
        yield _ReaderColumn(
            [each for each in (name, *ends) if each in frame],
            f"{column.head or base.replace('_', ' ')}{unit}",
            column.meaning,
            texts,
            is_number,
        )


def lead_table(frame: pd.DataFrame, max_rows: int) -> pd.DataFrame:
    """The rows and columns of a table that one screen shows: at most so many of the most important
    rows, and no column that says the same in each of them, or nothing.
    """
    rows = frame.attrs.get("lead_rows", range(len(frame)))
    lead = frame.iloc[[*rows][:max_rows]]
    declared = columns_of(frame)
    kept = list[str]()
    shown = 0
    for column in reader_columns(lead):
        is_same = len(lead) > 1 and len(set(column.texts)) == 1
        says_something = not is_same and not set(column.texts) <= {"-", "0"}
        is_detail = declared.get(column.names[0], Column("", "")).is_detail
        is_label = not kept and len(lead) > 1
        if not is_detail and (is_label or says_something) and shown < MAX_LEAD_COLUMNS:
            kept += column.names
            shown += 1
    lead = lead[list(dict.fromkeys(kept))]
    lead.attrs = {name: value for name, value in frame.attrs.items() if name != "bars"}
    return lead


def _interval_text(low: Any, high: Any, number_format: str) -> str:
    """An interval, of which an end may be missing, for readers."""
    texts = cell_text(low, number_format), cell_text(high, number_format)
    if low == high:
        return texts[0]
    forms = {(True, True): "-", (True, False): "up to {1}", (False, True): "from {0}"}
    return forms.get((texts[0] == "-", texts[1] == "-"), "{0} to {1}").format(*texts)


def terminal_tables(frame: pd.DataFrame, width: int) -> Iterator[WholeTable | str]:
    """The table; columns that do not fit stand in further tables, in which the first columns of
    text are repeated, and long texts in lines of their own.
    """
    # Long texts stand below a table.
    every = list(reader_columns(frame))
    long = [column for column in every if column.is_long]
    columns = [column for column in every if not column.is_long]
    if long and not any(column.is_number for column in columns) and len(columns) < 2:
        yield frame.attrs.get("title", "")  # lines say it all
        for first, *others in zip(
            *(column.texts for column in (*columns, *long)), strict=True
        ):
            yield ": ".join(filter(None, (first, " ".join(filter(None, others)))))
        return
    if (
        1
        + sum(
            max(_least_width(column), LEAST_TEXT * column.is_long) for column in every
        )
        <= width
    ):
        columns = every
        long = []

    # Blocks that fit into the width, each with the labels.
    labels = list(takewhile(lambda column: not column.is_number, columns))
    if 1 + sum(map(_least_width, labels)) > width:
        labels = labels[:1]
    blocks = [[*labels]]
    for column in columns[len(labels) :]:
        if (
            len(blocks[-1]) > len(labels)
            and 1 + sum(map(_least_width, [*blocks[-1], column])) > width
        ):
            blocks.append([*labels])
        blocks[-1].append(column)

    # Bars, blocks, and long texts.
    bars = [bar.blocks for bar in frame.attrs.get("bars", ())]
    if bars and columns:
        yield WholeTable(
            frame.attrs["title"],
            [(labels[0].head, False, labels[0].texts), (LEGEND["text"], False, bars)],
        )
    for number, block in enumerate(filter(None, blocks)):
        title = "" if number or bars else frame.attrs.get("title", "")
        yield WholeTable(
            title, [(column.head, column.is_number, column.texts) for column in block]
        )
    for column in long:
        yield from (
            f"{label}: {text}"
            for label, text in zip(columns[0].texts, column.texts, strict=True)
        )


def _least_width(column: _ReaderColumn) -> int:
    """The width of a column whose words are whole, with a line beside it [characters]."""
    return 1 + max(
        len(word)
        for text in (column.head, *column.texts)
        for word in text.split() or [""]
    )


def html_table(frame: pd.DataFrame) -> str:
    """A table with a caption, in which a screen reader finds the headings; texts have the class
    `label`.
    """
    # Heads and cells, with the head that a phone shows beside each cell.
    columns = list(reader_columns(frame))
    classes = ["" if column.is_number else ' class="label"' for column in columns]
    heads = "".join(
        f'<th scope="col"{css} title="{escape(column.meaning)}">{escape(column.head)}</th>'
        for css, column in zip(classes, columns, strict=True)
    )
    names = [f' data-head="{escape(column.head)}"' for column in columns]
    rows = [
        "".join(
            f"<td{css}{name}>{escape(cell)}</td>"
            for css, name, cell in zip(classes, names, cells, strict=True)
        )
        for cells in zip(*(column.texts for column in columns), strict=True)
    ]

    # Bars in a column of their own.
    title = escape(frame.attrs.get("title", ""))
    if bars := frame.attrs.get("bars"):
        heads = (
            f'<th scope="col" class="label" title="{LEGEND["html"]}">range</th>{heads}'
        )
        rows = [
            f'<td class="label" data-head="range">{bar.svg}</td>{row}'
            for bar, row in zip(bars, rows, strict=True)
        ]
    body = "\n".join(f"<tr>{row}</tr>" for row in rows)
    legend = f" <small>({LEGEND['html']})</small>" if bars else ""
    table = (
        f"<table><caption>{title}{legend}</caption><thead><tr>{heads}</tr></thead>"
        f"<tbody>\n{body}\n</tbody></table>"
    )
    return (
        f'<div class="wide" role="region" tabindex="0" aria-label="{title}">{table}</div>'
        if body
        else ""
    )


def latex_table(label: str, frame: pd.DataFrame) -> str:
    """A booktabs table that fits into the line."""
    # Cells and columns by kind.
    readable = pd.DataFrame(
        {column.head: column.texts for column in reader_columns(frame)}
    )
    style = (
        readable.style.hide()
        .format(_escaped_for_latex)
        .format_index(_escaped_for_latex, axis=1)
    )
    kinds = (
        "r" if column.is_number else "p{6cm}" if column.is_long else "l"
        for column in reader_columns(frame)
    )
    alignment = "".join(kinds)
    caption = _escaped_for_latex(frame.attrs.get("title", ""))
    table = style.to_latex(
        hrules=True,
        column_format=alignment,
        caption=caption,
        label=f"tab:{label}",
        position="htbp",
    )
    return table.replace(r"\begin{tabular}", FIT_BEGIN + r"\begin{tabular}").replace(
        r"\end{tabular}", r"\end{tabular}}"
    )


def latex_notes(frame: pd.DataFrame) -> str:
    """A table of texts as small paragraphs, its last column alone."""
    texts = [_escaped_for_latex(text) for text in frame.iloc[:, -1]]
    return "".join(f"\\noindent{{\\footnotesize {text}\\par}}\n" for text in texts)


def _escaped_for_latex(text: object) -> str:
    """Plain text as LaTeX, with superscripts and minus signs."""
    escaped = re.sub(
        r"\\textasciicircum\{\}(-?\d+)",
        r"\\textsuperscript{\1}",
        str(text).translate(LATEX_CODES),
    )
    return re.sub(r"(?<![\w)-])-(?=\.?\d)", r"\\textminus{}", escaped)
