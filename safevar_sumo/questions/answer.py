"""The answer that every question returns: a verdict, numbers and tables."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import wraps
from types import EllipsisType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast

import pandas as pd
from rich.console import Console

from safevar_sumo.errors import InputError, check_name, did_you_mean, one_of
from safevar_sumo.questions.render import print_answer, render
from safevar_sumo.questions.tables import (
    HIGH as HIGH,
    LOW as LOW,
    AnswerTable as AnswerTable,
    Column as Column,
    Columns as Columns,
    Frames,
    Wide as Wide,
    cell_text,
    plain,
    tabulate as tabulate,
    with_interval as with_interval,
)
from safevar_sumo.records import JsonObject
from safevar_sumo.study import Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AnswerFunction = TypeVar("AnswerFunction", bound="Callable[..., Answer]")


DeclaredNames = Collection[str | EllipsisType]
"""Names of numbers or columns; `...` stands for names that a study gives."""
JsonRows = list[JsonObject]
"""Rows of a table, by the names of its columns."""


class Contents(NamedTuple):
    """The names that an answer declares, so that a command can refuse others.

    Attributes
    ----------
    numbers
        Names of the numbers. `...` among them stands for names that a study gives, such as its
        metrics.
    tables
        Names of the columns, by the name of the table; `...` as above.
    lead
        Name of the table that one screen shows; "" for the first table.
    next
        Name of the question that a user should ask next; "" for none.
    """

    numbers: DeclaredNames
    tables: Mapping[str, DeclaredNames]
    lead: str = ""
    next: str = ""

    def in_study(self, measures: Collection[str]) -> Contents:
        """The same names, but with the study's `measures` in place of `...` among the numbers."""
        return self._replace(numbers=[*_without_ellipsis(self.numbers), *measures])

    def check_key(self, key: str) -> None:
        """Refuse a key that `Answer.values` would not know; raises an InputError. An index into a
        list may be of any size.
        """
        # A key is `number`, `number.index` or `table.column`.
        name, _, ending = key.rpartition(".")
        names = self.numbers
        number = key
        # The columns of all tables would fill the screen.
        legal = _without_ellipsis(names)
        legal += [f"{table}.COLUMN" for table in self.tables]
        if name in self.tables:
            names = self.tables[name]
            number = ending
            legal = [f"{name}.{column}" for column in _without_ellipsis(names)]
        elif name and ending.isdecimal():
            number = name
        if ... not in names and number not in names:
            raise InputError(
                "fail_if",
                f"the answer has no number {key!r}{did_you_mean(key, self.keys)}",
                one_of(legal),
            )

    @property
    def keys(self) -> list[str]:
        """All keys: names of numbers, and `table.column`. Names that a study gives are left out."""
        keys = _without_ellipsis(self.numbers)
        for table, names in self.tables.items():
            keys += [f"{table}.{name}" for name in _without_ellipsis(names)]
        return keys


def _without_ellipsis(names: DeclaredNames) -> list[str]:
    """The names without `...`."""
    return [name for name in names if isinstance(name, str)]


OF_ALL = ("driven", "never_moved", "rough", "simulations")
"""Numbers that any answer may have."""


def contents(
    *numbers: str | EllipsisType,
    lead: Any = "",
    next: Any = "",
    **tables: DeclaredNames,
) -> Callable[[AnswerFunction], AnswerFunction]:
    """Decorator that declares the `Contents` of a function's answers: the names of numbers, and the
    names of columns by table. The command refuses other names before it computes anything.

    `lead` is the table that one screen shows, `next` the question that a user should ask next.
    `OF_ALL` are always among the numbers.
    """
    if lead:
        check_name(
            "contents", f"lead = {lead!r} is no table that it declares", lead, tables
        )

    def declare(function: AnswerFunction) -> AnswerFunction:
        @wraps(function)
        def with_lead(*arguments: Any, **options: Any) -> Answer:
            """The function, whose answer gets the declared leading table if it states none."""
            answer = function(*arguments, **options)
            return replace(answer, lead=lead if answer.lead == "" else answer.lead)

        names = tuple(dict.fromkeys((*OF_ALL, *numbers)))
        vars(with_lead)["contents"] = Contents(names, tables, lead, next)
        return cast("AnswerFunction", with_lead)

    return declare


