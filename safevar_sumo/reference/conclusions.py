"""Comparison of results here with published results: joint tables, and whether each published conclusion holds here."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.analysis.research_questions.answer import Answer, answer_questions
from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES, Case, UnanswerableError
from safevar_sumo.analysis.research_questions.changes import changes_of, critical_solutions, masks_by_change_count
from safevar_sumo.analysis.research_questions.statistics import ALPHA, magnitude_of
from safevar_sumo.errors import InputError
from safevar_sumo.reference.agreement import rank_correlation

COMPARED_SIDES = HERE, PUBLISHED = "here", "published"
KEY_COLUMNS: Mapping[str, Sequence[str]] = {
    "rq1": ("setting", "algorithm", "metric"), "rq2": ("setting", "baseline", "metric"), "rq3.1": ("setting", "j"),
    "rq3.2": ("setting", "characteristic", "j"), "rq3.3": ("setting", "characteristic", "direction", "j"),
    "rq3.3-safety": ("setting", "quantity", "j"), "collisions": ("setting", "algorithm"), "combinations": ("setting", "place"),
    "weather": ("setting", "other", "characteristic")}
"""Columns that identify a row of each table."""
UNCOMPARED_COLUMNS = ("method", "n1", "n2")


class Pairs(NamedTuple):
    """Cases of studies with results both here and published, in the same order; and names of studies with only one of the two."""

    here: list[Case]
    published: list[Case]
    only_here: list[str]
    only_published: list[str]


class ComparedTable(NamedTuple):
    """A table with key columns, then two columns for each quantity (here and published); and notes on the table."""

    name: str
    frame: pd.DataFrame
    quantities: list[str]
    notes: list[str]


def pair_cases(here: Sequence[Case], published: Sequence[Case]) -> Pairs:
    """Match cases by the names of their studies.

    Raises
    ------
    InputError
        If one side has two results of a study, or no study has results on both sides.
    """
    here_by_study, published_by_study = _index_by_study(here, "directories"), _index_by_study(published, "published")
    common_names = [name for name in here_by_study if name in published_by_study]
    if not common_names:
        raise InputError("published", f"has {', '.join(published_by_study)} and none of {', '.join(here_by_study)}",
                         "published results of a study in DIR (the command `import` makes them)")
    for name in common_names:
        vehicle, published_vehicle = here_by_study[name].characteristics, published_by_study[name].characteristics
        if vehicle.names != published_vehicle.names or not np.array_equal(vehicle.original, published_vehicle.original):
            raise InputError("published", f"{name} has another vehicle in the published results", "results of the same study")
    return Pairs([here_by_study[name] for name in common_names], [published_by_study[name] for name in common_names],
                 [name for name in here_by_study if name not in common_names],
                 [name for name in published_by_study if name not in common_names])


def _index_by_study(cases: Sequence[Case], argument: str) -> dict[str, Case]:
    by_study: dict[str, Case] = {}
    for case in cases:
        if case.study.name in by_study:
            raise InputError(argument, f"has two results of the study {case.study.name!r}", "one of each study")
        by_study[case.study.name] = case
    return by_study


def compare_tables(pairs: Pairs) -> list[ComparedTable]:
    """Every table of the research questions, with columns of both sides."""
    cases_of_sides = pairs.here, pairs.published
    answers_by_table = [{result.name: result for result in answer_questions(cases)} for cases in cases_of_sides]
    tables = []
    for name, keys in KEY_COLUMNS.items():
        answers = [by_table.get(name, Answer(name, pd.DataFrame(), ())) for by_table in answers_by_table]  # a missing table has no notes
        frames = [_tabulate_change_numbers(cases) for cases in cases_of_sides] if name == "rq3.1" else [result.frame for result in answers]
        notes = [f"{side}: {note}" for side, result in zip(COMPARED_SIDES, answers, strict=True) for note in result.notes]
        frames = [_rank_combinations(frame) for frame in frames]
        if any(frame.empty for frame in frames):
            empty_sides = [side for side, frame in zip(COMPARED_SIDES, frames, strict=True) if frame.empty]
            tables.append(ComparedTable(name, pd.DataFrame(), [], [*notes, f"No table: nothing to show {' and '.join(empty_sides)}."]))
            continue
        quantities = [str(column) for column in frames[0] if column not in (*keys, *UNCOMPARED_COLUMNS) and column in frames[1]]
        joint_frame = frames[0][[*keys, *quantities]].merge(frames[1][[*keys, *quantities]], on=list(keys), how="outer", sort=False,
                                                            suffixes=(f" {HERE}", f" {PUBLISHED}"))
        tables.append(ComparedTable(name, joint_frame, quantities, notes))
    return tables


def _tabulate_change_numbers(cases: Sequence[Case]) -> pd.DataFrame:
    """The table of RQ3.1, which needs no runs here: share of the critical solutions with j changed characteristics [%]."""
    rows: list[dict[str, Any]] = []
    for case in cases:
        try:
            change_table = changes_of(case, critical_solutions(case))
        except UnanswerableError:
            continue
        rows += [{"setting": case.name, "j": j, "percent": 100 * float(np.mean(has_j_changes)) if len(has_j_changes) else None}
                 for j, has_j_changes in masks_by_change_count(case, change_table).items() if j != "any"]
    return pd.DataFrame(rows)


def _rank_combinations(frame: pd.DataFrame) -> pd.DataFrame:
    """Give combinations their rank by frequency, in the column `place`, so that equal ranks are compared."""
    if "characteristics" not in frame:
        return frame
    return frame.assign(place=frame.groupby("setting").cumcount() + 1, characteristics=frame["characteristics"].map(", ".join))


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
"""Least share of characteristics that lean to the published direction, for directions to hold, and to hold in direction."""
MIN_LEAN = 0.2
"""Least difference between the shares of increases and decreases for a characteristic to lean to one direction."""
RULES = (
    f"Tests (RQ1, RQ2): *{HOLDS}* if both are significant (p < {ALPHA:g}) or neither is, if both effect sizes are of the same magnitude "
    "(Kitchenham's negligible, small, medium, large), and if they lie on the same side of 0.5 unless they are negligible or not "
    f"significant; else *{IN_DIRECTION}* if they lie on the same side of 0.5; else *{DIFFERS}*.",
    f"Numbers of changes (RQ3.1): *{HOLDS}* if the most frequent number is the same, *{IN_DIRECTION}* if the means differ by at most 1.",
    f"Orders (RQ3.2, weather): *{HOLDS}* from a rank correlation of {MIN_RHO:g}, *{IN_DIRECTION}* from {MIN_RHO_IN_DIRECTION:g}.",
    f"Directions of changes (RQ3.3): *{HOLDS}* if at least {100 * MIN_SHARE:.0f} % of the characteristics that lean to one direction "
    f"in the published results (by {100 * MIN_LEAN:.0f} % of their changes) lean to it here, "
    f"*{IN_DIRECTION}* from {100 * MIN_SHARE_IN_DIRECTION:.0f} %.",
    f"Shares and means (collisions, safety): *{HOLDS}* within a factor of {MAX_FACTOR:g}, *{IN_DIRECTION}* if both have the same sign.",
    f"Combinations: *{HOLDS}* if the most frequent one is the same, *{IN_DIRECTION}* if it is among the combinations shown on the other "
    "side, or shares three of its four characteristics with the most frequent published one.")


class Conclusion(NamedTuple):
    """A published conclusion as a `statement`, whether it holds here, and the numbers that show it."""

    question: str
    setting: str
    statement: str
    verdict: ReplicationVerdict
    evidence: str


TableReader = Callable[[pd.DataFrame], Iterator[Conclusion]]
"""Yields the conclusions that a table shows."""


def draw_conclusions(tables: Sequence[ComparedTable]) -> list[Conclusion]:
    """All published conclusions, in the order of the questions."""
    return [conclusion for table in tables if not table.frame.empty for conclusion in TABLE_READERS[table.name](table.frame)]


def _make_test_reader(question: str, subject_column: str, if_larger: str, if_smaller: str) -> TableReader:
    """A reader of statistical tests; `if_larger` and `if_smaller` describe effect sizes above and below 0.5."""
    def read_tests(frame: pd.DataFrame) -> Iterator[Conclusion]:
        for row in frame.to_dict("records"):
            (effect, p), (published_effect, published_p) = (
                (_float_or_none(row[f"effect_size {side}"]), _float_or_none(row[f"p_value {side}"])) for side in COMPARED_SIDES)
            subject = f"{ALGORITHM_TITLES.get(row[subject_column], row[subject_column])}, {row['metric']}"
            if effect is None or published_effect is None or p is None or published_p is None:
                yield Conclusion(question, row["setting"], subject, UNDECIDED, f"no test {HERE if effect is None else PUBLISHED}")
                continue
            difference = "no difference" if published_p >= ALPHA else if_larger if published_effect > 0.5 else if_smaller
            yield Conclusion(question, row["setting"], f"{subject}: {difference}", judge_test(effect, p, published_effect, published_p),
                             f"effect size {effect:.2f} here ({row[f'magnitude {HERE}']}, p {p:.2g}), {published_effect:.2f} published "
                             f"({row[f'magnitude {PUBLISHED}']}, p {published_p:.2g})")
    return read_tests


def judge_test(effect: float, p: float, published_effect: float, published_p: float) -> ReplicationVerdict:
    """Whether a published test holds here, by direction, magnitude and significance."""
    is_same_direction = (effect - 0.5) * (published_effect - 0.5) > 0
    is_same_significance = (p < ALPHA) == (published_p < ALPHA)
    magnitudes = {magnitude_of(effect), magnitude_of(published_effect)}
    if is_same_significance and len(magnitudes) == 1 and (is_same_direction or p >= ALPHA or magnitudes == {"negligible"}):
        return HOLDS
    return IN_DIRECTION if is_same_direction else DIFFERS


def _read_change_numbers(frame: pd.DataFrame) -> Iterator[Conclusion]:
    for case, rows in frame.groupby("setting", sort=False):
        percents, published_percents = (rows[f"percent {side}"].fillna(0).to_numpy(dtype=float) for side in COMPARED_SIDES)
        if not percents.sum() or not published_percents.sum():
            continue
        numbers = rows["j"].astype(int).to_numpy()
        mode, published_mode = numbers[percents.argmax()], numbers[published_percents.argmax()]
        mean, published_mean = (float(numbers @ shares / shares.sum()) for shares in (percents, published_percents))
        verdict = HOLDS if mode == published_mode else IN_DIRECTION if abs(mean - published_mean) <= 1 else DIFFERS
        yield Conclusion("RQ3.1", str(case), f"most critical solutions change {published_mode} characteristics", verdict,
                         f"most frequent {mode} here, {published_mode} published; mean {mean:.1f} and {published_mean:.1f}")


def _read_orders(frame: pd.DataFrame) -> Iterator[Conclusion]:
    for case, rows in frame[frame["j"] == "any"].groupby("setting", sort=False):
        defined_rows = rows.dropna(subset=[f"percent {HERE}", f"percent {PUBLISHED}"])
        if defined_rows.empty:
            continue
        most_changed, published_most_changed = (
            ", ".join(defined_rows.sort_values(f"percent {side}", ascending=False, kind="stable")["characteristic"].head(3))
            for side in COMPARED_SIDES)
        yield _compare_ranks("RQ3.2", str(case), f"changed most often: {published_most_changed}", defined_rows, "percent",
                             f"; here {most_changed}")


def _read_weathers(frame: pd.DataFrame) -> Iterator[Conclusion]:
    for (case, other_case), rows in frame.groupby(["setting", "other"], sort=False):
        defined_rows = rows.dropna(subset=[f"difference {HERE}", f"difference {PUBLISHED}"])
        statement = "how much more often each characteristic is changed in the worse weather"
        yield _compare_ranks("weather", f"{case}, {other_case}", statement, defined_rows, "difference", "")


def _compare_ranks(question: str, case: str, statement: str, defined_rows: pd.DataFrame, column: str, note: str) -> Conclusion:
    rho = rank_correlation(*(defined_rows[f"{column} {side}"].to_numpy(dtype=float) for side in COMPARED_SIDES))
    verdict = UNDECIDED if rho is None else HOLDS if rho >= MIN_RHO else IN_DIRECTION if rho >= MIN_RHO_IN_DIRECTION else DIFFERS
    evidence = "no rank correlation" if rho is None else f"rank correlation {rho:.2f}"
    return Conclusion(question, case, statement, verdict, evidence + note)


def _read_directions(frame: pd.DataFrame) -> Iterator[Conclusion]:
    for case, rows in frame[frame["j"] == "any"].groupby("setting", sort=False):
        leans = {}
        for side in COMPARED_SIDES:
            counts = rows.pivot_table(index="characteristic", columns="direction", values=f"n {side}", aggfunc="sum", sort=False)
            totals = (counts["increase"] + counts["decrease"]).replace(0, np.nan)
            leans[side] = ((counts["increase"] - counts["decrease"]) / totals).astype(float)
        has_lean = leans[PUBLISHED].abs() >= MIN_LEAN
        is_same = np.sign(leans[HERE][has_lean]) == np.sign(leans[PUBLISHED][has_lean])
        if not len(is_same):
            continue
        share = float(is_same.mean())
        verdict = HOLDS if share >= MIN_SHARE else IN_DIRECTION if share >= MIN_SHARE_IN_DIRECTION else DIFFERS
        opposite = ", ".join(map(str, is_same.index[~is_same]))
        yield Conclusion("RQ3.3", str(case), f"{int(has_lean.sum())} characteristics are changed mostly one way", verdict,
                         f"{int(is_same.sum())} of them the same way here" + (f", but not {opposite}" if opposite else ""))


def _make_ratio_reader(question: str, subject_column: str, value_column: str, value_name: str) -> TableReader:
    """A reader that compares the two values of a column in each row by their ratio."""
    def read_ratios(frame: pd.DataFrame) -> Iterator[Conclusion]:
        rows = frame[frame["j"] == "any"] if "j" in frame else frame
        for row in rows.to_dict("records"):
            values = [_float_or_none(row[f"{value_column} {side}"]) for side in COMPARED_SIDES]
            statement = f"{ALGORITHM_TITLES.get(row[subject_column], row[subject_column])}: {value_name}"
            value, published_value = values
            if value is None or published_value is None:
                empty_sides = [side for side, side_value in zip(COMPARED_SIDES, values, strict=True) if side_value is None]
                yield Conclusion(question, row["setting"], statement, UNDECIDED, f"no value {' and '.join(empty_sides)}")
                continue
            yield Conclusion(question, row["setting"], statement, _judge_ratio(value, published_value),
                             f"{value:.3g} here, {published_value:.3g} published")
    return read_ratios


def _judge_ratio(value: float, published_value: float) -> ReplicationVerdict:
    if value == published_value or (value * published_value > 0 and 1 / MAX_FACTOR <= value / published_value <= MAX_FACTOR):
        return HOLDS
    return IN_DIRECTION if value * published_value > 0 else DIFFERS


def _read_combinations(frame: pd.DataFrame) -> Iterator[Conclusion]:
    for case, rows in frame.groupby("setting", sort=False):
        here, published = (rows.sort_values("place")[f"characteristics {side}"].dropna().tolist() for side in COMPARED_SIDES)
        if not here or not published:
            continue
        shared_count = len(set(here[0].split(", ")) & set(published[0].split(", ")))
        is_similar = published[0] in here or here[0] in published or shared_count >= 3
        verdict = HOLDS if here[0] == published[0] else IN_DIRECTION if is_similar else DIFFERS
        yield Conclusion("combinations", str(case), f"the four most often changed together: {published[0]}", verdict,
                         f"here {here[0]}; {shared_count} of four the same")


def _float_or_none(value: object) -> float | None:
    return None if value is None or pd.isna(value) else float(value)  # type: ignore[arg-type, call-overload]


TABLE_READERS: Mapping[str, TableReader] = {
    "rq1": _make_test_reader("RQ1", "algorithm", if_larger="safer than the original vehicle",
                             if_smaller="more unsafe than the original vehicle"),
    "rq2": _make_test_reader("RQ2", "baseline", if_larger="NSGA-II does better", if_smaller="NSGA-II does worse"),
    "rq3.1": _read_change_numbers, "rq3.2": _read_orders, "rq3.3": _read_directions,
    "rq3.3-safety": _make_ratio_reader("RQ3.3", "quantity", value_column="value", value_name="mean change of safety in critical solutions"),
    "collisions": _make_ratio_reader("collisions", "algorithm", value_column="share", value_name="share of the solutions that collide"),
    "combinations": _read_combinations, "weather": _read_weathers}
