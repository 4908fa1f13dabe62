"""Rules that tell where it is unsafe, in physical units, from an unbiased design and judged on another one.

A classification tree (CART, by scikit-learn) cuts the domain into boxes. It is pruned to the smallest one that
cross-validation does not tell from the best, its boxes that are more often unsafe than not become rules, and conditions
that a rule does as well without are dropped.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from safevar_sumo.analysis.criterion import Unsafe, spread, usual_in
from safevar_sumo.analysis.evaluator import Bench, Progress, open_bench, silent
from safevar_sumo.analysis.risk.compute import interval_of
from safevar_sumo.analysis.rules.options import RulesOptions
from safevar_sumo.records import BoolArray, Evaluations, FloatArray
from safevar_sumo.study import Study
from safevar_sumo.vehicles import CharacteristicSet
from safevar_sumo.workers.evaluation import Pool

CONFIDENCE = 0.95
"""Of the intervals of a rule's shares."""
FEWEST = 10
"""Unsafe and safe settings that rules can be made from."""
FOLDS, DEEPEST, PRUNINGS = 5, 6, 24
"""Of the cross-validation; conditions of a rule before any is dropped; sizes of trees that are compared."""
LEAST_ADDED = 0.01
"""Share of the unsafe settings that a rule must cover and those before it do not."""
DIGITS = 3
"""Digits of a width to which limits are rounded."""
Limits = dict[int, tuple[float | None, float | None]]
"""By column: at least, at most; None where open."""


@dataclass(frozen=True)
class Rule:
    """Settings within `limits` (by characteristic: at least, at most; None where open) are unsafe with some density.

    Attributes
    ----------
    inside, unsafe_inside, unsafe_everywhere
        How many settings of those that the rule was not made from lie inside, how many of these are unsafe, and how many
        are unsafe at all.
    """

    limits: Mapping[str, tuple[float | None, float | None]]
    inside: int
    unsafe_inside: int
    unsafe_everywhere: int
    confidence: float

    @property
    def density(self) -> float | None:
        """Share of the settings inside that are unsafe; None if there are none."""
        return self.unsafe_inside / self.inside if self.inside else None

    @property
    def coverage(self) -> float | None:
        """Share of the unsafe settings that lie inside; None if there are none."""
        return self.unsafe_inside / self.unsafe_everywhere if self.unsafe_everywhere else None

    @property
    def density_interval(self) -> tuple[float, float] | None:
        return interval_of(self.unsafe_inside, self.inside, self.confidence) if self.inside else None

    @property
    def coverage_interval(self) -> tuple[float, float] | None:
        return interval_of(self.unsafe_inside, self.unsafe_everywhere, self.confidence) if self.unsafe_everywhere else None

    def tells_more_than(self, share: float) -> bool:
        """Whether what lies inside is surely unsafe more often than that share of all; what has no limits tells of all."""
        return not self.limits or (self.density_interval is not None and self.density_interval[0] > share)

    def record(self) -> dict[str, Any]:
        """As `rules --json` prints it."""
        return {
            "conditions": [{"characteristic": name, "at_least": low, "at_most": high} for name, (low, high) in self.limits.items()],
            "density": self.density, "coverage": self.coverage,
            "density_interval": None if self.density_interval is None else list(self.density_interval),
            "coverage_interval": None if self.coverage_interval is None else list(self.coverage_interval)}


@dataclass(frozen=True, kw_only=True)
class Rules:
    """Rules of a study, the one that covers most first; `samples` settings were looked at, `unsafe_share` of them unsafe."""

    study: Study
    unsafe: Unsafe
    rules: list[Rule]
    samples: int
    unsafe_share: float
    remark: str = ""

    def records(self) -> list[dict[str, Any]]:
        """As `rules --json` prints them."""
        return [rule.record() for rule in self.rules]

    def __repr__(self) -> str:
        share = f"{self.unsafe_share:.2%} of {self.samples}"
        return f"<Rules of {self.study.name}, unsafe {self.unsafe}: {share} settings, {len(self.rules)} rules>"


