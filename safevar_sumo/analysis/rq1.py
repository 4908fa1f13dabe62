"""RQ1: do found settings put the vehicle into more unsafe situations than the original one?"""

from __future__ import annotations

import numpy as np
import pandas as pd

from safevar_sumo.analysis.case import Case, Unanswerable, values
from safevar_sumo.analysis.inference import Comparison, compare, magnitude

COLUMNS = ["setting", "algorithm", "metric", "p_value", "effect_size", "magnitude", "n1", "n2", "method", "mean", "original"]


def rq1(case: Case) -> pd.DataFrame:
    """Every algorithm's solutions against the original's value, repeated to the sample's size, metric by metric.

    Columns: `COLUMNS`. `effect_size` is A12, turned so that a smaller one means that the algorithm's solutions are
    more unsafe; `mean` is theirs, `original` the original's value. What is undefined is None.

    Raises
    ------
    Unanswerable
        If no run is finished.
    """
    if not case.algorithms:
        raise Unanswerable(case.name, "has no finished run", "results with at least one finished run")
    rows = []
    for algorithm in case.algorithms:
        solutions = case.solutions_of(algorithm)
        for metric in case.scoring.metrics:
            sample, original = values(solutions, metric), case.original[metric.name]
            told = against(sample, original, metric.more_is_unsafe)
            rows.append((case.name, algorithm, metric.name, *told, float(np.mean(sample)) if sample.size else None,
                         None if np.isnan(original) else original))
    return pd.DataFrame(rows, columns=COLUMNS, dtype=object)


def against(sample: np.ndarray, original: float, more_is_unsafe: bool) -> Comparison:
    """A sample against one value, n1 the sample's size; the effect size is smaller for a more unsafe sample."""
    told = compare(sample, np.full(0 if np.isnan(original) else len(sample), original))
    return turned(told) if more_is_unsafe else told


def turned(told: Comparison) -> Comparison:
    """The same comparison with the effect size of the other sample."""
    effect = told.reversed_effect
    return told if effect is None else told._replace(effect_size=effect, magnitude=magnitude(effect))
