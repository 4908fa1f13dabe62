"""RQ1 and RQ2 over runs in a few lines, for the end of a study."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from typing import Any

import pandas as pd

from safevar_sumo.analysis.research_questions.case import ALGORITHM_TITLES, Case, Unanswerable
from safevar_sumo.analysis.research_questions.comparisons import ALPHA
from safevar_sumo.analysis.research_questions.indicators import titles_of
from safevar_sumo.analysis.research_questions.over_runs import difference_line, fewest_runs, rq1_runs, rq2_runs

QUESTIONS: Mapping[str, tuple[Callable[[Case], pd.DataFrame], str, str]] = {
    "RQ1": (rq1_runs, "algorithm", "runs are more unsafe than the original if below 0.5 (A12)"),
    "RQ2": (rq2_runs, "baseline", "NSGA-II's runs are better than the other's if above 0.5 (A12)")}


def brief(case: Case) -> list[str]:
    """For each algorithm and baseline the effect sizes over runs, an asterisk where significant; and what differs from pooling.

    Of too few runs no difference can be significant: then the line says so.
    """
    titles = titles_of(case.scoring.metrics)
    lines, enough = [], False
    for question, (ask, who, title) in QUESTIONS.items():
        try:
            frame = ask(case)
        except Unanswerable as error:
            lines.append(f"{question}: {error.problem}.")
            continue
        lines.append(f"{question}: {title}; * p < {ALPHA:g} after Holm's correction")
        for name, rows_of_one in frame.groupby(who, sort=False):
            rows = rows_of_one.to_dict("records")
            defined = [row for row in rows if row["effect_size"] is not None]
            few = [titles[row["metric"]] for row in defined if _runs(row) < fewest_runs(question)]
            enough = enough or len(few) < len(defined)
            subject = "" if len(few) == len(defined) else f"{', '.join(few)}: "
            note = f"; {subject}too few runs for a test ({fewest_runs(question)} are needed)" if few else ""
            effects = ", ".join(_effect(titles[row["metric"]], row["effect_size"], row["p_holm"]) for row in rows)
            lines.append(f"  {ALGORITHM_TITLES.get(str(name), name)}: {effects}{note}")
    return [*lines, difference_line(case)] if enough else lines


def _runs(row: Mapping[Hashable, Any]) -> int:
    return int(row["runs"] if "runs" in row else min(row["n1"], row["n2"]))


def _effect(title: str, effect: float | None, p: float | None) -> str:
    if effect is None or p is None or pd.isna(p):
        return f"{title} -"
    return f"{title} {effect:.2f}{'*' if p < ALPHA else ''}"
