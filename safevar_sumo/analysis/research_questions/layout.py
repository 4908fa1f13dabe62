"""Lays answers out as tables of text, in full or in the paper's layout: headings, number formats, bold cells. `tables.py` renders them.

In the frames, the columns `setting` and `other` hold the names of cases.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.analysis.research_questions.answer import SAFETY_TABLE, Answer
from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES
from safevar_sumo.analysis.research_questions.changes import ANY
from safevar_sumo.analysis.research_questions.comparisons import ALPHA, ASYMPTOTIC_TEST, EXACT_TEST, NOTABLE_MAGNITUDES
from safevar_sumo.analysis.research_questions.indicators import titles_of
from safevar_sumo.analysis.research_questions.over_runs import ASYMPTOTIC_SIGNED_TEST, EXACT_SIGNED_TEST
from safevar_sumo.metrics import MetricFacts

UNDEFINED = "-"
CONTAINED_MARK = "x"
SAFETY_UNITS = {"avgSD_mD": "avgSD_mD [m]", "avgSD_cS": "avgSD_cS [m/s]", "TET": "TET [s]", "TIT": "TIT [s^2]",
                "aveDece": "aveDece [m/s^2]"}
PAPER_CHANGE_COUNTS = ("2", "3", "4", "5", "6")
"""The numbers of changed characteristics in the paper's table of RQ3.3."""
HOLM_LEGEND = f"bold or *: p < {ALPHA:g} after Holm"
BOLD_NOTE = f"Bold (or *): p < {ALPHA:g}; A12 also of medium or large magnitude."
HOLM_NOTE = f"Bold (or *): p < {ALPHA:g} after Holm's correction for all tests of a case's RQ1 and RQ2."
CELL_NOTE = f"Cells: p / A12; bold (or *) where p < {ALPHA:g} and A12 is of medium or large magnitude."
TITLES = {
    "rq1": "RQ1: solutions against the original vehicle",
    "rq2": "RQ2: NSGA-II against the other algorithms",
    "rq1-runs": f"RQ1 over runs: run means against the original vehicle ({HOLM_LEGEND})",
    "rq2-runs": f"RQ2 over runs: NSGA-II's runs against those of the other algorithms ({HOLM_LEGEND})",
    "rq2-pairs": f"RQ2 for every pair of algorithms, over runs ({HOLM_LEGEND})",
    "rq2-ranks": f"RQ2: ranks of the algorithms over runs (1 is best; {HOLM_LEGEND})",
    "rq3.1": "RQ3.1: number of changed characteristics",
    "rq3.2": "RQ3.2: % of critical solutions in which a characteristic is changed",
    "rq3.3": "RQ3.3: size of changes",
    SAFETY_TABLE: "RQ3.3: effect of the changes on safety",
    "collisions": "Collisions among the solutions",
    "combinations": "The most frequent combinations of four changes",
    "weather": "One weather against another",
}
WEATHER_COLUMNS = {"percent": ".1f", "percent_other": ".1f", "difference": "+.1f", "rank": "d", "rank_other": "d",
                   "increase": "+.3g", "increase_other": "+.3g", "decrease": "+.3g", "decrease_other": "+.3g"}
Row = Mapping[Any, Any]
"""A row of a frame by column."""


class BoldText(str):
    """A cell in bold."""


class Table(NamedTuple):
    """A table ready to be rendered: `spans` are headings over several columns, the first `label_count` columns are text."""

    title: str
    headings: tuple[str, ...]
    rows: list[tuple[str, ...]]
    label_count: int
    spans: tuple[tuple[str, int], ...] = ()
    notes: tuple[str, ...] = ()


Layouts = Mapping[str, Callable[[Answer], list[Table]]]
"""Functions that turn an answer into tables, by the answer's name."""


def lay_out(answer: Answer, layouts: Layouts | None = None) -> list[Table]:
    """The tables of an answer; for an empty answer a table with the reason."""
    if answer.frame.empty:
        return [Table(TITLES[answer.name], headings=(), rows=[], label_count=0, notes=answer.notes)]
    tables = (layouts or LAYOUTS)[answer.name](answer)
    return [*tables[:-1], tables[-1]._replace(notes=(*tables[-1].notes, *answer.notes))]


