"""The differences between two versions A and B of a study: what is better and what is worse in B.
Compared are limits, unsafe vehicles, needless braking, and where the new vehicle begins to brake.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.questions.answer import tabulate
from safevar_sumo.questions.boundary import Alone
from safevar_sumo.questions.compare import words
from safevar_sumo.questions.compare.coverage import TestCase, cases_of
from safevar_sumo.questions.compare.settings import Evaluators, Restriction, within
from safevar_sumo.questions.counterexamples import place_of
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import Model, Models
from safevar_sumo.questions.pairs import SIDES, Criteria, Runs, Titles
from safevar_sumo.questions.repair.price import (
    benign_scenes,
    drive_new_cars,
    needless_braking,
)
from safevar_sumo.questions.research_questions.statistics import ALPHA
from safevar_sumo.questions.sampling import Interval
from safevar_sumo.questions.sentence import Sentence
from safevar_sumo.questions.tables import AnswerTable, shipped_columns
from safevar_sumo.questions.tolerance.asked import Asked, asked_of
from safevar_sumo.questions.tolerance.search import alone_with_own_set
from safevar_sumo.questions.words import count_in_words, join_few
from safevar_sumo.records import Evaluations, FloatArray, JsonObject
from safevar_sumo.scenarios import Point
from safevar_sumo.sumo.matrix import simulate_all_points
from safevar_sumo.vehicles import CharacteristicSet

LIMIT_COLUMNS, SUMMARY_COLUMNS, *_ = shipped_columns("compare").values()
GROWN = "grown"
SHRUNK = "shrunk"
BOTH = "both"
SAME = "the same"
CHANGES = (SAME, GROWN, SHRUNK, BOTH)
"""How an interval of A changes in B. The position is a sum: 1 if the interval grows on a side, and
2 if it shrinks on a side.
"""
UNDEFINED = (np.nan, np.nan)
"""The ends of an interval that does not exist."""
MAX_LIMITS_NAMED = 3
"""Maximum number of limits that a sentence names."""
COMFORT, SAFETY, COLLISION = range(3)
"""Weights of differences, the largest for the most important kind: needless braking (0), safety
(1), and a new collision of the original vehicle (2).
"""


class Difference(NamedTuple):
    """A difference between the versions A and B. `template` and its `values` give the sentence,
    together with the names of A and B. `is_better` says whether B is better.
    """

    template: Sentence
    values: JsonObject
    is_better: bool
    weight: int = SAFETY


Differences = Iterator[Difference]


def summary_of(numbers: JsonObject, pairs: pd.DataFrame, titles: Titles) -> AnswerTable:
    """The table with a row for each compared quantity, and a column for each version. `numbers` are
    those of the answer; `pairs` has the safety degrees of A and B.
    """
    number_in_both = numbers["both"]
    rows = [
        (
            "safety degree of the original vehicle [m, or -m/s after a collision]",
            numbers["a_degree"],
            numbers["b_degree"],
        ),
        (
            f"unsafe vehicles of {numbers['settings']} changed vehicles",
            numbers["only_a_unsafe"] + number_in_both,
            numbers["only_b_unsafe"] + number_in_both,
        ),
        ("mean safety degree of the changed vehicles", *pairs[SIDES].mean()),
        (
            f"scenes with needless braking, of {numbers['benign_scenes']} benign scenes",
            numbers["a_needless_braking"],
            numbers["b_needless_braking"],
        ),
        (
            "characteristics with the narrower limit",
            numbers["limits_grown"],
            numbers["limits_shrunk"],
        ),
    ]
    columns = SUMMARY_COLUMNS | {
        side: SUMMARY_COLUMNS[side]._replace(head=title)
        for side, title in titles.items()
    }
    return tabulate("What was compared", columns, rows)


def compare_counts(counts: Mapping[str, int]) -> Differences:
    """The differences by the numbers of settings that are unsafe in one version only. `counts`
    holds the numbers `only_a_unsafe`, `only_b_unsafe`, `both` and `neither`.
    """
    for template, name, complement, is_better in (
        (words.SAFE_NOW, "only_a_unsafe", "both", True),
        (words.UNSAFE_NOW, "only_b_unsafe", "neither", False),
    ):
        number = counts[name]
        values = {
            "count": count_in_words(number, number + counts[complement]),
            "are": "is" if number == 1 else "are",
        }
        if number:
            yield Difference(template, values, is_better)


def compare_values(p: float, a12: float) -> Differences:
    """The difference of the safety degree over all pairs, if it is significant; p is NaN without
    pairs. An A12 below 0.5 means that B is better.
    """
    is_better = a12 < 0.5
    if p < ALPHA:
        higher = "higher" if is_better else "lower"
        yield Difference(words.DEGREE, {"higher": higher}, is_better)


def limits_of_both(
    evaluators: Evaluators,
    criteria: Criteria,
    limits: Restriction,
    *,
    at_tests: bool,
) -> AnswerTable:
    """The table of the limits of each characteristic alone, in both versions. The limits are those
    of `tolerance` with the study's own parameter set, cut to the user's `limits`. A version whose
    original vehicle is unsafe has no limits.
    """
    vehicles = [side.characteristics.vehicle for side in evaluators]
    requests = []
    for side, unsafe, vehicle in zip(evaluators, criteria, vehicles, strict=True):
        models = Models((Model(0, side, unsafe),), ())
        columns = range(len(vehicle))
        requests.append(asked_of(models, unsafe, columns, {}, at_tests=at_tests))
    # The remaining simulations limit the effort. Both versions get the smaller effort: otherwise
    # different efforts might find different limits.
    effort = min(requests, key=lambda request: request.effort.cases).effort
    alone = [
        _safe_alone(request._replace(effort=effort), limits) for request in requests
    ]
    rows = []
    for a, b, in_a, in_b in zip(*vehicles, *alone, strict=True):
        ends_in_a = (a.original, *(in_a or UNDEFINED))
        ends_in_b = (b.original, *(in_b or UNDEFINED))
        rows.append((a.name, a.unit, *ends_in_a, *ends_in_b, _change_of(in_a, in_b)))
    where = ", at the listed test cases" if at_tests else ""
    return tabulate(
        "Limits of each characteristic alone (parameter set 0 of the vehicle model"
        f"{where}), rounded to the safe side",
        LIMIT_COLUMNS,
        rows,
    )


def _safe_alone(request: Asked, limits: Restriction) -> list[Interval] | list[None]:
    """The safe interval of each characteristic alone, rounded inwards, and within the user's
    limits; None for all characteristics if the original vehicle is unsafe.
    """
    model = request.bench.own
    members = request.bench.vehicle
    if model.are_unsafe(model.characteristics.original_settings, "original vehicle")[0]:
        return [None] * len(members)
    alone, _ = alone_with_own_set(request, Alone(request.lower, request.upper))
    ends = np.column_stack([alone.lower, alone.upper]).tolist()
    intervals = []
    for item, safe in zip(members, ends, strict=True):
        low, high = item.rounded_inwards(safe)
        lower, upper = within(limits, item.name, model.evaluator.study.domains)
        intervals.append((max(low, lower), min(high, upper)))
    return intervals


def _change_of(a: Interval | None, b: Interval | None) -> str:
    """How A's interval changes in B (`CHANGES`); an interval is None if it does not exist."""
    grows = b is not None
    shrinks = a is not None
    if a and b:
        grows = b[0] < a[0] or b[1] > a[1]
        shrinks = b[0] > a[0] or b[1] < a[1]
    return CHANGES[grows + 2 * shrinks]


