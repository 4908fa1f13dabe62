"""Finds rules in physical units that say where a study is unsafe, from random vehicles, and validates them on others.

A classification tree (CART, by scikit-learn) cuts the domain into boxes. The tree is pruned to the smallest tree whose
score in cross-validation is within a standard error of the best score. Its boxes with more unsafe than safe settings
become rules. A rule then loses the conditions that do not make it denser.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
from rich.table import Table

from safevar_sumo.analysis.case import Case
from safevar_sumo.analysis.evaluator import CONFIDENCE, Evaluator, Interval, clopper_pearson
from safevar_sumo.analysis.figures import BLUE, FONT_SIZE, VERMILION, escape_dollars, new_figure
from safevar_sumo.analysis.rules import RulesOptions
from safevar_sumo.analysis.words import join_phrases, number_of
from safevar_sumo.errors import SimulationError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.records import BoolArray, FloatArray, JsonObject
from safevar_sumo.study import Study
from safevar_sumo.sumo.empty_road import summary_entry
from safevar_sumo.terminal import Answer, constraints_in_words, meanings
from safevar_sumo.vehicles import CharacteristicSet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MIN_SETTINGS = 10
"""Minimum number of unsafe settings, and of safe settings, that rules need."""
FOLDS = 5
"""Number of folds of the cross-validation."""
MAX_DEPTH = 6
"""Maximum depth of the tree."""
MAX_PRUNINGS = 24
"""Maximum number of prunings compared."""
MIN_ADDED_SHARE = 0.01
"""Share of the unsafe settings that a rule must cover in addition to the rules before it."""
RULES_NOTE = (
    "Shares of vehicles that did not form the rules. In a rule all characteristics vary together over the whole "
    "domain; how far one may go while all others stay as in the original says `tolerance`."
)
"""What the shares of rules are shares of."""
LIMIT_DIGITS = 3
"""Limits are rounded to this many digits of the domain's width."""
UNLIMITED = np.array([[-np.inf], [np.inf]])
"""Ends of a characteristic without limits; a box has the lower ends in row 0 and the upper ends in row 1."""


class Rule(NamedTuple):
    """A box of settings, and how dense unsafe settings are in it.

    Attributes
    ----------
    limits
        Lower and upper limit by name; None if there is no such limit.
    density, coverage
        Unsafe share of the validation settings inside the box, and the share of all unsafe ones that lie inside the
        box; None if there are no such settings.
    density_interval, coverage_interval
        The 95 % intervals of these shares.
    """

    limits: Mapping[str, tuple[float | None, float | None]]
    density: float | None
    coverage: float | None
    density_interval: Interval | None
    coverage_interval: Interval | None

    def is_denser_than(self, share: float) -> bool:
        """Whether the density is significantly above a share; always true of a rule without limits."""
        return not self.limits or (self.density_interval is not None and self.density_interval[0] > share)

    def conditions(self, characteristics: CharacteristicSet) -> list[str]:
        """The limits in words, such as `mass above 2500 kg`; `everywhere` without any."""
        conditions = []
        for item in characteristics:
            low, high = self.limits.get(item.name, (None, None))
            if low is not None and high is not None:
                conditions.append(f"{item.name} from {low:g} to {high:g}{item.suffix}")
            elif low is not None:
                conditions.append(f"{item.name} above {low:g}{item.suffix}")
            elif high is not None:
                conditions.append(f"{item.name} below {high:g}{item.suffix}")
        return conditions or ["everywhere"]

    def in_words(self, characteristics: CharacteristicSet, unsafe: Unsafe) -> str:
        """The rule and its shares: `mass above 2500 kg, the others anywhere: collides in 92 % (..), covers 61 %`."""
        others = ", the others anywhere" if 0 < len(self.limits) < len(characteristics) else ""
        density, coverage = (
            f"{100 * (share or 0.0):.0f} % ({100 * ends[0]:.0f} % to {100 * ends[1]:.0f} %)" if ends else "-"
            for share, ends in ((self.density, self.density_interval), (self.coverage, self.coverage_interval))
        )
        conditions = join_phrases(self.conditions(characteristics))
        return f"{conditions}{others}: {unsafe.in_words} in {density}, covers {coverage}"

    def to_dict(self) -> JsonObject:
        """An entry for a rule in `rules --json`."""
        shares = self._asdict()
        limits = shares.pop("limits")
        conditions = [
            {"characteristic": name, "at_least": low, "at_most": high} for name, (low, high) in limits.items()
        ]
        return {"conditions": conditions, **shares}


