"""Answers as tables for readers: which columns stand where, in which words, and what is bold."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.metrics import MetricFacts
from safevar_sumo.questions.research_questions.answer import EVALUATIONS, SAFETY_TABLE, TableAnswer
from safevar_sumo.questions.research_questions.changes import WEATHER_VALUES
from safevar_sumo.questions.research_questions.comparisons import titles_of
from safevar_sumo.questions.research_questions.statistics import ALPHA, NOTABLE_MAGNITUDES
from safevar_sumo.questions.words import join_phrases
from safevar_sumo.study import unit_text

UNDEFINED = "-"
SAFETY_UNITS = {
    "avgSD_mD": "avgSD_mD [m]",
    "avgSD_cS": "avgSD_cS [m/s]",
    "TET": "TET [s]",
    "TIT": "TIT [s^2]",
    "aveDece": "aveDece [m/s^2]",
}
CELL_FORMATS = {
    **dict.fromkeys(("mean", "original", "value"), ".2f"),
    **dict.fromkeys(("share", "pc"), ".1%"),
    **dict.fromkeys(("percent", "percent_other"), ".1f"),
    "difference": "+.1f",
    "effect_size": ".3f",
    **dict.fromkeys(("p_value", "p_holm"), "p"),
    **dict.fromkeys(("rank", "rank_other", "n1", "n2", "runs", "budget", "solutions", "collisions"), "d"),
    **dict.fromkeys(("delta", "increase", "increase_other", "decrease", "decrease_other"), "+.3g"),
    **dict.fromkeys(("min", "Q1", "median", "Q3", "max"), "g"),
}
"""Format specifications of the frames' columns; `p` is three decimals or `<0.001`."""
HEADINGS = {
    "setting": "case",
    "p_value": "p",
    "p_holm": "p Holm",
    "effect_size": "A12",
    "pc": "PC",
    "percent": "%",
    "percent_other": "% in the other",
    "rank_other": "rank in the other",
    "increase_other": "increase in the other",
    "decrease_other": "decrease in the other",
}


class BoldText(str):
    """A cell in bold."""


class Table(NamedTuple):
    """A table for readers: cells of text, with the labels of the rows as the frame's index, and headings as columns."""

    title: str
    frame: pd.DataFrame
    notes: tuple[str, ...] = ()


class Layout(NamedTuple):
    """A table of an answer; its fields but the last are columns of the answer's frame.

    A row stands for each combination of `labels`, a block of `columns` for each value of `blocks_of`, and a table for
    each combination of `one_table_per`. A single column, given by its name alone, has no heading of its own in a block.
    `title` follows the answer's title.
    """

    labels: Sequence[str]
    columns: Sequence[str] | str
    blocks_of: str | None = "setting"
    one_table_per: Sequence[str] = ()
    title: str = ""


TESTS = ["p_value", "effect_size", "magnitude", "n1", "n2"]
HOLM_TESTS = ["p_value", "p_holm", "effect_size", "magnitude"]
LAYOUTS: Mapping[str, Sequence[Layout]] = {
    "rq1": [
        Layout(["algorithm", "metric"], TESTS),
        Layout(["metric", "original"], "mean", "algorithm", ["setting"], ", mean metrics"),
    ],
    "rq2": [Layout(["baseline", "metric"], TESTS)],
    "rq1-runs": [Layout(["algorithm", "metric"], [*HOLM_TESTS, "runs"])],
    "rq2-runs": [Layout(["baseline", "metric"], [*HOLM_TESTS, "n1", "n2"])],
    EVALUATIONS: [Layout(["algorithm"], ["runs", "min", "median", "max", "budget"])],
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
    "weather": [Layout(["characteristic"], WEATHER_VALUES, None, ["setting", "other"])],
}
HOLM_LEGEND = f"bold or *: p < {ALPHA:g} after Holm"
TITLES = {
    "rq1": "RQ1: solutions against the original vehicle",
    "rq2": "RQ2: {first} against the other algorithms",
    "rq1-runs": f"RQ1 over runs: run means against the original vehicle ({HOLM_LEGEND})",
    "rq2-runs": f"RQ2 over runs: the runs of {{first}} against those of the other algorithms ({HOLM_LEGEND})",
    EVALUATIONS: "Different settings that a run simulates",
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
        "A12 above 0.5: {first} is better. IGD, IGD+ and HV compare runs;",
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
        "A12 above 0.5: {first} is better.",
        HOLM_NOTE,
    ],
    EVALUATIONS: ["Equal settings are simulated once, and an algorithm may stop before it has used its budget."],
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


