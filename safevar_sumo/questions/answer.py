"""What every question returns: a verdict, numbers and tables; and the one renderer of them in every
format.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from html import escape
from types import EllipsisType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import pandas as pd
from rich.console import Console

from safevar_sumo.errors import InputError, check_name, did_you_mean, one_of
from safevar_sumo.questions.tables import (
    HIGH as HIGH,
    LATEX_PREAMBLE,
    LOW as LOW,
    Column as Column,
    Columns as Columns,
    Wide as Wide,
    cell_text,
    columns_of,
    csv_cell,
    html_table,
    latex_notes,
    latex_table,
    plain,
    reader_tables,
    tabulate as tabulate,
    terminal_tables,
    with_interval as with_interval,
)
from safevar_sumo.records import JsonObject
from safevar_sumo.study import Study
from safevar_sumo.terminal import print_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AnswerFunction = TypeVar("AnswerFunction", bound="Callable[..., Answer]")
FORMATS = ("text", "json", "csv", "latex", "html")
SENTENCE_END = re.compile(r"(?<=[^.]{2}\.) (?=[A-Z])")
"""Between two sentences, each of which a page puts on lines of its own."""
MAX_ROWS = 200
"""Number of rows up to which readers see a table; JSON and CSV have them all."""
WIDTH = 80
"""Width of text that is not printed to a terminal [characters]."""


class Contents(NamedTuple):
    """The names of an answer's numbers, and of the columns of its tables; `...` among them stands
    for names that a study gives, such as its metrics.
    """

    numbers: Collection[str | EllipsisType]
    tables: Mapping[str, Collection[str | EllipsisType]]

    def in_study(self, given: Mapping[str, list[str]]) -> Contents:
        """The names that an answer has with those that a study has `given`, by table; of numbers
        under "".
        """
        tables = {
            table: [
                each
                for name in names
                for each in (given.get(table, [...]) if name is ... else [name])
            ]
            for table, names in {"": self.numbers, **self.tables}.items()
        }
        return Contents(tables.pop(""), tables)

    def check_table(self, name: str) -> None:
        """Refuse the name of no table; raises an InputError."""
        check_name("table", f"there is no table {name!r}", name, self.tables)

    def check_key(self, key: str) -> None:
        """Refuse what is no key of `Answer.values`, but for an index; raises an InputError."""
        # A number, a number in a list, or a column.
        name, _, rest = key.rpartition(".")
        names = self.numbers
        wanted = key
        legal = [number for number in self.numbers if number != ...]
        legal += [
            f"{table}.COLUMN" for table in self.tables
        ]  # the columns of all tables would fill the screen
        if name in self.tables:
            names = self.tables[name]
            wanted = rest
            legal = [f"{name}.{column}" for column in names if column != ...]
        elif name and rest.isdecimal():
            wanted = name
        if ... not in names and wanted not in names:
            problem = f"the answer has no number {key!r}{did_you_mean(key, self.keys)}"
            raise InputError("fail_if", problem, one_of(legal))

    @property
    def keys(self) -> list[str]:
        """All names of numbers, and `table.column`, without those that a study gives."""
        columns = [
            f"{table}.{name}"
            for table, names in self.tables.items()
            for name in names
            if name != ...
        ]
        return [*(name for name in self.numbers if name != ...), *columns]


def contents(
    *numbers: str | EllipsisType, **tables: Collection[str | EllipsisType]
) -> Callable[[AnswerFunction], AnswerFunction]:
    """Decorator: declares the names of all numbers that a function's answers may hold, and of the
    columns of their tables, so that its command refuses others before anything is computed.
    `driven` is among the numbers.
    """

    def declare(function: AnswerFunction) -> AnswerFunction:
        vars(function)["contents"] = Contents(("driven", *numbers), tables)
        return function

    return declare


def contents_of(function: Callable[..., Any]) -> Contents | None:
    """What a function's answers may hold; None if it does not say so."""
    return vars(function).get("contents")