def pivot_table(title: str, frame: pd.DataFrame, labels: Sequence[str], cells: Callable[[Row], Sequence[str]],
                headings: Sequence[str] = (), *, over: str = "setting", names: Mapping[str, str] | None = None,
                notes: Sequence[str] = ()) -> Table:
    """Make a row for each combination of `labels`, and a block of columns for each value of the column `over`, by default each case.

    A block has one column per heading, below the value of `over` as a spanning heading. Without `headings` a block is one column, headed
    by that value. `cells` makes the cells of one row and block; `names` are titles for the values of labels.
    """
    blocks = list(dict.fromkeys(frame[over]))
    keys = list(zip(*(frame[label] for label in labels), strict=True))
    cells_at = {(key, row[over]): cells(row) for key, row in zip(keys, frame.to_dict("records"), strict=True)}
    gaps = (UNDEFINED,) * (len(headings) or 1)
    rows = [(*((names or {}).get(label, label) for label in key), *(cell for block in blocks for cell in cells_at.get((key, block), gaps)))
            for key in dict.fromkeys(keys)]
    spans = tuple((block, len(headings)) for block in blocks) if headings else ()
    return Table(title, (*labels, *(tuple(headings) * len(blocks) or blocks)), rows, label_count=len(labels), spans=spans,
                 notes=tuple(notes))


def layout_by_case(layout: Callable[[str, pd.DataFrame], list[Table]]) -> Callable[[Answer], list[Table]]:
    """A layout that makes tables for each case from the case's name and rows."""
    return lambda answer: [table for case, group in answer.frame.groupby("setting", sort=False) for table in layout(str(case), group)]


def units_note(metrics: Iterable[MetricFacts]) -> str:
    """The units of metrics."""
    return "; ".join(f"{metric.title} in {metric.unit}" for metric in metrics if metric.unit != "-") + "."


def non_collision_note(metrics: Iterable[MetricFacts]) -> str:
    """A note on the solutions over which each metric is taken."""
    titles: dict[bool, list[str]] = {False: [], True: []}
    for metric in metrics:
        titles[metric.over_collisions].append(metric.title)
    safe_titles, other_titles = (" and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
                                 for names in titles.values())
    if not safe_titles:
        return f"{other_titles} over all solutions."
    return f"{safe_titles} over solutions without collision, {other_titles} over all."


def _titles(answer: Answer) -> dict[str, str]:
    return {**ALGORITHM_TITLES, **titles_of(answer.metrics)}


def _lay_out_tests(answer: Answer, group_column: str, size_columns: tuple[str, ...], notes: tuple[str, ...]) -> Table:
    """P-values (also with Holm's correction if the answer is over runs) and effect sizes; one block of columns per case."""
    frame, methods = answer.frame, set(answer.frame["method"])
    has_holm = "p_holm" in frame
    marks = {} if has_holm else {EXACT_TEST: "e"}
    method_notes = [f"p{f' with {marks[method]}' if method in marks else ''}: {method}."
                    for method in (EXACT_SIGNED_TEST, ASYMPTOTIC_SIGNED_TEST, ASYMPTOTIC_TEST, EXACT_TEST) if method in methods]
    return pivot_table(TITLES[answer.name], frame, (group_column, "metric"),
                       lambda row: _format_test_cells(answer, row, size_columns, marks),
                       ("p", *(("p Holm",) if has_holm else ()), "A12", "magnitude", *size_columns), names=_titles(answer),
                       notes=(*method_notes, *notes, HOLM_NOTE if has_holm else BOLD_NOTE))


def _format_test_cells(answer: Answer, row: Row, size_columns: Sequence[str] = (),
                       marks: Mapping[str, str] = MappingProxyType({})) -> tuple[str, ...]:
    """P-value with a mark for its method, Holm's p-value if the row has one, effect size, magnitude, sizes of the samples."""
    has_holm = "p_holm" in row
    if pd.isna(row["p_value"]):
        return (UNDEFINED,) * (3 + has_holm + len(size_columns))
    is_significant = row["p_holm"] < ALPHA if has_holm else _is_significant(answer, row)
    p = format_p_value(row["p_value"]) + marks.get(row["method"], "")
    effect = _bold_if(f"{row['effect_size']:.3f}", is_significant and (has_holm or row["magnitude"] in NOTABLE_MAGNITUDES))
    tests = (p, _bold_if(format_p_value(row["p_holm"]), is_significant)) if has_holm else (_bold_if(p, is_significant),)
    return (*tests, effect, row["magnitude"], *(str(row[column]) for column in size_columns))


