"""Minimal causes: the smallest subsets of a setting's changes that are unsafe by themselves; and whether a failure is
robust, as its neighbours are unsafe too.

Outcomes need not be monotone: a change may undo the effect of another change. So all subsets of a size are simulated,
size by size, until some are unsafe. These are minimal, as no smaller subset is unsafe.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import combinations, islice, pairwise
from math import comb
from typing import NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.evaluator import Evaluator, clopper_pearson
from safevar_sumo.records import BoolArray, Evaluations, FloatArray, JsonObject, finite_or_none
from safevar_sumo.vehicles import CharacteristicSet

NEIGHBOUR_COUNT = 64
"""Number of neighbours of a setting that are simulated with each time step."""
STEP_FACTORS = (1.0, 0.5, 2.0)
"""Factors by which the study's time step is multiplied; the step itself comes first."""
MIN_ROBUST_SHARE = 0.8
"""Share of unsafe neighbours from which on a failure is called robust; below, it is borderline."""
FAILURES_PER_BATCH = 8
"""Number of failures whose robustness is estimated at a time, the smallest failures first."""


class Robustness(NamedTuple):
    """Shares of unsafe outcomes among the neighbours of a setting, by time step [s]."""

    shares_by_step: dict[float, float]

    @property
    def share(self) -> float:
        return sum(self.shares_by_step.values()) / len(self.shares_by_step)

    @property
    def borderline(self) -> bool:
        """Whether small perturbations remove a failure, because too few of its neighbours are unsafe."""
        return self.share < MIN_ROBUST_SHARE

    def __str__(self) -> str:
        """A phrase such as `robust: 84 % of the neighbours are unsafe too, but only 53 % with a step of 0.1 s`."""
        step, least_share = min(self.shares_by_step.items(), key=lambda item: item[1])
        phrase = f"{100 * self.share:.0f} % of the neighbours are unsafe too"
        if self.borderline:
            return f"borderline: only {phrase}"
        exception = f", but only {100 * least_share:.0f} % with a step of {step:g} s"
        return f"robust: {phrase}{exception if least_share < MIN_ROBUST_SHARE else ''}"


def draw_neighbours(characteristics: CharacteristicSet, settings: FloatArray, seed: int) -> FloatArray:
    """The neighbours of M settings, shape (M, n), those of one setting after those of another.

    A neighbour differs from its setting by at most the filter's threshold.
    """
    n = len(characteristics)
    offsets = np.random.default_rng(seed).uniform(-1, 1, (NEIGHBOUR_COUNT, n)) * characteristics.threshold
    return np.clip(settings[:, np.newaxis] + offsets, characteristics.lower, characteristics.upper).reshape(-1, n)


def estimate_robustness(
    evaluator: Evaluator, settings: FloatArray, step: float, unsafe: Unsafe, factors: Sequence[float] = STEP_FACTORS
) -> list[Robustness]:
    """The robustness of each of M settings, shape (M, n).

    A setting's neighbours differ from it in each characteristic by at most the filter's threshold. They are simulated
    without the filter, with each of `factors` times the study's time step (`step` seconds). Neighbours that cannot be
    simulated do not count.
    """
    neighbours, shares = draw_neighbours(evaluator.characteristics, settings, evaluator.study.search.seed), {}
    for factor in factors:
        step_evaluator = evaluator if factor == 1 else evaluator.with_step(step * factor)
        evaluations = step_evaluator.evaluate(neighbours, f"neighbours at {step * factor:g} s a step")
        is_unsafe, is_valid = (
            flags.reshape(len(settings), NEIGHBOUR_COUNT) for flags in (unsafe.of(evaluations), evaluations.valid)
        )
        shares[step * factor] = (is_unsafe & is_valid).sum(axis=1) / np.maximum(is_valid.sum(axis=1), 1)
    return [Robustness(dict(zip(shares, row, strict=True))) for row in np.transpose(list(shares.values())).tolist()]


