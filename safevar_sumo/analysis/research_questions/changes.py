"""RQ3 and the discussion: number, kind and size of changes that make the vehicle unsafe, collisions, combinations, sun
against rain.

Functions of a case raise `UnanswerableError` as `critical_solutions` does; `rq31` also raises it if solutions belong to
no run. In the frames, the columns `setting` and `other` hold the names of cases.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from safevar_sumo.ads import REACTION_PARAMETERS
from safevar_sumo.analysis.research_questions.case import NSGA2, Case, UnanswerableError, are_collisions
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import SAFETY_DEGREE

ANY = "any"
COMBINATION_SIZE = 4
"""Number of changed characteristics in the combinations that are counted."""
COMBINATIONS_SHOWN = 3
"""Number of the most frequent combinations that are shown."""


def critical_solutions(case: Case) -> pd.DataFrame:
    """NSGA-II's solutions with a safety degree below the original's.

    Raises
    ------
    UnanswerableError
        If NSGA-II is missing or the original's safety degree is undefined.
    """
    solutions = case.solutions_of(NSGA2)
    if np.isnan(case.original[SAFETY_DEGREE]):
        raise UnanswerableError(case.name, "lacks the original vehicle's safety degree", "results that have it")
    return solutions[solutions[SAFETY_DEGREE] < case.original[SAFETY_DEGREE]]


def changes_of(case: Case, solutions: pd.DataFrame) -> FloatArray:
    """Changes of n characteristics in M solutions, each in its unit: filtered minus original value, the paper's v'' -
    v; shape (M, n).
    """
    return np.asarray(solutions[list(case.characteristics.names)].to_numpy(dtype=float) - case.characteristics.original)


def masks_by_change_count(case: Case, changes: FloatArray) -> dict[str, BoolArray]:
    """For j = "1".."n" and "any": whether each solution has j characteristics changed, shape (M,)."""
    change_counts = np.count_nonzero(changes, axis=1)
    return {
        **{str(j): change_counts == j for j in range(1, len(case.characteristics) + 1)},
        ANY: np.ones(len(changes), dtype=bool),
    }


def _means_by_change_count(case: Case, values: Mapping[tuple[str, ...], FloatArray]) -> list[tuple[Any, ...]]:
    """For each key and j: key, j, and the mean (or None) and number of the critical solutions' values with j changes;
    NaN is none.
    """
    rows: list[tuple[Any, ...]] = []
    for key, column in values.items():
        for j, mask in masks_by_change_count(case, changes_of(case, critical_solutions(case))).items():
            sample = column[mask & ~np.isnan(column)]
            rows.append((*key, j, float(np.mean(sample)) if sample.size else None, sample.size))
    return rows


def rq31(case: Case) -> pd.DataFrame:
    """Number of critical solutions of each run with exactly j characteristics changed; columns setting, run, j,
    count.
    """
    solutions, runs = critical_solutions(case), case.runs_of(NSGA2)
    masks = masks_by_change_count(case, changes_of(case, solutions))
    rows = [
        (case.name, run, j, int(np.count_nonzero((solutions["run"] == run) & mask)))
        for run in runs
        for j, mask in masks.items()
        if j != ANY
    ]
    return pd.DataFrame(rows, columns=["setting", "run", "j", "count"])


def rq32(case: Case) -> pd.DataFrame:
    """For each characteristic and j: the share of the critical solutions with j changes that change this
    characteristic.

    Columns setting, characteristic, j ("1".."n", "any"), percent (None without such a solution), rank (only for
    j = "any"; ties share the better rank and the next one is skipped).
    """
    changed = changes_of(case, critical_solutions(case)) != 0
    counts = changed.sum(axis=0)  # solutions that change each characteristic
    ranks = {
        name: 1 + int(np.count_nonzero(counts > count))
        for name, count in zip(case.characteristics.names, counts, strict=True)
    }
    shares = _means_by_change_count(
        case, {(name,): column for name, column in zip(ranks, changed.T.astype(float), strict=True)}
    )
    rows = [
        (case.name, name, j, None if share is None else 100 * share, ranks[name] if j == ANY and len(changed) else None)
        for name, j, share, _ in shares
    ]
    return pd.DataFrame(rows, columns=["setting", "characteristic", "j", "percent", "rank"], dtype=object)


def rq33(case: Case) -> pd.DataFrame:
    """Size of increases and of decreases in the critical solutions with j characteristics changed.

    Columns setting, characteristic, direction, j ("1".."n", "any"), pc (the paper's PC, a fraction: mean change
    relative to the original value, without sign), delta (mean signed change in the characteristic's unit), n (number of
    changes); pc and delta are None where n is 0.
    """
    changes = changes_of(case, critical_solutions(case))
    originals = dict(zip(case.characteristics.names, case.characteristics.original, strict=True))
    means = _means_by_change_count(
        case,
        {
            (name, direction): np.where(np.sign(column) == sign, column, np.nan)
            for name, column in zip(originals, changes.T, strict=True)
            for direction, sign in (("increase", 1), ("decrease", -1))
        },
    )
    rows = [
        (case.name, name, direction, j, None if mean is None else abs(mean / originals[name]), mean, n)
        for name, direction, j, mean, n in means
    ]
    return pd.DataFrame(rows, columns=["setting", "characteristic", "direction", "j", "pc", "delta", "n"], dtype=object)


def rq33_safety(case: Case) -> pd.DataFrame:
    """Effect on safety of the critical solutions with j characteristics changed: the footer of RQ3.3's table.

    Columns setting, quantity, j, value, percent (of the original's value), n (number of solutions in the mean); value
    is None where n is 0. Quantities:

    - avgSD_mD: mean reduction of the distance over solutions without collision [m];
    - avgSD_cS: mean collision speed over collisions [m/s]; it has no percent;
    - TET [s], TIT [s^2]: mean increase over solutions without collision;
    - aveDece: mean decrease over all solutions [m/s^2].
    """
    solutions = critical_solutions(case)
    has_collided = are_collisions(solutions).to_numpy()
    sd, tet, tit, dece = (solutions[name].to_numpy(dtype=float) for name in (SAFETY_DEGREE, "tet", "tit", "ave_dece"))
    original = case.original
    originals = {
        "avgSD_mD": original[SAFETY_DEGREE],
        "avgSD_cS": np.nan,
        "TET": original["tet"],
        "TIT": original["tit"],
        "aveDece": original["ave_dece"],
    }
    means = _means_by_change_count(
        case,
        {
            ("avgSD_mD",): np.where(has_collided, np.nan, original[SAFETY_DEGREE] - sd),
            ("avgSD_cS",): np.where(has_collided, -sd, np.nan),
            ("TET",): np.where(has_collided, np.nan, tet - original["tet"]),
            ("TIT",): np.where(has_collided, np.nan, tit - original["tit"]),
            ("aveDece",): original["ave_dece"] - dece,
        },
    )
    rows = [
        (
            case.name,
            quantity,
            j,
            mean,
            None if mean is None or not (scale := abs(originals[quantity])) > 0 else 100 * mean / scale,
            n,
        )
        for quantity, j, mean, n in means
    ]
    return pd.DataFrame(rows, columns=["setting", "quantity", "j", "value", "percent", "n"], dtype=object)


def count_collisions(case: Case) -> pd.DataFrame:
    """Number of collisions among each algorithm's solutions; columns setting, algorithm, solutions, collisions, share
    [fraction].

    Raises
    ------
    UnanswerableError
        If no run is finished.
    """
    case.require_solutions()
    rows = []
    for algorithm in case.algorithms:
        solutions = case.solutions_of(algorithm)
        collision_count = int(are_collisions(solutions).sum())
        rows.append(
            (
                case.name,
                algorithm,
                len(solutions),
                collision_count,
                collision_count / len(solutions) if len(solutions) else None,
            )
        )
    return pd.DataFrame(rows, columns=["setting", "algorithm", "solutions", "collisions", "share"], dtype=object)


def frequent_combinations(case: Case) -> pd.DataFrame:
    """The most frequent combinations among the critical solutions with exactly four characteristics changed.

    Columns setting, rank (ties share the better one), characteristics (a list), percent (of the solutions with exactly
    four changes); no row where there is no such solution. Of combinations that are equally frequent, those with the
    earlier characteristics in the study come first.
    """
    is_changed = changes_of(case, critical_solutions(case)) != 0
    masks = is_changed[np.count_nonzero(is_changed, axis=1) == COMBINATION_SIZE]
    counts = Counter(tuple(np.flatnonzero(mask).tolist()) for mask in masks)
    ranking = sorted(counts.items(), key=lambda item: (-item[1], item[0]))[:COMBINATIONS_SHOWN]
    names = case.characteristics.names
    rows = [
        (
            case.name,
            1 + sum(other > count for other in counts.values()),
            [names[i] for i in columns],
            100 * count / len(masks),
        )
        for columns, count in ranking
    ]
    return pd.DataFrame(rows, columns=["setting", "rank", "characteristics", "percent"])


def find_weather_pairs(cases: Sequence[Case]) -> list[tuple[Case, Case]]:
    """Pairs of cases that differ only in the weather and the ADS's reaction to it, clearer weather first (by friction,
    visibility, delays).

    Parameters of the reaction are the ADS's delays, and those that the calibration of either study marks as its own.

    Raises
    ------
    UnanswerableError
        If there is no such pair.
    """
    pairs = [
        (clearer, other)
        for clearer, other in permutations(cases, 2)
        if not _differences(clearer, other) and _clearness(clearer) > _clearness(other)
    ]
    if not pairs:
        problem = "two cases are needed that differ in the weather alone"
        if len(cases) == 2:
            differences = ", ".join(_differences(*cases))
            problem += f"; these two {f'also differ in {differences}' if differences else 'have equally clear weather'}"
        raise UnanswerableError(
            ", ".join(case.name for case in cases), problem, "results such as those of sun and rain"
        )
    return pairs


def compare_weathers(clearer: Case, other: Case) -> pd.DataFrame:
    """One weather against another, characteristic by characteristic, over the critical solutions.

    The column setting names the clearer weather's case. Columns without the suffix "_other" belong to this case.
    Columns: setting, other, characteristic; percent, percent_other (of the critical solutions that change it);
    difference (percent_other - percent); rank, rank_other; increase, increase_other, decrease, decrease_other (mean
    signed change in the characteristic's unit).
    """
    tables = []
    for case in (clearer, other):
        shares, sizes = rq32(case), rq33(case)
        deltas = sizes[sizes["j"] == ANY].pivot(index="characteristic", columns="direction", values="delta")
        tables.append(shares[shares["j"] == ANY].set_index("characteristic")[["percent", "rank"]].join(deltas))
    table = (
        tables[0]
        .join(tables[1].add_suffix("_other"))
        .assign(
            setting=clearer.name,
            other=other.name,
            difference=lambda rows: rows["percent_other"].astype(float) - rows["percent"].astype(float),
        )
    )
    columns = [
        "setting",
        "other",
        "characteristic",
        "percent",
        "percent_other",
        "difference",
        "rank",
        "rank_other",
        "increase",
        "increase_other",
        "decrease",
        "decrease_other",
    ]
    return table.reset_index()[columns]


def _clearness(case: Case) -> tuple[float, float, float]:
    weather = case.weather
    reaction_delays = [float(case.study.ads.parameters.get(name, 0.0)) for name in REACTION_PARAMETERS]
    return weather.road_friction, weather.visibility, -weather.recognition_delay - sum(reaction_delays)


def _differences(one: Case, other: Case) -> list[str]:
    """Keys, of what a simulation depends on, in which two studies differ other than by the weather and the ADS's
    reaction to it.
    """
    studies = [msgspec.to_builtins(case.study) for case in (one, other)]
    own_keys = [key for case in (one, other) for key, parameter in case.study.calibration.items() if parameter.own]
    for study in studies:
        for name in (*REACTION_PARAMETERS, *(key.removeprefix("ads.parameters.") for key in own_keys)):
            study["ads"]["parameters"].pop(name, None)
    return [
        f"{table}.{key}"
        for table in ("scenario", "vehicle", "ads", "metrics")
        for key in studies[0][table] | studies[1][table]
        if studies[0][table].get(key) != studies[1][table].get(key)
    ]
