"""Over many failures: which characteristics are needed, beside how often they are changed; and which causes there are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np
import pandas as pd

from safevar_sumo.answers.causes import MinimalCause, involved, necessary
from safevar_sumo.answers.risk import interval_of
from safevar_sumo.answers.words import direction
from safevar_sumo.records import BoolArray
from safevar_sumo.vehicles import CharacteristicSet

CONFIDENCE = 0.95
"""Of the interval of a sample's share."""
Key = tuple[str, ...]
"""A cause without its sizes: its changes with their directions, such as ('mass up', 'tireFric down')."""


def key_of(characteristics: CharacteristicSet, cause: MinimalCause) -> Key:
    return tuple(direction(characteristics.members[column], float(cause.setting[column])) for column in cause.columns)


def necessity(characteristics: CharacteristicSet, changed: BoolArray, causes: Sequence[Sequence[MinimalCause]],
              failures: int) -> pd.DataFrame:
    """How often each characteristic is changed, and how often it is needed.

    Parameters
    ----------
    changed
        Which characteristics each of M failures changes, shape (M, n).
    causes
        The minimal causes of each.
    failures
        How many failures there are; if more than M, the M are a random sample of them.

    Returns
    -------
    pandas.DataFrame
        One row per characteristic: `characteristic`, and shares of the failures: `changed`; `necessary`, in every minimal
        cause; `involved`, in one at least; and `necessary_lower` and `necessary_upper`, the `CONFIDENCE` interval of `necessary` among
        all failures: Clopper and Pearson's for a sample (a little too wide, as it is drawn without replacement from finitely many),
        the share itself where all failures were analysed. Ordered by necessary, involved, changed; without rows if there is no failure.
    """
    columns = range(len(characteristics) if len(changed) else 0)
    counts = {"changed": _count(frozenset(np.flatnonzero(row).tolist()) for row in changed),
              "necessary": _count(map(necessary, causes)), "involved": _count(map(involved, causes))}
    sampled = len(changed) < failures
    intervals = [interval_of(counts["necessary"][column], len(changed), CONFIDENCE) if sampled
                 else (counts["necessary"][column] / len(changed),) * 2 for column in columns]
    frame = pd.DataFrame({
        "characteristic": pd.Series([characteristics.names[column] for column in columns], dtype=object),
        **{name: pd.Series([count[column] / len(changed) for column in columns], dtype=float) for name, count in counts.items()},
        "necessary_lower": pd.Series([low for low, _ in intervals], dtype=float),
        "necessary_upper": pd.Series([high for _, high in intervals], dtype=float)})
    return frame.sort_values(["necessary", "involved", "changed"], ascending=False, kind="stable", ignore_index=True)


def distinct_causes(characteristics: CharacteristicSet, causes: Sequence[Sequence[MinimalCause]]) -> pd.DataFrame:
    """Every distinct minimal cause, most frequent first.

    Returns
    -------
    pandas.DataFrame
        Columns `cause`, a tuple of changes with their directions; `failures`, how many have it; `share` of all failures.
    """
    counts = Counter(key for of_it in causes for key in {key_of(characteristics, cause) for cause in of_it})
    order = sorted(counts, key=lambda key: (-counts[key], len(key), key))
    return pd.DataFrame({
        "cause": pd.Series(order, dtype=object), "failures": pd.Series([counts[key] for key in order], dtype=int),
        "share": pd.Series([counts[key] / len(causes) for key in order], dtype=float)})


def _count(sets: Iterable[frozenset[int]]) -> Counter[int]:
    return Counter(column for columns in sets for column in columns)