def find_smallest_robust_failure(
    evaluator: Evaluator, failures: Evaluations, step: float, unsafe: Unsafe, max_evaluations: int
) -> int | None:
    """The row of the robust failure with the fewest changes; of several, the one whose largest change is smallest.

    Failures are tried in this order until one is robust, or about `max_evaluations` settings are evaluated with each
    time step; None if no tried failure is robust.
    """
    order = np.lexsort([failures.f_safe, failures.f_diff, failures.f_num_diff])[
        : max_evaluations // NEIGHBOUR_COUNT + 1
    ]
    for start in range(0, len(order), FAILURES_PER_BATCH):
        rows = order[start : start + FAILURES_PER_BATCH]
        estimates = estimate_robustness(evaluator, failures.settings[rows], step, unsafe)
        for row, robustness in zip(rows.tolist(), estimates, strict=True):
            if not robustness.borderline:
                return int(row)
    return None


MAX_SUBSETS = 20_000
"""Maximum number of subsets simulated in one call, which bounds the memory."""


class BoundaryState(StrEnum):
    """What lies on a line from the original just below the smallest share of the line that is unsafe."""

    SAFE = "safe"
    FILTER = "filter threshold"
    NOT_SIMULATED = "not simulated"


STATE_PHRASES = {
    BoundaryState.SAFE: "slightly less is safe",
    BoundaryState.FILTER: "with less, a change falls below the filter's threshold and counts as none",
    BoundaryState.NOT_SIMULATED: "slightly less could not be simulated",
}


@dataclass(frozen=True, kw_only=True)
class Cause:
    """A smallest subset of a failure's changes that is unsafe by itself, all else as in the original vehicle.

    `find_minimal_causes` finds `changes`, `outcome` and `safety_degree`, `describe_causes` the limits.

    Attributes
    ----------
    changes
        The failure's values of these characteristics, in their units.
    outcome, safety_degree
        Outcome, and safety degree [m, or -m/s], of a vehicle with these changes only.
    boundary
        The limits if all changes are scaled: the values after every change is multiplied by `fraction`, the smallest
        factor at which the vehicle stays unsafe.
    alone
        The limits if one change is scaled: for each characteristic, the value to which it can return towards the
        original while the others stay as in `changes`.
    end
        What lies just below `fraction`, where the shrinking ends.
    neighbours
        Robustness of these changes by themselves, estimated from their neighbours; None in a rated study, where the
        simulations would take too long.
    sets, holds
        Number of fitted vehicle models (`ExplainOptions.fits`), and number of those in which these changes are a cause
        too; both are 0 in a study with a single model.
    """

    changes: dict[str, float]
    outcome: str
    safety_degree: float | None
    boundary: dict[str, float] = field(default_factory=dict)
    fraction: float = 1.0
    alone: dict[str, float] = field(default_factory=dict)
    end: BoundaryState = BoundaryState.SAFE
    neighbours: Robustness | None = None
    sets: int = 0
    holds: int = 0

    @property
    def robustness(self) -> float | None:
        """Share of the neighbours of these changes that are unsafe too."""
        return None if self.neighbours is None else self.neighbours.share

    @property
    def limit(self) -> str:
        """A sentence on the smallest unsafe share of the changes, and on what lies just below this share."""
        return f"Scaling all changes to {100 * self.fraction:.1f} % is still unsafe; {STATE_PHRASES[self.end]}."

    @property
    def notes(self) -> str:
        """A suffix in brackets: how robust the cause is, and in how many fitted vehicle models it is a cause; empty if
        neither is known.
        """
        notes = [] if self.neighbours is None else [str(self.neighbours)]
        notes += [f"in {self.holds} of {self.sets} fitted vehicle models"] if self.sets else []
        return f" ({'; '.join(notes)})" if notes else ""

    def setting(self, characteristics: CharacteristicSet) -> FloatArray:
        """The original vehicle with these changes only, shape (n,)."""
        return np.array([self.changes.get(item.name, item.original) for item in characteristics])

    def to_dict(self) -> JsonObject:
        """An entry for a cause in `minimal_causes` of `explain --json`."""
        names = ("changes", "boundary", "fraction", "outcome", "safety_degree", "end", "robustness")
        across_fits = {"sets": self.sets, "holds": self.holds} if self.sets else None
        return {name: getattr(self, name) for name in names} | {"across_fits": across_fits}


