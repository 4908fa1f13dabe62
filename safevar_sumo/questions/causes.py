"""Finds the minimal causes of failures, and counts which changes the failures need. A minimal cause
is a subset of a setting's changes that is unsafe by itself, while all smaller parts of it are safe.

Outcomes need not be monotone: a change may undo the effect of another change. So nothing is
inferred: all subsets are simulated, size by size, except those that contain a cause.
"""

from __future__ import annotations

import operator
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from itertools import combinations, compress, islice, takewhile
from math import comb
from typing import NamedTuple

import numpy as np
import pandas as pd
from rich.console import Console

from safevar_sumo.metrics import F_DIFF, F_NUM_DIFF, Unsafe
from safevar_sumo.questions.case import Results
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.sampling import clopper_pearson
from safevar_sumo.records import BoolArray, FloatArray, NamedValues
from safevar_sumo.terminal import print_text
from safevar_sumo.vehicles import CharacteristicSet

SUBSETS = "look for the necessary changes"
BOUNDARIES = "look for smaller changes"
OTHER_SETS = "check other parameter sets"
"""Phases of progress."""
MAX_SUBSETS = 20_000
"""Maximum number of subsets that are simulated in one call, which bounds the memory. The same
number is the default limit on all subsets.
"""


class Cause(NamedTuple):
    """A minimal subset of a failure's changes that is unsafe by itself. All other characteristics
    are as in the original vehicle.

    Attributes
    ----------
    changes
        The values of the changed characteristics in their units, by name.
    outcome, safety_degree
        The outcome and the safety degree [m, or -m/s] of a vehicle with only these changes.
    encounter
        The failure's parameters of the scenario; empty unless encounters are ranges.
    unsafe_runs
        The share of this vehicle's runs that is unsafe; 1 without repeats.
    """

    changes: NamedValues
    outcome: str
    safety_degree: float
    encounter: NamedValues
    unsafe_runs: float = 1.0


Causes = Sequence[Cause]


def find_minimal_causes(
    evaluator: Evaluator, settings: FloatArray, unsafe: Unsafe, limit: int = MAX_SUBSETS
) -> list[list[Cause]]:
    """The minimal causes of each of M settings, shape (M, n). The list of a setting is empty if no
    subset of its changes is unsafe.

    Up to a size (`largest_complete` for the number `limit` of simulated settings), all minimal
    causes are found. Larger subsets are simulated only for settings without a cause so far.

    The empty subset counts, too: if the original vehicle is unsafe, no change is needed.
    """
    # Only changes of the vehicle are undone: all subsets keep the setting's encounter.
    members = evaluator.characteristics
    is_changed = members.changed(settings) & members.of_vehicle
    changed = [np.flatnonzero(flags).tolist() for flags in is_changed]
    originals = members.with_original_vehicle(settings)
    causes = [dict[frozenset[int], Cause]() for _ in settings]
    numbers = list(map(len, changed))
    complete = largest_complete(numbers, limit)

    # Simulate the subsets by size, and the subsets of all settings together. A subset that contains
    # a smaller cause cannot be minimal: it is left out.
    with evaluator.phases.stage(SUBSETS, _count_subsets(numbers, complete)):
        for size in range(max(numbers, default=0) + 1):
            without_cause = compress(numbers, map(operator.not_, causes))
            room = evaluator.settings_left
            if (
                size > complete
                and room is not None
                and sum(comb(number, size) for number in without_cause) > room
            ):
                break
            subsets = _subsets(changed, causes, size, is_complete=size <= complete)
            while chunk := list(islice(subsets, MAX_SUBSETS)):
                partial_settings = originals[[row for row, _ in chunk]]
                for partial, (row, columns) in zip(
                    partial_settings, chunk, strict=True
                ):
                    partial[columns] = settings[row, columns]
                evaluations = evaluator.evaluate(partial_settings, SUBSETS)
                of_runs = unsafe.runs(evaluations).mean(axis=0)
                of_runs[~evaluator.confirmed(evaluations, unsafe)] = 0.0
                for index in np.flatnonzero(of_runs).tolist():
                    row, columns = chunk[index]
                    values = settings[row].tolist()
                    causes[row][frozenset(columns)] = Cause(
                        {members.names[column]: values[column] for column in columns},
                        str(evaluations.outcome[index]),
                        float(evaluations.f_safe[index]),
                        members.encounter_of(settings[row]),
                        float(of_runs[index]),
                    )
    return [list(of_row.values()) for of_row in causes]


