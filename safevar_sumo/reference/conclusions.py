"""Comparison of results here with published results: joint tables, and whether each published conclusion holds here."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import StrEnum
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.analysis.research_questions.answer import answer_questions
from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES, Case, UnanswerableError
from safevar_sumo.analysis.research_questions.changes import ANY, changes_of, critical_solutions, masks_by_change_count
from safevar_sumo.analysis.research_questions.statistics import ALPHA, magnitude_of
from safevar_sumo.records import FloatArray
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


Row = Mapping[Any, Any]
"""A row of a table by column."""

Rows = list[tuple[Row, Row]]
"""Pairs of a row here and the published row with the same keys."""


class ComparedTable(NamedTuple):
    """A table: pairs of a row here and the published row with the same keys, the quantities of a row, and notes on the
    table.
    """

    name: str
    rows: Rows
    quantities: list[str]
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
            tables.append(
                ComparedTable(name, [], [], [*notes, f"No table: nothing to show {' and '.join(empty_sides)}."])
            )
            continue
        if name == "combinations":  # those of equal rank are compared
            frames = {
                side: frame.assign(
                    place=frame.groupby("setting").cumcount() + 1,
                    characteristics=frame["characteristics"].map(", ".join),
                )
                for side, frame in frames.items()
            }
        rows_of_sides = [
            {tuple(row[key] for key in keys): row for row in frame.to_dict("records")} for frame in frames.values()
        ]
        rows = [
            [rows.get(key, dict(zip(keys, key, strict=True))) for rows in rows_of_sides]
            for key in dict.fromkeys(key for rows in rows_of_sides for key in rows)
        ]
        quantities = [
            str(column)
            for column in frames[HERE]
            if column in frames[PUBLISHED] and column not in (*keys, *UNCOMPARED_COLUMNS)
        ]
        tables.append(ComparedTable(name, [(row, other) for row, other in rows], quantities, notes))
    return tables


def _tabulate_change_numbers(cases: Sequence[Case]) -> pd.DataFrame:
    """The table of RQ3.1, which needs no runs here: share of the critical solutions with j changed characteristics
    [%].
    """
    rows: list[dict[str, Any]] = []
    for case in cases:
        try:
            masks = masks_by_change_count(case, changes_of(case, critical_solutions(case)))
        except UnanswerableError:
            continue
        rows += [
            {"setting": case.name, "j": j, "percent": 100 * float(np.mean(mask)) if len(mask) else None}
            for j, mask in masks.items()
            if j != ANY
        ]
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
RULES = (
    f"Tests (RQ1, RQ2): *{HOLDS}* if both are significant (p < {ALPHA:g}) or neither is, if both effect sizes are of "
    "the same magnitude "
    "(Kitchenham's negligible, small, medium, large), and if they lie on the same side of 0.5 unless they are "
    "negligible or not "
    f"significant; else *{IN_DIRECTION}* if they lie on the same side of 0.5; else *{DIFFERS}*.",
    f"Numbers of changes (RQ3.1): *{HOLDS}* if the most frequent number is the same, *{IN_DIRECTION}* if the means "
    "differ by at most 1.",
    f"Orders (RQ3.2, weather): *{HOLDS}* from a rank correlation of {MIN_RHO:g}, *{IN_DIRECTION}* from "
    f"{MIN_RHO_IN_DIRECTION:g}.",
    f"Directions of changes (RQ3.3): *{HOLDS}* if at least {100 * MIN_SHARE:.0f} % of the characteristics that lean to "
    "one direction "
    f"in the published results (by {100 * MIN_LEAN:.0f} % of their changes) lean to it here, "
    f"*{IN_DIRECTION}* from {100 * MIN_SHARE_IN_DIRECTION:.0f} %.",
    f"Shares and means (collisions, safety): *{HOLDS}* within a factor of {MAX_FACTOR:g}, *{IN_DIRECTION}* if both "
    "have the same sign.",
    f"Combinations: *{HOLDS}* if the most frequent one is the same, *{IN_DIRECTION}* if it is among the combinations "
    "shown on the other "
    "side, or shares three of its four characteristics with the most frequent published one.",
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
    return [conclusion for table in tables for conclusion in TABLE_READERS[table.name](_any_number(table.rows))]


def _any_number(rows: Rows) -> Rows:
    """The rows over all numbers of changes, if the table has some."""
    return [pair for pair in rows if pair[0]["j"] == ANY] if any(row.get("j") == ANY for row, _ in rows) else rows


def _by(rows: Rows, *keys: str) -> Iterator[tuple[str, Rows]]:
    """The rows of each combination of keys."""
    for names in dict.fromkeys(tuple(row[key] for key in keys) for row, _ in rows):
        yield ", ".join(names), [pair for pair in rows if tuple(pair[0][key] for key in keys) == names]


def _numbers(rows: Rows, quantity: str) -> FloatArray:
    """The values of a quantity here and published, shape (rows, 2); NaN where undefined."""
    return np.array([[row.get(quantity) for row in pair] for pair in rows], dtype=float)


def judge_test(effect: float, p: float, published_effect: float, published_p: float) -> ReplicationVerdict:
    """Whether a published test holds here, by direction, magnitude and significance."""
    is_same_direction = (effect - 0.5) * (published_effect - 0.5) > 0
    magnitudes = {magnitude_of(effect), magnitude_of(published_effect)}
    if (
        (p < ALPHA) == (published_p < ALPHA)
        and len(magnitudes) == 1
        and (is_same_direction or p >= ALPHA or magnitudes == {"negligible"})
    ):
        return HOLDS
    return IN_DIRECTION if is_same_direction else DIFFERS


def _judge(holds: bool, holds_in_direction: bool) -> ReplicationVerdict:
    return HOLDS if holds else IN_DIRECTION if holds_in_direction else DIFFERS


def _read_tests(question: str, subject: str, if_larger: str, if_smaller: str, rows: Rows) -> Iterator[Conclusion]:
    """Statistical tests; `if_larger` and `if_smaller` describe effect sizes above and below 0.5."""
    for (row, _), effects, p_values in zip(rows, _numbers(rows, "effect_size"), _numbers(rows, "p_value"), strict=True):
        name = f"{ALGORITHM_TITLES.get(row[subject], row[subject])}, {row['metric']}"
        if np.isnan(effects).any():
            yield Conclusion(
                question, row["setting"], name, UNDECIDED, f"no test {COMPARED_SIDES[int(np.isnan(effects).argmax())]}"
            )
            continue
        difference = "no difference" if p_values[1] >= ALPHA else if_larger if effects[1] > 0.5 else if_smaller
        numbers = (
            f"{effect:.2f} {side} ({magnitude_of(effect)}, p {p:.2g})"
            for side, effect, p in zip(COMPARED_SIDES, effects, p_values, strict=True)
        )
        yield Conclusion(
            question,
            row["setting"],
            f"{name}: {difference}",
            judge_test(effects[0], p_values[0], effects[1], p_values[1]),
            f"effect size {', '.join(numbers)}",
        )


def _read_ratios(question: str, subject: str, quantity: str, meaning: str, rows: Rows) -> Iterator[Conclusion]:
    """Comparisons of a quantity in each row by the ratio of its two values."""
    for (row, _), values in zip(rows, _numbers(rows, quantity), strict=True):
        statement, (value, published_value) = f"{ALGORITHM_TITLES.get(row[subject], row[subject])}: {meaning}", values
        if np.isnan(values).any():
            sides = " and ".join(
                side for side, is_missing in zip(COMPARED_SIDES, np.isnan(values), strict=True) if is_missing
            )
            yield Conclusion(question, row["setting"], statement, UNDECIDED, f"no value {sides}")
            continue
        is_same_sign = value * published_value > 0
        is_equal = value == published_value or (
            is_same_sign and 1 / MAX_FACTOR <= value / published_value <= MAX_FACTOR
        )
        yield Conclusion(
            question,
            row["setting"],
            statement,
            _judge(is_equal, is_same_sign),
            f"{value:.3g} here, {published_value:.3g} published",
        )


def _read_change_numbers(rows: Rows) -> Iterator[Conclusion]:
    for case, group in _by(rows, "setting"):
        percents, numbers = np.nan_to_num(_numbers(group, "percent")), np.array([int(row["j"]) for row, _ in group])
        if percents.any(axis=0).all():
            mode, published_mode = numbers[percents.argmax(axis=0)]
            mean, published_mean = numbers @ percents / percents.sum(axis=0)
            yield Conclusion(
                "RQ3.1",
                case,
                f"most critical solutions change {published_mode} characteristics",
                _judge(mode == published_mode, abs(mean - published_mean) <= 1),
                f"most frequent {mode} here, {published_mode} published; mean {mean:.1f} and {published_mean:.1f}",
            )


def _read_orders(question: str, keys: Sequence[str], quantity: str, rows: Rows) -> Iterator[Conclusion]:
    """Orders of the characteristics by a quantity."""
    for case, group in _by(rows, *keys):
        values = _numbers(group, quantity)
        is_defined = ~np.isnan(values).any(axis=1)
        if is_defined.any():
            names = np.array([row["characteristic"] for row, _ in group])[is_defined]
            here, published = (
                ", ".join(names[np.argsort(-column, kind="stable")][:3]) for column in values[is_defined].T
            )
            rho = rank_correlation(*values[is_defined].T)
            verdict = UNDECIDED if rho is None else _judge(rho >= MIN_RHO, rho >= MIN_RHO_IN_DIRECTION)
            evidence = "no rank correlation" if rho is None else f"rank correlation {rho:.2f}"
            yield (
                Conclusion(question, case, f"changed most often: {published}", verdict, f"{evidence}; here {here}")
                if question == "RQ3.2"
                else Conclusion(
                    question,
                    case,
                    "how much more often each characteristic is changed in the worse weather",
                    verdict,
                    evidence,
                )
            )


def _read_directions(rows: Rows) -> Iterator[Conclusion]:
    for case, group in _by(rows, "setting"):
        same, opposite = list[str](), list[str]()
        for name, pairs in _by(group, "characteristic"):
            counts = {pair[0]["direction"]: numbers for pair, numbers in zip(pairs, _numbers(pairs, "n"), strict=True)}
            differences, totals = counts["increase"] - counts["decrease"], counts["increase"] + counts["decrease"]
            if totals[1] and abs(differences[1]) / totals[1] >= MIN_LEAN:
                is_same = totals[0] > 0 and np.sign(differences[0]) == np.sign(differences[1])
                (same if is_same else opposite).append(name)
        if same or opposite:
            share = len(same) / len([*same, *opposite])
            yield Conclusion(
                "RQ3.3",
                case,
                f"{len([*same, *opposite])} characteristics are changed mostly one way",
                _judge(share >= MIN_SHARE, share >= MIN_SHARE_IN_DIRECTION),
                f"{len(same)} of them the same way here" + (f", but not {', '.join(opposite)}" if opposite else ""),
            )


def _read_combinations(rows: Rows) -> Iterator[Conclusion]:
    for case, group in _by(rows, "setting"):
        here, published = (
            [pair[side]["characteristics"] for pair in group if "characteristics" in pair[side]] for side in (0, 1)
        )
        if here and published:
            shared_count = len(set(here[0].split(", ")) & set(published[0].split(", ")))
            is_similar = published[0] in here or here[0] in published or shared_count >= 3
            yield Conclusion(
                "combinations",
                case,
                f"the four most often changed together: {published[0]}",
                _judge(here[0] == published[0], is_similar),
                f"here {here[0]}; {shared_count} of four the same",
            )


TABLE_READERS: Mapping[str, Callable[[Rows], Iterator[Conclusion]]] = {
    "rq1": partial(
        _read_tests, "RQ1", "algorithm", "safer than the original vehicle", "more unsafe than the original vehicle"
    ),
    "rq2": partial(_read_tests, "RQ2", "baseline", "NSGA-II does better", "NSGA-II does worse"),
    "rq3.1": _read_change_numbers,
    "rq3.2": partial(_read_orders, "RQ3.2", ["setting"], "percent"),
    "rq3.3": _read_directions,
    "rq3.3-safety": partial(_read_ratios, "RQ3.3", "quantity", "value", "mean change of safety in critical solutions"),
    "collisions": partial(_read_ratios, "collisions", "algorithm", "share", "share of the solutions that collide"),
    "combinations": _read_combinations,
    "weather": partial(_read_orders, "weather", ["setting", "other"], "difference"),
}
"""Functions that yield the conclusions that a table's rows show."""
