"""The smallest changes that make a vehicle unsafe, as `explain` prints them: causes at the ends of
the domain with where they begin and how sure they are, the staircase, and the verdict.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
import pandas as pd

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.counterexamples import values_in_words
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain.beginnings import find_beginnings
from safevar_sumo.questions.explain.combinations import (
    Enumeration,
    count_cures,
    enumerate_causes,
    staircase,
)
from safevar_sumo.questions.explain.robustness import robustness_in_words
from safevar_sumo.questions.explain.tables import RUNS, sureness
from safevar_sumo.questions.tables import Column, Columns, Frames, tabulate
from safevar_sumo.questions.words import EXACT, join_phrases, number_of, percentage
from safevar_sumo.records import JsonObject, NamedValues
from safevar_sumo.vehicles import CharacteristicSet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_SETTINGS = 12_000
"""Largest number of settings for the combinations at the ends, and again for the staircase."""
CURES = 4
"""Combinations that contain a cause are as many of these settings, divided by this number."""
NAMED = 3
"""Largest number of causes that a sentence names."""
SMALLEST_COLUMNS: Columns = {
    "causes": Column(
        "",
        "smallest set of changes that is unsafe, at the ends of the domain (or where the set begins"
        " to be unsafe)",
        EXACT,
        head="cause",
    ),
    "size": Column("", "number of changes", is_shown=False),
    "begins_at": Column(
        "-",
        "smallest share of the way to the ends of the domain at which these changes together are"
        " unsafe (in steps of 1 %)",
        EXACT,
        head="begins at share of the way",
    ),
    "boundary": Column(
        "",
        "the values at which it begins, simulated as they stand here",
        EXACT,
        is_shown=False,
    ),
    "safe_again": Column(
        "-",
        "smallest larger share of the way at which these changes are safe again; - without any",
        ".2f",
    ),
    "holds": Column(
        "",
        "number of parameter sets of the vehicle model in which it is a cause",
        head="holds in parameter sets",
    ),
    "fits": "number of parameter sets that were tried",
    "robust_share": Column(
        "-", "share of vehicles with nearly these values that are unsafe", ".2f"
    ),
    "unsafe_runs": RUNS,
    "outcome": Column("", "outcome with these changes only", is_shown=False),
}
STAIRCASE_COLUMNS: Columns = {
    "share": Column(
        "-", "share of the way to its end at which each changed part is", ".1f"
    ),
    "fewest": "fewest changes at this share of the way that are unsafe; - if none was found",
    "tried": "combinations of changes that were simulated",
    "causes": Column("", "the parts that are changed", head="changed parts"),
}
TITLE = "The smallest changes that are unsafe, all else as in the original"
SMALLEST_NUMBERS = (
    *("tried", "up_to_changes", "complete_up_to", "causes"),
    *("containing", "containing_tried", "cures"),
)


class Smallest(NamedTuple):
    """The smallest changes that are unsafe: at the ends of the domain, and nearer to the original;
    how many combinations are safe although they contain a cause, by size; and a row of
    `SMALLEST_COLUMNS` for each cause, the most robust first.
    """

    at_ends: Enumeration
    steps: Sequence[Enumeration]
    cures: dict[int, int]
    table: pd.DataFrame

    @classmethod
    def of(cls, evaluator: Evaluator, unsafe: Unsafe, fits: int) -> Self:
        """Enumerate them within what may be simulated, and see how sure they are."""
        # Of few simulations half enumerate and a third of the others find the staircase, as what is
        # not enumerated cannot be made smaller; the rest says how sure the causes are.
        at_ends = enumerate_causes(
            evaluator, unsafe, evaluator.at_most(MAX_SETTINGS, 2)
        )
        steps = staircase(
            evaluator, unsafe, at_ends, evaluator.at_most(MAX_SETTINGS, 3)
        )
        cures = count_cures(
            evaluator, unsafe, at_ends, evaluator.at_most(MAX_SETTINGS // CURES, 8)
        )
        return cls(at_ends, steps, cures, _table(evaluator, unsafe, steps, fits))

    @property
    def numbers(self) -> JsonObject:
        at_ends = self.at_ends
        containing = {
            size: len(of_size) for size, of_size in at_ends.containing.items()
        }
        simulated = sum(containing[size] for size in self.cures)
        of_containing = (sum(containing.values()), simulated, sum(self.cures.values()))
        up_to = max(at_ends.simulated, default=0)
        values = (
            at_ends.tried,
            up_to,
            at_ends.complete_up_to,
            len(self.table),
            *of_containing,
        )
        return dict(zip(SMALLEST_NUMBERS, values, strict=True))

    def sentences(self, evaluator: Evaluator, unsafe: Unsafe) -> Iterator[str]:
        """The verdict: the smallest changes, how sure they are, and what was simulated."""
        members = evaluator.characteristics
        sizes = [size for size, number in self.at_ends.existing.items() if number]
        fewest = self.at_ends.size or max(sizes, default=0)
        yield from self._first(members, unsafe)
        yield from self._of_sizes(
            members, unsafe, [size for size in sizes if size <= fewest]
        )
        yield from self._stairs(unsafe)
        yield from self._of_sizes(
            members, unsafe, [size for size in sizes if size > fewest]
        )
        yield from self._containing()
        yield self._in_none(members)
        encounters = len(evaluator.critical_encounters)
        if encounters:
            yield (
                f"Scope: the original encounter and the {encounters} encounters in which the"
                " original vehicle is least safe."
            )

    def _first(self, members: CharacteristicSet, unsafe: Unsafe) -> Iterator[str]:
        """The smallest changes at any simulated share of the way, and how sure they are."""
        thing = "a collision" if unsafe.is_collision else "an unsafe vehicle"
        if not self.at_ends.tried:
            yield "No combination of changes was simulated: the simulations did not suffice."
            return
        if self.table.empty:
            up_to = _up_to(max(self.at_ends.simulated, default=0))
            yield f"No cause of {thing} was found with {up_to} to the ends of their domains."
            return

        # The fewest changes that begin nearest to the original.
        if not self.table["size"].min():
            yield "No change is necessary: the original vehicle is unsafe in one of the encounters."
            return
        of_size = self.table[self.table["size"] == self.table["size"].min()]
        first, *others = of_size.sort_values("begins_at", kind="stable").to_dict(
            "records"
        )
        size = first["size"]
        way = "the ends of their domains (their ranges of values)"
        enough = f"{_count(size).capitalize()} changes together are"
        if size == 1:
            way, enough = "the end of its domain (its range of values)", "One change is"
        if first["begins_at"] < 1:
            way = f"{100 * first['begins_at']:.12g} % of the way to {way}"
        yield f"{enough} enough for {thing}: {values_in_words(members, first['boundary'])}, {way}."
        if others:
            other = f"other combination{'' if len(others) == 1 else 's'} of {_count(size)} changes"
            if size == 1:
                other = f"other change{'' if len(others) == 1 else 's'}"
            yield f"{len(others):,} {other} {_are(len(others))} enough, too."

        # How sure they are.
        if pd.notna(first["safe_again"]):
            again = f"{percentage(first['safe_again'])} % of the way"
            yield f"The unsafe range has a gap: at {again} the vehicle is safe again."
        if first["causes"] != first["boundary"] and pd.notna(first["robust_share"]):
            tested = values_in_words(members, first["causes"])
            yield f"The program tested with {tested} how sure this cause is."
        if first["unsafe_runs"] < 1:
            yield f"The vehicle is unsafe in {percentage(first['unsafe_runs'])} % of its runs."
        if pd.notna(first["holds"]):
            yield (
                f"These changes are a cause in {first['holds']} of {first['fits']} parameter sets"
                " of the vehicle model (alternative calibrations)."
            )
        yield robustness_in_words(first["robust_share"])

    def _of_sizes(
        self, members: CharacteristicSet, unsafe: Unsafe, sizes: Sequence[int]
    ) -> Iterator[str]:
        """How many combinations of each of some sizes are unsafe, and which."""
        simulated, existing = self.at_ends.simulated, self.at_ends.existing
        of_size = {
            size: [one for one in self.at_ends.causes if len(one.changes) == size]
            for size in sizes
        }
        are_whole_and_safe = {
            size: not causes and simulated[size] == existing[size]
            for size, causes in of_size.items()
        }
        for is_safe, group in groupby(sizes, are_whole_and_safe.__getitem__):
            if is_safe:
                parts = [
                    [*of_part]
                    for _, of_part in groupby(group, lambda size: min(size, 3))
                ]
                nouns = [
                    _noun(part, sum(existing[size] for size in part)) for part in parts
                ]
                yield f"None of the {join_phrases(nouns)} {_makes_unsafe(unsafe, 0)}."
                continue
            for size in group:
                is_whole = simulated[size] == existing[size]
                causes = of_size[size]
                names = "; ".join(
                    join_phrases(_names(members, one.changes)) for one in causes
                )
                named = f": {names}" if 0 < len(causes) <= NAMED else ""
                which = "" if is_whole else "simulated "
                beside = (
                    "" if is_whole else f" ({existing[size]:,} such combinations exist)"
                )
                noun = _noun([size], simulated[size], which)
                number = f"{len(causes):,}" if causes else "None"
                verb = _makes_unsafe(unsafe, len(causes))
                yield f"{number} of the {noun} {verb}{beside}{named}."

    def _stairs(self, unsafe: Unsafe) -> Iterator[str]:
        """The fewest changes at each share of the way that was simulated beside the ends."""
        for (number, largest), group in groupby(
            self.steps[1:], lambda step: (step.size, max(step.simulated))
        ):
            steps = [*group]
            ends = [
                f"{100 * steps[place].share:.0f}"
                for place in sorted({0, len(steps) - 1})
            ]
            where = f"If all changes go {' to '.join(ends)} % of the way to the ends"
            if number:
                enough = (
                    "1 change is" if number == 1 else f"{_count(number)} changes are"
                )
                thing = "a collision" if unsafe.is_collision else "an unsafe vehicle"
                yield f"{where}, {enough} enough for {thing}."
                continue
            tried = f"{sum(step.tried for step in steps):,} simulated combinations"
            cut = ", because more exceed the search" if steps[0].is_cut else ""
            yield f"{where}, none of {tried} ({_up_to(largest)}{cut}) {_makes_unsafe(unsafe, 0)}."

    def _containing(self) -> Iterator[str]:
        """How many combinations contain a smaller cause, and how many of these are safe."""
        *_, total, tried, cures = self.numbers.values()
        if not total:
            return
        sizes = [size for size, of_size in self.at_ends.containing.items() if of_size]
        verb = "contains" if total == 1 else "contain"
        noun = _noun(sizes, total, "further ")
        yield f"{noun} {verb} a smaller cause and {_are(total)} not among these."
        number = f"{cures:,} of" if cures else "None of"
        why = ", because another change prevents the failure" if cures else ""
        if tried:
            yield f"{number} the {tried:,} simulated ones {_are(max(cures, 1))} safe{why}."

    def _in_none(self, members: CharacteristicSet) -> str:
        """Which characteristics no cause has, up to the size of which all were simulated."""
        size = self.at_ends.complete_up_to
        names = {name for cause in self.at_ends.causes for name in cause.changes}
        others = [item.short_name for item in members.vehicle if item.name not in names]
        if not (others and self.at_ends.causes and size):
            return ""
        verb = "is" if len(others) == 1 else "are"
        sentence = (
            f"{join_phrases(others)} {verb} in no cause of {_up_to(size)} to an end."
        )
        return sentence[:1].upper() + sentence[1:]


def smallest_tables(smallest: Smallest | None) -> Frames:
    """The tables of causes and of the staircase; empty where the original itself is unsafe."""
    rows = [
        (
            step.share,
            step.size or None,
            step.tried,
            [", ".join(cause.changes) for cause in step.fewest],
        )
        for step in (smallest.steps if smallest else ())
    ]
    title = "The fewest changes at a share of the way to the ends of their domains"
    stairs = pd.DataFrame(rows, columns=[*STAIRCASE_COLUMNS]).astype(
        {"fewest": "Int64"}
    )
    causes = smallest.table if smallest else pd.DataFrame(columns=[*SMALLEST_COLUMNS])
    return {
        "causes": tabulate(TITLE, SMALLEST_COLUMNS, causes),
        "staircase": tabulate(title, STAIRCASE_COLUMNS, stairs),
    }


def draw_staircase(answer: Answer) -> Figure:
    """The fewest changes over the share of the way to the ends, with the names of the parts."""
    from safevar_sumo.questions.figures import (
        BLUE,
        FONT_SIZE,
        escape_dollars,
        new_figure,
    )

    # A step for each share, the original at the left.
    rows = answer.tables["staircase"].iloc[::-1].to_dict("records")
    found = [
        (100 * row["share"], row["fewest"], row["causes"])
        for row in rows
        if row["causes"]
    ]
    figure, ((axis,),) = new_figure(
        f"{answer.study.name}: the fewest changes that are unsafe", 1, 1, (6.4, 3.6)
    )
    shares = [share for share, _, _ in found]
    fewest = [number for _, number, _ in found]
    axis.step(shares, fewest, "o-", where="post", color=BLUE)
    for place, (share, number, causes) in enumerate(found):
        if place and causes[0] == found[place - 1][2][0]:
            continue
        others = f"\n(one of {len(causes)})" if len(causes) > 1 else ""
        axis.annotate(
            escape_dollars(causes[0].replace(", ", "\n") + others),
            (share, number),
            xytext=(5, 6),
            textcoords="offset points",
            fontsize=FONT_SIZE - 2,
        )
    for row in rows:
        if not row["causes"]:
            words = f"none of {row['tried']:,}\nsimulated"
            axis.text(
                100 * row["share"], 1.1, words, fontsize=FONT_SIZE - 2, ha="center"
            )
    axis.set_xlim(0, 125)  # with room for names at the right
    axis.set_xticks(range(0, 101, 20))
    axis.grid(visible=False, axis="x")
    axis.set_ylim(0.5, max(fewest, default=1) + 1.6)
    axis.yaxis.get_major_locator().set_params(integer=True)
    axis.set_xlabel("share of the way from the original to the end of the domain [%]")
    axis.set_ylabel("changes")
    return figure


def _table(
    evaluator: Evaluator, unsafe: Unsafe, steps: Sequence[Enumeration], fits: int
) -> pd.DataFrame:
    """A row of `SMALLEST_COLUMNS` for each cause, the most robust first."""
    beginnings = find_beginnings(evaluator, unsafe, steps)
    causes = [one.cause for one in beginnings]
    robust, holds, tried = sureness(evaluator, causes, unsafe, fits)
    rows = [
        {
            **one.cause._asdict(),
            "causes": one.cause.changes,
            "size": len(one.cause.changes),
            "begins_at": one.share,
            "boundary": one.boundary,
            "safe_again": one.safe_again,
            "holds": held,
            "fits": tried,
            "robust_share": share,
        }
        for one, held, share in zip(beginnings, holds, robust.tolist(), strict=True)
    ]
    rows.sort(
        key=lambda row: (
            -np.nan_to_num(row["robust_share"], nan=-1),
            -(row["holds"] or 0),
            row["size"],
        )
    )
    frame = pd.DataFrame(rows, columns=[*SMALLEST_COLUMNS])
    frame["safe_again"] = frame["safe_again"].astype(float).replace(np.inf, np.nan)
    return frame.astype({"holds": "Int64", "fits": "Int64"})


def _names(members: CharacteristicSet, changes: NamedValues) -> list[str]:
    return [item.short_name for item in members if item.name in changes]


def _makes_unsafe(unsafe: Unsafe, number: int) -> str:
    """What so many changes do; of none, as of one."""
    if unsafe.is_collision:
        return "cause a collision" if number > 1 else "causes a collision"
    return "make the vehicle unsafe" if number > 1 else "makes the vehicle unsafe"


def _noun(sizes: Sequence[int], number: int, which: str = "") -> str:
    """Combinations of sizes: `24 changes of a single characteristic to an end of its domain`."""
    if [*sizes] == [1]:
        change = number_of(number, f"{which}change")
        return f"{change} of a single characteristic to an end of its domain"
    counts = " to ".join(map(_count, sorted({sizes[0], sizes[-1]})))
    return f"{number_of(number, f'{which}combination')} of {counts} changes"


def _are(number: int) -> str:
    return "is" if number == 1 else "are"


def _count(number: int) -> str:
    words = (
        "none",
        "one",
        "two",
        "three",
        "four",
        "five",
        "six",
        "seven",
        "eight",
        "nine",
        "ten",
    )
    return words[number] if number < len(words) else f"{number:,}"


def _up_to(size: int) -> str:
    return "one change" if size <= 1 else f"up to {_count(size)} changes"