def _subsets(
    changed: Sequence[Sequence[int]],
    causes: Sequence[Collection[frozenset[int]]],
    size: int,
    *,
    is_complete: bool,
) -> Iterator[tuple[int, list[int]]]:
    """Yield the row and the changed columns of each subset of a size that contains no cause. If the
    size is not complete, only rows without a cause have subsets.
    """
    for row, of_row in enumerate(causes):
        if is_complete or not of_row:
            for columns in combinations(changed[row], size):
                if not any(cause.issubset(columns) for cause in of_row):
                    yield row, list(columns)


def largest_complete(numbers: Sequence[int], limit: int) -> int:
    """The largest size for which all subsets can be simulated with at most `limit` settings; at
    least 1. `numbers` are the numbers of changes of the settings.
    """
    sizes = range(2, max(numbers, default=1) + 1)
    affordable = takewhile(lambda size: _count_subsets(numbers, size) <= limit, sizes)
    return max(affordable, default=1)


def are_causes(evaluator: Evaluator, causes: Causes, unsafe: Unsafe) -> BoolArray:
    """Whether each of M causes is also a minimal cause with the parameters of another evaluator,
    shape (M,). All its changes together are unsafe there, and safe if any single change is left
    out.
    """
    characteristics = evaluator.characteristics
    original = characteristics.original
    groups = []
    for setting in settings_of(characteristics, causes):
        is_changed = (setting != original) & characteristics.of_vehicle
        # Each further row leaves out one of the changes.
        is_left_out = np.diag(is_changed)[is_changed]
        groups.append(np.vstack([setting, np.where(is_left_out, original, setting)]))
    starts = np.cumsum([0, *map(len, groups[:-1])])
    is_unsafe = unsafe.of(evaluator.evaluate(np.concatenate(groups), OTHER_SETS))
    # The first setting of a group, with all changes, is the only unsafe one.
    return np.asarray(
        is_unsafe[starts] & (np.add.reduceat(is_unsafe, starts, dtype=int) == 1)
    )


def _count_subsets(numbers: Sequence[int], largest: int) -> int:
    """The number of subsets with at most `largest` changes, over all `numbers` of changes."""
    return sum(comb(number, size) for number in numbers for size in range(largest + 1))


def select_affordable_rows(
    settings: FloatArray, evaluator: Evaluator, max_evaluations: int
) -> list[int]:
    """The rows of `settings` whose minimal causes can be found with about `max_evaluations`: all
    rows, or a random sample. If only few simulations are allowed, the sample has at least one row,
    provided that the simulations suffice for each single change.
    """
    costs = 2.0 ** evaluator.characteristics.number_changed(settings)
    order = np.random.default_rng(evaluator.seed).permutation(len(settings))
    smallest_number = int(
        evaluator.budget.is_few and len(evaluator.characteristics) < max_evaluations
    )
    number = max(
        smallest_number, np.count_nonzero(np.cumsum(costs[order]) <= max_evaluations)
    )
    return sorted(order[:number].tolist())


