"""Answers as tables for readers: which columns, in which order and format, under which title.

`tables.py` renders them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.analysis.research_questions.answer import SAFETY_TABLE, Answer
from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES
from safevar_sumo.analysis.research_questions.comparisons import titles_of
from safevar_sumo.analysis.research_questions.statistics import ALPHA, EXACT_TEST, NOTABLE_MAGNITUDES
from safevar_sumo.analysis.words import join_phrases
from safevar_sumo.metrics import MetricFacts

UNDEFINED = "-"
SAFETY_UNITS = {
    "avgSD_mD": "avgSD_mD [m]",
    "avgSD_cS": "avgSD_cS [m/s]",
    "TET": "TET [s]",
    "TIT": "TIT [s^2]",
    "aveDece": "aveDece [m/s^2]",
}
PAPER_CHANGE_COUNTS = ("2", "3", "4", "5", "6")
"""The numbers of changed characteristics in the paper's table of RQ3.3."""
FORMATS = {
    "mean": ".2f",
    "original": ".2f",
    "mean_rank": ".2f",
    "critical_difference": ".2f",
    "share": ".1%",
    "pc": ".1%",
    "value": ".2f",
    "percent": ".1f",
    "percent_other": ".1f",
    "difference": "+.1f",
    "effect_size": ".3f",
    **dict.fromkeys(("rank", "rank_other", "n1", "n2", "runs", "solutions", "collisions"), "d"),
    **dict.fromkeys(("delta", "increase", "increase_other", "decrease", "decrease_other"), "+.3g"),
    **dict.fromkeys(("min", "Q1", "median", "Q3", "max"), "g"),
}
"""Format specifications of the frames' columns."""
HEADINGS = {
    "setting": "case",
    "p_value": "p",
    "p_holm": "p Holm",
    "effect_size": "A12",
    "critical_difference": "critical difference",
    "pc": "PC",
    "percent": "%",
    "percent_other": "% in the other",
    "difference": "difference",
    "rank_other": "rank in the other",
    "increase_other": "increase in the other",
    "decrease_other": "decrease in the other",
}


class BoldText(str):
    """A cell in bold."""


class Table(NamedTuple):
    """A table for readers: cells of text, with the labels of the rows as the frame's index, and headings as its
    columns.
    """

    title: str
    frame: pd.DataFrame
    notes: tuple[str, ...] = ()

    def headings(self) -> list[str]:
        """A heading for each label and column; headings over several columns are repeated in each of them, if there are
        several.
        """
        columns = self.frame.columns.to_frame().astype(str)
        blocks = columns if columns.shape[1] == 1 or columns[0].nunique() > 1 else columns[[1]]
        return [*map(str, self.frame.index.names), *blocks.agg(": ".join, axis=1)]


class Layout(NamedTuple):
    """A table of an answer: a row for each combination of `labels`, and a block of `columns` for each value of `over`.

    `separate` are columns for whose values there are separate tables; `title` follows the answer's title.
    """

    labels: Sequence[str]
    columns: Sequence[str] | str
    over: str | None = "setting"
    separate: Sequence[str] = ()
    title: str = ""


Layouts = Mapping[str, Sequence[Layout]]
"""The tables of each answer, by the answer's name."""
TESTS = ["p_value", "effect_size", "magnitude", "n1", "n2"]
HOLM_TESTS = ["p_value", "p_holm", "effect_size", "magnitude"]
LAYOUTS: Layouts = {
    "rq1": [
        Layout(["algorithm", "metric"], TESTS),
        Layout(["metric", "original"], "mean", "algorithm", ["setting"], ", mean metrics"),
    ],
    "rq2": [Layout(["baseline", "metric"], TESTS)],
    "rq1-runs": [Layout(["algorithm", "metric"], [*HOLM_TESTS, "runs"])],
    "rq2-runs": [Layout(["baseline", "metric"], [*HOLM_TESTS, "n1", "n2"])],
    "rq2-pairs": [Layout(["algorithm", "other", "metric"], HOLM_TESTS)],
    "rq2-ranks": [
        Layout(["metric", "runs", "p_value", "p_holm", "critical_difference"], "mean_rank", "algorithm", ["setting"])
    ],
    "rq3.1": [Layout(["j"], ["min", "Q1", "median", "Q3", "max"])],
    "rq3.2": [Layout(["characteristic", "rank"], "percent", "j", ["setting"])],
    "rq3.3": [
        Layout(["characteristic", "direction"], "pc", "j", ["setting"], ", PC"),
        Layout(["characteristic", "direction"], "delta", "j", ["setting"], ", delta"),
    ],
    SAFETY_TABLE: [
        Layout(["quantity"], "value", "j", ["setting"], ", mean"),
        Layout(["quantity"], "percent", "j", ["setting"], ", % of the original"),
    ],
    "collisions": [Layout(["algorithm"], ["solutions", "collisions", "share"])],
    "combinations": [Layout(["setting", "rank", "characteristics"], ["percent"], None)],
    "weather": [
        Layout(
            ["characteristic"],
            [
                "percent",
                "percent_other",
                "difference",
                "rank",
                "rank_other",
                "increase",
                "increase_other",
                "decrease",
                "decrease_other",
            ],
            None,
            ["setting", "other"],
        )
    ],
}
PAPER_LAYOUTS: Layouts = {
    **LAYOUTS,
    "rq1": [Layout(["setting", "algorithm"], "p / A12", "metric")],
    "rq2": [Layout(["setting", "baseline"], "p / A12", "metric")],
    "rq3.3": [Layout(["characteristic", "direction"], ["pc", "delta"], "j of the paper", ["setting"])],
    "combinations": [Layout(["characteristic"], "contained", "place")],
}
LAYOUTS_BY_NAME = {"full": LAYOUTS, "paper": PAPER_LAYOUTS}

