"""Renders every answer. As text and HTML, an answer is one screen, or all details. JSON has
everything; CSV has one table.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import replace
from html import escape
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import pandas as pd
from rich.console import Console

from safevar_sumo.errors import printable
from safevar_sumo.questions.sentence import Verdict
from safevar_sumo.questions.tables import (
    LATEX_PREAMBLE,
    MAX_LEAD_ROWS,
    AnswerTable,
    AnswerTables,
    csv_cell,
    html_table,
    latex_notes,
    latex_table,
    lead_table,
    reader_tables,
    terminal_tables,
)
from safevar_sumo.questions.words import number_of
from safevar_sumo.records import csv_text
from safevar_sumo.terminal import print_text

if TYPE_CHECKING:
    from safevar_sumo.questions.answer import Answer

Form = Literal["text", "json", "csv", "latex", "html"]
MAX_SENTENCES = 5
"""Largest number of sentences of the verdict on one screen."""
CODE = re.compile("`([^`<>]+)`")
"""A part of a text that is quoted as code."""
MAX_ROWS = 200
"""Largest number of rows of a table that readers see. JSON and CSV have longer tables, too."""
MAX_LINES = 30
"""Largest number of lines of one screen."""
WIDTH = 100
"""Width of a text that is not printed to a terminal [characters]."""


class Screen(NamedTuple):
    """The one screen of an answer, and the tables that this screen leaves out.

    Attributes
    ----------
    sentences
        The first sentences of the verdict.
    unsaid
        Number of further sentences of the verdict.
    lead
        The only table on the screen; empty if there is none.
    notes
        Sentences below the table: what the answer is valid for, how it was tested, and remarks.
    tables
        All other tables by name.
    """

    sentences: list[str]
    unsaid: int
    lead: AnswerTable
    notes: list[str]
    tables: AnswerTables


def screen_of(answer: Answer, max_rows: int = MAX_LEAD_ROWS) -> Screen:
    """The one screen of an answer. Its table has at most `max_rows` rows, or all rows if the table
    may be shown completely (`shown_whole`).
    """
    sentences_by_kind = Verdict.of(answer.verdict).sentences
    tested = Verdict.of(answer.tested).sentences
    sentences = [text for kind, text in sentences_by_kind if kind != "note"]
    notes = [text for kind, text in sentences_by_kind if kind == "note"]
    if tested:
        notes.insert(1, f"Tested: {tested[0].text}")
        notes += [text for kind, text in tested[1:] if kind == "note"]

    lead = AnswerTable(pd.DataFrame())
    tables = dict(answer.tables.records)
    name = next(iter(tables), "") if answer.lead == "" else answer.lead or ""
    if name not in answer.folded and len(answer.tables.get(name, ())):
        _, table = next(reader_tables(name, tables.pop(name)))
        if len(table.frame) <= table.shown_whole:
            max_rows = table.shown_whole
        lead = lead_table(table, max_rows)
        cut = len(table.lead_rows or table.frame) - len(lead.frame)
        if cut > 0:
            notes.insert(0, f"{cut} more rows: --details.")
    unsaid = max(len(sentences) - MAX_SENTENCES, 0)
    return Screen(sentences[:MAX_SENTENCES], unsaid, lead, notes, tables)


def _more(answer: Answer, screen: Screen) -> str:
    """The last line of a screen: what the details hold, and the command that a user should call
    next.
    """
    names = [name for name, table in screen.tables.items() if len(table.frame)]
    contents = []
    if screen.unsaid:
        contents.append(number_of(screen.unsaid, "more sentence"))
    if names:
        contents.append(f"{number_of(len(names), 'table')}: {', '.join(names)}")
    in_brackets = f" ({'; '.join(contents)})"
    line = f"More: --details{in_brackets if contents else ''}, --json."
    if answer.next and answer.numbers.get("driven"):
        line += f" Next: {answer.next}"
    return line


def print_answer(answer: Answer, console: Console, *, details: bool) -> None:
    """Print one screen of an answer. With `details`, print all tables and how they were tested.

    An answer that is always shown completely (`is_whole`) has no screen. If it has a single leading
    table, as many rows are printed as fit on a screen; otherwise everything is printed.
    """
    if details or (answer.is_whole and answer.lead not in answer.tables):
        _print_whole(answer, MAX_ROWS, console)
        return

    # Print drafts with fewer and fewer rows, until the whole text fits on a screen.
    show, size = _print_screen, MAX_LEAD_ROWS
    if answer.is_whole:
        show, size = _print_whole, MAX_LINES
    for max_rows in range(size, 0, -1):
        draft = Console(width=console.width, no_color=True, force_terminal=False)
        with draft.capture() as capture:
            show(answer, max_rows, draft)
        lines = capture.get().splitlines()
        widths = np.maximum(list(map(len, lines)), 1)
        if np.ceil(widths / draft.width).sum() <= MAX_LINES:
            break
    show(answer, max_rows, console)


def _print_whole(answer: Answer, max_rows: int, console: Console) -> None:
    """Print the verdict, at most `max_rows` rows of each short table, and the details."""
    print_text(console, answer.verdict)
    for table in _short_tables(answer).values():
        cut = len(table.frame) - max_rows
        part = table.with_rows(table.frame[:max_rows])
        _print_table(console, replace(part, bars=table.bars[:max_rows]))
        if cut > 0:
            print_text(console, f"{cut} more rows: --details.")
    for text in _details_in_words(answer):
        print_text(console, text)


def _print_screen(answer: Answer, max_rows: int, console: Console) -> None:
    """Print one screen, whose table has at most `max_rows` rows."""
    screen = screen_of(answer, max_rows)
    print_text(console, " ".join(screen.sentences))
    _print_table(console, screen.lead)
    for text in (*screen.notes, _more(answer, screen)):
        print_text(console, text)


def _print_table(console: Console, table: AnswerTable) -> None:
    """Print a table in the parts that fit into the width of the terminal."""
    for part in terminal_tables(table, console.width):
        if isinstance(part, str):
            print_text(console, part)
        elif part.row_count:
            console.print(part)


def render(
    answer: Answer, form: str, table: str | None = None, *, details: bool = False
) -> str:
    """An answer in a form: text, JSON, LaTeX, HTML or CSV. With `table`, the answer has only this
    table. CSV is always one table: by default the answer's listing, else the first table. Text is
    one screen; with `table` or `details` it is complete.
    """
    if form == "csv":
        frame = answer.listing
        if table or frame is None:
            frame = answer.table(table)
        cells = frame.map(csv_cell).rename(columns=csv_cell)
        return csv_text(cells)
    if table is not None:
        answer = answer.only(table)
    if form == "json":
        return json.dumps(answer.to_dict(), indent=2, allow_nan=False) + "\n"
    if form == "latex":
        return printable(_latex(answer))
    if form == "html":
        return printable(_html(answer))

    # A text looks as on a terminal of fixed width.
    console = Console(width=WIDTH, no_color=True, force_terminal=False)
    with console.capture() as capture:
        print_answer(answer, console, details=details)
    return capture.get()


def _html(answer: Answer) -> str:
    """The answer as HTML: one screen, and below it the folded details. An answer that is always
    shown completely (`is_whole`) has no fold.
    """
    tables = map(html_table, _short_tables(answer).values())
    if answer.is_whole:
        return _html_of([answer.verdict], tables)
    screen = screen_of(answer)
    verdict, *sentences = map(escape, screen.sentences)
    for sentence in sentences:
        verdict += f" <span>{sentence}</span>"
    parts = [
        f"<p>{verdict}</p>",
        html_table(screen.lead),
        _html_of(screen.notes),
        "<details><summary>Details</summary>",
        _html_of([answer.verdict, *_details_in_words(answer)], tables),
        "</details>",
    ]
    return _html_of([], parts)


def _html_of(texts: Iterable[str], parts: Iterable[str] = ()) -> str:
    """HTML with texts as paragraphs, followed by parts that are HTML already. Quoted code becomes
    `<code>`.
    """
    paragraphs = [f"<p>{escape(text)}</p>" for text in texts]
    html = "\n".join(filter(None, [*paragraphs, *parts]))
    return CODE.sub(r"<code>\1</code>", html)


def _latex(answer: Answer) -> str:
    """The answer as LaTeX: all short tables, with remarks below them."""
    parts = [LATEX_PREAMBLE]
    notes = []
    for name, table in _short_tables(answer).items():
        if name == "remarks":
            notes.append(latex_notes(table.frame.iloc[:, -1]))
        else:
            parts.append(latex_table(_label_of(answer, name), table))
    if answer.tested:
        notes.append(latex_notes([_tested_in_words(answer)]))
    return "\n".join(parts + notes)


def _tested_in_words(answer: Answer) -> str:
    """How the answer was tested, with an introduction."""
    return f"How this was tested: {answer.tested}"


def _details_in_words(answer: Answer) -> Iterator[str]:
    """Yield how an answer was tested, and the names of tables that are too long or folded."""
    if answer.tested:
        yield _tested_in_words(answer)
    long = [
        f"{name} ({len(table.frame):,} rows)"
        for name, table in _shown_tables(answer).items()
        if len(table.frame) > MAX_ROWS
    ]
    folded = [name for name in answer.folded if len(answer.tables.get(name, ()))]
    sentences = []
    if long:
        sentences.append(f"By --format csv --table NAME: {', '.join(long)}.")
    if folded:
        sentences.append(f"By --table NAME: {', '.join(folded)}.")
    if sentences:
        yield " ".join(sentences)


def _shown_tables(answer: Answer) -> AnswerTables:
    """The tables that the details show, by name. Folded tables are left out, and so are the remarks
    on them. A table of remarks without a row is left out, too.
    """
    tables = {**answer.tables.records}
    for name in answer.folded:
        tables.pop(name, None)
    remarks = tables.pop("remarks", None)
    if remarks is not None:
        rows = remarks.frame
        if "table" in rows:
            rows = rows[~rows["table"].isin(answer.folded)]
            # A remark on all tables names no table: a reader would take "all" for its first word.
            rows = rows.replace({"table": {"all": ""}})
        if not rows.empty:
            tables["remarks"] = remarks.with_rows(rows)
    parts = AnswerTables()
    for name, table in tables.items():
        parts |= reader_tables(name, table)
    return parts


def _short_tables(answer: Answer) -> AnswerTables:
    """The tables that the details show, without those with more than `MAX_ROWS` rows."""
    tables = _shown_tables(answer).items()
    return {name: table for name, table in tables if len(table.frame) <= MAX_ROWS}


def _label_of(answer: Answer, table: str) -> str:
    """The label of a table in LaTeX. It differs from the labels of other studies, questions and
    commands, so that a document can hold all of them.
    """
    study = getattr(answer.study, "name", "safevar")
    label = f"{study}-{answer.question.replace(':', '-')}-{table}"
    if answer.command:
        label += f"-{zlib.crc32(answer.command.encode()) % 0x10000:04x}"
    return label
