"""Comparison of results here with published results: joint tables, and whether each published conclusion holds here."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import StrEnum
from functools import partial
from typing import NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.analysis.case import ALGORITHM_TITLES, Case, UnanswerableError
from safevar_sumo.analysis.research_questions.answer import answer_questions
from safevar_sumo.analysis.research_questions.changes import ANY, change_numbers, count_changes
from safevar_sumo.analysis.research_questions.statistics import ALPHA, magnitude_of
from safevar_sumo.records import FloatArray, JsonObject
from safevar_sumo.reference.agreement import rank_correlation

COMPARED_SIDES = HERE, PUBLISHED = "here", "published"
KEY_COLUMNS: Mapping[str, list[str]] = {
    "rq1": ["setting", "algorithm", "metric"],
    "rq2": ["setting", "baseline", "metric"],
    "rq3.1": ["setting", "j"],
    "rq3.2": ["setting", "characteristic", "j"],
    "rq3.3": ["setting", "characteristic", "direction", "j"],
    "rq3.3-safety": ["setting", "quantity", "j"],
    "collisions": ["setting", "algorithm"],
    "combinations": ["setting", "place"],
    "weather": ["setting", "other", "characteristic"],
}
"""Columns that identify a row of each table."""
UNCOMPARED_COLUMNS = ["method", "n1", "n2"]


class ComparedTable(NamedTuple):
    """A table of a research question with both sides, and notes on it.

    The columns of the frame are the quantities here, then those published; its index has the keys. It is empty if one
    side has no rows.
    """

    name: str
    frame: pd.DataFrame
    notes: list[str]


def compare_tables(here: Sequence[Case], published: Sequence[Case]) -> list[ComparedTable]:
    """Every table of the research questions, with the rows of both sides; without rows if one side has none."""
    sides = {HERE: here, PUBLISHED: published}
    answers = {side: {answer.name: answer for answer in answer_questions(cases)} for side, cases in sides.items()}
    tables = []
    for name, keys in KEY_COLUMNS.items():
        frames = {
            side: _tabulate_change_numbers(cases) if name == "rq3.1" else answers[side][name].frame
            for side, cases in sides.items()
        }
        notes = [f"{side}: {note}" for side in sides for note in answers[side][name].notes]
        empty_sides = [side for side, frame in frames.items() if frame.empty]
        if empty_sides:
            notes.append(f"No table: nothing to show {' and '.join(empty_sides)}.")
            tables.append(ComparedTable(name, pd.DataFrame(), notes))
            continue
        for side, frame in frames.items():
            if name == "combinations":  # those in the same place are compared
                places, combinations = frame.groupby("setting").cumcount() + 1, frame["characteristics"].map(", ".join)
                frame = frame.assign(place=places, characteristics=combinations)
            frames[side] = frame.astype(object).set_index(keys)
        ours, theirs = frames.values()
        quantities = [column for column in ours if column in theirs and column not in UNCOMPARED_COLUMNS]
        rows = ours.index.append(theirs.index[~theirs.index.isin(ours.index)])
        sides_by_name = {side: frame.reindex(rows)[quantities] for side, frame in frames.items()}
        tables.append(ComparedTable(name, pd.concat(sides_by_name, axis=1), notes))
    return tables


def _tabulate_change_numbers(cases: Sequence[Case]) -> pd.DataFrame:
    """The table of RQ3.1, which needs no runs here: share of the critical solutions with j changed characteristics
    [%].
    """
    rows: list[JsonObject] = []
    for case in cases:
        try:
            counts = count_changes(case)
        except UnanswerableError:
            continue
        shares = {j: 100 * float(np.mean(counts == j)) if len(counts) else None for j in change_numbers(case)}
        rows += [{"setting": case.name, "j": j, "percent": percent} for j, percent in shares.items()]
    return pd.DataFrame(rows)


class ReplicationVerdict(StrEnum):
    """How far a published conclusion holds here; see `RULES`."""

    HOLDS = "holds"
    IN_DIRECTION = "holds in direction"
    DIFFERS = "differs"
    UNDECIDED = "cannot be decided"


HOLDS, IN_DIRECTION, DIFFERS, UNDECIDED = ReplicationVerdict
MIN_RHO, MIN_RHO_IN_DIRECTION = 0.7, 0.4
"""Least rank correlation for an order to hold, and to hold in direction."""
MAX_FACTOR = 1.5
"""Largest factor between two shares, or two means, that count as equal."""
MIN_SHARE, MIN_SHARE_IN_DIRECTION = 0.8, 0.6
"""Least share of characteristics that lean to the published direction, for directions to hold, and to hold in
direction."""
MIN_LEAN = 0.2
"""Least difference between the shares of increases and decreases for a characteristic to lean to one direction."""
CHARACTERISTICS_SHOWN = 3
"""Number of the characteristics that are changed most often that a conclusion names."""
RULES = (
    f"Tests (RQ1, RQ2): *{HOLDS}* if both are significant (p < {ALPHA:g}) or neither is, if both effect sizes are of "
    "the same magnitude (Kitchenham's negligible, small, medium, large), and if they lie on the same side of 0.5 "
    f"unless they are negligible or not significant; else *{IN_DIRECTION}* if they lie on the same side of 0.5; else "
    f"*{DIFFERS}*.",
    f"Numbers of changes (RQ3.1): *{HOLDS}* if the most frequent number is the same, *{IN_DIRECTION}* if the means "
    "differ by at most 1.",
    f"Orders (RQ3.2, weather): *{HOLDS}* from a rank correlation of {MIN_RHO:g}, *{IN_DIRECTION}* from "
    f"{MIN_RHO_IN_DIRECTION:g}.",
    f"Directions of changes (RQ3.3): *{HOLDS}* if at least {100 * MIN_SHARE:.0f} % of the characteristics that lean to "
    f"one direction in the published results (by {100 * MIN_LEAN:.0f} % of their changes) lean to it here, "
    f"*{IN_DIRECTION}* from {100 * MIN_SHARE_IN_DIRECTION:.0f} %.",
    f"Shares and means (collisions, safety): *{HOLDS}* within a factor of {MAX_FACTOR:g}, *{IN_DIRECTION}* if both "
    "have the same sign.",
    f"Combinations: *{HOLDS}* if the most frequent one is the same, *{IN_DIRECTION}* if it is among the combinations "
    "shown on the other side, or shares three of its four characteristics with the most frequent published one.",
)


class Conclusion(NamedTuple):
    """A published conclusion as a `statement`, whether it holds here, and the numbers that show it."""

    question: str
    setting: str
    statement: str
    verdict: ReplicationVerdict
    evidence: str


def draw_conclusions(tables: Sequence[ComparedTable]) -> list[Conclusion]:
    """All published conclusions, in the order of the questions."""
    conclusions = list[Conclusion]()
    for name, frame, _ in tables:
        if "j" in frame.index.names and name != "rq3.1":
            frame = frame[frame.index.get_level_values("j") == ANY]
        if len(frame):
            conclusions += TABLE_READERS[name](frame)
    return conclusions


def _numbers(frame: pd.DataFrame, quantity: str) -> FloatArray:
    """The values of a quantity, here and published, shape (rows, 2); NaN where undefined."""
    return np.stack([frame[side][quantity].to_numpy(dtype=float) for side in COMPARED_SIDES], axis=1)


def _missing(values: FloatArray) -> str:
    """Which of two values, here and published, is undefined, in words; empty if none is."""
    sides = [side for side, is_missing in zip(COMPARED_SIDES, np.isnan(values), strict=True) if is_missing]
    return f"no value {' and '.join(sides)}" if sides else ""


def judge_test(effect: float, p: float, published_effect: float, published_p: float) -> ReplicationVerdict:
    """Whether a published test holds here, by direction, magnitude and significance."""
    is_same_direction = (effect - 0.5) * (published_effect - 0.5) > 0  # on the same side of 0.5
    magnitudes = {magnitude_of(effect), magnitude_of(published_effect)}
    is_equal = (p < ALPHA) == (published_p < ALPHA) and len(magnitudes) == 1
    return _judge(is_equal and (is_same_direction or p >= ALPHA or magnitudes == {"negligible"}), is_same_direction)


def _judge(holds: bool, holds_in_direction: bool) -> ReplicationVerdict:
    if holds:
        return HOLDS
    return IN_DIRECTION if holds_in_direction else DIFFERS


def _read_tests(question: str, if_larger: str, if_smaller: str, frame: pd.DataFrame) -> Iterator[Conclusion]:
    """Statistical tests; `if_larger` and `if_smaller` describe effect sizes above and below 0.5."""
    values = zip(frame.index, _numbers(frame, "effect_size"), _numbers(frame, "p_value"), strict=True)
    for (setting, algorithm, metric), effects, p_values in values:
        name = f"{ALGORITHM_TITLES.get(algorithm, algorithm)}, {metric}"
        if missing := _missing(effects):
            yield Conclusion(question, setting, name, UNDECIDED, missing)
            continue
        (effect_here, published_effect), (p_here, published_p) = effects, p_values
        difference = if_larger if published_effect > 0.5 else if_smaller
        if published_p >= ALPHA:
            difference = "no difference"
        numbers = (
            f"{effect:.2f} {side} ({magnitude_of(effect)}, p {p:.2g})"
            for side, effect, p in zip(COMPARED_SIDES, effects, p_values, strict=True)
        )
        verdict = judge_test(effect_here, p_here, published_effect, published_p)
        yield Conclusion(question, setting, f"{name}: {difference}", verdict, f"effect size {', '.join(numbers)}")


def _read_ratios(question: str, quantity: str, meaning: str, frame: pd.DataFrame) -> Iterator[Conclusion]:
    """Comparisons of a quantity in each row by the ratio of its two values."""
    for (setting, subject, *_), values in zip(frame.index, _numbers(frame, quantity), strict=True):
        (value, published_value), missing = values, _missing(values)
        is_same_sign = value * published_value > 0
        is_equal = value == published_value or (
            is_same_sign and 1 / MAX_FACTOR <= value / published_value <= MAX_FACTOR
        )
        verdict = UNDECIDED if missing else _judge(is_equal, is_same_sign)
        evidence = missing or f"{value:.3g} here, {published_value:.3g} published"
        yield Conclusion(question, setting, f"{ALGORITHM_TITLES.get(subject, subject)}: {meaning}", verdict, evidence)


def _read_change_numbers(frame: pd.DataFrame) -> Iterator[Conclusion]:
    for case, group in frame.groupby(level="setting", sort=False):
        percents = np.nan_to_num(_numbers(group, "percent"))
        numbers = group.index.get_level_values("j").astype(int).to_numpy()
        if percents.any(axis=0).all():
            mode, published_mode = numbers[percents.argmax(axis=0)]
            mean, published_mean = numbers @ percents / percents.sum(axis=0)
            yield Conclusion(
                "RQ3.1",
                str(case),
                f"most critical solutions change {published_mode} characteristics",
                _judge(mode == published_mode, abs(mean - published_mean) <= 1),
                f"most frequent {mode} here, {published_mode} published; mean {mean:.1f} and {published_mean:.1f}",
            )


def _read_orders(question: str, keys: Sequence[str], quantity: str, frame: pd.DataFrame) -> Iterator[Conclusion]:
    """Orders of the characteristics by a quantity."""
    for names, group in frame.groupby(level=keys, sort=False):
        values = _numbers(group, quantity)
        is_defined = ~np.isnan(values).any(axis=1)
        if is_defined.any():
            characteristics = group.index.get_level_values("characteristic").to_numpy()[is_defined]
            here, published = (
                ", ".join(characteristics[np.argsort(-column, kind="stable")][:CHARACTERISTICS_SHOWN])
                for column in values[is_defined].T
            )
            rho = rank_correlation(*values[is_defined].T)
            verdict = UNDECIDED if rho is None else _judge(rho >= MIN_RHO, rho >= MIN_RHO_IN_DIRECTION)
            evidence = "no rank correlation" if rho is None else f"rank correlation {rho:.2f}"
            statement = "how much more often each characteristic is changed in the worse weather"
            if question == "RQ3.2":
                statement, evidence = f"changed most often: {published}", f"{evidence}; here {here}"
            yield Conclusion(question, ", ".join(map(str, names)), statement, verdict, evidence)


def _read_directions(frame: pd.DataFrame) -> Iterator[Conclusion]:
    for case, group in frame.groupby(level="setting", sort=False):
        counts = group.xs("n", axis=1, level=1).astype(float).unstack("direction", sort=False)
        ours, theirs = (counts[side]["increase"] - counts[side]["decrease"] for side in COMPARED_SIDES)
        totals = counts[PUBLISHED]["increase"] + counts[PUBLISHED]["decrease"]
        leaning = theirs[theirs.abs() >= MIN_LEAN * totals.clip(lower=1)]
        is_same = np.sign(ours[leaning.index]) == np.sign(leaning)
        if len(leaning):
            opposite = ", ".join(is_same.index[~is_same].get_level_values("characteristic"))
            yield Conclusion(
                "RQ3.3",
                str(case),
                f"{len(leaning)} characteristics are changed mostly one way",
                _judge(is_same.mean() >= MIN_SHARE, is_same.mean() >= MIN_SHARE_IN_DIRECTION),
                f"{is_same.sum()} of them the same way here" + (f", but not {opposite}" if opposite else ""),
            )


def _read_combinations(frame: pd.DataFrame) -> Iterator[Conclusion]:
    for case, group in frame.groupby(level="setting", sort=False):
        here, published = (group[side]["characteristics"].dropna().tolist() for side in COMPARED_SIDES)
        if here and published:
            shared_count = len(set(here[0].split(", ")) & set(published[0].split(", ")))
            is_similar = published[0] in here or here[0] in published or shared_count >= 3
            yield Conclusion(
                "combinations",
                str(case),
                f"the four most often changed together: {published[0]}",
                _judge(here[0] == published[0], is_similar),
                f"here {here[0]}; {shared_count} of four the same",
            )


TABLE_READERS: Mapping[str, Callable[[pd.DataFrame], Iterator[Conclusion]]] = {
    "rq1": partial(_read_tests, "RQ1", "safer than the original vehicle", "more unsafe than the original vehicle"),
    "rq2": partial(_read_tests, "RQ2", "NSGA-II does better", "NSGA-II does worse"),
    "rq3.1": _read_change_numbers,
    "rq3.2": partial(_read_orders, "RQ3.2", ["setting"], "percent"),
    "rq3.3": _read_directions,
    "rq3.3-safety": partial(_read_ratios, "RQ3.3", "value", "mean change of safety in critical solutions"),
    "collisions": partial(_read_ratios, "collisions", "share", "share of the solutions that collide"),
    "combinations": _read_combinations,
    "weather": partial(_read_orders, "weather", ["setting", "other"], "difference"),
}
"""Functions that yield the conclusions that a table's rows show."""
