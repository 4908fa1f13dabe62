"""Answers laid out as the paper's tables: headings, number formats, what is bold. Still plain data; `tables` renders it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.analysis.research_questions.answer import SAFETY, Answer
from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES
from safevar_sumo.analysis.research_questions.changes import ANY
from safevar_sumo.analysis.research_questions.comparisons import ALPHA, ASYMPTOTIC, EXACT, NOTABLE
from safevar_sumo.analysis.research_questions.indicators import titles_of
from safevar_sumo.analysis.research_questions.over_runs import ASYMPTOTIC_SIGNED, EXACT_SIGNED
from safevar_sumo.metrics import MetricFacts

UNDEFINED = "-"
SAFETY_UNITS = {"avgSD_mD": "avgSD_mD [m]", "avgSD_cS": "avgSD_cS [m/s]", "TET": "TET [s]", "TIT": "TIT [s^2]",
                "aveDece": "aveDece [m/s^2]"}
PAPER_NUMBERS = ("2", "3", "4", "5", "6")
"""The numbers of changed characteristics that the paper's table of RQ3.3 has."""
BOLD_NOTE = f"Bold (or *): p < {ALPHA:g}; an effect size of medium or large magnitude."

HOLM_NOTE = f"Bold (or *): p < {ALPHA:g} after Holm's correction for all tests of a setting's RQ1 and RQ2; A12 medium or large."


class Bold(str):
    """A cell that stands out."""


class Table(NamedTuple):
    """A table ready to be rendered: `spans` are headings over several columns, the first `labels` columns are text."""

    title: str
    heads: tuple[str, ...]
    rows: list[tuple[str, ...]]
    labels: int
    spans: tuple[tuple[str, int], ...] = ()
    notes: tuple[str, ...] = ()


Layout = Callable[[Answer], list[Table]]
"""What turns an answer into tables."""
Layouts = Mapping[str, Layout]
"""Layouts by the answers' names."""


def lay_out(answer: Answer, layouts: Layouts | None = None) -> list[Table]:
    """The tables of an answer; without any case that has it, one that says why."""
    if answer.frame.empty:
        return [Table(TITLES[answer.name], (), [], 0, (), answer.notes)]
    tables = (layouts or LAYOUTS)[answer.name](answer)
    return [*tables[:-1], tables[-1]._replace(notes=(*tables[-1].notes, *answer.notes))]


def units_note(metrics: Iterable[MetricFacts]) -> str:
    """The units of metrics."""
    return "; ".join(f"{metric.title} in {metric.unit}" for metric in metrics if metric.unit != "-") + "."


