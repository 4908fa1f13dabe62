"""The question `rules`: in which regions of the domain do failures lie, in physical units?

A classification tree (CART, by scikit-learn) cuts the domain into boxes. The tree is pruned to the
smallest tree whose score in cross-validation is within a standard error of the best score. Its
boxes with more unsafe than safe settings become rules. A rule then loses the conditions that do not
make it denser. Other vehicles test the rules.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd

from safevar_sumo.metrics.unsafe import SHARE_DECIMALS
from safevar_sumo.questions.answer import (
    Answer,
    contents,
    tabulate,
)
from safevar_sumo.questions.ask import Criterion, question
from safevar_sumo.questions.budget import LEAST_SETTINGS
from safevar_sumo.questions.case import Subject
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.options import Count
from safevar_sumo.questions.over_sets import (
    BY_SET,
    INTERVALS,
    SharesOverSets,
    moving_in_words,
    planned_over_sets,
    simulate_sample,
)
from safevar_sumo.questions.rules import words
from safevar_sumo.questions.sampling import clopper_pearson, share_with_interval
from safevar_sumo.questions.sentence import Sentences, Verdict
from safevar_sumo.questions.tables import shipped_columns
from safevar_sumo.questions.variation import VariationModel, sampled_in_words
from safevar_sumo.questions.words import (
    constraints_in_words,
    count_in_words,
    counted_in_words,
    interval_in_words,
    join_phrases,
    notes_on,
    percentage,
)
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.vehicles import CharacteristicSet

SAMPLED_STAGE = "vehicles sampled over the whole domain"
"""The phase of progress in which the sampled vehicles are simulated."""
MIN_SETTINGS = 10
"""Minimum number of unsafe settings, and of safe settings, that rules need."""
FOLDS = 5
"""Number of folds of the cross-validation."""
MAX_DEPTH = 6
"""Maximum depth of the tree."""
MAX_PRUNINGS = 24
"""Maximum number of prunings of the tree that are compared."""
MIN_ADDED_SHARE = 0.01
"""Share of the unsafe settings that a rule must cover in addition to the rules before it."""
LIMIT_DIGITS = 3
"""A limit is rounded so that the width of the domain would have this number of digits."""
UNLIMITED = np.array([[-np.inf], [np.inf]])
"""The column of a characteristic without limits in a box. A box, shape (2, n), has the lower ends
in row 0 and the upper ends in row 1.
"""
(COLUMNS,) = shipped_columns("rules").values()


@question
@contents(
    "unsafe",
    "samples",
    "failures",
    "share",
    "interval",
    BY_SET,
    INTERVALS,
    lead="rules",
    next="explain",
    rules=COLUMNS,
)
def rules(
    subject: Subject,
    evaluator: Evaluator,
    *,
    samples: Count = 16_384,
    unsafe: Criterion = None,
) -> Answer:
    """Find regions of the domain (ranges of values) in which many vehicles are unsafe. Each region
    is a rule in physical units, such as "tyre friction below 1.07", with the share of unsafe
    vehicles in it. All characteristics vary at the same time.

    Example: python -m safevar_sumo rules rain

    Parameters
    ----------
    samples
        Number of sampled vehicles (drawn at random and simulated). One half finds the rules, the
        other half tests these rules.
    unsafe
        What counts as unsafe: a collision, less than X m of clearance, or a metric beyond a limit.
        Default: the criterion of the study, else a collision (if nothing collides: half of the
        original vehicle's safety degree).
    """
    study = evaluator.study
    characteristics = evaluator.characteristics
    evaluator.begin(
        planned_over_sets(study, SAMPLED_STAGE, samples), minimum=LEAST_SETTINGS
    )

    # One half of the vehicles yields the rules, the other half tests them.
    criterion = evaluator.choose_criterion(unsafe, subject)
    samples = evaluator.of_stage(samples)
    model = VariationModel(study)
    evaluations = simulate_sample(evaluator, model, samples, SAMPLED_STAGE)
    vehicles = evaluations.settings
    is_first_half = np.arange(len(evaluations)) < len(evaluations) // 2
    training = evaluations.take(evaluations.valid & is_first_half)
    testing = evaluations.take(evaluations.valid & ~is_first_half)
    of_runs = criterion.runs(training)
    unsafe_in_test = criterion.runs(testing).mean(axis=0)
    total = len(training) + len(testing)
    failures = criterion.number(evaluations.take(evaluations.valid))

    # Rules are boxes in which unsafe vehicles are dense. If a simulation has repeats, the tree
    # learns from each run as from a vehicle.
    trained = np.tile(training.settings, (len(of_runs), 1))
    boxes = _boxes(trained, of_runs.ravel(), characteristics)
    groups = [is_within(box, vehicles) & ~is_first_half for box in boxes]
    over_sets = SharesOverSets.of(evaluator, criterion, vehicles, groups)
    rows = []
    for number, box in enumerate(boxes, 1):
        own_shares = shares(box, testing.settings, unsafe_in_test)
        ends = over_sets.ends(number, own_shares[:3])
        rows.append((conditions(box, characteristics), *own_shares, *ends))
    frame = pd.DataFrame(rows, columns=list(COLUMNS))
    frame = frame.sort_values("coverage", ascending=False, kind="stable")
    title = "Regions in which many vehicles are unsafe"
    table = tabulate(title, COLUMNS, frame.reset_index(drop=True))

    share = failures / total
    low, high = clopper_pearson(failures, total)
    numbers = {
        "unsafe": str(criterion),
        "samples": total,
        "failures": failures,
        "share": share,
        "interval": [low, high],
        **over_sets.numbers(share),
    }
    counted = counted_in_words(study, int(evaluations.infeasible.sum()))
    sentences = [
        words.SHARE(
            count=count_in_words(failures, total),
            sampled=sampled_in_words(study),
            collide=criterion.verbs[failures > 1],
            share=percentage(share),
            interval=interval_in_words(low, high),
        ),
        *moving_in_words(evaluations),
        *over_sets.sentences(),
        *notes_on(criterion, *counted, *constraints_in_words(study)),
    ]
    denser = frame[frame["density_low"] > share]
    if not boxes:
        sentences.append(
            words.TOO_FEW(
                unsafe=of_runs.sum(),
                safe=(~of_runs).sum(),
                least=MIN_SETTINGS,
            )
        )
    elif denser.empty:
        sentences.append(words.NO_REGION)
    else:
        box = boxes[denser.index[0]]
        region = conditions(box, characteristics, "short_name")
        if unsafe_in_test.any():
            outside = _share_outside(boxes, testing.settings, unsafe_in_test)
            regions = "the region"
            if len(boxes) > 1:
                regions = f"the {len(boxes)} regions"
            sentences.append(words.OUTSIDE(outside=100 * outside, regions=regions))
        sentences += _region_in_words(denser.iloc[0], region)
    return Answer(
        question="rules",
        study=study,
        verdict=Verdict(sentences),
        numbers=numbers,
        tables={"rules": table},
    )


def _region_in_words(rule: pd.Series[Any], region: str) -> Sentences:
    """Yield the sentences about the region of a rule (a row of the table): the region, the share of
    unsafe vehicles in it, and the share of all unsafe vehicles that it holds.
    """
    shares = 100 * rule[1:]
    is_wider = rule["density_least"] < rule["density_greatest"]
    yield words.REGION(region=region)
    density = words.DENSITY_OVER_SETS if is_wider else words.DENSITY
    yield density(**shares)
    yield words.COVERAGE(**shares)


def _share_outside(
    boxes: Sequence[FloatArray], settings: FloatArray, unsafe: FloatArray
) -> float:
    """The share of all unsafe settings that lie in none of the boxes. `unsafe` is the unsafe share
    of each setting's runs, shape (M,).
    """
    is_inside = np.any([is_within(box, settings) for box in boxes], axis=0)
    return float(unsafe[~is_inside].sum() / unsafe.sum())


def conditions(
    box: FloatArray, characteristics: CharacteristicSet, attribute: str = "name"
) -> str:
    """The limits of a box in words, such as `mass above 2500 kg`; `everywhere` without limits.
    `attribute` is the characteristics' attribute that names them.
    """
    texts = []
    for item, low, high in zip(characteristics, *box.tolist(), strict=True):
        name = getattr(item, attribute)
        has_low = low > -np.inf
        if has_low and high < np.inf:
            texts.append(f"{name} from {low:g} to {high:g}{item.suffix}")
        elif has_low:
            texts.append(f"{name} above {low:g}{item.suffix}")
        elif high < np.inf:
            texts.append(f"{name} below {high:g}{item.suffix}")
    return join_phrases(texts) or "everywhere"


def shares(
    box: FloatArray, settings: FloatArray, unsafe: FloatArray | BoolArray
) -> list[float]:
    """Two shares, each followed by the ends of its interval: the share of unsafe settings among
    those in a box, and the share of all unsafe settings that lie in the box. `unsafe` is the unsafe
    share of each setting's runs, shape (M,).
    """
    is_inside = is_within(box, settings)
    count = round(float(unsafe[is_inside].sum()), SHARE_DECIMALS)
    total = round(float(unsafe.sum()), SHARE_DECIMALS)
    density = share_with_interval(count, int(is_inside.sum()))
    return density + share_with_interval(count, total)


def _boxes(
    settings: FloatArray, is_unsafe: BoolArray, characteristics: CharacteristicSet
) -> list[FloatArray]:
    """The boxes that become rules, ordered by the number of unsafe settings in them. A box that
    adds few unsafe settings to the boxes before it is dropped.

    The whole domain is the only box if all settings are unsafe. There is no box if there are fewer
    than `MIN_SETTINGS` safe or unsafe settings.
    """
    domain = np.repeat(UNLIMITED, len(characteristics), axis=1)
    if is_unsafe.all() and len(settings):
        return [domain]
    if min(is_unsafe.sum(), (~is_unsafe).sum()) < MIN_SETTINGS:
        return []

    # Take the leaves of the tree in which more than half of the settings are unsafe or, without
    # such a leaf, the densest leaf.
    lower = characteristics.lower
    width = characteristics.upper - characteristics.lower
    tree = _fit_pruned_tree((settings - lower) / width, is_unsafe).tree_
    leaves = list(_boxes_of_leaves(tree, 0, domain, lower, width))
    densest, _ = max(leaves, key=lambda leaf: leaf[1])
    dense_boxes = [box for box, density in leaves if density > 0.5] or [densest]

    digits = LIMIT_DIGITS - 1 - np.floor(np.log10(width)).astype(int)
    boxes = []
    for box in dense_boxes:
        rounded = [list(map(round, ends, digits.tolist())) for ends in box.tolist()]
        boxes.append(_drop_useless_conditions(np.array(rounded), settings, is_unsafe))
    boxes.sort(key=lambda box: -np.count_nonzero(is_unsafe & is_within(box, settings)))

    chosen = list[FloatArray]()
    is_uncovered = is_unsafe.copy()
    least_added = MIN_ADDED_SHARE * np.count_nonzero(is_unsafe)
    for box in boxes:
        is_inside = is_within(box, settings)
        if not chosen or np.count_nonzero(is_uncovered & is_inside) >= least_added:
            chosen.append(box)
            is_uncovered &= ~is_inside
    return chosen


def _fit_pruned_tree(inputs: FloatArray, is_unsafe: BoolArray) -> Any:
    """The smallest classification tree whose cross-validated Brier score is within a standard error
    of the best score. `inputs` are settings that are scaled to the domain, shape (M, n).
    """
    # Loading takes a second.
    from sklearn.model_selection import GridSearchCV, StratifiedKFold
    from sklearn.tree import DecisionTreeClassifier

    def smallest_good_enough(results: Any) -> int:
        """The index of the strongest pruning whose score is within a standard error of the best."""
        means = results["mean_test_score"]
        best = np.argmax(means)
        threshold = means[best] - results["std_test_score"][best] / math.sqrt(FOLDS - 1)
        return int(np.flatnonzero(means >= threshold)[-1])

    tree = DecisionTreeClassifier(
        max_depth=MAX_DEPTH, min_samples_leaf=MIN_SETTINGS // 2, random_state=0
    )
    path = tree.cost_complexity_pruning_path(inputs, is_unsafe)
    # The strongest pruning leaves a tree without a condition: it is left out.
    strengths = np.unique(np.maximum(path.ccp_alphas, 0.0))[:-1]
    if len(strengths):
        places = np.linspace(0, len(strengths) - 1, MAX_PRUNINGS).round()
        strengths = strengths[np.unique(places.astype(int))]
    else:
        strengths = np.zeros(1)

    folds = StratifiedKFold(FOLDS, shuffle=True, random_state=0)
    search = GridSearchCV(
        tree,
        {"ccp_alpha": strengths},
        scoring="neg_brier_score",
        cv=folds,
        refit=smallest_good_enough,
    )
    return search.fit(inputs, is_unsafe).best_estimator_


def _boxes_of_leaves(
    tree: Any, node: int, box: FloatArray, lower: FloatArray, width: FloatArray
) -> Iterator[tuple[FloatArray, float]]:
    """Yield the box of each leaf below a node of a tree, and the share of unsafe settings in it.
    `box` is the box of the node.
    """
    # A leaf has no children: scikit-learn states -1.
    if tree.children_left[node] < 0:
        counts = tree.value[node][0]
        yield box, counts[-1] / counts.sum()
        return

    column = tree.feature[node]
    threshold = lower[column] + tree.threshold[node] * width[column]
    for end, children in enumerate((tree.children_right, tree.children_left)):
        part = box.copy()
        part[end, column] = threshold
        yield from _boxes_of_leaves(tree, children[node], part, lower, width)


def _drop_useless_conditions(
    box: FloatArray, settings: FloatArray, is_unsafe: BoolArray
) -> FloatArray:
    """Drop the conditions of a box one after another, as long as the lower bound of the unsafe
    share in the box does not fall.
    """

    def least_density(box: FloatArray) -> float:
        """The lower bound of the unsafe share in a box; 0 for a box without settings."""
        flags = is_unsafe[is_within(box, settings)]
        if not len(flags):
            return 0.0
        return clopper_pearson(flags.sum(), len(flags))[0]

    while np.isfinite(box).any():
        columns = np.flatnonzero(np.isfinite(box).any(axis=0))
        wider = [
            np.where(np.arange(box.shape[1]) == column, UNLIMITED, box)
            for column in columns
        ]
        best = max(wider, key=least_density)
        if least_density(best) < least_density(box):
            break
        box = best
    return box


def is_within(box: FloatArray, settings: FloatArray) -> BoolArray:
    """Whether each of M settings lies within a box, shape (M,)."""
    return np.asarray(((settings >= box[0]) & (settings <= box[1])).all(axis=1))
