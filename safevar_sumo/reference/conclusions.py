"""Tables of published results beside the results here, the published conclusions, and whether these hold here."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.analysis.research_questions.answer import Answer, answer_questions
from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES, Case, UnanswerableError
from safevar_sumo.analysis.research_questions.changes import change_matrix, critical_solutions, masks_by_change_count
from safevar_sumo.analysis.research_questions.comparisons import ALPHA, magnitude_of
from safevar_sumo.errors import InputError
from safevar_sumo.reference.validation import rank_correlation

HERE, PUBLISHED = "here", "published"
KEYS: Mapping[str, Sequence[str]] = {
    "rq1": ("setting", "algorithm", "metric"), "rq2": ("setting", "baseline", "metric"), "rq3.1": ("setting", "j"),
    "rq3.2": ("setting", "characteristic", "j"), "rq3.3": ("setting", "characteristic", "direction", "j"),
    "rq3.3-safety": ("setting", "quantity", "j"), "collisions": ("setting", "algorithm"), "combinations": ("setting", "place"),
    "weather": ("setting", "other", "characteristic")}
"""Columns that identify a row of each table."""
NOT_COMPARED = ("method", "n1", "n2")


class Pairs(NamedTuple):
    """Cases of the same studies on both sides, and names of studies that only one side has."""

    here: list[Case]
    published: list[Case]
    only_here: list[str]
    only_published: list[str]


class ComparedTable(NamedTuple):
    """A table with key columns, then two columns for each quantity (here and published), and its notes."""

    name: str
    frame: pd.DataFrame
    quantities: list[str]
    notes: list[str]


def pair_cases(here: Sequence[Case], published: Sequence[Case]) -> Pairs:
    """Match cases by their studies' names.

    Raises
    ------
    InputError
        If one side has two results of a study, or no study is on both sides.
    """
    sides = [_by_study(here, "directories"), _by_study(published, "published")]
    common = [name for name in sides[0] if name in sides[1]]
    if not common:
        raise InputError("published", f"has {', '.join(sides[1])} and none of {', '.join(sides[0])}",
                         "imported results of a study that DIR has results of (command import)")
    for name in common:
        vehicle, published_vehicle = (side[name].characteristics for side in sides)
        if vehicle.names != published_vehicle.names or not np.array_equal(vehicle.original, published_vehicle.original):
            raise InputError("published", f"{name} has another vehicle in the published results", "results of the same study")
    cases = [[side[name] for name in common] for side in sides]
    unpaired_names = [[name for name in side if name not in common] for side in sides]
    return Pairs(cases[0], cases[1], unpaired_names[0], unpaired_names[1])


def _by_study(cases: Sequence[Case], flag: str) -> dict[str, Case]:
    by_study: dict[str, Case] = {}
    for case in cases:
        if case.study.name in by_study:
            raise InputError(flag, f"has two results of the study {case.study.name!r}", "one of each study")
        by_study[case.study.name] = case
    return by_study


def compared_tables(pairs: Pairs) -> list[ComparedTable]:
    """Every table of the research questions, with its columns here and published."""
    sides = [{result.name: result for result in answer_questions(cases)} for cases in (pairs.here, pairs.published)]
    tables = []
    for name, keys in KEYS.items():
        answers = [side.get(name, Answer(name, pd.DataFrame(), ())) for side in sides]  # a missing table has no notes
        frames = [_number_shares(cases) for cases in pairs[:2]] if name == "rq3.1" else [result.frame for result in answers]
        notes = [f"{side}: {note}" for side, result in zip((HERE, PUBLISHED), answers, strict=True) for note in result.notes]
        frames = [_rank_combinations(frame) for frame in frames]
        if any(frame.empty for frame in frames):
            empty_sides = [side for side, frame in zip((HERE, PUBLISHED), frames, strict=True) if frame.empty]
            tables.append(ComparedTable(name, pd.DataFrame(), [], [*notes, f"No table: nothing to show {' and '.join(empty_sides)}."]))
            continue
        quantities = [str(column) for column in frames[0] if column not in (*keys, *NOT_COMPARED) and column in frames[1]]
        joint_frame = frames[0][[*keys, *quantities]].merge(frames[1][[*keys, *quantities]], on=list(keys), how="outer", sort=False,
                                                            suffixes=(f" {HERE}", f" {PUBLISHED}"))
        tables.append(ComparedTable(name, joint_frame, quantities, notes))
    return tables


def _number_shares(cases: Sequence[Case]) -> pd.DataFrame:
    """Share of the critical solutions with j changed characteristics [%]: the table of RQ3.1, which needs no runs here."""
    rows: list[dict[str, Any]] = []
    for case in cases:
        try:
            change_table = change_matrix(case, critical_solutions(case))
        except UnanswerableError:
            continue
        rows += [{"setting": case.name, "j": j, "percent": 100 * float(np.mean(is_member)) if len(is_member) else None}
                 for j, is_member in masks_by_change_count(case, change_table).items() if j != "any"]
    return pd.DataFrame(rows)


def _rank_combinations(frame: pd.DataFrame) -> pd.DataFrame:
    """Number the combinations by frequency, so that equal ranks are compared."""
    if "characteristics" not in frame:
        return frame
    return frame.assign(place=frame.groupby("setting").cumcount() + 1, characteristics=frame["characteristics"].map(", ".join))


HOLDS, DIRECTION, DIFFERS, OPEN = "holds", "holds in direction", "differs", "cannot be decided"
HOLDING_RHO, DIRECTION_RHO = 0.7, 0.4
"""Least rank correlation for an order to hold, and to hold in direction."""
FACTOR = 1.5
"""Largest factor between two shares, or two means, that count as equal."""
HOLDING_SHARE, DIRECTION_SHARE = 0.8, 0.6
"""Least share of characteristics changed in the same direction, for directions to hold, and to hold in direction."""
LEAST_LEAN = 0.2
"""Least difference between the shares of increases and decreases for a characteristic to lean to one direction."""
RULES = (
    f"Tests (RQ1, RQ2): *{HOLDS}* if both are significant (p < {ALPHA:g}) or neither is, both effect sizes are of the same magnitude "
    f"(Kitchenham's negligible, small, medium, large) and, where they are significant and not negligible, on the same side of 0.5; "
    f"*{DIRECTION}* if they only lie on the same side of 0.5; else *{DIFFERS}*.",
    f"Numbers of changes (RQ3.1): *{HOLDS}* if the most frequent number is the same, *{DIRECTION}* if the means differ by at most 1.",
    f"Orders (RQ3.2, weather): *{HOLDS}* from a rank correlation of {HOLDING_RHO:g}, *{DIRECTION}* from {DIRECTION_RHO:g}.",
    f"Directions of changes (RQ3.3): *{HOLDS}* if at least {100 * HOLDING_SHARE:.0f} % of the characteristics that lean to one direction "
    f"in the published results (by {100 * LEAST_LEAN:.0f} % of their changes) lean to it here, "
    f"*{DIRECTION}* from {100 * DIRECTION_SHARE:.0f} %.",
    f"Shares and means (collisions, safety): *{HOLDS}* within a factor of {FACTOR:g}, *{DIRECTION}* if both have the same sign.",
    f"Combinations: *{HOLDS}* if the most frequent one is the same, *{DIRECTION}* if it is among the combinations shown on the other "
    "side, or shares three of its four characteristics with the most frequent published one.")


class Conclusion(NamedTuple):
    """A published conclusion in words, whether it holds here, and the numbers that show it."""

    question: str
    setting: str
    words: str
    verdict: str
    why: str


def conclusions(tables: Sequence[ComparedTable]) -> list[Conclusion]:
    """All published conclusions, in the order of the questions."""
    return [conclusion for table in tables if not table.frame.empty for conclusion in READERS[table.name](table.frame)]


def _tests(question: str, subject_column: str, directions: str) -> Any:
    def read(frame: pd.DataFrame) -> Iterator[Conclusion]:
        for row in frame.to_dict("records"):
            (effect, p), (published_effect, published_p) = (
                (_float_or_none(row[f"effect_size {side}"]), _float_or_none(row[f"p_value {side}"])) for side in (HERE, PUBLISHED))
            subject = f"{ALGORITHM_TITLES.get(row[subject_column], row[subject_column])}, {row['metric']}"
            if effect is None or published_effect is None or p is None or published_p is None:
                yield Conclusion(question, row["setting"], subject, OPEN, f"no test {HERE if effect is None else PUBLISHED}")
                continue
            words = f"{subject}: {_difference(published_effect, published_p, directions)}"
            yield Conclusion(question, row["setting"], words, grade(effect, p, published_effect, published_p),
                             f"effect size {effect:.2f} here ({row[f'magnitude {HERE}']}, p {p:.2g}), {published_effect:.2f} published "
                             f"({row[f'magnitude {PUBLISHED}']}, p {published_p:.2g})")
    return read


def grade(effect: float, p: float, published_effect: float, published_p: float) -> str:
    """How far a published test holds here, by direction, magnitude and significance; see `RULES`."""
    same_side = (effect - 0.5) * (published_effect - 0.5) > 0
    as_significant = (p < ALPHA) == (published_p < ALPHA)
    bands = {magnitude_of(effect), magnitude_of(published_effect)}
    if as_significant and len(bands) == 1 and (same_side or p >= ALPHA or bands == {"negligible"}):
        return HOLDS
    return DIRECTION if same_side else DIFFERS


def _difference(effect: float, p: float, directions: str) -> str:
    if p >= ALPHA:
        return "no difference"
    high, low = directions.split("/")
    return high if effect > 0.5 else low


def _change_numbers(frame: pd.DataFrame) -> Iterator[Conclusion]:
    for setting, rows in frame.groupby("setting", sort=False):
        sides = [rows[f"percent {side}"].fillna(0).to_numpy(dtype=float) for side in (HERE, PUBLISHED)]
        if not all(side.sum() for side in sides):
            continue
        number = rows["j"].astype(int).to_numpy()
        modes, means = [number[side.argmax()] for side in sides], [float(number @ side / side.sum()) for side in sides]
        verdict = HOLDS if modes[0] == modes[1] else DIRECTION if abs(means[0] - means[1]) <= 1 else DIFFERS
        yield Conclusion("RQ3.1", str(setting), f"most critical solutions change {modes[1]} characteristics", verdict,
                         f"most frequent {modes[0]} here, {modes[1]} published; mean {means[0]:.1f} and {means[1]:.1f}")


def _orders(frame: pd.DataFrame) -> Iterator[Conclusion]:
    for setting, rows in frame[frame["j"] == "any"].groupby("setting", sort=False):
        defined_rows = rows.dropna(subset=[f"percent {HERE}", f"percent {PUBLISHED}"])
        if defined_rows.empty:
            continue
        top = defined_rows.sort_values(f"percent {PUBLISHED}", ascending=False, kind="stable")["characteristic"].head(3)
        top_here = defined_rows.sort_values(f"percent {HERE}", ascending=False, kind="stable")["characteristic"].head(3)
        yield _rank_conclusion("RQ3.2", str(setting), f"changed most often: {', '.join(top)}", defined_rows, "percent",
                               f"; here {', '.join(top_here)}")


def _weather(frame: pd.DataFrame) -> Iterator[Conclusion]:
    for (setting, other), rows in frame.groupby(["setting", "other"], sort=False):
        defined_rows = rows.dropna(subset=[f"difference {HERE}", f"difference {PUBLISHED}"])
        words = "how much more often each characteristic is changed in the worse weather"
        yield _rank_conclusion("weather", f"{setting}, {other}", words, defined_rows, "difference", "")


def _rank_conclusion(question: str, setting: str, words: str, defined_rows: pd.DataFrame, column: str, note: str) -> Conclusion:
    rho = rank_correlation(*(defined_rows[f"{column} {side}"].to_numpy(dtype=float) for side in (HERE, PUBLISHED)))
    verdict = OPEN if rho is None else HOLDS if rho >= HOLDING_RHO else DIRECTION if rho >= DIRECTION_RHO else DIFFERS
    return Conclusion(question, setting, words, verdict, ("no rank correlation" if rho is None else f"rank correlation {rho:.2f}") + note)


def _directions(frame: pd.DataFrame) -> Iterator[Conclusion]:
    for setting, rows in frame[frame["j"] == "any"].groupby("setting", sort=False):
        leans = {}
        for side in (HERE, PUBLISHED):
            counts = rows.pivot_table(index="characteristic", columns="direction", values=f"n {side}", aggfunc="sum", sort=False)
            totals = (counts["increase"] + counts["decrease"]).replace(0, np.nan)
            leans[side] = ((counts["increase"] - counts["decrease"]) / totals).astype(float)
        has_lean = leans[PUBLISHED].abs() >= LEAST_LEAN
        is_same = np.sign(leans[HERE][has_lean]) == np.sign(leans[PUBLISHED][has_lean])
        if not len(is_same):
            continue
        share = float(is_same.mean())
        verdict = HOLDS if share >= HOLDING_SHARE else DIRECTION if share >= DIRECTION_SHARE else DIFFERS
        opposite = ", ".join(map(str, is_same.index[~is_same]))
        yield Conclusion("RQ3.3", str(setting), f"{int(has_lean.sum())} characteristics are changed mostly one way", verdict,
                         f"{int(is_same.sum())} of them the same way here" + (f", but not {opposite}" if opposite else ""))


def _ratios(question: str, subject_column: str, value: str, words: str) -> Any:
    def read(frame: pd.DataFrame) -> Iterator[Conclusion]:
        rows = frame[frame["j"] == "any"] if "j" in frame else frame
        for row in rows.to_dict("records"):
            number, published_number = (_float_or_none(row[f"{value} {side}"]) for side in (HERE, PUBLISHED))
            subject = f"{ALGORITHM_TITLES.get(row[subject_column], row[subject_column])}: {words}"
            if number is None or published_number is None:
                sides = " and ".join(side for side, value_there in ((HERE, number), (PUBLISHED, published_number)) if value_there is None)
                yield Conclusion(question, row["setting"], subject, OPEN, f"no value {sides}")
                continue
            yield Conclusion(question, row["setting"], subject, _ratio(number, published_number),
                             f"{number:.3g} here, {published_number:.3g} published")
    return read


def _ratio(number: float, published_number: float) -> str:
    if number == published_number or (number * published_number > 0 and 1 / FACTOR <= number / published_number <= FACTOR):
        return HOLDS
    return DIRECTION if number * published_number > 0 else DIFFERS


def _combinations(frame: pd.DataFrame) -> Iterator[Conclusion]:
    for setting, rows in frame.groupby("setting", sort=False):
        ours, published = (rows.sort_values("place")[f"characteristics {side}"].dropna().tolist() for side in (HERE, PUBLISHED))
        if not ours or not published:
            continue
        common_number = len(set(ours[0].split(", ")) & set(published[0].split(", ")))
        is_similar = published[0] in ours or ours[0] in published or common_number >= 3
        verdict = HOLDS if ours[0] == published[0] else DIRECTION if is_similar else DIFFERS
        yield Conclusion("combinations", str(setting), f"the four most often changed together: {published[0]}", verdict,
                         f"here {ours[0]}; {common_number} of four the same")


def _float_or_none(value: object) -> float | None:
    return None if value is None or pd.isna(value) else float(value)  # type: ignore[arg-type, call-overload]


READERS: Mapping[str, Any] = {
    "rq1": _tests("RQ1", "algorithm", "safer than the original vehicle/more unsafe than the original vehicle"),
    "rq2": _tests("RQ2", "baseline", "NSGA-II does better/NSGA-II does worse"),
    "rq3.1": _change_numbers, "rq3.2": _orders, "rq3.3": _directions,
    "rq3.3-safety": _ratios("RQ3.3", "quantity", "value", "mean change of safety in critical solutions"),
    "collisions": _ratios("collisions", "algorithm", "share", "share of the solutions that collide"),
    "combinations": _combinations, "weather": _weather}
