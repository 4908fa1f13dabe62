"""RQ2: does NSGA-II beat the other algorithms?"""

from __future__ import annotations

import pandas as pd

from safevar_sumo.analysis.case import NSGA2, Case, Unanswerable, values
from safevar_sumo.analysis.inference import Comparison, compare
from safevar_sumo.analysis.quality import MORE_IS_BETTER, indicators
from safevar_sumo.analysis.rq1 import turned

COLUMNS = ["setting", "baseline", "metric", "p_value", "effect_size", "magnitude", "n1", "n2", "method"]
NO_RUNS = Comparison(None, None, None, 0, 0, None)


def rq2(case: Case) -> pd.DataFrame:
    """NSGA-II against every other algorithm: its runs' indicators, then its pooled solutions' metrics.

    Columns: `COLUMNS`. `effect_size` is A12, turned so that a higher one means that NSGA-II is better: a better front,
    more unsafe solutions. `n1` counts NSGA-II's values, `n2` the baseline's. What is undefined is None, as are the
    indicators of imported solutions, which belong to no run.

    Raises
    ------
    Unanswerable
        If NSGA-II or every other algorithm is missing.
    """
    own = case.solutions_of(NSGA2)
    baselines = [name for name in case.algorithms if name != NSGA2]
    if not baselines:
        raise Unanswerable(case.name, f"has finished runs of {NSGA2} alone", "results of another algorithm to compare with, such as rs")
    quality = indicators(case) if case.has_runs and len(case.solutions) else None
    rows: list[tuple[object, ...]] = []
    for baseline in baselines:
        for indicator, more_is_better in MORE_IS_BETTER.items():
            told = NO_RUNS
            if quality is not None:
                told = compare(*(quality.loc[quality["algorithm"] == name, indicator] for name in (NSGA2, baseline)))
            rows.append((case.name, baseline, indicator, *(told if more_is_better else turned(told))))
        for metric in case.scoring.metrics:
            told = compare(values(own, metric), values(case.solutions_of(baseline), metric))
            rows.append((case.name, baseline, metric.name, *(told if metric.more_is_unsafe else turned(told))))
    return pd.DataFrame(rows, columns=COLUMNS, dtype=object)