def count_needed(
    characteristics: CharacteristicSet,
    changed: BoolArray,
    causes: Sequence[Causes],
    failures: int,
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
        One row per characteristic: `characteristic`, and the shares of failures in which it is
        `changed`, `needed` (part of every minimal cause) and `in_some` (part of at least one).
        `needed_low` and `needed_high` are the 95 % interval of `needed` among all failures: Clopper
        and Pearson's for a sample (slightly too wide, because the sample is drawn without
        replacement from finitely many failures), the share itself if all failures were analysed.
        Ordered by needed, in_some, changed; no rows if there is no failure.
    """
    names = characteristics.vehicle.names
    number = max(len(changed), 1)
    changed = changed[:, characteristics.of_vehicle]
    counts = np.zeros(len(names))
    in_some = np.zeros(len(names))
    for group in filter(None, causes):
        is_in_cause = [np.isin(names, list(cause.changes)) for cause in group]
        counts += np.all(is_in_cause, axis=0)
        in_some += np.any(is_in_cause, axis=0)

    # If the failures are a sample, the share among all failures is uncertain.
    intervals = np.repeat(counts[:, None] / number, 2, axis=1)
    if len(changed) < failures:
        intervals = np.array([clopper_pearson(count, number) for count in counts])
    shares = {
        "characteristic": names,
        "changed": changed.sum(axis=0) / number,
        "needed": counts / number,
        "needed_low": intervals[:, 0],
        "needed_high": intervals[:, 1],
        "in_some": in_some / number,
    }
    frame = pd.DataFrame(shares).head(len(names) if len(changed) else 0)
    return frame.sort_values(
        ["needed", "in_some", "changed"],
        ascending=False,
        kind="stable",
        ignore_index=True,
    )


def directions(
    characteristics: CharacteristicSet, changes: NamedValues
) -> tuple[str, ...]:
    """The directions of changes, without their sizes, such as ('mass up', 'tireFric down')."""
    texts = []
    for item in characteristics:
        if item.name in changes:
            is_larger = changes[item.name] > item.original
            texts.append(f"{item.name} {'up' if is_larger else 'down'}")
    return tuple(texts)


def kinds_of(
    characteristics: CharacteristicSet, causes: Causes
) -> set[tuple[str, ...]]:
    """The different kinds of causes: which characteristics change, and in which direction."""
    return {directions(characteristics, cause.changes) for cause in causes}


def count_distinct_causes(
    characteristics: CharacteristicSet, causes: Sequence[Causes]
) -> pd.DataFrame:
    """Every distinct minimal cause, most frequent first.

    Returns
    -------
    pandas.DataFrame
        Columns `cause`, a tuple of changes with their directions; `failures`, the number of
        failures with this cause; and `share`, their share of all failures.
    """
    counts = Counter[tuple[str, ...]]()
    for group in causes:
        counts.update(kinds_of(characteristics, group))
    order = sorted(counts, key=lambda key: (-counts[key], len(key), key))
    rows = [(key, counts[key], counts[key] / len(causes)) for key in order]
    return pd.DataFrame(rows, columns=["cause", "failures", "share"])


def causes_of_runs(case: Results, evaluator: Evaluator, limit: int) -> pd.DataFrame:
    """How many distinct minimal causes each finished run found, in at most `limit` of its unsafe
    solutions: those with the fewest, then the smallest changes.

    Returns
    -------
    pandas.DataFrame
        Columns algorithm, run, failures (different unsafe solutions), examined and causes.
    """
    keys = ["algorithm", "run"]
    order = [F_NUM_DIFF.name, F_DIFF.name]
    names = evaluator.characteristics.names
    failures = case.solutions[case.unsafe.rows(case.solutions)].drop_duplicates(
        [*keys, *names]
    )
    examined = failures.sort_values(order, kind="stable").groupby(keys).head(limit)
    settings = examined[[*names, F_NUM_DIFF.name]].drop_duplicates()
    price = int((2.0 ** settings.pop(F_NUM_DIFF.name)).sum())
    print_text(
        Console(stderr=True),
        f"Finding the minimal causes of {case.name} takes at most {price:,} simulations.",
    )
    rows = settings.to_numpy(dtype=float)
    causes = find_minimal_causes(evaluator, rows, case.unsafe, price)
    kinds = pd.Series(
        [kinds_of(evaluator.characteristics, group) for group in causes],
        settings.index,
        name="kind",
    )
    causes_of_solutions = examined.merge(settings.join(kinds.explode())).dropna(
        subset="kind"
    )
    counted = {
        "failures": failures,
        "examined": examined,
        "causes": causes_of_solutions[[*keys, "kind"]].drop_duplicates(),
    }
    frame = pd.DataFrame(
        {name: rows.groupby(keys).size() for name, rows in counted.items()},
        pd.MultiIndex.from_tuples(case.finished, names=keys),
    )
    return frame.fillna(0).astype(int).reset_index()


def settings_of(characteristics: CharacteristicSet, causes: Causes) -> FloatArray:
    """The settings of M causes, shape (M, n): the original vehicle with only the changes of the
    cause, in the encounter of the cause.
    """
    settings = [
        characteristics.setting(cause.changes | cause.encounter, beyond=True)
        for cause in causes
    ]
    return np.array(settings).reshape(-1, len(characteristics))
