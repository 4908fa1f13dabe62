"""Answers in every format: tables as text, Markdown and LaTeX, and frames as CSV and JSON."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain

from safevar_sumo.questions.research_questions.answer import TableAnswer
from safevar_sumo.questions.research_questions.tables import BoldText, Table, lay_out

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


def as_text(answers: Sequence[TableAnswer]) -> str:
    """Text for a terminal: aligned columns, bold cells with an asterisk."""
    texts = []
    for table in chain.from_iterable(map(lay_out, answers)):
        frame = table.frame.rename(lambda label: f"{label}*" if isinstance(label, BoldText) else label)
        cells = frame.map(lambda cell: f"{cell}*" if isinstance(cell, BoldText) else f"{cell} ")
        body = [] if cells.empty else [re.sub(" +$", "", cells.to_string(), flags=re.MULTILINE), ""]
        texts.append("\n".join([table.title, "", *body, *table.notes, ""]))
    return "\n".join(texts)


def as_markdown(answers: Sequence[TableAnswer]) -> str:
    """Markdown tables; a heading over several columns is repeated in each column's heading."""
    texts = []
    for table in chain.from_iterable(map(lay_out, answers)):
        frame, body = table.frame, []
        if not frame.empty:
            columns = frame.columns
            if columns.nlevels > 1:
                has_one_heading = len(columns.unique(0)) == 1
                columns = columns.get_level_values(1) if has_one_heading else columns.map(": ".join)
            rows = [[*frame.index.names, *map(str, columns)], *frame.reset_index().to_numpy().tolist()]
            body = [markdown_table(rows, frame.index.nlevels), ""]
        notes = (f"{_escaped_for_markdown(note)}  " for note in table.notes)
        texts.append("\n".join([f"**{_escaped_for_markdown(table.title)}**", "", *body, *notes, ""]))
    return "\n".join(texts)


def markdown_table(rows: Iterable[Sequence[str]], label_count: int) -> str:
    """A Markdown table of texts; all columns but the first `label_count` are aligned to the right."""
    head, *lines = [
        [
            f"**{_escaped_for_markdown(cell)}**" if isinstance(cell, BoldText) else _escaped_for_markdown(cell)
            for cell in cells
        ]
        for cells in rows
    ]
    rule = [":---" if i < label_count else "---:" for i in range(len(head))]
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, rule, *lines))


def _escaped_for_markdown(source: str) -> str:
    return re.sub(r"([\\`*_|<>\[\]~^#$])", r"\\\1", source.replace("\n", " "))


def as_latex(answers: Sequence[TableAnswer]) -> str:
    r"""Booktabs tables for `\input`, each with a label: `tab:rq1`, and `tab:rq1-2` for an answer's second table."""
    numbered = ((answer.name, i, table) for answer in answers for i, table in enumerate(lay_out(answer), 1))
    tables = [render_latex(table, f"{name}-{i}" if i > 1 else name) for name, i, table in numbered]
    return "\n".join([LATEX_NEEDS, *tables])


def render_latex(table: Table, label: str) -> str:
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


def as_csv(answers: Sequence[TableAnswer]) -> str:
    """The tidy frame as CSV; several frames are separated by empty lines, and each follows a line with its name."""
    tables = []
    for name, frame, *_ in answers:
        if "characteristics" in frame:
            frame = frame.assign(characteristics=frame["characteristics"].map(" ".join))
        title_line = f"# {name}\n" if len(answers) > 1 else ""
        tables.append(title_line + ("" if frame.empty else frame.to_csv(index=False, lineterminator="\n")))
    return "\n".join(tables)


def as_json(answers: Sequence[TableAnswer]) -> str:
    """One list of records; with several tables, each record names its "table".

    Undefined values are null; only `rank`, which rq3.2 has just in its rows j = any, is left out of all other rows.
    """
    rows = []
    for name, frame, *_ in answers:
        table_key = {"table": name} if len(answers) > 1 else {}
        for row in frame.astype(object).where(frame.notna(), None).to_dict("records"):
            present = {str(key): value for key, value in row.items() if key != "rank" or value is not None}
            rows.append(table_key | present)
    return json.dumps(rows, indent=2, allow_nan=False) + "\n"


FORMATS: Mapping[str, Callable[[Sequence[TableAnswer]], str]] = {
    "text": as_text,
    "markdown": as_markdown,
    "latex": as_latex,
    "csv": as_csv,
    "json": as_json,
}
ENDINGS = {"text": "txt", "markdown": "md", "latex": "tex", "csv": "csv", "json": "json"}
