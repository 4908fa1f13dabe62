"""Two sides of the same settings, cell beside cell: what was found here, and what is published."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.analysis.research_questions.answer import Answer, answer
from safevar_sumo.analysis.research_questions.case import Case, Unanswerable
from safevar_sumo.analysis.research_questions.changes import by_number, changes, critical
from safevar_sumo.errors import InputError

HERE, THERE = "here", "published"
KEYS: Mapping[str, Sequence[str]] = {
    "rq1": ("setting", "algorithm", "metric"), "rq2": ("setting", "baseline", "metric"), "rq3.1": ("setting", "j"),
    "rq3.2": ("setting", "characteristic", "j"), "rq3.3": ("setting", "characteristic", "direction", "j"),
    "rq3.3-safety": ("setting", "quantity", "j"), "collisions": ("setting", "algorithm"), "combinations": ("setting", "place"),
    "weather": ("setting", "other", "characteristic")}
"""What tells the rows of a table apart."""
NO_CELLS = ("method", "n1", "n2")


class Pairs(NamedTuple):
    """Cases by setting, on both sides, and settings that stand on one side alone."""

    here: list[Case]
    there: list[Case]
    only_here: list[str]
    only_there: list[str]


class Beside(NamedTuple):
    """A table of both sides: keys, then each quantity as two columns; and what to know about it."""

    name: str
    frame: pd.DataFrame
    quantities: list[str]
    notes: list[str]


def paired(here: Sequence[Case], there: Sequence[Case]) -> Pairs:
    """Match cases by their studies' names.

    Raises
    ------
    InputError
        If a side has two results of one study, or no study is on both.
    """
    sides = [_by_study(here, "directories"), _by_study(there, "published")]
    common = [name for name in sides[0] if name in sides[1]]
    if not common:
        raise InputError("published", f"has {', '.join(sides[1])} and none of {', '.join(sides[0])}",
                         "imported results of a study that DIR has results of (command import)")
    for name in common:
        one, other = (side[name].characteristics for side in sides)
        if one.names != other.names or not np.array_equal(one.original, other.original):
            raise InputError("published", f"{name} is of another vehicle there", "results of one and the same study")
    cases = [[side[name] for name in common] for side in sides]
    alone = [[name for name in side if name not in common] for side in sides]
    return Pairs(cases[0], cases[1], alone[0], alone[1])


def _by_study(cases: Sequence[Case], flag: str) -> dict[str, Case]:
    found: dict[str, Case] = {}
    for case in cases:
        if case.study.name in found:
            raise InputError(flag, f"has two results of the study {case.study.name!r}", "one of each study")
        found[case.study.name] = case
    return found


def tables_beside(pairs: Pairs) -> list[Beside]:
    """Every table of the research questions with both sides."""
    sides = [{one.name: one for one in answer(cases)} for cases in (pairs.here, pairs.there)]
    found = []
    for name, keys in KEYS.items():
        answers = [side.get(name, Answer(name, pd.DataFrame(), ())) for side in sides]  # a footer is missing with its table
        frames = [_shares(cases) for cases in pairs[:2]] if name == "rq3.1" else [one.frame for one in answers]
        notes = [f"{side}: {note}" for side, one in zip((HERE, THERE), answers, strict=True) for note in one.notes]
        frames = [_with_places(frame) for frame in frames]
        if any(frame.empty for frame in frames):
            lacking = [side for side, frame in zip((HERE, THERE), frames, strict=True) if frame.empty]
            found.append(Beside(name, pd.DataFrame(), [], [*notes, f"No table: nothing to show {' and '.join(lacking)}."]))
            continue
        quantities = [str(column) for column in frames[0] if column not in (*keys, *NO_CELLS) and column in frames[1]]
        both = frames[0][[*keys, *quantities]].merge(frames[1][[*keys, *quantities]], on=list(keys), how="outer", sort=False,
                                                     suffixes=(f" {HERE}", f" {THERE}"))
        found.append(Beside(name, both, quantities, notes))
    return found


def _shares(cases: Sequence[Case]) -> pd.DataFrame:
    """Which share of the critical solutions has j characteristics changed: RQ3.1 for solutions whose runs nobody knows [%]."""
    rows: list[dict[str, Any]] = []
    for case in cases:
        try:
            changed = changes(case, critical(case))
        except Unanswerable:
            continue
        rows += [{"setting": case.name, "j": j, "percent": 100 * float(np.mean(chosen)) if len(chosen) else None}
                 for j, chosen in by_number(case, changed).items() if j != "any"]
    return pd.DataFrame(rows)


def _with_places(frame: pd.DataFrame) -> pd.DataFrame:
    """Combinations stand in the order of their frequency: the first beside the first."""
    if "characteristics" not in frame:
        return frame
    return frame.assign(place=frame.groupby("setting").cumcount() + 1, characteristics=frame["characteristics"].map(", ".join))