def _is_significant(answer: Answer, row: Row) -> bool:
    """Whether a test of pooled solutions counts as significant: enough runs stand behind it."""
    return bool(row["p_value"] < ALPHA) and (row["setting"], row.get("algorithm", row.get("baseline"))) not in answer.untested


def _lay_out_rq1(answer: Answer) -> list[Table]:
    frame, metrics, names = answer.frame, answer.metrics, _titles(answer)
    size_columns = ("n1", "n2") if frame["setting"].nunique() == 1 else ()
    test = _lay_out_tests(answer, "algorithm", size_columns, (
        "A12 below 0.5: the algorithm's solutions are more unsafe than the original vehicle,",
        "whose value is repeated to the sample's size.", non_collision_note(metrics)))
    cases, headings = list(dict.fromkeys(frame["setting"])), tuple(metric.title for metric in metrics)
    means = {(row["setting"], row["algorithm"], row["metric"]): row["mean"] for row in frame.to_dict("records")}
    means |= {(row["setting"], "original", row["metric"]): row["original"] for row in frame.to_dict("records")}
    rows = [(names.get(name, name), *(_format_number(means.get((case, name, metric.name)), ".2f")
                                      for case in cases for metric in metrics))
            for name in ("original", *dict.fromkeys(frame["algorithm"]))]
    return [test, Table("RQ1: mean metrics", ("vehicle", *headings * len(cases)), rows, label_count=1,
                        spans=tuple((case, len(headings)) for case in cases), notes=(units_note(metrics), non_collision_note(metrics)))]


def _lay_out_rq2(answer: Answer) -> list[Table]:
    size_columns = ("n1", "n2") if answer.frame["setting"].nunique() == 1 else ()
    return [_lay_out_tests(answer, "baseline", size_columns, (
        "A12 above 0.5: NSGA-II is better. IGD, IGD+ and HV compare runs; the other metrics compare pooled solutions.",
        non_collision_note(answer.metrics), "IGD on the objectives as they are, IGD+ and hypervolume (HV) on normalised ones."))]


def _lay_out_rq1_runs(answer: Answer) -> list[Table]:
    return [_lay_out_tests(answer, "algorithm", ("runs",), (
        "One mean for each run against the original vehicle's value; A12 below 0.5: the runs are more unsafe.",
        non_collision_note(answer.metrics)))]


def _lay_out_rq2_runs(answer: Answer) -> list[Table]:
    return [_lay_out_tests(answer, "baseline", ("n1", "n2"), (
        "One value for each run (for safety metrics, the mean over its solutions); A12 above 0.5: NSGA-II is better.",
        non_collision_note(answer.metrics)))]


def _lay_out_pairs(answer: Answer) -> list[Table]:
    """A table for each pair: its metrics, cases side by side."""
    notes = ("One value for each run; A12 above 0.5: the first is better (a better front, more unsafe solutions).",
             non_collision_note(answer.metrics), "Holm's correction is for all pairs and metrics of a case.")
    return [pivot_table(TITLES["rq2-pairs"], answer.frame, ("algorithm", "other", "metric"), partial(_format_test_cells, answer),
                        ("p", "p Holm", "A12", "magnitude"), names=_titles(answer), notes=notes)]


def _lay_out_ranks(answer: Answer) -> list[Table]:
    """Mean ranks, one column per algorithm and one table per case."""
    names, tables = _titles(answer), []
    for case, group in answer.frame.groupby("setting", sort=False):
        algorithms = list(dict.fromkeys(group["algorithm"]))
        rows: list[tuple[str, ...]] = []
        for metric, metric_rows in group.groupby("metric", sort=False):
            first = metric_rows.iloc[0]
            is_significant = not pd.isna(first["p_holm"]) and first["p_holm"] < ALPHA
            p, holm = (UNDEFINED if pd.isna(first[name]) else format_p_value(first[name]) for name in ("p_value", "p_holm"))
            rows.append((names.get(str(metric), str(metric)), *(_format_number(rank, ".2f") for rank in metric_rows["mean_rank"]),
                         _format_number(first["critical_difference"], ".2f"), p, _bold_if(holm, is_significant), str(first["runs"])))
        headings = ("metric", *(names.get(name, name) for name in algorithms), "critical difference", "p", "p Holm", "runs")
        tables.append(Table(f"{TITLES['rq2-ranks']}: {case}", headings, rows, label_count=1, notes=(
            "p: Friedman's test; runs with the same number form a block. Holm's correction is for all metrics of a case.",
            f"Mean ranks that differ by less than the critical difference are not distinguished (Nemenyi, {ALPHA:g}).",
            non_collision_note(answer.metrics))))
    return tables