HOLM_LEGEND = f"bold or *: p < {ALPHA:g} after Holm"
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
BOLD_NOTE = f"Bold (or *): p < {ALPHA:g}; A12 also of medium or large magnitude."
HOLM_NOTE = f"Bold (or *): p < {ALPHA:g} after Holm's correction for all tests of a case's RQ1 and RQ2."
NOTES: Mapping[str, Sequence[str]] = {
    "rq1": [
        "A12 below 0.5: the algorithm's solutions are more unsafe than the original vehicle.",
        "The original vehicle's value is repeated to the sample's size.",
        BOLD_NOTE,
    ],
    "rq2": [
        "A12 above 0.5: NSGA-II is better. IGD, IGD+ and HV compare runs;",
        "the other metrics compare pooled solutions.",
        "IGD on the objectives as they are, IGD+ and hypervolume (HV) on normalised ones.",
        BOLD_NOTE,
    ],
    "rq1-runs": [
        "One mean for each run against the original vehicle's value; A12 below 0.5: the runs are more unsafe.",
        HOLM_NOTE,
    ],
    "rq2-runs": [
        "One value for each run (for safety metrics, the mean over its solutions).",
        "A12 above 0.5: NSGA-II is better.",
        HOLM_NOTE,
    ],
    "rq2-pairs": [
        "One value for each run; A12 above 0.5: the first is better (a better front, more unsafe solutions).",
        "Holm's correction is for all pairs and metrics of a case.",
    ],
    "rq2-ranks": [
        "p: Friedman's test; runs with the same number form a block.",
        "Holm's correction is for all metrics of a case.",
        f"Ranks closer than the critical difference are not distinguished (Nemenyi, {ALPHA:g}).",
    ],
    "rq3.1": ["Critical solutions of a run with exactly j characteristics changed, over the runs."],
    "rq3.2": ["Columns: number of characteristics changed; ranked by 'any'."],
    "rq3.3": [
        "PC: mean of |v - v''| / v (v'': filtered, v: original value).",
        "delta: mean signed change in the characteristic's unit.",
    ],
    SAFETY_TABLE: [
        "Without collisions: avgSD_mD is the reduction of the distance, TET and TIT are increases.",
        "avgSD_cS is the speed of the collisions. aveDece is the decrease over all solutions.",
    ],
    "combinations": ["Percent of the critical solutions with exactly four characteristics changed."],
    "weather": ["Over the critical solutions; increase and decrease: mean, in the characteristic's unit."],
}


def lay_out(answer: Answer, layouts: Layouts = LAYOUTS) -> list[Table]:
    """The tables of an answer, with notes below the last one; for an empty answer a table with the reason."""
    if answer.frame.empty:
        return [Table(TITLES[answer.name], pd.DataFrame(), answer.notes)]
    frame, tables = _readable_frame(answer), []
    for layout in layouts[answer.name]:
        for key, group in frame.groupby(list(layout.separate), sort=False) if layout.separate else [((), frame)]:
            title = f"{TITLES[answer.name]}{layout.title}" + (f": {' against '.join(map(str, key))}" if key else "")
            tables.append(Table(title, _arrange(group, layout)))
    methods = [
        f"p{' with e' if method == EXACT_TEST and 'p_holm' not in frame else ''}: {method}."
        for method in (answer.frame["method"].dropna().unique() if "method" in answer.frame else ())
    ]
    metric_notes = [_note_on_metrics(answer.metrics)] if "metric" in answer.frame else []
    notes = (*methods, *NOTES.get(answer.name, ()), *metric_notes, *answer.notes)
    return [*tables[:-1], tables[-1]._replace(notes=notes)]


def _arrange(frame: pd.DataFrame, layout: Layout) -> pd.DataFrame:
    cells = frame.explode(layout.labels[0])  # a cell with several labels is in the row of each
    if layout.over is None:
        return _with_headings(cells.set_index(list(layout.labels))[layout.columns])
    blocks = {
        block: _with_headings(group.set_index(list(layout.labels))[layout.columns])
        for block, group in cells.groupby(layout.over, sort=False)
    }
    return pd.concat(blocks, axis=1).fillna(UNDEFINED)