def find_rules(study: Study, *, samples: int = RulesOptions.samples, unsafe: str | None = None, pool: Pool | None = None,
          jobs: int | None = None, progress: Progress = silent) -> Rules:
    """Find rules that tell where a study is unsafe, from settings spread evenly over the whole domain.

    Parameters
    ----------
    samples
        Settings: half of them make the rules, the other half judges them.
    unsafe, pool, jobs, progress
        As in `safevar_sumo.analysis.tolerance.compute`.

    Raises
    ------
    InputError
        As in `safevar_sumo.analysis.tolerance.compute`.
    """
    RulesOptions(samples=samples, unsafe=unsafe)
    means, members = Unsafe.given(unsafe), CharacteristicSet.of(study.vehicle.characteristics)
    with open_bench(study, pool, jobs, progress) as bench:
        means = means or usual_in(bench, bench.original())
        first, second = (_design(bench, samples // 2, study.search.seed + half) for half in (1, 2))
    made, judged = means.of(first), means.of(second)
    fewer = min(np.count_nonzero(made), np.count_nonzero(~made))
    remark, found = "", list[Limits]()
    if made.all() and made.size:
        found = [{}]
    elif fewer < FEWEST:
        remark = (f"{np.count_nonzero(made)} of {len(made)} settings are unsafe: rules need at least {FEWEST} unsafe and as many safe ones "
                  "(--samples looks at more)")
    else:
        found = _boxes(first.settings, made, members)
    named = [_judged(limits, second.settings, judged, members) for limits in found]
    both = np.concatenate([made, judged])
    return Rules(study=study, unsafe=means, rules=sorted(named, key=lambda rule: -rule.unsafe_inside), samples=len(both),
                 unsafe_share=float(np.mean(both)), remark=remark)


def _design(bench: Bench, number: int, seed: int) -> Evaluations:
    """Evaluated settings over the whole domain, those that could not be simulated left out."""
    evaluations = bench.evaluate(spread(bench.characteristics, number, seed), "settings over the whole domain")
    return evaluations.take(evaluations.valid)


def _boxes(settings: FloatArray, unsafe: BoolArray, members: CharacteristicSet) -> list[Limits]:
    """The boxes that become rules, each once."""
    tree = _pruned_tree((settings - members.lower) / (members.upper - members.lower), unsafe)
    leaves = [(_rounded(limits, members), density) for limits, density in _leaves(tree, members)]
    chosen = [limits for limits, density in leaves if density > 0.5] or [max(leaves, key=lambda leaf: leaf[1])[0]]
    simple = [_without_idle_conditions(limits, settings, unsafe) for limits in chosen]
    return _that_add_something(simple, settings, unsafe)


def _pruned_tree(shares: FloatArray, unsafe: BoolArray) -> Any:
    """The smallest tree whose cross-validated Brier score is within a standard error of the best one's."""
    from sklearn.model_selection import StratifiedKFold, cross_val_score  # takes a second to load
    from sklearn.tree import DecisionTreeClassifier

    def tree(pruning: float) -> Any:
        return DecisionTreeClassifier(max_depth=DEEPEST, min_samples_leaf=FEWEST // 2, ccp_alpha=pruning, random_state=0)

    path = np.unique(np.maximum(tree(0.0).cost_complexity_pruning_path(shares, unsafe).ccp_alphas, 0.0))[:-1]
    prunings = path[np.unique(np.linspace(0, len(path) - 1, PRUNINGS).round().astype(int))] if len(path) else np.zeros(1)
    folds = StratifiedKFold(FOLDS, shuffle=True, random_state=0)
    scores = np.array([cross_val_score(tree(pruning), shares, unsafe, cv=folds, scoring="neg_brier_score") for pruning in prunings])
    means, errors = scores.mean(axis=1), scores.std(axis=1, ddof=1) / math.sqrt(FOLDS)
    best = int(np.argmax(means))
    return tree(prunings[np.flatnonzero(means >= means[best] - errors[best])[-1]]).fit(shares, unsafe)


def _leaves(tree: Any, members: CharacteristicSet) -> list[tuple[Limits, float]]:
    """The boxes of a tree, and the density of the unsafe in each."""
    inner, found = tree.tree_, []
    places: list[tuple[int, Limits]] = [(0, {})]
    while places:
        node, limits = places.pop()
        if inner.children_left[node] < 0:
            counts = inner.value[node][0]
            found.append((limits, float(counts[-1] / counts.sum())))
            continue
        column = int(inner.feature[node])
        cut = float(members.lower[column] + inner.threshold[node] * (members.upper - members.lower)[column])
        low, high = limits.get(column, (None, None))
        places.append((int(inner.children_left[node]), {**limits, column: (low, cut)}))
        places.append((int(inner.children_right[node]), {**limits, column: (cut, high)}))
    return found


def _rounded(limits: Limits, members: CharacteristicSet) -> Limits:
    """Limits as one tells them, in the order of the characteristics."""
    def told(value: float | None, width: float) -> float | None:
        return None if value is None else round(value, DIGITS - 1 - math.floor(math.log10(width)))

    widths = members.upper - members.lower
    return {column: (told(limits[column][0], widths[column]), told(limits[column][1], widths[column])) for column in sorted(limits)}


def _without_idle_conditions(limits: Limits, settings: FloatArray, unsafe: BoolArray) -> Limits:
    """Drop conditions as long as the density that one can be sure of does not get less."""
    def sure_of(some: Limits) -> float:
        inside = within(some, settings)
        count = int(np.count_nonzero(inside))
        return interval_of(int(np.count_nonzero(unsafe & inside)), count, CONFIDENCE)[0] if count else 0.0

    while limits:
        shorter = [{column: ends for column, ends in limits.items() if column != dropped} for dropped in limits]
        best = max(shorter, key=sure_of)
        if sure_of(best) < sure_of(limits):
            break
        limits = best
    return limits


def _that_add_something(boxes: list[Limits], settings: FloatArray, unsafe: BoolArray) -> list[Limits]:
    """The boxes that cover unsafe settings which those that cover more do not; at least the first."""
    kept: list[Limits] = []
    left = unsafe.copy()
    for limits in sorted(boxes, key=lambda one: -np.count_nonzero(unsafe & within(one, settings))):
        inside = within(limits, settings)
        if not kept or np.count_nonzero(left & inside) >= LEAST_ADDED * np.count_nonzero(unsafe):
            kept.append(limits)
            left &= ~inside
    return kept


def within(limits: Limits, settings: FloatArray) -> BoolArray:
    """Which settings lie within limits; shape (M,)."""
    inside = np.ones(len(settings), dtype=bool)
    for column, (low, high) in limits.items():
        inside &= (settings[:, column] >= (-np.inf if low is None else low)) & (settings[:, column] <= (np.inf if high is None else high))
    return inside


def _judged(limits: Limits, settings: FloatArray, unsafe: BoolArray, members: CharacteristicSet) -> Rule:
    """A rule with what it is worth on settings that it was not made from."""
    inside = within(limits, settings)
    within_it, unsafe_in_it, unsafe_at_all = (int(np.count_nonzero(one)) for one in (inside, inside & unsafe, unsafe))
    named = {members.names[column]: ends for column, ends in limits.items()}
    return Rule(named, within_it, unsafe_in_it, unsafe_at_all, CONFIDENCE)
