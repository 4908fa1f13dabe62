"""The one renderer of answers: one screen, or all details, as text and HTML; other formats have
everything.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Iterable, Iterator
from html import escape
from typing import TYPE_CHECKING, Literal, NamedTuple

import pandas as pd
from rich.console import Console

from safevar_sumo.errors import printable
from safevar_sumo.questions.tables import (
    LATEX_PREAMBLE,
    MAX_LEAD_ROWS,
    Frames,
    csv_cell,
    html_table,
    latex_notes,
    latex_table,
    lead_table,
    reader_tables,
    terminal_tables,
)
from safevar_sumo.questions.words import number_of
from safevar_sumo.terminal import print_text

if TYPE_CHECKING:
    from safevar_sumo.questions.answer import Answer

Form = Literal["text", "json", "csv", "latex", "html"]
SENTENCE_END = re.compile(r"(?<=[^.]{2}\.) (?=[A-Z0-9])")
"""Between two sentences."""
MAX_SENTENCES = 3
"""Number of sentences of the verdict that one screen has."""
CODE = re.compile("`([^`<>]+)`")
"""What a text quotes as code."""
SCOPE = "Scope: "
NOTES = (
    *(
        SCOPE,
        "Valid for: ",
        "Remark: ",
        "Changed: ",
        "Criterion: ",
        "Not simulated: ",
        "Unsafe means: ",
    ),
    "Safe means: ",
    *(
        "An encounter counts only",
        "A vehicle counts only",
        "Left out",
        "If all changes go",
    ),
)
"""Beginnings of sentences of a verdict that one screen has below the table."""
MAX_ROWS = 200
"""Number of rows up to which readers see a table; JSON and CSV have them all."""
MAX_LINES = 30
"""Number of lines that one screen has."""
WIDTH = 100
"""Width of text that is not printed to a terminal [characters]."""


class Screen(NamedTuple):
    """What a reader sees of an answer, and the tables that stand behind it.

    Attributes
    ----------
    sentences
        The first sentences of the verdict.
    unsaid
        Number of its further sentences.
    lead
        The one table; empty if there is none.
    notes
        What the answer is valid for, how it was tested, and remarks.
    others
        Other tables by name.
    """

    sentences: list[str]
    unsaid: int
    lead: pd.DataFrame
    notes: list[str]
    others: Frames


def screen_of(answer: Answer, max_rows: int = MAX_LEAD_ROWS) -> Screen:
    """The one screen of an answer, whose table has at most so many rows, unless it is shown whole:
    its attribute `shown_whole` is the number of rows up to which it is.
    """
    # Sentences of the verdict by kind.
    plain_sentences = list[str]()
    notes = list[str]()
    for sentence in SENTENCE_END.split(answer.verdict):
        if sentence.startswith(NOTES):
            notes.append(sentence.replace(SCOPE, "Valid for: ", 1))
        else:
            plain_sentences.append(sentence)
    if answer.tested:
        first, *further = SENTENCE_END.split(answer.tested)
        notes.insert(1, f"Tested: {first}")
        notes += [sentence for sentence in further if sentence.startswith(NOTES)]

    # The lead, and what it does not show.
    lead = pd.DataFrame()
    others = dict(answer.tables)
    name = next(iter(others), "") if answer.lead == "" else answer.lead or ""
    if name not in answer.folded and len(others.get(name, ())):
        whole = next(reader_tables(name, others.pop(name)))[1]
        few = whole.attrs.get("shown_whole", 0)
        lead = lead_table(whole, few if len(whole) <= few else max_rows)
        cut = len(whole.attrs.get("lead_rows", whole)) - len(lead)
        if cut > 0:
            notes.insert(0, f"{cut} more rows: --details.")
    unsaid = max(len(plain_sentences) - MAX_SENTENCES, 0)
    return Screen(plain_sentences[:MAX_SENTENCES], unsaid, lead, notes, others)


def _more(answer: Answer, screen: Screen) -> str:
    """The last line: what else there is, and the next question."""
    names = [name for name, frame in screen.others.items() if len(frame)]
    unsaid = number_of(screen.unsaid, "more sentence") if screen.unsaid else ""
    behind = ", ".join(filter(None, [unsaid, *names]))
    following = (
        f" Next: {answer.next}" if answer.next and answer.numbers.get("driven") else ""
    )
    return f"More: --details{f' ({behind})' if behind else ''}, --json.{following}"


def print_answer(answer: Answer, console: Console, *, details: bool) -> None:
    """Print one screen, also of a table alone; with `details`, or of another answer that is whole,
    all tables and numbers.
    """
    if details or (answer.is_whole and answer.lead not in answer.tables):
        _print_whole(answer, MAX_ROWS, console)
        return

    # As many rows of the table as there are lines for.
    show = _print_whole if answer.is_whole else _print_screen
    for max_rows in range(MAX_LINES if answer.is_whole else MAX_LEAD_ROWS, 0, -1):
        draft = Console(width=console.width, no_color=True, force_terminal=False)
        with draft.capture() as capture:
            show(answer, max_rows, draft)
        lines = capture.get().splitlines()
        if sum(max(1, -(-len(line) // draft.width)) for line in lines) <= MAX_LINES:
            break
    show(answer, max_rows, console)


def _print_whole(answer: Answer, max_rows: int, console: Console) -> None:
    print_text(console, answer.verdict.replace(f" {SCOPE}", f"\n{SCOPE}"))
    for frame in _short_tables(answer).values():
        cut = len(frame) - max_rows
        shown = frame[:max_rows] if cut > 0 else frame
        shown.attrs = {**frame.attrs, "bars": frame.attrs.get("bars", ())[:max_rows]}
        _print_table(console, shown)
        if cut > 0:
            print_text(console, f"{cut} more rows: --details.")
    for text in _details_in_words(answer):
        print_text(console, text)


def _print_screen(answer: Answer, max_rows: int, console: Console) -> None:
    screen = screen_of(answer, max_rows)
    print_text(console, " ".join(screen.sentences))
    _print_table(console, screen.lead)
    for text in (*screen.notes, _more(answer, screen)):
        print_text(console, text)


def _print_table(console: Console, frame: pd.DataFrame) -> None:
    for part in terminal_tables(frame, console.width):
        if isinstance(part, str):
            print_text(console, part)
        elif part.row_count:
            console.print(part)


def render(
    answer: Answer, form: str, table: str | None = None, *, details: bool = False
) -> str:
    """An answer, or with one table only, as text, JSON, LaTeX or HTML; one table, by default the
    first, as CSV. Text is one screen, with a table's name or `details` all.
    """
    if form == "csv":
        frame = (
            answer.table(table) if table or answer.listing is None else answer.listing
        )
        cells = frame.map(csv_cell).rename(columns=csv_cell)
        return cells.to_csv(index=False, lineterminator="\n")
    if table is not None:
        answer = answer.only(table)
    if form == "json":
        return json.dumps(answer.to_dict(), indent=2, allow_nan=False) + "\n"
    if form == "latex":
        return printable(_latex(answer))
    if form == "html":
        return printable(_html(answer))

    # Text as on a terminal of fixed width.
    console = Console(width=WIDTH, no_color=True, force_terminal=False)
    with console.capture() as capture:
        print_answer(answer, console, details=details)
    return capture.get()


def _html(answer: Answer) -> str:
    """One screen, below which the rest is folded; all of an answer that is whole."""
    every = map(html_table, _short_tables(answer).values())
    if answer.is_whole:
        return _marked([f"<p>{escape(answer.verdict)}</p>", *every])
    screen = screen_of(answer)
    first, *later = map(escape, screen.sentences)
    verdict = " ".join([first, *(f"<span>{sentence}</span>" for sentence in later)])
    parts = [f"<p>{verdict}</p>", html_table(screen.lead)]
    parts += [f"<p>{escape(note)}</p>" for note in screen.notes]

    # All sentences and tables.
    folded = [
        f"<p>{escape(text)}</p>"
        for text in (answer.verdict, *_details_in_words(answer))
    ]
    parts += ["<details><summary>Details</summary>", *folded, *every, "</details>"]
    return _marked(parts)


def _marked(parts: Iterable[str]) -> str:
    """Parts of HTML, in which what texts quote as code is marked."""
    return CODE.sub(r"<code>\1</code>", "\n".join(filter(None, parts)))


def _latex(answer: Answer) -> str:
    """All tables that are short, with remarks below them."""
    shown = _short_tables(answer)
    remarks = shown.pop("remarks", None)
    tables = [
        latex_table(_label_of(answer, name), frame) for name, frame in shown.items()
    ]
    notes = [] if remarks is None else [latex_notes(remarks)]
    if answer.tested:
        notes.append(latex_notes(pd.DataFrame([_tested_in_words(answer)])))
    return "\n".join([LATEX_PREAMBLE, *tables, *notes])


def _tested_in_words(answer: Answer) -> str:
    return f"How this was tested: {answer.tested}" if answer.tested else ""


def _details_in_words(answer: Answer) -> Iterator[str]:
    """How an answer was tested, and the tables that readers do not see."""
    long = [
        f"{name} ({len(frame):,} rows)"
        for name, frame in _shown_tables(answer).items()
        if len(frame) > MAX_ROWS
    ]
    folded = [name for name in answer.folded if len(answer.tables.get(name, ()))]
    sentences = [f"By --format csv --table NAME: {', '.join(long)}."] if long else []
    sentences += [f"By --table NAME: {', '.join(folded)}."] if folded else []
    yield from filter(None, (_tested_in_words(answer), " ".join(sentences)))


def _shown_tables(answer: Answer) -> Frames:
    """The tables of all details, by name; without remarks on others, and without a table of no
    remark.
    """
    shown = {
        name: frame
        for name, frame in answer.tables.items()
        if name not in answer.folded
    }
    remarks = shown.pop("remarks", None)
    if remarks is not None:
        about = (
            remarks[~remarks["table"].isin(answer.folded)]
            if "table" in remarks
            else remarks
        )
        if "table" in about:  # "all" would be read as a part of the remark
            about = about.replace({"table": {"all": ""}})
        shown |= {} if about.empty else {"remarks": about}
    return {
        label: part
        for name, frame in shown.items()
        for label, part in reader_tables(name, frame)
    }


def _short_tables(answer: Answer) -> Frames:
    return {
        name: frame
        for name, frame in _shown_tables(answer).items()
        if len(frame) <= MAX_ROWS
    }


def _label_of(answer: Answer, table: str) -> str:
    """The label of a table in LaTeX, which tables of other studies, questions and commands do not
    have.
    """
    digest = (
        f"-{zlib.crc32(answer.command.encode()) % 0x10000:04x}"
        if answer.command
        else ""
    )
    study = getattr(answer.study, "name", "safevar")
    return f"{study}-{answer.question.replace(':', '-')}-{table}{digest}"