@dataclass(frozen=True, kw_only=True, repr=False)
class Rules(Answer):
    """Rules of a study, ordered by coverage.

    Attributes
    ----------
    samples
        Number of settings that could be simulated.
    unsafe_share, unsafe_interval
        Share of these settings that is unsafe, and its 95 % interval.
    remark
        Why there can be no rule; may be empty.
    no_verdict
        Why simulations tell nothing about the driving system; "" if they do.
    """

    study: Study
    unsafe: Unsafe
    rules: list[Rule]
    samples: int
    unsafe_share: float
    unsafe_interval: Interval
    remark: str = ""
    no_verdict: str = ""

    def to_dict(self) -> list[JsonObject]:
        """The JSON of `rules`: an entry for each rule, and a summary if no verdict on the ADS is possible."""
        return [*(rule.to_dict() for rule in self.rules), *summary_entry(self.no_verdict)]

    def to_frame(self) -> pd.DataFrame:
        """One row for each condition of each rule; a rule without conditions, which holds everywhere, has one row.

        Columns: `rule`, counted from 0, `characteristic`, `at_least`, `at_most` [unit], `density`, `coverage`
        [fraction].
        """
        return pd.DataFrame(
            [
                (number, name, low, high, rule.density, rule.coverage)
                for number, rule in enumerate(self.rules)
                for name, (low, high) in rule.limits.items() or [(None, (None, None))]
            ],
            columns=["rule", "characteristic", "at_least", "at_most", "density", "coverage"],
        )

    def figure(self) -> Figure:
        """The density and coverage of each rule, with their 95 % intervals."""
        title, size = f"{self.study.name}: rules (unsafe: {self.unsafe})", (7.2, 1.1 + 0.5 * len(self.rules))
        figure, ((axis,),) = new_figure(title, 1, 1, size)
        places, characteristics = -np.arange(len(self.rules)), CharacteristicSet.of(self.study)
        for kind, colour in (("density", VERMILION), ("coverage", BLUE)):
            shares = np.array([getattr(rule, kind) for rule in self.rules], dtype=float)
            ends = [getattr(rule, f"{kind}_interval") or (math.nan, math.nan) for rule in self.rules]
            axis.hlines(places, *np.reshape(ends, (-1, 2)).T, color=colour, linewidth=1.5)
            axis.plot(shares, places, "o", color=colour, label=kind)
        texts = ["\n".join(rule.conditions(characteristics)) for rule in self.rules]
        axis.set_yticks(places, list(map(escape_dollars, texts)), fontsize=FONT_SIZE - 1)
        axis.set_xlim(-0.02, 1.02)
        axis.set_ylim(0.5 - max(len(places), 1), 0.5)
        axis.set_xlabel("unsafe share within a rule (density), share of all unsafe within it (coverage)")
        axis.legend(fontsize=FONT_SIZE)
        return figure

    def sentences(self) -> Iterator[str | Table]:
        """Every rule with its density and coverage."""
        characteristics, (low, high) = CharacteristicSet.of(self.study), self.unsafe_interval
        yield (
            f"Unsafe: {self.unsafe.description}; {100 * self.unsafe_share:.2f} % of {self.samples} vehicles drawn "
            f"evenly over the whole domain ({100 * low:.2f} % to {100 * high:.2f} %)."
        )
        yield from constraints_in_words(self.study)
        if self.remark:
            yield f"No rule: {self.remark}."
        elif not self.rules:
            yield "Nothing unsafe found."
        dense = [rule for rule in self.rules if rule.is_denser_than(self.unsafe_share)]
        yield from (f"- {rule.in_words(characteristics, self.unsafe)}" for rule in dense)
        if len(dense) < len(self.rules):
            omitted = number_of(len(self.rules) - len(dense), "rule")
            yield f"Left out: {omitted} that may be due to chance; more samples decide."
        if self.rules:
            named = {name for rule in dense for name in rule.limits}
            yield meanings(item for item in characteristics if item.name in named)
            yield f"{RULES_NOTE} In brackets: {100 * CONFIDENCE:.0f} % intervals."