def contents_of(function: Callable[..., Any]) -> Contents | None:
    """The contents that a function declares for its answers; None if it declares nothing."""
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
        Conclusion and evidence in a few sentences; of a `Verdict`, which knows what each sentence
        is, one screen has the first five and the notes.
    tested
        How the conclusion was tested, in sentences that readers see below the tables.
    numbers
        Values by name; NaN or None where undefined.
    tables
        Frames by name. A question gives what `tabulate` makes; `tables.records` has it.
    failures
        Sentences that say which of the user's limits are not kept; the command then ends with exit
        code 3.
    lead
        The table of the one screen, by default the first; None for none.
    folded
        Names of tables that readers see only by name; JSON and CSV have all.
    is_whole
        Whether readers see all of it, not one screen; of the lead alone, as many rows as one screen
        has.
    next
        The command that comes next.
    command
        The command line that gives this answer.
    listing
        What CSV has unless a table is named; by default the first table.
    draw
        Draws the answer; by default the values of the first table with their intervals.

    Examples
    --------
    >>> answer = sv.risk("smoke", samples=64)
    >>> answer.numbers["samples"], answer.numbers["failures"]
    (64, 1)
    >>> list(answer.tables)
    ['sensitivity']
    """

    question: str
    study: Study
    verdict: str
    numbers: JsonObject
    tables: Any
    failures: tuple[str, ...] = ()
    lead: str | None = ""
    folded: tuple[str, ...] = ()
    is_whole: bool = False
    next: str = ""
    command: str = ""
    tested: str = ""
    listing: pd.DataFrame | None = field(default=None, compare=False)
    draw: Callable[[Answer], Figure] | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        if not isinstance(self.verdict, str):
            raise InputError("verdict", repr(self.verdict), "a text")
        if not isinstance(self.numbers, Mapping):
            raise InputError("numbers", repr(self.numbers), "a mapping of names")
        if not isinstance(self.tables, Frames):
            object.__setattr__(self, "tables", Frames(self.tables))

    def to_dict(self) -> JsonObject:
        """The answer as plain values for JSON: question, study, verdict, numbers, and the columns
        and rows of each table. An undefined value is None.
        """
        tables = {}
        for name, table in self.tables.records.items():
            columns = {
                key: {"unit": column.unit, "meaning": column.meaning}
                for key, column in table.columns.items()
            }
            rows = plain(table.frame.to_dict("records"))
            tables[name] = {"columns": columns, "rows": rows}
        answer = {
            "question": self.question,
            "study": getattr(self.study, "name", None),
            "verdict": self.verdict,
        }
        if self.tested:
            answer["tested"] = self.tested
        return {**answer, "numbers": plain(self.numbers), "tables": tables}

    def table(self, name: str | None = None) -> pd.DataFrame:
        """A table by name, the first one by default.

        Raises
        ------
        InputError
            If the answer has no such table.
        """
        frames: dict[str, pd.DataFrame] = self.tables
        if name is None:
            return next(iter(frames.values()), pd.DataFrame())
        check_name("table", f"there is no table {name!r}", name, frames)
        return frames[name]

    def only(self, name: str) -> Answer:
        """The answer with one of its tables, and the remarks on it.

        Raises
        ------
        InputError
            If the answer has no such table.
        """
        self.table(name)
        records = self.tables.records
        tables = {name: records[name]}
        if remarks := records.get("remarks"):
            rows = remarks.frame
            if "table" in rows:
                rows = rows[rows["table"].isin([name, "all"])]
            tables["remarks"] = remarks.with_rows(rows)
        return replace(self, tables=tables, folded=(), lead=name, is_whole=True)

    def render(
        self, form: str, table: str | None = None, *, details: bool = False
    ) -> str:
        """The answer, or with one table only, as text, JSON, LaTeX or HTML; one table, by default
        the first, as CSV. Text is one screen, with a table's name or `details` all.
        """
        return render(self, form, table, details=details)

    def print(self, console: Console, *, details: bool = False) -> None:
        """Print one screen; with `details` all tables and numbers."""
        print_answer(self, console, details=details)

    def _repr_html_(self) -> str:
        return self.render("html")

    def __repr__(self) -> str:
        return f"<Answer {self.question}: {self.verdict}>"

    def figure(self) -> Figure:
        """The answer as a figure."""
        from safevar_sumo.questions.figures import own_style

        with own_style():
            return (self.draw or _draw_intervals)(self)

    def values(self, key: str) -> list[Any]:
        """The numbers under a key: a number's name, with an index if it is a list (`interval.1`),
        or `table.column`, a value for each row.

        Raises
        ------
        InputError
            If there is no such number.
        """
        columns = {name: list(map(str, frame)) for name, frame in self.tables.items()}
        Contents(self.numbers, columns).check_key(key)
        name, _, ending = key.rpartition(".")
        if name in self.tables:
            return list(plain(self.tables[name][ending].tolist()))
        if key in self.numbers:
            return [self.numbers[key]]
        value = self.numbers[name]
        if not (isinstance(value, list | tuple) and int(ending) < len(value)):
            raise InputError(
                "fail_if",
                f"the answer has no number {key!r}",
                f"{name}, which is {cell_text(value)}",
            )
        return [value[int(ending)]]


def _draw_intervals(answer: Answer) -> Figure:
    """Draw the first table's numbers with their intervals: a panel for each column that has an
    interval, and a line for each row.
    """
    from safevar_sumo.questions.figures import (
        BLUE,
        FONT_SIZE,
        escape_dollars,
        new_figure,
    )

    frame = answer.table()
    names = [
        name
        for name in map(str, frame)
        if f"{name}{LOW}" in frame and frame[name].notna().any()
    ]
    if not names or frame.empty:
        raise InputError(
            "plot", "the answer has nothing to draw", "the answer as a table"
        )

    size = (max(2.6 * len(names), 5.2), 1.1 + 0.35 * len(frame))
    table, *_ = answer.tables.records.values()
    figure, axes = new_figure(table.title, 1, len(names), size, sharey=True)
    places = range(len(frame), 0, -1)
    for axis, name in zip(axes[0], names, strict=True):
        columns = [name, f"{name}{LOW}", f"{name}{HIGH}"]
        value, low, high = frame[columns].to_numpy(float).T
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