@dataclass(frozen=True, kw_only=True, repr=False)
class Answer:
    """The answer to a question about a study.

    Attributes
    ----------
    question
        The command that asks it.
    study
        The study that was examined; `list` is about none.
    verdict
        Conclusion, evidence and next step in a few sentences; what it covers stands in the last
        one, which begins with `Scope:`.
    tested
        How the conclusion was tested, in sentences that readers see below the tables.
    numbers
        Values by name; NaN or None where undefined.
    tables
        Frames by name, made by `tabulate`.
    failures
        Sentences that say which of the user's limits are not kept; the command then ends with exit
        code 3.
    folded
        Names of tables that readers see only if they ask for them; JSON and CSV have all.
    command
        The command line that gives this answer.
    listing
        What CSV has unless a table is named; by default the first table.
    draw
        Draws the answer; by default the values of the first table with their intervals.
    """

    question: str
    study: Study
    verdict: str
    numbers: JsonObject
    tables: dict[str, pd.DataFrame]
    failures: tuple[str, ...] = ()
    folded: tuple[str, ...] = ()
    command: str = ""
    tested: str = ""
    listing: pd.DataFrame | None = field(default=None, compare=False)
    draw: Callable[[Answer], Figure] | None = field(default=None, compare=False)

    def to_dict(self) -> JsonObject:
        """Plain values: question, study, verdict, numbers, and of each table its columns and rows;
        null where undefined.
        """
        # Each table with units and meanings.
        tables = {}
        for name, frame in self.tables.items():
            columns = columns_of(frame).items()
            tables[name] = {
                "columns": {
                    key: {"unit": column.unit, "meaning": column.meaning} for key, column in columns
                },
                "rows": [plain(row) for row in frame.to_dict("records")],
            }
        head = {
            "question": self.question,
            "study": getattr(self.study, "name", None),
            "verdict": self.verdict,
            **({"tested": self.tested} if self.tested else {}),
        }
        return {**head, "numbers": plain(self.numbers), "tables": tables}

    def table(self, name: str | None = None) -> pd.DataFrame:
        """A table by name, the first one by default.

        Raises
        ------
        InputError
            If the answer has no such table.
        """
        if name is None:
            return next(iter(self.tables.values()), pd.DataFrame())
        check_name("table", f"there is no table {name!r}", name, self.tables)
        return self.tables[name]

    def only(self, name: str) -> Answer:
        """The answer with one of its tables, and the remarks on it.

        Raises
        ------
        InputError
            If the answer has no such table.
        """
        tables = {name: self.table(name)}
        remarks = self.tables.get("remarks")
        if remarks is not None:
            is_about_it = (
                remarks["table"].isin([name, "all"]) if "table" in remarks else slice(None)
            )
            tables["remarks"] = remarks[is_about_it]
        return replace(self, tables=tables, folded=())

    def render(self, form: str, table: str | None = None) -> str:
        """The answer, or with one table only, as text, JSON, LaTeX or HTML; one table, by default
        the first, as CSV.
        """
        # A table as CSV, or the answer with this table alone.
        if form == "csv":
            frame = self.table(table) if table or self.listing is None else self.listing
            return frame.map(csv_cell).to_csv(index=False, lineterminator="\n")
        if table is not None:
            return self.only(table).render(form)
        if form == "json":
            return json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n"
        if form == "latex":
            shown = self._short_tables
            remarks = shown.pop("remarks", None)
            parts = [
                LATEX_PREAMBLE,
                *(latex_table(self._label_of(name), frame) for name, frame in shown.items()),
            ]
            parts += [] if remarks is None else [latex_notes(remarks)]
            tested = pd.DataFrame([self._tested_in_words])
            parts += [latex_notes(tested)] if self.tested else []
            return "\n".join(parts)
        if form == "html":
            first, *later = map(escape, SENTENCE_END.split(self.verdict))
            verdict = " ".join([first, *(f"<span>{sentence}</span>" for sentence in later)])
            texts = filter(None, (self._tested_in_words, self._other_tables))
            others = [f"<p>{escape(text)}</p>" for text in texts]
            return "\n".join(
                [f"<p>{verdict}</p>", *map(html_table, self._short_tables.values()), *others]
            )

        # Text as on a terminal of fixed width.
        console = Console(width=WIDTH, no_color=True, force_terminal=False)
        with console.capture() as capture:
            self.print(console)
        return capture.get()

    def print(self, console: Console) -> None:
        """Print the verdict, the tables and the numbers."""
        # Verdict, tables, and what else there is.
        print_text(console, self.verdict.replace(" Scope: ", "\nScope: "))
        for frame in self._short_tables.values():
            for part in terminal_tables(frame, console.width):
                if isinstance(part, str):
                    print_text(console, part)
                elif part.row_count:
                    console.print(part)
        for text in filter(None, (self._tested_in_words, self._other_tables)):
            print_text(console, text)
        if self.study is not None:  # `list` has checked nothing
            in_table = self.tables.get("results", pd.DataFrame({"result": []}))["result"].tolist()
            numbers = {name: value for name, value in self.numbers.items() if name not in in_table}
            texts = (f"{name}: {cell_text(value)}" for name, value in numbers.items())
            print_text(console, "; ".join(texts))

    @property
    def _tested_in_words(self) -> str:
        return f"How this was tested: {self.tested}" if self.tested else ""

    @property
    def _reader_tables(self) -> dict[str, pd.DataFrame]:
        """The tables that readers see, by name; without remarks on others, and without a table of
        no remark.
        """
        shown = {name: frame for name, frame in self.tables.items() if name not in self.folded}
        remarks = shown.pop("remarks", None)
        if remarks is not None:
            about = remarks[~remarks["table"].isin(self.folded)] if "table" in remarks else remarks
            if "table" in about:  # "all" would be read as a part of the remark
                about = about.replace({"table": {"all": ""}})
            shown |= {} if about.empty else {"remarks": about}
        return {
            label: part
            for name, frame in shown.items()
            for label, part in reader_tables(name, frame)
        }

    @property
    def _short_tables(self) -> dict[str, pd.DataFrame]:
        return {
            name: frame for name, frame in self._reader_tables.items() if len(frame) <= MAX_ROWS
        }

    @property
    def _other_tables(self) -> str:
        """The tables that readers do not see, in sentences."""
        long = [
            f"{name} ({len(frame):,} rows)"
            for name, frame in self._reader_tables.items()
            if len(frame) > MAX_ROWS
        ]
        sentences = [f"By --format csv --table NAME: {', '.join(long)}."] if long else []
        folded = [name for name in self.folded if len(self.tables.get(name, ()))]
        by_all = "--all, or " if self.question == "tables" else ""
        sentences += [f"By {by_all}--table NAME: {', '.join(folded)}."] if folded else []
        return " ".join(sentences)

    def _label_of(self, table: str) -> str:
        """The label of a table in LaTeX, which tables of other studies, questions and commands do
        not have.
        """
        digest = f"-{zlib.crc32(self.command.encode()) % 0x10000:04x}" if self.command else ""
        study = getattr(self.study, "name", "safevar")
        return f"{study}-{self.question.replace(':', '-')}-{table}{digest}"

    def _repr_html_(self) -> str:
        return self.render("html")

    def __repr__(self) -> str:
        return f"<Answer {self.question}: {self.verdict}>"

    def figure(self) -> Figure:
        """The answer as a figure."""
        return (self.draw or _draw_intervals)(self)

    def values(self, key: str) -> list[Any]:
        """The numbers under a key: a number's name, with an index if it is a list (`interval.1`),
        or `table.column`, a value for each row.

        Raises
        ------
        InputError
            If there is no such number.
        """
        # A column, a number, or a number in a list.
        Contents(
            self.numbers, {name: [*map(str, frame)] for name, frame in self.tables.items()}
        ).check_key(key)
        name, _, rest = key.rpartition(".")
        if name in self.tables:
            return list(plain(self.tables[name][rest].tolist()))
        if key in self.numbers:
            return [self.numbers[key]]
        value = self.numbers[name]
        if not (isinstance(value, list | tuple) and int(rest) < len(value)):
            raise InputError(
                "fail_if",
                f"the answer has no number {key!r}",
                f"{name}, which is {cell_text(value)}",
            )
        return [value[int(rest)]]


