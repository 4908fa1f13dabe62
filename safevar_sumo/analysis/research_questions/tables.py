"""Answers as text, Markdown, LaTeX, CSV and JSON."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from typing import Any

import pandas as pd

from safevar_sumo.analysis.research_questions.answer import Answer
from safevar_sumo.analysis.research_questions.layout import LAYOUTS, PAPER_LAYOUTS, BoldText, Layouts, Table, lay_out

MINUS = "\N{MINUS SIGN}"
_LATEX_CODES = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "%": r"\%", "_": r"\_",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}", "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", "[": "{[}", "]": "{]}", "*": "{*}",
    '"': r"\textquotedbl{}", "'": r"\textquotesingle{}", "`": r"\textasciigrave{}",
    "\N{DEGREE SIGN}": r"\textdegree{}", "\N{MICRO SIGN}": r"\textmu{}", "\N{GREEK SMALL LETTER MU}": r"\textmu{}",
    "\N{SUPERSCRIPT TWO}": r"\textsuperscript{2}", "\N{SUPERSCRIPT THREE}": r"\textsuperscript{3}",
    "\N{MIDDLE DOT}": r"\textperiodcentered{}", MINUS: r"\textminus{}"}
"""LaTeX code for LaTeX's special characters, and for some characters that occur in units."""
_LAST_LETTER = "\N{LATIN SMALL LETTER Z WITH CARON}"
"""Last letter of the range that LaTeX's T1 fonts cover almost completely."""
LATEX_NEEDS = r"% In the preamble: \usepackage[T1]{fontenc} \usepackage{textcomp} \usepackage{booktabs} \usepackage{graphicx}"


def as_text(answers: Sequence[Answer], layouts: Layouts = LAYOUTS) -> str:
    """Text for a terminal: aligned columns, bold cells with an asterisk."""
    return "\n".join(_render_text(table) for answer in answers for table in lay_out(answer, layouts))


def as_markdown(answers: Sequence[Answer], layouts: Layouts = LAYOUTS) -> str:
    """Markdown tables; a heading that spans several columns is repeated in each column's heading."""
    return "\n".join(_render_markdown(table) for answer in answers for table in lay_out(answer, layouts))


def as_latex(answers: Sequence[Answer], layouts: Layouts = LAYOUTS) -> str:
    r"""Booktabs tables for `\input`, each with a label: `tab:rq1`, and `tab:rq1-2` for an answer's second table."""
    tables = [_render_latex(table, f"{answer.name}-{i}" if i > 1 else answer.name)
              for answer in answers for i, table in enumerate(lay_out(answer, layouts), 1)]
    return "\n".join([LATEX_NEEDS, *tables])


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
    """One list of records; with several tables, each record names its table under "table"."""
    has_several = len(answers) > 1
    rows = [{"table": answer.name, **row} if has_several else row for answer in answers for row in plain_records(answer.frame)]
    return json.dumps(rows, indent=2, allow_nan=False) + "\n"


