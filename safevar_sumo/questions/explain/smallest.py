"""The smallest changes that make a vehicle unsafe, as `explain` prints them: causes at the ends of
the domain with where they begin and how sure they are, the staircase, and the verdict.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
import pandas as pd

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer
from safevar_sumo.questions.boundary import find_boundaries
from safevar_sumo.questions.cause_limits import settings_of_line
from safevar_sumo.questions.causes import BOUNDARIES, Cause, settings_of
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.explain.combinations import Enumeration, enumerate_causes, staircase
from safevar_sumo.questions.explain.robustness import robustness_in_words
from safevar_sumo.questions.explain.tables import sureness
from safevar_sumo.questions.tables import Column, Columns, Frames, tabulate
from safevar_sumo.questions.words import EXACT, join_phrases, number_of, percentage
from safevar_sumo.records import JsonObject
from safevar_sumo.vehicles import CharacteristicSet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_SETTINGS = 12_000
"""Largest number of settings for the combinations at the ends, and again for the staircase."""
PARTS, COARSE_PARTS = (32, 8), (8, 4)
"""Parts of the way to the ends, as `boundary.PARTS`; and where few simulations are allowed."""
NAMED = 3
"""Largest number of causes that a sentence names."""
SMALLEST_COLUMNS: Columns = {
    "causes": Column(
        "",
        "a smallest set of changes to an end of the domain that is unsafe, all else as in the"
        " original; fewer of them are safe",
        EXACT,
        head="cause",
    ),
    "size": Column("", "number of changes", is_shown=False),
    "begins_at": Column(
        "-",
        "share of the way from the original to these values at which it begins to be unsafe, all"
        " changes at the same share",
        ".2f",
        head="begins at share of the way",
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
    "outcome": Column("", "outcome with these changes only", is_shown=False),
}
STAIRCASE_COLUMNS: Columns = {
    "share": Column("-", "largest share of the way to its end at which a changed part is", ".1f"),
    "fewest": "fewest changes at this share of the way that are unsafe; - if none was found",
    "tried": "combinations of changes that were simulated",
    "causes": Column("", "the parts that are changed", head="changed parts"),
}
TITLE = "The smallest changes to an end of the domain, all else as in the original"
SMALLEST_NUMBERS = ("tried", "up_to_changes", "complete_up_to", "causes")


class Smallest(NamedTuple):
    """The smallest changes that are unsafe: at the ends of the domain, and nearer to the original;
    a row of `SMALLEST_COLUMNS` for each cause at the ends, the most robust first.
    """

    at_ends: Enumeration
    steps: Sequence[Enumeration]
    table: pd.DataFrame

    @classmethod
    def of(cls, evaluator: Evaluator, unsafe: Unsafe, fits: int) -> Self:
        """Enumerate them within what may be simulated, and see how sure they are."""
        # Of few simulations half enumerate and a third of the others find the staircase, as what is
        # not enumerated cannot be made smaller; the rest says how sure the causes are.
        at_ends = enumerate_causes(evaluator, unsafe, evaluator.at_most(MAX_SETTINGS, 2))
        steps = staircase(evaluator, unsafe, at_ends, evaluator.at_most(MAX_SETTINGS, 3))
        return cls(at_ends, steps, _table(evaluator, unsafe, at_ends.causes, fits))

    @property
    def numbers(self) -> JsonObject:
        up_to = max(self.at_ends.simulated, default=0)
        values = (self.at_ends.tried, up_to, self.at_ends.complete_up_to, len(self.at_ends.causes))
        return dict(zip(SMALLEST_NUMBERS, values, strict=True))

    def sentences(self, evaluator: Evaluator, unsafe: Unsafe) -> Iterator[str]:
        """The verdict: what collides, where it begins, how sure it is, and what was simulated."""
        members = evaluator.characteristics
        verbs = unsafe.verbs
        sizes = [size for size, number in self.at_ends.existing.items() if number]
        fewest = self.at_ends.size or max(sizes, default=0)
        yield from self._of_sizes(members, verbs, [size for size in sizes if size <= fewest])
        yield from self._leading(members, verbs[0], fewest)
        yield self._stairs(verbs[1])
        larger = [size for size in sizes if size > fewest]
        verbs = f"{verbs[0]} without a smaller cause", f"{verbs[1]} without a smaller cause"
        yield from self._of_sizes(members, verbs, larger)
        yield self._in_none(members)
        encounters = len(evaluator.critical_encounters)
        if encounters:
            yield (
                "Scope: each combination was simulated in the original encounter and in the"
                f" {encounters} in which the original vehicle is least safe."
            )

    def _of_sizes(
        self, members: CharacteristicSet, verbs: tuple[str, str], sizes: Sequence[int]
    ) -> Iterator[str]:
        """How many combinations of each of some sizes are unsafe, and which."""
        of_size = {
            size: [one for one in self.at_ends.causes if len(one.changes) == size] for size in sizes
        }
        simulated, existing = self.at_ends.simulated, self.at_ends.existing
        are_whole_and_safe = {
            size: not causes and simulated[size] == existing[size]
            for size, causes in of_size.items()
        }
        for is_safe, group in groupby(sizes, are_whole_and_safe.__getitem__):
            if is_safe:
                yield f"All {join_phrases(self._in_words([*group]))} are safe."
                continue
            for size in group:
                (noun,) = self._in_words([size])
                part = ""
                if simulated[size] < existing[size]:
                    part = f", of which {simulated[size]:,} were simulated,"
                causes = of_size[size]
                verb = verbs[1] if len(causes) > 1 else verbs[0]
                names = "; ".join(join_phrases(_names(members, one.changes)) for one in causes)
                named = f": {names}" if 0 < len(causes) <= NAMED else ""
                yield f"Of the {noun}{part} {_count(len(causes))} {verb}{named}."

    def _in_words(self, sizes: Sequence[int]) -> list[str]:
        """The combinations of some sizes: `24 single changes to an end of the domain`, `264 pairs`,
        `1,760 combinations of three to five`.
        """
        existing = self.at_ends.existing
        phrases = list[str]()
        if 1 in sizes:
            phrases.append(f"{number_of(existing[1], 'single change')} to an end of the domain")
        if 2 in sizes:
            phrases.append(number_of(existing[2], "pair"))
        if larger := [size for size in sizes if size > 2]:
            ends = " to ".join(map(_count, sorted({larger[0], larger[-1]})))
            number = sum(existing[size] for size in larger)
            phrases.append(f"{number_of(number, 'combination')} of {ends}")
        return phrases

    def _leading(self, members: CharacteristicSet, verb: str, size: int) -> Iterator[str]:
        """Where the most robust cause of the fewest changes begins, and how sure it is."""
        of_size = self.table[self.table["size"] == size]
        if of_size.empty:
            return
        first = of_size.iloc[0]
        names = join_phrases(_names(members, first["causes"]))
        who = "It" if len(of_size) == 1 else f"The most robust of them, {names},"
        ends = {1: "the end", 2: "both ends"}.get(size, "all ends")
        facts = []
        if pd.notna(first["begins_at"]):
            facts.append(f"begins at {percentage(first['begins_at'])} % of the way to {ends}")
        if pd.notna(first["holds"]):
            facts.append(f"{verb} in {first['holds']} of {first['fits']} parameter sets")
        yield f"{who} {' and '.join(facts)}." if facts else ""
        yield robustness_in_words(first["robust_share"])

    def _stairs(self, verb: str) -> str:
        """The fewest changes at each share of the way."""
        phrases = list[str]()
        for number, group in groupby(self.steps, lambda step: step.size):
            steps = [*group]
            ends = [f"{100 * steps[place].share:.0f}" for place in {0, len(steps) - 1}]
            what = _count(number)
            if not number:
                largest = max(steps[0].simulated, default=0)
                tried = number_of(steps[0].tried, "combination")
                what = f"none of {tried} of {_up_to(largest)}"
            phrases.append(f"{what} at {' to '.join(ends)} %")
        if not self.at_ends.causes:
            return ""
        return (
            f"The fewest changes that {verb}, all at one share of the way to their ends:"
            f" {', '.join(phrases)}."
        )

    def _in_none(self, members: CharacteristicSet) -> str:
        """Which characteristics no cause has, up to the size of which all were simulated."""
        size = self.at_ends.complete_up_to
        names = {name for cause in self.at_ends.causes for name in cause.changes}
        others = [item.short_name for item in members.vehicle if item.name not in names]
        if not (others and self.at_ends.causes and size):
            return ""
        verb = "is" if len(others) == 1 else "are"
        sentence = f"{join_phrases(others)} {verb} in no cause of {_up_to(size)} to an end."
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
    stairs = pd.DataFrame(rows, columns=[*STAIRCASE_COLUMNS]).astype({"fewest": "Int64"})
    causes = smallest.table if smallest else pd.DataFrame(columns=[*SMALLEST_COLUMNS])
    return {
        "causes": tabulate(TITLE, SMALLEST_COLUMNS, causes),
        "staircase": tabulate(title, STAIRCASE_COLUMNS, stairs),
    }


def draw_staircase(answer: Answer) -> Figure:
    """The fewest changes over the share of the way to the ends, with the names of the parts."""
    from safevar_sumo.questions.figures import BLUE, FONT_SIZE, escape_dollars, new_figure

    # A step for each share, the original at the left.
    rows = answer.tables["staircase"].iloc[::-1].to_dict("records")
    found = [(100 * row["share"], row["fewest"], row["causes"]) for row in rows if row["causes"]]
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
            axis.text(100 * row["share"], 1.1, words, fontsize=FONT_SIZE - 2, ha="center")
    axis.set_xlim(0, 125)  # with room for names at the right
    axis.set_xticks(range(0, 101, 20))
    axis.grid(visible=False, axis="x")
    axis.set_ylim(0.5, max(fewest, default=1) + 1.6)
    axis.yaxis.get_major_locator().set_params(integer=True)
    axis.set_xlabel("share of the way from the original to the end of the domain [%]")
    axis.set_ylabel("changes")
    return figure


def _table(
    evaluator: Evaluator, unsafe: Unsafe, causes: Sequence[Cause], fits: int
) -> pd.DataFrame:
    """A row of `SMALLEST_COLUMNS` for each cause, the most robust first."""
    # Where each begins, for as many as may be simulated.
    settings = settings_of(evaluator.characteristics, causes)
    starts = evaluator.characteristics.with_original_vehicle(settings)
    parts = PARTS if evaluator.left is None else COARSE_PARTS
    # Of few simulations half are left for the neighbours and the other parameter sets.
    known = evaluator.at_most(len(causes) * settings_of_line(parts), 2) // settings_of_line(parts)
    begins = np.full(len(causes), np.nan)
    if known:
        begins[:known] = find_boundaries(
            starts[:known],
            settings[:known],
            lambda rows: unsafe.of(evaluator.evaluate(rows, BOUNDARIES)),
            parts,
        ).unsafe_shares

    # How sure each is.
    robust, holds, tried = sureness(evaluator, causes, unsafe, fits)
    rows = [
        (cause.changes, len(cause.changes), begin, held, tried, share, cause.outcome)
        for cause, begin, held, share in zip(causes, begins, holds, robust, strict=True)
    ]
    rows.sort(key=lambda row: (-np.nan_to_num(row[5], nan=-1), -(row[3] or 0), row[1]))
    frame = pd.DataFrame(rows, columns=[*SMALLEST_COLUMNS])
    return frame.astype({"holds": "Int64", "fits": "Int64"})


def _names(members: CharacteristicSet, changes: Collection[str]) -> list[str]:
    return [item.short_name for item in members if item.name in changes]


def _count(number: int) -> str:
    words = ("none", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
    return words[number] if number < len(words) else f"{number:,}"


def _up_to(size: int) -> str:
    return "one change" if size <= 1 else f"up to {_count(size)} changes"
