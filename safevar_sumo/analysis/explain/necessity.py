"""Statistics of many failures: how often each characteristic is changed and needed, and distinct minimal causes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
import pandas as pd

from safevar_sumo.analysis.evaluator import clopper_pearson
from safevar_sumo.analysis.explain.causes import MinimalCause, involved_columns, necessary_columns
from safevar_sumo.analysis.words import direction_in_words
from safevar_sumo.records import BoolArray
from safevar_sumo.vehicles import CharacteristicSet

CauseKey = tuple[str, ...]
"""The directions of a cause's changes, without their sizes, such as ('mass up', 'tireFric down')."""


def cause_key(characteristics: CharacteristicSet, cause: MinimalCause) -> CauseKey:
    return tuple(
        direction_in_words(characteristics.members[column], float(cause.setting[column])) for column in cause.columns
    )


def necessity_frame(
    characteristics: CharacteristicSet, changed: BoolArray, causes: Sequence[Sequence[MinimalCause]], failures: int
) -> pd.DataFrame:
    """How often each characteristic is changed, and how often it is needed.

    Parameters
    ----------
    changed
        Which characteristics each of M failures changes, shape (M, n).
    causes
        The minimal causes of each of the M failures.
    failures
        Number of all failures; if it is larger than M, the M failures are a random sample of them.

    Returns
    -------
    pandas.DataFrame
        One row per characteristic: `characteristic`, and the shares of failures in which it is `changed`, `necessary`
        (part of every minimal cause) and `involved` (part of at least one). `necessary_lower` and `necessary_upper` are
        the 95 % interval of `necessary` among all failures: Clopper and Pearson's for a sample (slightly too wide,
        because the sample is drawn without replacement from finitely many failures), the share itself if all failures
        were analysed. Ordered by necessary, involved, changed; no rows if there is no failure.
    """
    columns = range(len(characteristics) if len(changed) else 0)
    counts = {
        "changed": Counter(np.nonzero(changed)[1].tolist()),
        "necessary": Counter(column for failure_causes in causes for column in necessary_columns(failure_causes)),
        "involved": Counter(column for failure_causes in causes for column in involved_columns(failure_causes)),
    }
    is_sample = len(changed) < failures
    intervals = [
        clopper_pearson(counts["necessary"][column], len(changed))
        if is_sample
        else (counts["necessary"][column] / len(changed),) * 2
        for column in columns
    ]
    frame = pd.DataFrame(
        {
            "characteristic": pd.Series([characteristics.names[column] for column in columns], dtype=object),
            **{
                name: pd.Series([count[column] / len(changed) for column in columns], dtype=float)
                for name, count in counts.items()
            },
            "necessary_lower": pd.Series([low for low, _ in intervals], dtype=float),
            "necessary_upper": pd.Series([high for _, high in intervals], dtype=float),
        }
    )
    return frame.sort_values(["necessary", "involved", "changed"], ascending=False, kind="stable", ignore_index=True)


def count_distinct_causes(characteristics: CharacteristicSet, causes: Sequence[Sequence[MinimalCause]]) -> pd.DataFrame:
    """Every distinct minimal cause, most frequent first.

    Returns
    -------
    pandas.DataFrame
        Columns `cause`, a tuple of changes with their directions; `failures`, the number of failures with this cause;
        and `share`, their share of all failures.
    """
    counts = Counter(
        key for failure_causes in causes for key in {cause_key(characteristics, cause) for cause in failure_causes}
    )
    order = sorted(counts, key=lambda key: (-counts[key], len(key), key))
    return pd.DataFrame(
        {
            "cause": pd.Series(order, dtype=object),
            "failures": pd.Series([counts[key] for key in order], dtype=int),
            "share": pd.Series([counts[key] / len(causes) for key in order], dtype=float),
        }
    )
