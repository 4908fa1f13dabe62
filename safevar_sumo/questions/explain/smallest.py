"""The smallest changes that make a vehicle unsafe, as `explain` of a study prints them. The search
tries the ends of the domain, shares of the way to the ends, and sampled vehicles. For each cause,
the answer says where the cause begins, and how sure it is. The staircase is the least number of
unsafe changes at each share of the way to the ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple, Self

import pandas as pd

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.causes import Causes, directions, kinds_of
from safevar_sumo.questions.counterexamples import FURTHER_DIGITS, values_as_printed
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain.beginnings import (
    Beginning,
    find_beginnings,
    with_sample,
)
from safevar_sumo.questions.explain.combinations import (
    CountBySize,
    Enumeration,
    count_cures,
    enumerate_causes,
    staircase,
)
from safevar_sumo.questions.explain.tables import (
    COUNTS,
    SMALLEST_COLUMNS,
    STAIRCASE_COLUMNS,
    sureness,
    with_fresh_runs,
)
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.tables import AnswerTables, tabulate
from safevar_sumo.records import JsonObject

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_SETTINGS = 12_000
"""Largest number of settings for the combinations at the ends of the domain; the staircase may take
the same number again.
"""
CURES = 4
"""Combinations that contain a cause may take `MAX_SETTINGS` / `CURES` settings."""
DIGITS_OF_SHARES = FURTHER_DIGITS[1:]
"""Numbers of digits beyond the digits of a limit. A value has at least one further digit, so that
the share of the way at which a cause begins is also that of the printed value.
"""
TITLE = (
    "The smallest unsafe changes, with the values at which the vehicle becomes unsafe"
)

SMALLEST_NUMBERS = (
    "tried",
    "up_to_changes",
    "complete_up_to",
    "causes",
    "containing",
    "containing_tried",
    "cures",
)


class Smallest(NamedTuple):
    """The smallest unsafe changes of a study.

    Attributes
    ----------
    at_ends
        The causes at the ends of the domain.
    steps
        The causes at each share of the way to the ends; the first step is `at_ends`.
    cures
        By size, the number of combinations that are safe although they contain a cause.
    sampled
        Causes of the failures of sampled vehicles.
    table
        A row of `SMALLEST_COLUMNS` for each cause, ordered by the number of changes. Of causes with
        the same number of changes, the most robust comes first.
    """

    at_ends: Enumeration
    steps: Sequence[Enumeration]
    cures: CountBySize
    sampled: Causes
    table: pd.DataFrame

    @classmethod
    def of(
        cls, evaluator: Evaluator, unsafe: Unsafe, fits: int, sampled: Causes = ()
    ) -> Self:
        """Find the smallest unsafe changes, and check them in `fits` parameter sets. `sampled` are
        the causes of the failures of sampled vehicles.
        """
        # With few simulations, half of them enumerate the combinations at the ends, because only
        # causes that are found there can be made smaller. A third of the remaining simulations
        # finds the staircase. The rest checks how sure the causes are.
        at_ends = enumerate_causes(
            evaluator, unsafe, evaluator.of_stage(MAX_SETTINGS, 2)
        )
        steps = staircase(
            evaluator, unsafe, at_ends, evaluator.of_stage(MAX_SETTINGS, 3)
        )
        cures = count_cures(
            evaluator, unsafe, at_ends, evaluator.of_stage(MAX_SETTINGS // CURES, 8)
        )
        known = find_beginnings(evaluator, unsafe, steps)
        beginnings = with_sample(evaluator, unsafe, known, sampled)
        table = _table(evaluator, unsafe, beginnings, fits)
        if table.empty and beginnings:
            # Fresh runs confirmed no cause. Sampled vehicles may have other causes.
            members = evaluator.characteristics
            refuted = kinds_of(members, [beginning.cause for beginning in beginnings])
            sampled_others = [
                cause
                for cause in sampled
                if directions(members, cause.changes) not in refuted
            ]
            beginnings = with_sample(evaluator, unsafe, [], sampled_others)
            table = _table(evaluator, unsafe, beginnings, fits)
        return cls(at_ends, steps, cures, sampled, table)

    @property
    def changed(self) -> set[str]:
        """The names of the characteristics that some known cause changes."""
        names = {name for changes in self.table["causes"] for name in changes}
        for cause in [*self.at_ends.causes, *self.sampled]:
            names.update(cause.changes)
        return names

    @property
    def containing(self) -> tuple[int, int, int]:
        """The number of combinations that contain a smaller cause, the number of these that were
        simulated, and the number of these that are safe.
        """
        numbers = {size: len(group) for size, group in self.at_ends.containing.items()}
        simulated = sum(numbers[size] for size in self.cures)
        return sum(numbers.values()), simulated, sum(self.cures.values())

    @property
    def numbers(self) -> JsonObject:
        """The numbers of the answer, by the names in `SMALLEST_NUMBERS`."""
        at_ends = self.at_ends
        largest = max(at_ends.simulated, default=0)
        enumerated = at_ends.tried, largest, at_ends.complete_up_to, len(self.table)
        values = (*enumerated, *self.containing)
        return dict(zip(SMALLEST_NUMBERS, values, strict=True))


def smallest_tables(smallest: Smallest | None) -> AnswerTables:
    """The tables of causes and of the staircase. Both are empty if `smallest` is None, because the
    original vehicle itself is unsafe.
    """
    rows = []
    for step in smallest.steps if smallest else ():
        causes_in_words = [", ".join(cause.changes) for cause in step.fewest]
        rows.append((step.share, step.size or None, step.tried, causes_in_words))
    title = (
        "How many changes are enough, with every change at the same share of the way to its"
        " end"
    )
    stairs = pd.DataFrame(rows, columns=list(STAIRCASE_COLUMNS)).astype(
        {"fewest": "Int64"}
    )
    return {
        "causes": tabulate(TITLE, SMALLEST_COLUMNS, smallest.table if smallest else ()),
        "staircase": tabulate(title, STAIRCASE_COLUMNS, stairs),
    }


def draw_staircase(answer: Answer) -> Figure:
    """Draw the least number of unsafe changes over the share of the way to the ends. Each step has
    the names of the changed characteristics.
    """
    from safevar_sumo.questions.figures import (
        BLUE,
        FONT_SIZE,
        escape_dollars,
        new_figure,
    )

    title = f"{answer.study.name}: how many changes are enough for an unsafe vehicle"
    figure, ((axis,),) = new_figure(title, 1, 1, (6.4, 3.6))
    rows = answer.tables["staircase"].iloc[::-1]
    stairs = rows[rows["causes"].map(len) > 0]
    fewest = stairs["fewest"].astype(int)
    axis.step(100 * stairs["share"], fewest, "o-", where="post", color=BLUE)
    size = FONT_SIZE - 2
    named = ""
    for row in rows.to_dict("records"):
        share = 100 * row["share"]
        if not row["causes"]:
            text = f"none of {row['tried']:,}\ncombinations\nis unsafe"
            axis.text(share, 1.1, text, fontsize=size, ha="center")
            continue
        cause, *alternatives = row["causes"]
        if cause == named:
            continue
        named = cause
        text = cause.replace(", ", "\n")
        if alternatives:
            text += f"\n(1 of {len(alternatives) + 1})"
        axis.annotate(
            escape_dollars(text),
            (share, row["fewest"]),
            xytext=(5, 6),
            textcoords="offset points",
            fontsize=size,
        )
    # The axis ends at 125 %, because the names at the last step need room at the right.
    axis.set_xlim(0, 125)
    axis.set_xticks(range(0, 101, 20))
    axis.grid(visible=False, axis="x")
    axis.set_ylim(0.5, max(fewest, default=1) + 1.6)
    axis.yaxis.get_major_locator().set_params(integer=True)
    axis.set_xlabel("share of the way from the original to the end of the domain [%]")
    axis.set_ylabel("changes")
    return figure


def _table(
    evaluator: Evaluator, unsafe: Unsafe, beginnings: Sequence[Beginning], fits: int
) -> pd.DataFrame:
    """The frame with a row of `SMALLEST_COLUMNS` for each cause."""
    beginnings = _as_printed(evaluator, unsafe, beginnings)
    causes = [beginning.cause for beginning in beginnings]
    robust, holds, number_of_sets = sureness(evaluator, causes, unsafe, fits)
    rows = [
        {
            **beginning.cause._asdict(),
            **beginning._asdict(),
            "causes": beginning.cause.changes,
            "size": len(beginning.cause.changes),
            "holds": sets_with_cause,
            "fits": number_of_sets,
            "robust_share": share,
        }
        for beginning, sets_with_cause, share in zip(
            beginnings, holds, robust.tolist(), strict=True
        )
    ]
    frame = pd.DataFrame(rows, columns=list(SMALLEST_COLUMNS))
    in_order = frame.astype(COUNTS).sort_values(
        ["size", "robust_share", "holds", "begins_at"],
        ascending=[True, False, False, True],
    )
    frame = in_order.reset_index(drop=True)
    return with_fresh_runs(evaluator, unsafe, frame, "causes")


def _as_printed(
    evaluator: Evaluator, unsafe: Unsafe, beginnings: Sequence[Beginning]
) -> list[Beginning]:
    """The beginnings with values as they are printed, rounded to the unsafe side. With too few
    simulations they stay as they are, because a rounded vehicle is simulated again.
    """
    vehicles = []
    for beginning in beginnings:
        encounter = beginning.cause.encounter
        vehicles += [
            beginning.boundary | encounter,
            beginning.cause.changes | encounter,
        ]
    left = evaluator.settings_left
    if left is not None and left < 2 * len(DIGITS_OF_SHARES) * len(vehicles):
        return list(beginnings)
    model = Model(0, evaluator, unsafe)
    printed = iter(values_as_printed(model, vehicles, further=DIGITS_OF_SHARES))
    rounded = []
    for beginning in beginnings:
        at_boundary = next(printed)
        checked = next(printed)
        names = beginning.boundary
        cause = beginning.cause._replace(
            changes={name: checked[name] for name in names}
        )
        values = {name: at_boundary[name] for name in names}
        rounded.append(beginning._replace(cause=cause, boundary=values))
    return rounded
