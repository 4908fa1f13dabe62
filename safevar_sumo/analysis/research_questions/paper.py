"""RQ1, RQ2 and the combinations laid out as the paper has them: cases by metrics, cells of p and A12, marks for combinations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd

from safevar_sumo.analysis.research_questions.answer import Answer
from safevar_sumo.analysis.research_questions.comparisons import ALPHA, NOTABLE
from safevar_sumo.analysis.research_questions.indicators import titles_of
from safevar_sumo.analysis.research_questions.layout import (
    LAYOUTS,
    TITLES,
    UNDEFINED,
    Bold,
    Layouts,
    Table,
    algorithm_title,
    of_frame,
    p_value,
)

MARK = "x"
CELL_NOTE = f"Cells: p / A12; bold (or *) where p < {ALPHA:g} and A12 is of medium or large magnitude."
SMALLER = "A12 below 0.5: the algorithm's solutions are more unsafe than the original vehicle."
GREATER = "A12 above 0.5: NSGA-II is better."


def _tests(answer: Answer, who: str, note: str) -> list[Table]:
    """A row for each case and algorithm, a column for each metric."""
    frame, name, titles = answer.frame, answer.name, titles_of(answer.metrics)
    cells = {(row["setting"], row[who], row["metric"]): _cell(row) for row in frame.to_dict("records")}
    metrics = list(dict.fromkeys(frame["metric"]))
    rows = [(case, algorithm_title(algorithm), *(cells.get((case, algorithm, metric), UNDEFINED) for metric in metrics))
            for case, algorithm in dict.fromkeys(zip(frame["setting"], frame[who], strict=True))]
    return [Table(TITLES[name], ("case", who, *(titles.get(metric, metric) for metric in metrics)), rows, 2,
                  notes=(CELL_NOTE, note))]


def _cell(row: Mapping[Any, Any]) -> str:
    if pd.isna(row["p_value"]):
        return UNDEFINED
    told = f"{p_value(row['p_value'])} / {row['effect_size']:.3f}"
    return Bold(told) if row["p_value"] < ALPHA and row["magnitude"] in NOTABLE else told


def _combinations(frame: pd.DataFrame) -> list[Table]:
    """A row for each characteristic, a column for each combination; marks where one is part of the other."""
    found = frame.to_dict("records")
    cases = list(dict.fromkeys(frame["setting"]))
    names = dict.fromkeys(name for row in found for name in row["characteristics"])
    rows = [(name, *(MARK if name in row["characteristics"] else "" for row in found)) for name in names]
    rows.append(("% of solutions", *(f"{row['percent']:.1f}" for row in found)))
    spans = tuple((case, sum(row["setting"] == case for row in found)) for case in cases)
    return [Table(TITLES["combinations"], ("characteristic", *(f"#{row['rank']}" for row in found)), rows, 1, spans,
                  ("Percent of the critical solutions with exactly four characteristics changed; #: rank.",))]


PAPER: Layouts = {
    **LAYOUTS, "rq1": lambda answer: _tests(answer, "algorithm", SMALLER), "rq2": lambda answer: _tests(answer, "baseline", GREATER),
    "combinations": of_frame(_combinations)}
