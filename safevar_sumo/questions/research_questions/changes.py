"""RQ3 and the paper's discussion: the number, kind and size of the changes of critical solutions
(less safe than the original vehicle), collisions, and combinations of changes.

Functions of a case raise `UnanswerableError` in the same cases as `critical_solutions`. `rq31` also
raises it if the solutions belong to no run.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import compress, product

import numpy as np
import pandas as pd

from safevar_sumo.questions.case import (
    NSGA2,
    Results,
    UnanswerableError,
    are_collisions,
)
from safevar_sumo.records import FloatArray, TextArray
from safevar_sumo.study import SAFETY_DEGREE

ANY = "any"
COMBINATION_SIZE = 4
"""Number of changed characteristics in the combinations that are counted."""
COMBINATIONS_SHOWN = 3
"""Number of combinations that are shown: the most frequent ones."""
SAFETY_SCALES = {
    "avgSD_mD": SAFETY_DEGREE,
    "TET": "tet",
    "TIT": "tit",
    "aveDece": "ave_dece",
}
"""By the quantity of `rq33_safety`, the metric whose value for the original vehicle is 100 %. Only
quantities with a percentage are in it.
"""


def critical_solutions(case: Results) -> pd.DataFrame:
    """The critical solutions: NSGA-II's solutions with a safety degree below the original's.

    Raises
    ------
    UnanswerableError
        If NSGA-II has no finished run, or the original's safety degree is undefined.
    """
    solutions = case.solutions_of(NSGA2)
    if np.isnan(case.original_metrics[SAFETY_DEGREE]):
        raise UnanswerableError(
            case.name,
            "lacks the original vehicle's safety degree",
            "results that have it",
        )
    return solutions[solutions[SAFETY_DEGREE] < case.original_degrees(solutions)]


def changes_of(case: Results) -> FloatArray:
    """The changes of the vehicle's n characteristics in the M critical solutions, in their units,
    shape (M, n). A change is the filtered value minus the original value, the paper's v'' - v.
    """
    vehicle = case.characteristics.vehicle
    values = critical_solutions(case)[list(vehicle.names)].to_numpy(float)
    return values - vehicle.original


def change_numbers(case: Results) -> list[str]:
    """All possible numbers of changed characteristics, as texts: "1".."n"."""
    return list(map(str, range(1, len(case.characteristics.vehicle) + 1)))


def count_changes(case: Results) -> TextArray:
    """The number j of changed characteristics of each of the M critical solutions, as texts, shape
    (M,).
    """
    counts = np.count_nonzero(changes_of(case), axis=1)
    return np.asarray(counts.astype(str))


def _means_by_change_count(
    case: Results,
    labels: Sequence[str],
    name: str,
    values: Iterable[tuple[tuple[str, ...], FloatArray]],
) -> pd.DataFrame:
    """Mean values of the critical solutions with j characteristics changed, for each key and j.

    `values` holds keys, each with one value per critical solution; NaN does not count. Columns: the
    `labels` of the keys, j ("1".."n", "any"), `name` (the mean, NaN without values), n (number of
    values).
    """
    change_counts = count_changes(case)
    rows = []
    for (key, column), j in product(values, (*change_numbers(case), ANY)):
        has_number = (j == ANY) | (change_counts == j)
        sample = column[has_number & ~np.isnan(column)]
        mean = np.mean(sample) if sample.size else np.nan
        rows.append((*key, j, mean, sample.size))
    return pd.DataFrame(rows, columns=[*labels, "j", name, "n"])


def rq31(case: Results) -> pd.DataFrame:
    """Number of critical solutions of each run with exactly j characteristics changed; columns run,
    j, count.
    """
    solutions = critical_solutions(case)
    runs = case.runs_of(NSGA2)
    counts = solutions.groupby([solutions["run"], count_changes(case)]).size()
    index = pd.MultiIndex.from_product([runs, change_numbers(case)], names=["run", "j"])
    return counts.reindex(index, fill_value=0).reset_index(name="count")


def rq32(case: Results) -> pd.DataFrame:
    """For each characteristic and j: the share of the critical solutions with j changes that change
    this characteristic.

    Columns characteristic, j ("1".."n", "any"), percent (undefined without such a solution), rank
    (only for j = "any"; ties share the better rank and the next one is skipped).
    """
    shares = (changes_of(case) != 0).astype(float)
    keys = zip(case.characteristics.vehicle.names, strict=True)
    values = zip(keys, shares.T, strict=True)
    frame = _means_by_change_count(case, ["characteristic"], "percent", values)
    frame = frame.drop(columns="n")
    frame["percent"] *= 100
    of_any = frame["percent"].where(frame["j"] == ANY)
    ranks = of_any.rank(method="min", ascending=False)
    return frame.assign(rank=ranks.astype("Int64"))


def rq33(case: Results) -> pd.DataFrame:
    """Size of increases and of decreases in the critical solutions with j characteristics changed.

    Columns characteristic, direction, j ("1".."n", "any"), pc (the paper's PC, a fraction: mean
    change relative to the original value, without sign), delta (mean signed change in the
    characteristic's unit), n (number of changes); pc and delta are undefined where n is 0.
    """
    changes = changes_of(case)
    vehicle = case.characteristics.vehicle
    originals = vehicle.named(vehicle.original)
    values = {}
    for name, column in zip(originals, changes.T, strict=True):
        values[name, "increase"] = np.where(column > 0, column, np.nan)
        values[name, "decrease"] = np.where(column < 0, column, np.nan)
    frame = _means_by_change_count(
        case, ["characteristic", "direction"], "delta", values.items()
    )
    frame["pc"] = (frame["delta"] / frame["characteristic"].map(originals)).abs()
    return frame


def rq33_safety(case: Results) -> pd.DataFrame:
    """Effect on safety of the critical solutions with j characteristics changed: the footer of
    RQ3.3's table.

    Columns quantity, j, value, percent (of the original's value), n (number of solutions in the
    mean); value is undefined where n is 0. Quantities:

    - avgSD_mD: mean reduction of the distance over solutions without collision [m];
    - avgSD_cS: mean collision speed over collisions [m/s]; it has no percent;
    - TET [s], TIT [s^2]: mean increase over solutions without collision;
    - aveDece: mean decrease over all solutions [m/s^2].

    If encounters are ranges, only the original's safety degree is known in the encounter of a
    solution. Then TET, TIT and aveDece are undefined, and the original's safety degree is the mean
    over these encounters.
    """
    solutions = critical_solutions(case)
    has_collided = are_collisions(solutions).to_numpy()
    safety_degree, tet, tit, deceleration = (
        solutions[[SAFETY_DEGREE, "tet", "tit", "ave_dece"]].to_numpy(float).T
    )
    degrees = case.original_degrees(solutions)
    original = case.original_metrics
    if case.study.ranges:
        original = {**dict.fromkeys(original, np.nan), SAFETY_DEGREE: degrees.mean()}

    values = {
        ("avgSD_mD",): np.where(has_collided, np.nan, degrees - safety_degree),
        ("avgSD_cS",): np.where(has_collided, -safety_degree, np.nan),
        ("TET",): np.where(has_collided, np.nan, tet - original["tet"]),
        ("TIT",): np.where(has_collided, np.nan, tit - original["tit"]),
        ("aveDece",): original["ave_dece"] - deceleration,
    }
    frame = _means_by_change_count(case, ["quantity"], "value", values.items())

    metrics = frame["quantity"].map(SAFETY_SCALES)
    scales = metrics.map(original).abs().replace(0.0, np.nan)
    frame["percent"] = 100 * frame["value"] / scales
    return frame


def count_collisions(case: Results) -> pd.DataFrame:
    """Number of collisions among each algorithm's solutions; columns algorithm, solutions,
    collisions, share [fraction].

    Raises
    ------
    UnanswerableError
        If no run is finished.
    """
    case.require_solutions()
    has_collided = are_collisions(case.solutions)
    groups = has_collided.groupby(case.solutions["algorithm"])
    counts = groups.agg(solutions="size", collisions="sum")
    counts = counts.reindex(list(case.algorithms), fill_value=0)
    counts["share"] = counts["collisions"] / counts["solutions"]
    return counts.rename_axis("algorithm").reset_index()


def frequent_combinations(case: Results) -> pd.DataFrame:
    """The most frequent combinations among the critical solutions with exactly four characteristics
    changed.

    Columns rank (ties share the better rank), characteristics (a list), percent (of the solutions
    with exactly four changes). There is no row without such a solution. Of equally frequent
    combinations, the one with earlier characteristics in the study comes first.
    """
    is_changed = changes_of(case) != 0
    masks = is_changed[np.count_nonzero(is_changed, axis=1) == COMBINATION_SIZE]
    combinations, counts = np.unique(masks, axis=0, return_counts=True)
    # The reversed order begins with the earliest characteristics.
    combinations = combinations[::-1]
    counts = counts[::-1]
    names = case.characteristics.vehicle.names
    rows = []
    for row in np.argsort(-counts, kind="stable")[:COMBINATIONS_SHOWN]:
        count = counts[row]
        rank = 1 + np.count_nonzero(counts > count)
        combination = list(compress(names, combinations[row]))
        rows.append((rank, combination, 100 * count / len(masks)))
    return pd.DataFrame(rows, columns=["rank", "characteristics", "percent"])