def non_collision_note(metrics: Iterable[MetricFacts]) -> str:
    """Which metrics are taken over which solutions."""
    titles: dict[bool, list[str]] = {False: [], True: []}
    for metric in metrics:
        titles[metric.over_collisions].append(metric.title)
    without, over_all = (" and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names) for names in titles.values())
    return f"{without} over solutions without collision, {over_all} over all." if without else f"{over_all} over all solutions."


def _tests(answer: Answer, who: str, notes: tuple[str, ...]) -> Table:
    """p-values and effect sizes, cases side by side."""
    frame, name, titles = answer.frame, answer.name, titles_of(answer.metrics)
    cases = list(dict.fromkeys(frame["setting"]))
    cells = {(row[who], row["metric"], row["setting"]): row for row in frame.to_dict("records")}
    parts = ("p", "A12", "magnitude", "n1", "n2") if len(cases) == 1 else ("p", "A12", "magnitude")
    rows = [(algorithm_title(algorithm), titles[metric],
             *(cell for case in cases for cell in _test(cells.get((algorithm, metric, case)), len(parts))))
            for algorithm, metric in dict.fromkeys(zip(frame[who], frame["metric"], strict=True))]
    methods = [f"p{' with e' if method == EXACT else ''}: {method}." for method in (ASYMPTOTIC, EXACT) if method in set(frame["method"])]
    return Table(TITLES[name], (who, "metric", *parts * len(cases)), rows, 2, tuple((case, len(parts)) for case in cases),
                 (*methods, *notes, BOLD_NOTE))


def _test(row: Mapping[Any, Any] | None, width: int) -> tuple[str, ...]:
    if row is None or pd.isna(row["p_value"]):
        return (UNDEFINED,) * width
    p, effect = p_value(row["p_value"]) + ("e" if row["method"] == EXACT else ""), f"{row['effect_size']:.3f}"
    p, effect = Bold(p) if row["p_value"] < ALPHA else p, Bold(effect) if row["magnitude"] in NOTABLE else effect
    return (p, effect, row["magnitude"], str(row["n1"]), str(row["n2"]))[:width]


def _rq1(answer: Answer) -> list[Table]:
    frame, metrics = answer.frame, answer.metrics
    test = _tests(answer, "algorithm", (
        "A12 below 0.5: the algorithm's solutions are more unsafe than the original vehicle,",
        "whose value is repeated to the sample's size.", non_collision_note(metrics)))
    cases = list(dict.fromkeys(frame["setting"]))
    means = {(row["setting"], row["algorithm"], row["metric"]): row["mean"] for row in frame.to_dict("records")}
    means |= {(row["setting"], "original", row["metric"]): row["original"] for row in frame.to_dict("records")}
    rows = [(algorithm_title(name), *(_number(means.get((case, name, metric.name)), ".2f") for case in cases for metric in metrics))
            for name in ("original", *dict.fromkeys(frame["algorithm"]))]
    heads = tuple(metric.title for metric in metrics)
    spans = tuple((case, len(heads)) for case in cases)
    return [test, Table("RQ1: mean metrics", ("vehicle", *heads * len(cases)), rows, 1, spans,
                        (units_note(metrics), non_collision_note(metrics)))]


def _rq2(answer: Answer) -> list[Table]:
    return [_tests(answer, "baseline", (
        "A12 above 0.5: NSGA-II is better; IGD, IGD+, HV: run against run, the others: pooled solutions.",
        non_collision_note(answer.metrics), "IGD on the objectives as they are, IGD+ and hypervolume (HV) on normalised ones."))]


def _over_runs(answer: Answer, who: str, sizes: tuple[str, ...], notes: tuple[str, ...]) -> list[Table]:
    """Tests over runs: p as it is and corrected, effect sizes, cases side by side."""
    frame, titles = answer.frame, titles_of(answer.metrics)
    cases = list(dict.fromkeys(frame["setting"]))
    cells = {(row[who], row["metric"], row["setting"]): row for row in frame.to_dict("records")}
    parts = ("p", "p Holm", "A12", "magnitude", *sizes)
    rows = [(algorithm_title(algorithm), titles[metric],
             *(cell for case in cases for cell in _test_over_runs(cells.get((algorithm, metric, case)), sizes)))
            for algorithm, metric in dict.fromkeys(zip(frame[who], frame["metric"], strict=True))]
    methods = [f"p: {method}." for method in (EXACT_SIGNED, ASYMPTOTIC_SIGNED, EXACT, ASYMPTOTIC) if method in set(frame["method"])]
    return [Table(TITLES[answer.name], (who, "metric", *parts * len(cases)), rows, 2, tuple((case, len(parts)) for case in cases),
                  (*methods, *notes, HOLM_NOTE))]


def _test_over_runs(row: Mapping[Any, Any] | None, sizes: tuple[str, ...]) -> tuple[str, ...]:
    if row is None or pd.isna(row["p_value"]):
        return (UNDEFINED,) * (4 + len(sizes))
    corrected, effect = p_value(row["p_holm"]), f"{row['effect_size']:.3f}"
    return (p_value(row["p_value"]), Bold(corrected) if row["p_holm"] < ALPHA else corrected,
            Bold(effect) if row["magnitude"] in NOTABLE else effect, row["magnitude"], *(str(row[size]) for size in sizes))


def _rq1_runs(answer: Answer) -> list[Table]:
    return _over_runs(answer, "algorithm", ("runs",), (
        "One mean for each run against the original vehicle's value; A12 below 0.5: the runs are more unsafe.",
        non_collision_note(answer.metrics)))


def _rq2_runs(answer: Answer) -> list[Table]:
    return _over_runs(answer, "baseline", ("n1", "n2"), (
        "One value for each run (SD and the like: the mean of its solutions); A12 above 0.5: NSGA-II is better.",
        non_collision_note(answer.metrics)))


def _rq31(frame: pd.DataFrame) -> list[Table]:
    cases = list(dict.fromkeys(frame["setting"]))
    counts = {key: group["count"].to_numpy() for key, group in frame.groupby(["setting", "j"])}
    heads = ("min", "Q1", "median", "Q3", "max")
    rows = []
    for j in _js(frame):
        quartiles = [np.quantile(counts[case, j], [0, 0.25, 0.5, 0.75, 1]) if (case, j) in counts else [None] * 5
                     for case in cases]
        rows.append((j, *(_number(value, "g") for group in quartiles for value in group)))
    return [Table(TITLES["rq3.1"], ("j", *heads * len(cases)), rows, 1, tuple((case, 5) for case in cases),
                  ("Critical solutions of a run with exactly j characteristics changed, over the runs.",))]


def _rq32(frame: pd.DataFrame) -> list[Table]:
    tables = []
    for case, group in frame.groupby("setting", sort=False):
        percent, js = _grid(group, ["characteristic"], "percent"), _js(group)
        overall = group[group["j"] == ANY]
        rank: dict[str, object] = dict(zip(overall["characteristic"], overall["rank"], strict=True))
        rows = [(name, *(_number(percent[name, j], ".1f") for j in js), _number(rank[name], "d")) for name in rank]
        tables.append(Table(f"{TITLES['rq3.2']}: {case}", ("characteristic", *js, "rank"), rows, 1,
                            notes=("Columns: number of characteristics changed; ranked by 'any'.",)))
    return [*tables, _side_by_side(frame)] if len(tables) > 1 else tables


def _side_by_side(frame: pd.DataFrame) -> Table:
    """Settings beside each other by their columns `any` and rank."""
    overall = frame[frame["j"] == ANY]
    cases = list(dict.fromkeys(overall["setting"]))
    cells = {(row["setting"], row["characteristic"]): (_number(row["percent"], ".1f"), _number(row["rank"], "d"))
             for row in overall.to_dict("records")}
    rows = [(name, *(cell for case in cases for cell in cells.get((case, name), (UNDEFINED, UNDEFINED))))
            for name in dict.fromkeys(overall["characteristic"])]
    return Table("RQ3.2: % of all critical solutions, cases side by side", ("characteristic", *("any", "rank") * len(cases)), rows, 1,
                 tuple((case, 2) for case in cases))


def _rq33(frame: pd.DataFrame) -> list[Table]:
    tables = []
    for case, group in frame.groupby("setting", sort=False):
        group = group.assign(pc=[_number(value, ".1%") for value in group["pc"]],
                             delta=[_number(value, "+.3g") for value in group["delta"]])
        pc, delta, js = (*(_grid(group, ["characteristic", "direction"], name) for name in ("pc", "delta")), _js(group))
        of_paper = [j for j in PAPER_NUMBERS if j in js]
        labels = list(dict.fromkeys(zip(group["characteristic"], group["direction"], strict=True)))
        note = ("PC: mean of |v - v''| / v; delta: mean signed change in the characteristic's unit.",)
        tables += [
            Table(f"{TITLES['rq3.3']}, 2 to 6 changed: {case}", ("characteristic", "direction", *("PC", "delta") * len(of_paper)),
                  [(*label, *(cell for j in of_paper for cell in (pc[*label, j], delta[*label, j]))) for label in labels], 2,
                  tuple((f"j = {j}", 2) for j in of_paper), note),
            *(Table(f"RQ3.3: {what}, any number changed: {case}", ("characteristic", "direction", *js),
                    [(*label, *(cells[*label, j] for j in js)) for label in labels], 2)
              for what, cells in (("PC", pc), ("delta", delta)))]
    return tables


def _safety(frame: pd.DataFrame) -> list[Table]:
    tables = []
    for case, group in frame.groupby("setting", sort=False):
        value, percent, js = _grid(group, ["quantity"], "value"), _grid(group, ["quantity"], "percent"), _js(group)
        rows = []
        for name, title in SAFETY_UNITS.items():
            rows.append((title, *(_number(value[name, j], ".2f") for j in js)))
            if name != "avgSD_cS":
                rows.append(("  % of the original", *(_number(percent[name, j], ".1f") for j in js)))
        tables.append(Table(f"{TITLES[SAFETY]}: {case}", ("mean of", *js), rows, 1, notes=(
            "avgSD_mD: reduction of the distance; TET, TIT: increase (all three without collisions);",
            "avgSD_cS: speed of collisions; aveDece: decrease, over all.")))
    return tables


def _collisions(frame: pd.DataFrame) -> list[Table]:
    cases = list(dict.fromkeys(frame["setting"]))
    cells = {(row["algorithm"], row["setting"]): (str(row["solutions"]), str(row["collisions"]), _number(row["share"], ".1%"))
             for row in frame.to_dict("records")}
    rows = [(algorithm_title(name), *(cell for case in cases for cell in cells.get((name, case), (UNDEFINED,) * 3)))
            for name in dict.fromkeys(frame["algorithm"])]
    return [Table(TITLES["collisions"], ("algorithm", *("solutions", "collisions", "share") * len(cases)), rows, 1,
                  tuple((case, 3) for case in cases))]


def _combinations(frame: pd.DataFrame) -> list[Table]:
    rows: list[tuple[str, ...]] = [(row["setting"], str(row["rank"]), ", ".join(row["characteristics"]), f"{row['percent']:.1f}")
                                   for row in frame.to_dict("records")]
    return [Table(TITLES["combinations"], ("setting", "rank", "characteristics", "%"), rows, 3,
                  notes=("Percent of the critical solutions with exactly four characteristics changed.",))]


def _weather(frame: pd.DataFrame) -> list[Table]:
    tables = []
    for (case, other), group in frame.groupby(["setting", "other"], sort=False):
        rows = [(row["characteristic"], *(_number(row[name], form) for name, form in WEATHER_COLUMNS.items()))
                for row in group.to_dict("records")]
        tables.append(Table(f"{TITLES['weather']}: {case} against {other}",
                            ("characteristic", str(case), str(other), "diff.", *(str(case), str(other)) * 3), rows, 1,
                            (("% changed", 3), ("rank", 2), ("mean increase", 2), ("mean decrease", 2)),
                            ("Over the critical solutions; increase and decrease in the characteristic's unit.",)))
    return tables


def _grid(frame: pd.DataFrame, labels: Sequence[str], value: str) -> dict[Any, Any]:
    """A column by its labels and j."""
    return dict(zip(zip(*(frame[label] for label in labels), frame["j"], strict=True), frame[value], strict=True))


def _js(frame: pd.DataFrame) -> tuple[str, ...]:
    return tuple(dict.fromkeys(frame["j"]))


def algorithm_title(name: str) -> str:
    return ALGORITHM_TITLES.get(name, name)


def _number(value: Any, form: str) -> str:
    return UNDEFINED if value is None or pd.isna(value) else format(int(value) if form == "d" else float(value), form)


def p_value(value: float) -> str:
    return "<0.001" if value < 0.001 else f"{value:.3f}"


WEATHER_COLUMNS = {"percent": ".1f", "percent_other": ".1f", "difference": "+.1f", "rank": "d", "rank_other": "d",
                   "increase": "+.3g", "increase_other": "+.3g", "decrease": "+.3g", "decrease_other": "+.3g"}
TITLES = {
    "rq1": "RQ1: found settings against the original vehicle",
    "rq2": "RQ2: NSGA-II against the other algorithms",
    "rq1-runs": "RQ1 over runs: run means against the original vehicle",
    "rq2-runs": "RQ2 over runs: NSGA-II's runs against those of the other algorithms",
    "rq3.1": "RQ3.1: number of changed characteristics",
    "rq3.2": "RQ3.2: % of critical solutions in which a characteristic is changed",
    "rq3.3": "RQ3.3: size of changes",
    SAFETY: "RQ3.3: what the changes did to safety",
    "collisions": "Collisions among the solutions",
    "combinations": "The most frequent combinations of four changes",
    "weather": "One weather against another",
}


def of_frame(layout: Callable[[pd.DataFrame], list[Table]]) -> Layout:
    """A layout that needs an answer's frame alone."""
    return lambda answer: layout(answer.frame)


LAYOUTS: Layouts = {
    "rq1": _rq1, "rq2": _rq2, "rq1-runs": _rq1_runs, "rq2-runs": _rq2_runs,
    **{name: of_frame(layout) for name, layout in {
        "rq3.1": _rq31, "rq3.2": _rq32, "rq3.3": _rq33, SAFETY: _safety, "collisions": _collisions, "combinations": _combinations,
        "weather": _weather}.items()}}