def find_minimal_causes(evaluator: Evaluator, settings: FloatArray, unsafe: Unsafe) -> list[list[Cause]]:
    """All smallest unsafe subsets of the changes of each of M settings, shape (M, n), without limits; an empty list if
    no subset is unsafe.

    The empty subset counts too: if the original vehicle is unsafe, no change is needed.
    """
    characteristics = evaluator.characteristics
    changed = [np.flatnonzero(flags).tolist() for flags in characteristics.changed(settings)]
    causes: list[list[Cause]] = [[] for _ in settings]
    for size in range(max(map(len, changed), default=0) + 1):
        subsets = (
            (row, list(columns))
            for row, columns_changed in enumerate(changed)
            if not causes[row]  # no smaller subset is one; of this size, all subsets are simulated
            for columns in combinations(columns_changed, size)
        )
        while chunk := list(islice(subsets, MAX_SUBSETS)):
            partial_settings = np.tile(characteristics.original, (len(chunk), 1))
            for partial, (row, columns) in zip(partial_settings, chunk, strict=True):
                partial[columns] = settings[row, columns]
            evaluations = evaluator.evaluate(partial_settings, f"subsets of {size} changes")
            for index in np.flatnonzero(unsafe.of(evaluations)).tolist():
                row, columns = chunk[index]
                changes = {characteristics.names[column]: float(settings[row, column]) for column in columns}
                outcome, degree = str(evaluations.outcome[index]), finite_or_none(evaluations.f_safe[index])
                causes[row].append(Cause(changes=changes, outcome=outcome, safety_degree=degree))
    return causes