def compare_limits(limits: pd.DataFrame, members: CharacteristicSet) -> Differences:
    """The differences by limits that exist in both versions, and change. An interval that grows on
    one side and shrinks on the other gives two differences: B is better, and B is worse.
    """
    exist = limits[limits[["a_low", "b_low"]].notna().all(axis=1)]
    for change, wider, signs in (
        (GROWN, "wider", (True,)),
        (SHRUNK, "narrower", (False,)),
        (BOTH, "narrower on one side and wider on the other", (True, False)),
    ):
        changed = {*exist["characteristic"][exist["change"] == change]}
        names = [item.short_name for item in members if item.name in changed]
        for is_better in signs if names else ():
            values = {"wider": wider, "names": join_few(names, MAX_LIMITS_NAMED)}
            yield Difference(words.LIMITS, values, is_better)


def compare_originals(
    evaluators: Evaluators,
    originals: Runs,
    criteria: Criteria,
) -> tuple[JsonObject, list[Difference]]:
    """Compare the original vehicles of A and B: how they end, how often they brake needlessly, and
    how much earlier B's original vehicle brakes. Returns the numbers of the answer, and the
    differences.
    """
    in_a, in_b = (
        bool(unsafe.of(original)[0])
        for unsafe, original in zip(criteria, originals, strict=True)
    )
    braking = _needless_braking(*evaluators)
    ends = _ends_of_originals(evaluators, originals)
    numbers = {**ends, **braking, **_metres_earlier(*evaluators)}

    differences = list(_new_collisions(evaluators))
    if in_a != in_b:
        template = words.ORIGINAL_UNSAFE if in_b else words.ORIGINAL_SAFE
        differences.append(Difference(template, {}, is_better=in_a))
    count_in_a, count_in_b, scenes = braking.values()
    if count_in_a != count_in_b:
        values = {"before": count_in_a, "after": count_in_b, "scenes": scenes}
        is_better = count_in_b < count_in_a
        differences.append(
            Difference(words.NEEDLESS_BRAKING, values, is_better, COMFORT)
        )
    return numbers, differences


