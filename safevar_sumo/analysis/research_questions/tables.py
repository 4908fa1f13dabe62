"""Answers as text, Markdown, LaTeX, CSV and JSON."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from safevar_sumo.analysis.research_questions.answer import Answer
from safevar_sumo.analysis.research_questions.layout import LAYOUTS, BoldText, Layouts, Table, lay_out

LATEX_NEEDS = "% In the preamble: " + " ".join(
    rf"\usepackage{name}" for name in ("[T1]{fontenc}", "{textcomp}", "{booktabs}", "{graphicx}")
)
_LATEX_CODES = str.maketrans(
    {
        **{character: "\\" + character for character in "{}$&#%_"},
        **{character: f"{{{character}}}" for character in "[]*"},  # LaTeX reads these as arguments of the line before
        "\\": r"\textbackslash{}",
        "^": r"\textasciicircum{}",
        "~": r"\textasciitilde{}",
    }
)


def as_text(answers: Sequence[Answer], layouts: Layouts = LAYOUTS) -> str:
    """Text for a terminal: aligned columns, bold cells with an asterisk."""
    texts = []
    for table in (table for answer in answers for table in lay_out(answer, layouts)):
        cells = table.frame.map(lambda cell: f"{cell}*" if isinstance(cell, BoldText) else f"{cell} ")
        body = [] if cells.empty else ["\n".join(line.rstrip() for line in cells.to_string().splitlines()), ""]
        texts.append("\n".join([table.title, "", *body, *table.notes, ""]))
    return "\n".join(texts)


def as_markdown(answers: Sequence[Answer], layouts: Layouts = LAYOUTS) -> str:
    """Markdown tables; a heading over several columns is repeated in each column's heading."""
    texts = []
    for table in (table for answer in answers for table in lay_out(answer, layouts)):
        body = (
            []
            if table.frame.empty
            else [
                markdown_table(
                    table.headings(), table.frame.reset_index().to_numpy().tolist(), table.frame.index.nlevels
                ),
                "",
            ]
        )
        texts.append(
            "\n".join(
                [f"**{_markdown(table.title)}**", "", *body, *(f"{_markdown(note)}  " for note in table.notes), ""]
            )
        )
    return "\n".join(texts)


def markdown_table(headings: Sequence[str], rows: Iterable[Sequence[str]], label_count: int) -> str:
    """A Markdown table of texts; all columns but the first `label_count` are aligned to the right."""
    rule = [":---" if i < label_count else "---:" for i in range(len(headings))]
    lines = [
        rule
        if cells is rule
        else [f"**{_markdown(cell)}**" if isinstance(cell, BoldText) else _markdown(cell) for cell in cells]
        for cells in (headings, rule, *rows)
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _markdown(source: str) -> str:
    return re.sub(r"([\\`*_|<>\[\]~^#$])", r"\\\1", source.replace("\n", " "))


def as_latex(answers: Sequence[Answer], layouts: Layouts = LAYOUTS) -> str:
    r"""Booktabs tables for `\input`, each with a label: `tab:rq1`, and `tab:rq1-2` for an answer's second table."""
    tables = [
        _render_latex(table, f"{answer.name}-{i}" if i > 1 else answer.name)
        for answer in answers
        for i, table in enumerate(lay_out(answer, layouts), 1)
    ]
    return "\n".join([LATEX_NEEDS, *tables])


def _render_latex(table: Table, label: str) -> str:
    lines = [
        r"\begin{table}[htbp]",
        r"\centering",
        rf"\caption{{{escaped_for_latex(table.title)}}}",
        rf"\label{{tab:{label}}}",
    ]
    if not table.frame.empty:
        style = table.frame.style.format(_latex_cell)
        style = style.format_index(_latex_cell, axis=0).format_index(_latex_cell, axis=1)
        alignment = "l" * table.frame.index.nlevels + "r" * len(table.frame.columns)
        lines += [
            r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
            style.to_latex(hrules=True, sparse_index=False, multicol_align="c", column_format=alignment).rstrip() + "%",
            "}",
        ]
    notes = " ".join(map(escaped_for_latex, table.notes))
    lines += [rf"\par\smallskip{{\footnotesize {notes}\par}}"] if notes else []
    return "\n".join([*lines, r"\end{table}", ""])


def _latex_cell(cell: object) -> str:
    return rf"\textbf{{{escaped_for_latex(cell)}}}" if isinstance(cell, BoldText) else escaped_for_latex(str(cell))


def escaped_for_latex(source: str) -> str:
    """Plain text as LaTeX, with superscripts and minus signs."""
    escaped = re.sub(r"\\textasciicircum\{\}(-?\d+)", r"\\textsuperscript{\1}", source.translate(_LATEX_CODES))
    return re.sub(r"(?<![\w)-])-(?=\.?\d)", r"\\textminus{}", escaped)


def as_csv(answers: Sequence[Answer]) -> str:
    """The tidy frame as CSV; several frames are separated by empty lines, and each follows a line with its name."""
    tables = []
    for answer in answers:
        frame = answer.frame
        if "characteristics" in frame:
            frame = frame.assign(characteristics=frame["characteristics"].map(" ".join))
        title_line = f"# {answer.name}\n" if len(answers) > 1 else ""
        tables.append(title_line + ("" if frame.empty else frame.to_csv(index=False, lineterminator="\n")))
    return "\n".join(tables)


def as_json(answers: Sequence[Answer]) -> str:
    """One list of records; undefined values are null, a missing rank has no key; with several tables, each record names
    its "table".
    """
    rows: list[dict[Any, Any]] = []
    for answer in answers:
        frame = answer.frame.astype(object).where(answer.frame.notna(), None)
        table_key = {"table": answer.name} if len(answers) > 1 else {}
        rows += [
            table_key | {name: value for name, value in row.items() if name != "rank" or value is not None}
            for row in frame.to_dict("records")
        ]
    return json.dumps(rows, indent=2, allow_nan=False) + "\n"


FORMATS_WITH_LAYOUT: Mapping[str, Callable[..., str]] = {"text": as_text, "markdown": as_markdown, "latex": as_latex}
"""Formats for human readers, whose functions take a layout; the other formats hold the frames."""
FORMATS: Mapping[str, Callable[..., str]] = {**FORMATS_WITH_LAYOUT, "csv": as_csv, "json": as_json}
ENDINGS = {"text": "txt", "markdown": "md", "latex": "tex", "csv": "csv", "json": "json"}