def plain_records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of a frame as plain values; undefined values are None, and a missing rank has no key."""
    rows = [{str(name): _plain_value(value) for name, value in row.items()} for row in frame.to_dict("records")]
    return [{name: value for name, value in row.items() if not (name == "rank" and value is None)} for row in rows]


LAYOUTS_BY_NAME: Mapping[str, Layouts] = {"full": LAYOUTS, "paper": PAPER_LAYOUTS}
FORMATS_WITH_LAYOUT: Mapping[str, Callable[..., str]] = {"text": as_text, "markdown": as_markdown, "latex": as_latex}
"""Formats for human readers, whose functions take a layout; the other formats hold the frames."""
FORMATS: Mapping[str, Callable[..., str]] = {**FORMATS_WITH_LAYOUT, "csv": as_csv, "json": as_json}
ENDINGS = {"text": "txt", "markdown": "md", "latex": "tex", "csv": "csv", "json": "json"}


def _render_text(table: Table) -> str:
    rows = [tuple(f"{cell}*" if isinstance(cell, BoldText) else f"{cell} " if i >= table.label_count else cell
                  for i, cell in enumerate(row)) for row in table.rows]
    headings = tuple(f"{heading} " if i >= table.label_count else heading for i, heading in enumerate(table.headings))
    widths = [max(len(cell) for cell in column) for column in zip(headings, *rows, strict=True)]
    for (span, width), start in zip(table.spans, _span_starts(table), strict=True):
        extra_width = len(span) - (sum(widths[start:start + width]) + 2 * (width - 1))
        widths[start] += max(extra_width, 0)
    lines = [table.title, ""]
    if table.spans:
        blocks = [" " * (sum(widths[:table.label_count]) + 2 * (table.label_count - 1))]
        blocks += [span.center(sum(widths[start:start + width]) + 2 * (width - 1), " ")
                   for (span, width), start in zip(table.spans, _span_starts(table), strict=True)]
        lines.append("  ".join(blocks).rstrip())
    if headings:
        lines += [_align_cells(headings, widths, table.label_count), "-" * (sum(widths) + 2 * (len(widths) - 1))]
    lines += [_align_cells(row, widths, table.label_count) for row in rows]
    return "\n".join([*lines, *([""] if headings and table.notes else []), *table.notes, ""])


def _align_cells(cells: Sequence[str], widths: Sequence[int], label_count: int) -> str:
    return "  ".join(cell.ljust(width) if i < label_count else cell.rjust(width)
                     for i, (cell, width) in enumerate(zip(cells, widths, strict=True))).rstrip()


def _render_markdown(table: Table) -> str:
    headings = list(table.headings)
    for (span, width), start in zip(table.spans, _span_starts(table), strict=True):
        if len(table.spans) > 1 or headings[start] in table.spans[0][0]:
            headings[start:start + width] = [f"{span}: {heading}" for heading in headings[start:start + width]]
    lines = [f"**{_escaped_for_markdown(table.title)}**", ""]
    if headings:
        rule = [":---" if i < table.label_count else "---:" for i in range(len(headings))]
        cells = [[f"**{_escaped_for_markdown(cell)}**" if isinstance(cell, BoldText) else _escaped_for_markdown(cell) for cell in row]
                 for row in table.rows]
        lines += [f"| {' | '.join(row)} |" for row in ([_escaped_for_markdown(heading) for heading in headings], rule, *cells)] + [""]
    return "\n".join([*lines, *(f"{_escaped_for_markdown(note)}  " for note in table.notes), ""])


def _escaped_for_markdown(source: str) -> str:
    """Plain text as Markdown, with Markdown's special characters escaped."""
    return re.sub(r"([\\`*_|<>\[\]~^#$])", r"\\\1", source.replace("\n", " "))


def _render_latex(table: Table, label: str) -> str:
    lines = [r"\begin{table}[htbp]", r"\centering", rf"\caption{{{escaped_for_latex(table.title)}}}", rf"\label{{tab:{label}}}"]
    if table.headings:
        lines += [r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%", *_render_tabular(table), "}"]
    lines += [rf"\par\smallskip{{\footnotesize {' '.join(escaped_for_latex(note) for note in table.notes)}\par}}"] if table.notes else []
    return "\n".join([*lines, r"\end{table}", ""])


def _render_tabular(table: Table) -> list[str]:
    columns = "l" * table.label_count + "r" * (len(table.headings) - table.label_count)
    lines = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule"]
    if table.spans:
        spans = [rf"\multicolumn{{{width}}}{{c}}{{{escaped_for_latex(span)}}}" for span, width in table.spans]
        rules = [rf"\cmidrule(lr){{{start + 1}-{start + width}}}"
                 for (_, width), start in zip(table.spans, _span_starts(table), strict=True)]
        lines += [" & ".join([""] * table.label_count + spans).strip() + r" \\", "".join(rules)]
    lines += [" & ".join(escaped_for_latex(heading) for heading in table.headings) + r" \\", r"\midrule"]
    cells = [[rf"\textbf{{{escaped_for_latex(cell)}}}" if isinstance(cell, BoldText) else escaped_for_latex(cell) for cell in row]
             for row in table.rows]
    lines += [" & ".join(row) + r" \\" for row in cells]
    return [*lines, r"\bottomrule", r"\end{tabular}%"]


def escaped_for_latex(source: str) -> str:
    """Plain text as LaTeX; a character that LaTeX's fonts may lack becomes its code point."""
    pieces = re.split(r"\^(-?\d+)", re.sub(r"(?<![\w)^-])-(?=\.?\d)", MINUS, " ".join(source.split())))
    escaped = ["".join(map(_escaped_character, piece.replace("-", MINUS) if i % 2 else piece)) for i, piece in enumerate(pieces)]
    return "".join(rf"\textsuperscript{{{piece}}}" if i % 2 else piece for i, piece in enumerate(escaped)).replace("--", "-{}-")


def _escaped_character(character: str) -> str:
    if character in _LATEX_CODES:
        return _LATEX_CODES[character]
    is_plain = character.isascii() or (character.isalpha() and character <= _LAST_LETTER)
    return character if is_plain else f"U+{ord(character):04X}"


def _span_starts(table: Table) -> list[int]:
    """The first column under each spanning heading."""
    return [table.label_count + offset for offset in accumulate([width for _, width in table.spans[:-1]], initial=0)] if table.spans else []


def _plain_value(value: Any) -> Any:
    if isinstance(value, list | str) or value is None:
        return value
    if pd.isna(value):
        return None
    return value.item() if hasattr(value, "item") else value