def _new_collisions(evaluators: Evaluators) -> Differences:
    """The difference by new collisions: B's original vehicle collides in a test case in which A's
    does not. The sentence names the fastest new collision. Test cases that A lacks do not count,
    because they show nothing about a change.
    """
    of_a, of_b = map(_runs_of_original, evaluators)
    safe_in_a = [case for case, _, run in of_a if not run.collided[0]]
    new = [
        (-run.f_safe[0], point)
        for case, point, run in of_b
        if run.collided[0] and case in safe_in_a
    ]
    if new:
        speed, point = max(new, key=lambda pair: pair[0])
        points = evaluators[1].system.points
        place = place_of(points, point, point.scenario, {})
        template = words.NEW_COLLISIONS if len(new) > 1 else words.NEW_COLLISION
        where = f" ({place})" if place else ""
        values = {"speed": speed, "place": where, "number": len(new)}
        yield Difference(template, values, is_better=False, weight=COLLISION)


def _runs_of_original(side: Evaluator) -> list[tuple[TestCase, Point, Evaluations]]:
    """The test cases of a version, each with its point of the matrix and the evaluation of the
    version's original vehicle.
    """
    results = simulate_all_points(side.system, side.characteristics.original_settings)
    return [
        (case, point, result.evaluations)
        for (_, point, case), result in zip(cases_of(side), results, strict=True)
    ]


def _ends_of_originals(evaluators: Evaluators, originals: Runs) -> JsonObject:
    """The outcome and the safety degree of both original vehicles. The gap between the bodies [m]
    is added if the safety degree is not measured between bumpers.
    """
    numbers: JsonObject = {}
    for side, evaluator, original in zip(SIDES, evaluators, originals, strict=True):
        numbers |= {
            f"{side}_outcome": str(original.outcome[0]),
            f"{side}_degree": float(original.f_safe[0]),
        }
        if contact := evaluator.system.contact:
            numbers[f"{side}_gap"] = float(original.gaps(contact)[0])
    return numbers


def _needless_braking(a: Evaluator, b: Evaluator) -> JsonObject:
    """The numbers of A's benign scenes (nobody needs to brake there) in which the original vehicles
    of A and B brake, None without such scenes; and the number of these scenes.
    """
    # No searched parameter of the scenario varies: the scenes are those of the original encounter.
    system = replace(a.system, characteristics=a.characteristics.vehicle)
    scenes = benign_scenes(a.study, system)
    counts = []
    for side in (a, b):
        brakes = needless_braking(side.system, scenes)
        counts.append(sum(brakes) if brakes else None)
    return {
        "a_needless_braking": counts[0],
        "b_needless_braking": counts[1],
        "benign_scenes": len(brakes),
    }


def _metres_earlier(a: Evaluator, b: Evaluator) -> JsonObject:
    """The largest distances over all points by which B's original vehicle begins to brake earlier,
    and later, than A's [m]. Both are None if the scenarios differ, or if at no point both vehicles
    brake.
    """
    metres = np.empty(0)
    is_same_scenario = (a.study.scenario, a.study.matrix) == (
        b.study.scenario,
        b.study.matrix,
    )
    if is_same_scenario:
        metres = _onset_places(a) - _onset_places(b)
        metres = metres[np.isfinite(metres)]
    if not len(metres):
        return {"metres_earlier": None, "metres_later": None}
    return {
        "metres_earlier": max(0.0, float(metres.max())),
        "metres_later": max(0.0, float(-metres.min())),
    }


def _onset_places(evaluator: Evaluator) -> FloatArray:
    """The position at which the original vehicle begins to brake at each of N points of the matrix
    [m], shape (N,); NaN if the vehicle does not brake.
    """
    onsets, _ = drive_new_cars(
        evaluator.system, evaluator.characteristics.original_settings
    )
    return np.asarray(onsets[0])