def _draw_intervals(answer: Answer) -> Figure:
    """The numbers of the first table with their intervals, a row for each of its rows."""
    from safevar_sumo.questions.figures import BLUE, FONT_SIZE, escape_dollars, new_figure

    # Columns that have an interval.
    frame = answer.table()
    names = [
        name for name in map(str, frame) if f"{name}{LOW}" in frame and frame[name].notna().any()
    ]
    if not names or frame.empty:
        raise InputError("plot", "the answer has nothing to draw", "the answer as a table")

    # A panel for each column.
    size = (max(2.6 * len(names), 5.2), 1.1 + 0.35 * len(frame))
    figure, axes = new_figure(frame.attrs["title"], 1, len(names), size, sharey=True)
    places = range(len(frame), 0, -1)
    for axis, name in zip(axes[0], names, strict=True):
        value, low, high = (frame[f"{name}{end}"].to_numpy(float) for end in ("", LOW, HIGH))
        axis.errorbar(
            value,
            places,
            xerr=[value - low, high - value],
            fmt="o",
            color=BLUE,
            capsize=2,
            markersize=4,
        )
        axis.set_xlabel(escape_dollars(name.replace("_", " ")))
    labels = [escape_dollars(str(label)) for label in frame.iloc[:, 0]]
    axes[0][0].set_yticks(places, labels, fontsize=FONT_SIZE - 1)
    return figure
