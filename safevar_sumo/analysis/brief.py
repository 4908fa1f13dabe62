"""RQ1 and RQ2 in a few lines, for the end of a study."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import pandas as pd

from safevar_sumo.analysis.case import ALGORITHM_TITLES, Case, Unanswerable
from safevar_sumo.analysis.inference import ALPHA, too_few
from safevar_sumo.analysis.layout import titles_of
from safevar_sumo.analysis.quality import MORE_IS_BETTER
from safevar_sumo.analysis.rq1 import rq1
from safevar_sumo.analysis.rq2 import rq2


def brief(case: Case) -> list[str]:
    """One line for each algorithm and baseline: effect sizes, and an asterisk where p says that they are no chance.

    Indicators are of runs: of too few to be told apart they say nothing.
    """
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
            rows = of_it.to_dict("records")
            few = [titles[row["metric"]] for row in rows if _says_nothing(row)]
            told = [_effect(titles[row["metric"]], row["effect_size"], row["p_value"]) for row in rows if not _says_nothing(row)]
            unsaid = f"; {', '.join(few)}: too few runs" if few else ""
            lines.append(f"  {ALGORITHM_TITLES.get(str(name), name)}: {', '.join(told)}{unsaid}")
    return lines


def _says_nothing(row: dict[Hashable, Any]) -> bool:
    """Whether these are indicators of too few runs."""
    return row["metric"] in MORE_IS_BETTER and bool(row["n1"] and row["n2"]) and too_few(row["n1"], row["n2"])


def _effect(title: str, effect: float | None, p: float | None) -> str:
    if effect is None or p is None or pd.isna(p):
        return f"{title} -"
    return f"{title} {effect:.2f}{'*' if p < ALPHA else ''}"