def _with_headings(cells: pd.DataFrame) -> pd.DataFrame:
    cells.index.names = [HEADINGS.get(str(name), name) for name in cells.index.names]
    return cells.rename(columns=HEADINGS) if isinstance(cells, pd.DataFrame) else cells


def _readable_frame(answer: Answer) -> pd.DataFrame:
    """The frame with titles in place of names and numbers as text, and with the columns that some layouts need
    besides.
    """
    name, frame = answer.name, answer.frame
    if name == "rq3.1":
        counts, quartiles = frame.groupby(["setting", "j"], sort=False)["count"], ("min", "Q1", "median", "Q3", "max")
        frame = pd.DataFrame({quartile: counts.quantile(k / 4) for k, quartile in enumerate(quartiles)}).reset_index()
    if name == "rq3.2":
        frame = frame.assign(rank=frame.groupby(["setting", "characteristic"], sort=False)["rank"].transform("max"))
    cells = frame.assign(
        **{
            column: [_format(value, spec) for value in frame[column]]
            for column, spec in FORMATS.items()
            if column in frame
        }
    )
    titles = {**ALGORITHM_TITLES, **SAFETY_UNITS, **titles_of(answer.metrics)}
    for column in ("algorithm", "baseline", "metric", "quantity", *(["other"] if name == "rq2-pairs" else [])):
        if column in frame:
            cells[column] = frame[column].map(lambda value: titles.get(value, value))
    if name == "rq3.3":
        cells["j of the paper"] = ("j = " + frame["j"]).where(frame["j"].isin(PAPER_CHANGE_COUNTS))
    if name == "combinations":
        places = (frame.groupby("setting").cumcount() + 1).astype(str)
        cells = cells.assign(
            characteristics=frame["characteristics"].map(", ".join),
            characteristic=frame["characteristics"],
            contained="x",
            place=frame["setting"] + " #" + places + " (" + cells["percent"] + " %)",
        )
    return cells.assign(**_test_cells(answer)) if "p_value" in frame else cells


def _test_cells(answer: Answer) -> dict[str, list[str]]:
    """P-values and A12 as text: bold where significant (after Holm's correction if the frame has it), without it A12
    also where notable.
    """
    frame = answer.frame
    p = frame["p_value"].map(format_p_value).tolist()
    if "p_holm" in frame:
        is_significant = frame["p_holm"].astype(float) < ALPHA
        cells = {"p_value": p, "p_holm": _bold_where(frame["p_holm"].map(format_p_value), is_significant)}
        if "effect_size" in frame:
            cells["effect_size"] = _bold_where(_effects(frame), is_significant)
        return cells
    algorithms = frame["algorithm" if answer.name == "rq1" else "baseline"]
    is_tested = np.array([pair not in answer.untested for pair in zip(frame["setting"], algorithms, strict=True)])
    is_significant = (frame["p_value"].astype(float) < ALPHA) & is_tested
    is_notable = is_significant & frame["magnitude"].isin(NOTABLE_MAGNITUDES)
    marked = [value + ("e" if method == EXACT_TEST else "") for value, method in zip(p, frame["method"], strict=True)]
    both = [
        value if value == UNDEFINED else f"{value} / {effect}" for value, effect in zip(p, _effects(frame), strict=True)
    ]
    return {
        "p_value": _bold_where(marked, is_significant),
        "effect_size": _bold_where(_effects(frame), is_notable),
        "p / A12": _bold_where(both, is_notable),
    }


def _effects(frame: pd.DataFrame) -> list[str]:
    return [_format(value, ".3f") for value in frame["effect_size"]]


def _bold_where(cells: Iterable[str], conditions: Iterable[bool]) -> list[str]:
    return [BoldText(cell) if is_bold else cell for cell, is_bold in zip(cells, conditions, strict=True)]


def _format(value: float | None, spec: str) -> str:
    return UNDEFINED if value is None or math.isnan(value) else format(int(value) if spec == "d" else value, spec)


def format_p_value(value: float | None) -> str:
    return "<0.001" if value is not None and value < 0.001 else _format(value, ".3f")


def _note_on_metrics(metrics: Iterable[MetricFacts]) -> str:
    """The metrics' units, and the solutions over which each metric is taken."""
    titles: dict[bool, list[str]] = {False: [], True: []}
    for metric in metrics:
        titles[metric.over_collisions].append(metric.title + (f" [{metric.unit}]" if metric.unit != "-" else ""))
    parts = [
        f"{join_phrases(names)} over {which}"
        for names, which in ((titles[False], "solutions without collision"), (titles[True], "all solutions"))
        if names
    ]
    return f"{'; '.join(parts)}."