def select_affordable_rows(settings: FloatArray, evaluator: Evaluator, max_evaluations: int) -> list[int]:
    """All rows of `settings`, or a random sample of them, so that finding their minimal causes takes at most about
    `max_evaluations`.

    The estimate assumes causes with half of the changes, about as in the shipped studies.
    """
    costs = np.array(
        [
            sum(comb(changes, size) for size in range((changes + 1) // 2 + 1))
            for changes in evaluator.characteristics.number_changed(settings).astype(int).tolist()
        ]
    )
    if costs.sum() <= max_evaluations:
        return list(range(len(settings)))
    order = np.random.default_rng(evaluator.study.search.seed).permutation(len(settings))
    return sorted(order[np.cumsum(costs[order]) <= max_evaluations].tolist())


def necessity_frame(
    characteristics: CharacteristicSet, changed: BoolArray, causes: Sequence[Sequence[Cause]], failures: int
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
    names, number = characteristics.names, max(len(changed), 1)
    in_causes = [np.array([[name in cause.changes for name in names] for cause in group]) for group in causes if group]
    necessary, involved = (
        sum((combine(rows, axis=0) for rows in in_causes), np.zeros(len(names))) for combine in (np.all, np.any)
    )
    frame = pd.DataFrame({"characteristic": names, "changed": changed.sum(axis=0) / number})
    frame["necessary"], frame["involved"] = necessary / number, involved / number
    frame[["necessary_lower", "necessary_upper"]] = (
        [clopper_pearson(int(count), number) for count in necessary]
        if len(changed) < failures
        else frame[["necessary", "necessary"]].to_numpy()
    )
    frame = frame if len(changed) else frame.head(0)
    return frame.sort_values(["necessary", "involved", "changed"], ascending=False, kind="stable", ignore_index=True)


def cause_key(characteristics: CharacteristicSet, cause: Cause) -> tuple[str, ...]:
    """The directions of a cause's changes, without their sizes, such as ('mass up', 'tireFric down')."""
    return tuple(
        f"{item.name} {'up' if cause.changes[item.name] > item.original else 'down'}"
        for item in characteristics
        if item.name in cause.changes
    )


def count_distinct_causes(characteristics: CharacteristicSet, causes: Sequence[Sequence[Cause]]) -> pd.DataFrame:
    """Every distinct minimal cause, most frequent first.

    Returns
    -------
    pandas.DataFrame
        Columns `cause`, a tuple of changes with their directions; `failures`, the number of failures with this cause;
        and `share`, their share of all failures.
    """
    counts = Counter[tuple[str, ...]]()
    for of_failure in causes:
        counts.update({cause_key(characteristics, cause) for cause in of_failure})
    order = sorted(counts, key=lambda key: (-counts[key], len(key), key))
    rows = [(key, counts[key], counts[key] / len(causes)) for key in order]
    return pd.DataFrame(rows, columns=["cause", "failures", "share"])


LINE_SETTINGS = 32
"""Number of settings first simulated on each line from the original to a setting. The search finds every unsafe stretch
of the line that is as long as their spacing.
"""
PARTS_PER_ROUND = 8
"""Number of parts into which each further round divides the interval with the boundary."""
ROUNDS = 3
"""Number of rounds after the first."""
RESOLUTION = 1 / (LINE_SETTINGS * PARTS_PER_ROUND**ROUNDS)
"""Accuracy of a boundary, as a share of the line."""


def describe_causes(evaluator: Evaluator, causes: Sequence[Cause], unsafe: Unsafe) -> list[Cause]:
    """Find the limits of causes: how far all changes shrink by a common factor, and each change by itself, while they
    stay unsafe and above the filter's thresholds.
    """
    if not causes:
        return []
    characteristics = evaluator.characteristics
    settings, original = np.array([cause.setting(characteristics) for cause in causes]), characteristics.original
    is_changed = settings != original
    # A cause has a line on which all its changes are scaled, then a line for each change by itself.
    groups = [np.vstack([flags, np.eye(len(flags), dtype=bool)[flags]]) for flags in is_changed]
    line_counts = list(map(len, groups))
    is_scaled, ends = np.concatenate(groups), np.repeat(settings, line_counts, axis=0)
    starts = np.where(is_scaled, original, ends)
    thresholds = np.divide(
        characteristics.threshold, np.abs(ends - original), out=np.zeros(ends.shape), where=is_scaled
    )
    shares, states = find_boundary_shares(evaluator, starts, ends, unsafe, thresholds.max(axis=1))
    limits, first_lines = settings_on_lines(starts, ends, shares[:, np.newaxis])[:, 0], np.cumsum([0, *line_counts])
    return [
        replace(
            cause,
            boundary=dict(zip(cause.changes, limits[first, flags].tolist(), strict=True)),
            alone=dict(zip(cause.changes, np.diagonal(limits[first + 1 : stop, flags]).tolist(), strict=True)),
            fraction=float(shares[first]) if cause.changes else 0.0,
            end=states[first],
        )
        for cause, flags, (first, stop) in zip(causes, is_changed, pairwise(first_lines), strict=True)
    ]


def settings_on_lines(starts: FloatArray, ends: FloatArray, shares: FloatArray) -> FloatArray:
    """Settings at K `shares`, shape (M, K), of M lines from `starts` to `ends`, shape (M, n); shape (M, K, n)."""
    factors, start, end = shares[..., np.newaxis], starts[:, np.newaxis], ends[:, np.newaxis]
    return np.where(factors >= 1, end, start + factors * (end - start))


def find_boundary_shares(
    evaluator: Evaluator,
    starts: FloatArray,
    ends: FloatArray,
    unsafe: Unsafe,
    lowest: FloatArray | float = 0.0,
    stage: str = "boundaries",
) -> tuple[FloatArray, list[BoundaryState]]:
    """The first unsafe share above `lowest` of each of M lines, whose end must be unsafe, and what lies just below it.

    The error is at most `RESOLUTION` times the line above `lowest`. A setting that cannot be simulated is neither safe
    nor unsafe; just below the share, it gives the state `NOT_SIMULATED`.
    """
    number = len(starts)
    rows, lowest = np.arange(number), np.broadcast_to(lowest, number)
    low, high, low_is_valid = lowest, np.ones(number), np.ones(number, dtype=bool)
    for parts in (LINE_SETTINGS, *(PARTS_PER_ROUND,) * ROUNDS):
        shares = low[:, np.newaxis] + (high - low)[:, np.newaxis] * np.arange(1, parts + 1) / parts
        shares[:, -1] = high  # without a rounding error; known to be unsafe
        inner = settings_on_lines(starts, ends, shares[:, :-1])
        evaluations = evaluator.evaluate(inner.reshape(-1, starts.shape[1]), stage)
        is_unsafe, is_valid = (
            np.column_stack([flags.reshape(number, parts - 1), np.ones(number, dtype=bool)])
            for flags in (unsafe.of(evaluations), evaluations.valid)
        )
        first_unsafe = np.argmax(is_unsafe, axis=1)
        below = rows, np.maximum(first_unsafe - 1, 0)
        low_is_valid = np.where(first_unsafe > 0, is_valid[below], low_is_valid)
        low, high = np.where(first_unsafe > 0, shares[below], low), shares[rows, first_unsafe]
    states = np.where(low_is_valid, BoundaryState.SAFE, BoundaryState.NOT_SIMULATED)
    states = np.where((low == lowest) & (lowest > 0), BoundaryState.FILTER, states)
    return high, [BoundaryState(state) for state in states]