def lay_out(answer: TableAnswer) -> list[Table]:
    """The tables of an answer, with notes below the last one; for an empty answer a table with the reason."""
    if answer.frame.empty:
        return [Table(TITLES[answer.name].format(first="one algorithm"), pd.DataFrame(), answer.notes)]
    frame, tables = _readable_frame(answer), []
    first = " or ".join(frame["algorithm"].unique()) if answer.name.startswith("rq2") else ""
    for layout in LAYOUTS[answer.name]:
        title = TITLES[answer.name].format(first=first) + layout.title
        if not layout.one_table_per:
            tables.append(Table(title, _arrange(frame, layout)))
            continue
        for names, group in frame.groupby(list(layout.one_table_per), sort=False):
            tables.append(Table(f"{title}: {' against '.join(map(str, names))}", _arrange(group, layout)))
    notes = []
    if "method" in frame:
        notes.append(f"p: {'; '.join(frame['method'].dropna().unique())}.")
    notes += [note.replace("{first}", first) for note in NOTES.get(answer.name, ())]
    if "metric" in frame:
        metrics = {metric.name: metric for case in answer.cases for metric in case.scoring.metrics}.values()
        notes.append(_note_on_metrics(metrics))
    return [*tables[:-1], tables[-1]._replace(notes=(*notes, *answer.notes))]


def _arrange(frame: pd.DataFrame, layout: Layout) -> pd.DataFrame:
    """The layout's columns, with labels as the index, and a block of columns for each value of `blocks_of`."""
    label_headings = [HEADINGS.get(label, label) for label in layout.labels]
    cells = frame.set_index(list(layout.labels)).rename_axis(label_headings)[layout.columns]
    if isinstance(cells, pd.DataFrame):
        cells = cells.rename(columns=HEADINGS)
    if layout.blocks_of is None:
        return cells
    groups = cells.groupby(frame[layout.blocks_of].to_numpy(), sort=False)
    return pd.concat(dict(list(groups)), axis=1).fillna(UNDEFINED)


def _readable_frame(answer: TableAnswer) -> pd.DataFrame:
    """The frame with titles in place of names and numbers as text."""
    name, frame = answer.name, answer.frame
    if name == "rq3.1":
        quartiles = frame.groupby(["setting", "j"], sort=False)["count"].quantile(np.linspace(0, 1, 5)).unstack()
        frame = quartiles.set_axis(["min", "Q1", "median", "Q3", "max"], axis=1).reset_index()
    if name == EVALUATIONS:
        runs = frame.groupby(["setting", "algorithm"], sort=False)
        simulated = runs["simulated"].agg(["min", "median", "max"])
        frame = simulated.assign(runs=runs.size(), budget=runs["budget"].first()).reset_index()
    if name == "rq3.2":  # the rank by 'any', the only one, labels the whole row of a characteristic
        frame = frame.assign(rank=frame.groupby(["setting", "characteristic"], sort=False)["rank"].transform("first"))
    if name == "combinations":
        frame = frame.assign(characteristics=frame["characteristics"].map(", ".join))
    titles = titles_of(answer.cases) | SAFETY_UNITS
    texts = {
        column: [_format(value, CELL_FORMATS[column]) for value in frame[column]]
        for column in frame.columns.intersection(list(CELL_FORMATS))
    }
    columns_of_names = frame.columns.intersection(["algorithm", "baseline", "metric", "quantity"])
    names = {column: frame[column].replace(titles) for column in columns_of_names}
    cells = frame.assign(**texts, **names)
    return _mark_tests(cells, frame) if "p_value" in frame else cells


def _mark_tests(cells: pd.DataFrame, frame: pd.DataFrame) -> pd.DataFrame:
    """Make significant p-values and their effect sizes bold.

    Where p-values have Holm's correction, the corrected ones count. Without it (RQ1 and RQ2 over pooled solutions), a
    test needs enough runs, and effect sizes also have to be notable.
    """
    if "p_holm" in frame:
        p_column, is_significant = "p_holm", frame["p_holm"] < ALPHA
        is_bold_effect = is_significant
    else:
        p_column, is_significant = "p_value", (frame["p_value"] < ALPHA) & frame["enough_runs"]
        is_bold_effect = is_significant & frame["magnitude"].isin(NOTABLE_MAGNITUDES)
    for column, is_bold in ((p_column, is_significant), ("effect_size", is_bold_effect)):
        cells[column] = cells[column].where(~is_bold, cells[column].map(BoldText))
    return cells


def _format(value: float, spec: str) -> str:
    if pd.isna(value):
        return UNDEFINED
    if spec == "p":
        return "<0.001" if value < 0.001 else f"{value:.3f}"
    return format(int(value) if spec == "d" else value, spec)


def _note_on_metrics(metrics: Collection[MetricFacts]) -> str:
    """The metrics' units, and the solutions over which each metric is taken."""
    parts = []
    for over_collisions, solutions in ((False, "solutions without collision"), (True, "all solutions")):
        titles = [
            metric.title + unit_text(metric.unit, " [{}]")
            for metric in metrics
            if metric.over_collisions is over_collisions
        ]
        if titles:
            parts.append(f"{join_phrases(titles)} over {solutions}")
    return f"{'; '.join(parts)}."