def find_rules(source: Study | Case, options: RulesOptions, evaluator: Evaluator) -> Rules:
    """Find rules that say where a study is unsafe, from random settings of the whole domain.

    Raises
    ------
    InputError
        If `unsafe` cannot be used.
    SimulationError
        If no setting can be simulated.
    """
    characteristics, unsafe = evaluator.characteristics, evaluator.choose_criterion(options.unsafe, source)
    evaluations = evaluator.evaluate(evaluator.random_settings(options.samples), "settings over the whole domain")
    rows = np.arange(len(evaluations))
    training, validation = (
        evaluations.take(half[evaluations.valid[half]]) for half in np.split(rows, [len(rows) // 2])
    )
    is_unsafe, is_unsafe_validation = unsafe.of(training), unsafe.of(validation)
    unsafe_count, samples = int(np.count_nonzero(is_unsafe)), len(training) + len(validation)
    if not samples:
        raise SimulationError(f"study {evaluator.study.name!r}: none of {len(rows)} vehicles could be simulated")
    remark, boxes = "", list[FloatArray]()
    if unsafe_count == len(training) > 0:
        boxes = [np.repeat(UNLIMITED, len(characteristics), axis=1)]
    elif min(unsafe_count, len(training) - unsafe_count) < MIN_SETTINGS:
        remark = (
            f"{unsafe_count} of {len(training)} settings are unsafe: rules need at least {MIN_SETTINGS} unsafe and as "
            "many safe settings (the command rules --samples N simulates more)"
        )
    else:
        boxes = _find_boxes(training.settings, is_unsafe, characteristics)
    rules = [_validate_rule(box, validation.settings, is_unsafe_validation, characteristics.names) for box in boxes]
    all_unsafe = unsafe_count + int(np.count_nonzero(is_unsafe_validation))
    return Rules(
        study=evaluator.study,
        unsafe=unsafe,
        rules=sorted(rules, key=lambda rule: -(rule.coverage or 0.0)),
        remark=remark,
        no_verdict=evaluator.no_verdict,
        samples=samples,
        unsafe_share=all_unsafe / samples,
        unsafe_interval=clopper_pearson(all_unsafe, samples),
    )


def _find_boxes(settings: FloatArray, is_unsafe: BoolArray, characteristics: CharacteristicSet) -> list[FloatArray]:
    """The boxes that become rules, ordered by coverage; a box that adds few unsafe settings to those before it is
    dropped.
    """
    lower, width = characteristics.lower, characteristics.upper - characteristics.lower
    tree = _fit_pruned_tree((settings - lower) / width, is_unsafe).tree_
    leaves = list(_boxes_of_leaves(tree, 0, np.repeat(UNLIMITED, len(width), axis=1), lower, width))
    dense_boxes = [box for box, density in leaves if density > 0.5]
    if not dense_boxes:
        densest, _ = max(leaves, key=lambda leaf: leaf[1])
        dense_boxes = [densest]
    digits = [LIMIT_DIGITS - 1 - math.floor(math.log10(its_width)) for its_width in width]
    rounded = [np.array([list(map(round, ends, digits)) for ends in box.tolist()]) for box in dense_boxes]
    boxes = [_drop_useless_conditions(box, settings, is_unsafe) for box in rounded]
    chosen, is_uncovered = list[FloatArray](), is_unsafe.copy()
    for box in sorted(boxes, key=lambda box: -np.count_nonzero(is_unsafe & is_within(box, settings))):
        is_inside = is_within(box, settings)
        if not chosen or np.count_nonzero(is_uncovered & is_inside) >= MIN_ADDED_SHARE * np.count_nonzero(is_unsafe):
            chosen.append(box)
            is_uncovered &= ~is_inside
    return chosen


def _fit_pruned_tree(inputs: FloatArray, is_unsafe: BoolArray) -> Any:
    """The smallest tree whose cross-validated Brier score is within a standard error of the best score."""
    from sklearn.model_selection import GridSearchCV, StratifiedKFold  # takes a second to load
    from sklearn.tree import DecisionTreeClassifier

    def smallest_good_enough(results: Any) -> int:
        """The index of the strongest pruning whose score is within a standard error of the best."""
        means = results["mean_test_score"]
        best = np.argmax(means)
        least = means[best] - results["std_test_score"][best] / math.sqrt(FOLDS - 1)
        return int(np.flatnonzero(means >= least)[-1])

    tree = DecisionTreeClassifier(max_depth=MAX_DEPTH, min_samples_leaf=MIN_SETTINGS // 2, random_state=0)
    strengths = np.unique(np.maximum(tree.cost_complexity_pruning_path(inputs, is_unsafe).ccp_alphas, 0.0))
    strengths = strengths[:-1]  # the strongest pruning leaves no condition
    evenly_spaced = np.unique(np.linspace(0, len(strengths) - 1, MAX_PRUNINGS).round().astype(int))
    prunings = {"ccp_alpha": strengths[evenly_spaced] if len(strengths) else np.zeros(1)}
    folds = StratifiedKFold(FOLDS, shuffle=True, random_state=0)
    search = GridSearchCV(tree, prunings, scoring="neg_brier_score", cv=folds, refit=smallest_good_enough)
    return search.fit(inputs, is_unsafe).best_estimator_


def _boxes_of_leaves(
    tree: Any, node: int, box: FloatArray, lower: FloatArray, width: FloatArray
) -> Iterator[tuple[FloatArray, float]]:
    """The boxes of a tree's leaves below a node, whose own box is `box`, each with its share of unsafe settings."""
    if tree.children_left[node] < 0:  # a leaf
        counts = tree.value[node][0]
        yield box, float(counts[-1] / counts.sum())
        return
    column = int(tree.feature[node])
    # The threshold is the lower end of the right child, and the upper end of the left one.
    for end, children in enumerate((tree.children_right, tree.children_left)):
        part = box.copy()
        part[end, column] = lower[column] + tree.threshold[node] * width[column]
        yield from _boxes_of_leaves(tree, int(children[node]), part, lower, width)


def _drop_useless_conditions(box: FloatArray, settings: FloatArray, is_unsafe: BoolArray) -> FloatArray:
    """Drop conditions while the lower bound of the density does not fall."""

    def least_density(box: FloatArray) -> float:
        is_inside = is_within(box, settings)
        count = int(np.count_nonzero(is_inside))
        return clopper_pearson(int(np.count_nonzero(is_unsafe & is_inside)), count)[0] if count else 0.0

    while np.isfinite(box).any():
        columns = np.flatnonzero(np.isfinite(box).any(axis=0))
        wider = [np.where(np.arange(box.shape[1]) == column, UNLIMITED, box) for column in columns]
        best = max(wider, key=least_density)
        if least_density(best) < least_density(box):
            break
        box = best
    return box


def is_within(box: FloatArray, settings: FloatArray) -> BoolArray:
    """Whether each of M settings lies within a box; shape (M,)."""
    return np.asarray(((settings >= box[0]) & (settings <= box[1])).all(axis=1))


def _validate_rule(box: FloatArray, settings: FloatArray, is_unsafe: BoolArray, names: Sequence[str]) -> Rule:
    """The rule of a box, with its density and coverage among validation settings."""
    is_inside = is_within(box, settings)
    limits = {
        name: (None if low == -np.inf else low, None if high == np.inf else high)
        for name, low, high in zip(names, *box.tolist(), strict=True)
        if np.isfinite([low, high]).any()
    }
    count = int(np.count_nonzero(is_inside & is_unsafe))
    density, density_interval = _share(count, int(np.count_nonzero(is_inside)))
    coverage, coverage_interval = _share(count, int(np.count_nonzero(is_unsafe)))
    return Rule(limits, density, coverage, density_interval, coverage_interval)


def _share(count: int, total: int) -> tuple[float, Interval] | tuple[None, None]:
    """The share `count` / `total` with its 95 % interval; twice None if `total` is 0."""
    return (count / total, clopper_pearson(count, total)) if total else (None, None)
