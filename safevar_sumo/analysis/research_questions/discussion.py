"""What the paper discusses: collisions, combinations of changes, sun against rain, and how each characteristic is changed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import permutations

import numpy as np
import pandas as pd

from safevar_sumo.analysis.research_questions.case import Case, Unanswerable, collided
from safevar_sumo.analysis.research_questions.changes import ANY, changes, critical, rq32, rq33

COMBINED = 4
"""How many characteristics are changed in the combinations that are counted."""
SHOWN = 3
"""How many of the most frequent combinations are shown."""


def collisions(case: Case) -> pd.DataFrame:
    """Per algorithm how many of its solutions are collisions; columns setting, algorithm, solutions, collisions, share [fraction].

    Raises
    ------
    Unanswerable
        If no run is finished.
    """
    if not case.algorithms:
        raise Unanswerable(case.name, "has no finished run", "results with at least one finished run")
    rows = []
    for algorithm in case.algorithms:
        found = case.solutions_of(algorithm)
        crashes = int(collided(found).sum())
        rows.append((case.name, algorithm, len(found), crashes, crashes / len(found) if len(found) else None))
    return pd.DataFrame(rows, columns=["setting", "algorithm", "solutions", "collisions", "share"], dtype=object)


def combinations(case: Case) -> pd.DataFrame:
    """The most frequent combinations among the critical solutions with exactly four characteristics changed.

    Columns setting, rank (ties share the better one), characteristics (a list), percent of those solutions; no row
    where there is no such solution. Of combinations that are equally frequent, those whose characteristics stand
    earlier in the study come first.

    Raises
    ------
    Unanswerable
        As `critical`.
    """
    changed = changes(case, critical(case)) != 0
    of_four = changed[np.count_nonzero(changed, axis=1) == COMBINED]
    counted = Counter(tuple(np.flatnonzero(row).tolist()) for row in of_four)
    ordered = sorted(counted.items(), key=lambda item: (-item[1], item[0]))[:SHOWN]
    names = case.characteristics.names
    rows = [(case.name, 1 + sum(other > number for other in counted.values()), [names[i] for i in members], 100 * number / len(of_four))
            for members, number in ordered]
    return pd.DataFrame(rows, columns=["setting", "rank", "characteristics", "percent"])


def weather_pairs(cases: Sequence[Case]) -> list[tuple[Case, Case]]:
    """Settings that differ in the weather alone: the clearer one first (by friction, then sight, then delay).

    Raises
    ------
    Unanswerable
        If there is no such pair.
    """
    pairs = [(one, other) for one, other in permutations(cases, 2)
             if _without_weather(one) == _without_weather(other) and _clearness(one) > _clearness(other)]
    if not pairs:
        raise Unanswerable(", ".join(one.name for one in cases), "two cases are needed that differ in the weather alone",
                           "results such as those of sun and rain")
    return pairs


def weather(clear: Case, wet: Case) -> pd.DataFrame:
    """One weather against another, characteristic by characteristic, over the critical solutions.

    Columns setting, other, characteristic, percent and percent_other (in which share of the critical solutions it is
    changed), difference (the other's minus the first's), rank and rank_other, and for increase and decrease the mean
    signed change in its unit: increase, increase_other, decrease, decrease_other.

    Raises
    ------
    Unanswerable
        As `critical`.
    """
    sides = []
    for case in (clear, wet):
        share, size = rq32(case), rq33(case)
        side = share[share["j"] == ANY].set_index("characteristic")[["percent", "rank"]]
        for direction in ("increase", "decrease"):
            group = size[(size["j"] == ANY) & (size["direction"] == direction)]
            side[direction] = group.set_index("characteristic")["delta"]
        sides.append(side)
    both = sides[0].join(sides[1].add_suffix("_other"))
    difference = [None if a is None or b is None else b - a for a, b in zip(both["percent"], both["percent_other"], strict=True)]
    both.insert(0, "difference", pd.Series(difference, index=both.index, dtype=object))
    both.insert(0, "other", wet.name)
    both.insert(0, "setting", clear.name)
    columns = ["setting", "other", "characteristic", "percent", "percent_other", "difference", "rank", "rank_other",
               "increase", "increase_other", "decrease", "decrease_other"]
    return both.reset_index()[columns]


def effects(case: Case) -> pd.DataFrame:
    """Every change in every critical solution; columns setting, characteristic, change (signed, in its unit).

    Raises
    ------
    Unanswerable
        As `critical`.
    """
    changed = changes(case, critical(case))
    parts = [pd.DataFrame({"setting": case.name, "characteristic": name, "change": column[column != 0]})
             for name, column in zip(case.characteristics.names, changed.T, strict=True)]
    return pd.concat(parts, ignore_index=True)


def _clearness(case: Case) -> tuple[float, float, float]:
    weather = case.weather
    return weather.road_friction, weather.visibility, -weather.recognition_delay - weather.hesitation


def _without_weather(case: Case) -> tuple[object, ...]:
    study = case.study
    return study.scenario, study.vehicle, study.ads, study.metrics