def _lay_out_rq31(answer: Answer) -> list[Table]:
    counts = answer.frame.groupby(["setting", "j"], sort=False)["count"].agg(list).reset_index()
    return [pivot_table(TITLES["rq3.1"], counts, ("j",),
                        lambda row: [f"{value:g}" for value in np.quantile(row["count"], [0, 0.25, 0.5, 0.75, 1])],
                        ("min", "Q1", "median", "Q3", "max"),
                        notes=("Critical solutions of a run with exactly j characteristics changed, over the runs.",))]


def _lay_out_rq32(answer: Answer) -> list[Table]:
    tables = []
    for case, group in answer.frame.groupby("setting", sort=False):
        table = pivot_table(f"{TITLES['rq3.2']}: {case}", group, ("characteristic",), _format_column("percent", ".1f"), over="j",
                            notes=("Columns: number of characteristics changed; ranked by 'any'.",))
        ranks = group.loc[group["j"] == ANY, "rank"]
        tables.append(table._replace(headings=(*table.headings, "rank"), rows=[(*row, _format_number(rank, "d")) for row, rank in
                                                                               zip(table.rows, ranks, strict=True)]))
    if len(tables) == 1:
        return tables
    return [*tables, pivot_table("RQ3.2: % of all critical solutions, cases side by side", answer.frame[answer.frame["j"] == ANY],
                                 ("characteristic",), lambda row: (_format_number(row["percent"], ".1f"), _format_number(row["rank"], "d")),
                                 ("any", "rank"))]


def _lay_out_rq33(case: str, group: pd.DataFrame) -> list[Table]:
    labels, specs = ("characteristic", "direction"), {"pc": ".1%", "delta": "+.3g"}
    paper_rows = group[group["j"].isin(PAPER_CHANGE_COUNTS)]
    return [
        pivot_table(f"{TITLES['rq3.3']}, 2 to 6 changed: {case}", paper_rows.assign(j="j = " + paper_rows["j"]), labels,
                    lambda row: [_format_number(row[name], spec) for name, spec in specs.items()], ("PC", "delta"), over="j",
                    notes=("PC: mean of |v - v''| / v (v'': filtered, v: original value); delta: mean signed change in the "
                           "characteristic's unit.",)),
        *(pivot_table(f"RQ3.3: {title}, any number changed: {case}", group, labels, _format_column(name, specs[name]), over="j")
          for title, name in (("PC", "pc"), ("delta", "delta")))]


def _format_column(name: str, spec: str) -> Callable[[Row], tuple[str]]:
    """Cells that show one column of a frame."""
    return lambda row: (_format_number(row[name], spec),)


def _lay_out_safety(case: str, group: pd.DataFrame) -> list[Table]:
    values, shares = (pivot_table("", group, ("quantity",), _format_column(name, spec), over="j")
                      for name, spec in (("value", ".2f"), ("percent", ".1f")))
    rows = []
    for (name, *cells), (_, *percent) in zip(values.rows, shares.rows, strict=True):
        rows.append((SAFETY_UNITS[name], *cells))
        if name != "avgSD_cS":
            rows.append(("  % of the original", *percent))
    return [Table(f"{TITLES[SAFETY_TABLE]}: {case}", ("mean of", *values.headings[1:]), rows, label_count=1, notes=(
        "Without collisions: avgSD_mD is the reduction of the distance, TET and TIT are increases.",
        "avgSD_cS is the speed of the collisions. aveDece is the decrease over all solutions."))]


def _lay_out_collisions(answer: Answer) -> list[Table]:
    return [pivot_table(TITLES["collisions"], answer.frame, ("algorithm",),
                        lambda row: (str(row["solutions"]), str(row["collisions"]), _format_number(row["share"], ".1%")),
                        ("solutions", "collisions", "share"), names=ALGORITHM_TITLES)]


