"""RQ1 and RQ2 in a few lines, for the end of a study."""

from __future__ import annotations

import pandas as pd

from safevar_sumo.analysis.case import ALGORITHM_TITLES, Case, Unanswerable
from safevar_sumo.analysis.inference import ALPHA
from safevar_sumo.analysis.layout import titles_of
from safevar_sumo.analysis.rq1 import rq1
from safevar_sumo.analysis.rq2 import rq2


def brief(case: Case) -> list[str]:
    """One line for each algorithm and baseline: effect sizes, and an asterisk where p says that they are no chance."""
    lines, titles = [], titles_of(case.scoring.metrics)
    asked = ((rq1, "algorithm", "RQ1: more unsafe than the original if below 0.5 (A12)"),
             (rq2, "baseline", "RQ2: NSGA-II better than the other if above 0.5 (A12)"))
    for ask, who, title in asked:
        try:
            frame = ask(case)
        except Unanswerable as error:
            lines.append(f"{title.partition(':')[0]}: {error.problem}.")
            continue
        lines.append(f"{title}; * p < {ALPHA:g}")
        for name, of_it in frame.groupby(who, sort=False):
            told = [_effect(titles[row[0]], *row[1:]) for row in zip(of_it["metric"], of_it["effect_size"], of_it["p_value"], strict=True)]
            lines.append(f"  {ALGORITHM_TITLES.get(str(name), name)}: {', '.join(told)}")
    return lines


def _effect(title: str, effect: float | None, p: float | None) -> str:
    if effect is None or p is None or pd.isna(p):
        return f"{title} -"
    return f"{title} {effect:.2f}{'*' if p < ALPHA else ''}"