def _lay_out_combinations(answer: Answer) -> list[Table]:
    rows: list[tuple[str, ...]] = [(row["setting"], str(row["rank"]), ", ".join(row["characteristics"]), f"{row['percent']:.1f}")
                                   for row in answer.frame.to_dict("records")]
    return [Table(TITLES["combinations"], ("case", "rank", "characteristics", "%"), rows, label_count=3,
                  notes=("Percent of the critical solutions with exactly four characteristics changed.",))]


def _lay_out_weather(answer: Answer) -> list[Table]:
    tables = []
    for (case, other_case), group in answer.frame.groupby(["setting", "other"], sort=False):
        rows = [(row["characteristic"], *(_format_number(row[name], spec) for name, spec in WEATHER_COLUMNS.items()))
                for row in group.to_dict("records")]
        tables.append(Table(f"{TITLES['weather']}: {case} against {other_case}",
                            ("characteristic", str(case), str(other_case), "diff.", *(str(case), str(other_case)) * 3), rows,
                            label_count=1, spans=(("% changed", 3), ("rank", 2), ("mean increase", 2), ("mean decrease", 2)),
                            notes=("Over the critical solutions; increase and decrease in the characteristic's unit.",)))
    return tables


def _lay_out_paper_tests(answer: Answer, group_column: str, note: str) -> list[Table]:
    """A row for each case and algorithm, a column for each metric."""
    names = _titles(answer)

    def cells(row: Row) -> tuple[str]:
        if pd.isna(row["p_value"]):
            return (UNDEFINED,)
        cell = f"{format_p_value(row['p_value'])} / {row['effect_size']:.3f}"
        return (_bold_if(cell, _is_significant(answer, row) and row["magnitude"] in NOTABLE_MAGNITUDES),)

    table = pivot_table(TITLES[answer.name], answer.frame, ("setting", group_column), cells, over="metric", names=ALGORITHM_TITLES,
                        notes=(CELL_NOTE, note))
    return [table._replace(headings=("case", group_column, *(names.get(metric, metric) for metric in table.headings[2:])))]


def _lay_out_paper_combinations(answer: Answer) -> list[Table]:
    """A row for each characteristic, a column for each combination; a cell is marked if the combination contains the characteristic."""
    records = answer.frame.to_dict("records")
    names = dict.fromkeys(name for row in records for name in row["characteristics"])
    rows = [(name, *(CONTAINED_MARK if name in row["characteristics"] else "" for row in records)) for name in names]
    rows.append(("% of solutions", *(f"{row['percent']:.1f}" for row in records)))
    spans = tuple((case, sum(row["setting"] == case for row in records)) for case in dict.fromkeys(answer.frame["setting"]))
    return [Table(TITLES["combinations"], ("characteristic", *(f"#{row['rank']}" for row in records)), rows, label_count=1,
                  spans=spans, notes=("Percent of the critical solutions with exactly four characteristics changed; #: rank.",))]


def _bold_if(cell: str, is_bold: bool) -> str:
    return BoldText(cell) if is_bold else cell


def _format_number(value: Any, spec: str) -> str:
    return UNDEFINED if value is None or pd.isna(value) else format(int(value) if spec == "d" else float(value), spec)


def format_p_value(value: float) -> str:
    return "<0.001" if value < 0.001 else f"{value:.3f}"


LAYOUTS: Layouts = {
    "rq1": _lay_out_rq1, "rq2": _lay_out_rq2, "rq1-runs": _lay_out_rq1_runs, "rq2-runs": _lay_out_rq2_runs,
    "rq2-pairs": _lay_out_pairs, "rq2-ranks": _lay_out_ranks, "rq3.1": _lay_out_rq31, "rq3.2": _lay_out_rq32,
    "rq3.3": layout_by_case(_lay_out_rq33), SAFETY_TABLE: layout_by_case(_lay_out_safety), "collisions": _lay_out_collisions,
    "combinations": _lay_out_combinations, "weather": _lay_out_weather}
PAPER_LAYOUTS: Layouts = {
    **LAYOUTS, "combinations": _lay_out_paper_combinations,
    "rq1": lambda answer: _lay_out_paper_tests(answer, "algorithm",
                                               "A12 below 0.5: the algorithm's solutions are more unsafe than the original vehicle."),
    "rq2": lambda answer: _lay_out_paper_tests(answer, "baseline", "A12 above 0.5: NSGA-II is better.")}
