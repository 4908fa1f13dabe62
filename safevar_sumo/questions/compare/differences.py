"""What is better and what is worse in B than in A: limits, needless braking, when the new vehicle brakes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.metrics import RATING_POINTS, Unsafe
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.questions.answer import Column, with_interval
from safevar_sumo.questions.compare.settings import within
from safevar_sumo.questions.evaluator import Evaluator, Interval
from safevar_sumo.questions.pairs import SIDES
from safevar_sumo.questions.repair.price import benign_scenes, drive_new_cars, needless_braking
from safevar_sumo.questions.research_questions.statistics import ALPHA
from safevar_sumo.questions.tolerance.scans import OneAtATimeScan, scan
from safevar_sumo.questions.words import join_phrases, number_of
from safevar_sumo.records import Evaluations, JsonObject
from safevar_sumo.study import Limit
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import Characteristic

LIMIT_COLUMNS = {
    "characteristic": Column("", "characteristic of the vehicle"),
    "unit": Column("", "its unit"),
    **with_interval("a", Column("", "value of A's original vehicle; the interval is safe alone in A", ".10g")),
    **with_interval("b", Column("", "value of B's original vehicle; the interval is safe alone in B", ".10g")),
    "change": Column("", "what becomes of the interval: grown, shrunk, both, or the same"),
}
GROWN, SHRUNK, BOTH, SAME = "grown", "shrunk", "both", "the same"
MAX_LIMITS_NAMED = 3
"""Maximum number of limits that a sentence names."""
LEAST_METRES = 0.05
"""A smaller distance by which a vehicle brakes earlier or later is not told [m]."""


class Difference(NamedTuple):
    """What B does in comparison with A, each a phrase: `better`, `worse`, and `facts` that are neither."""

    better: list[str]
    worse: list[str]
    facts: list[str]


def compare_counts(counts: Mapping[str, Any], a: str) -> Difference:
    """The settings that are unsafe in one system only."""
    only_a, only_b, both, neither = (counts[name] for name in ("only_a_unsafe", "only_b_unsafe", "both", "neither"))
    better = [f"avoids {only_a} of {number_of(only_a + both, 'setting')} unsafe in {a}"] if only_a else []
    worse = [f"is unsafe in {only_b} of {number_of(only_b + neither, 'setting')} safe in {a}"] if only_b else []
    return Difference(better, worse, [])


def compare_values(quantity: str, p: float, a12: float) -> Difference:
    """A significant difference of the safety degree, or of the rating, over all pairs."""
    is_significant = p < ALPHA  # without pairs, p is NaN
    better = [f"has a higher {quantity} (p = {p:.2g})"] if is_significant and a12 < 0.5 else []
    worse = [f"has a lower {quantity} (p = {p:.2g})"] if is_significant and a12 >= 0.5 else []
    return Difference(better, worse, [])


def limits_of_both(
    evaluators: Sequence[Evaluator], criteria: Sequence[Unsafe], limits: Mapping[str, Limit]
) -> list[list[Any]]:
    """The rows of `LIMIT_COLUMNS`: limits alone, rounded as `tolerance` rounds them, within the user's limits; no
    interval where the original is unsafe.
    """
    columns = np.flatnonzero(evaluators[0].characteristics.of_vehicle).tolist()
    scans = [scan(one, columns, unsafe) for one, unsafe in zip(evaluators, criteria, strict=True)]
    rows = []
    for both in zip(*scans, strict=True):
        items = [one.characteristic for one in both]
        name = items[0].name
        ends = [
            _within(one, within(limits, name, of.study.domains[name])) for one, of in zip(both, evaluators, strict=True)
        ]
        values = [(item.original, *(safe or (np.nan, np.nan))) for item, safe in zip(items, ends, strict=True)]
        rows.append([name, items[0].unit, *chain(*values), _change_of(*ends)])
    return rows


def _within(one: OneAtATimeScan, ends: Interval) -> Interval | None:
    """What is safe alone and between the ends, rounded inwards."""
    if one.safe is None:
        return None
    low, high = one.characteristic.rounded_inwards(one.safe)
    return max(low, ends[0]), min(high, ends[1])


def _change_of(a: Interval | None, b: Interval | None) -> str:
    """What becomes of A's interval in B."""
    if a is None or b is None:
        return SAME if a is b else (GROWN if a is None else SHRUNK)
    grows = b[0] < a[0] or b[1] > a[1]
    shrinks = b[0] > a[0] or b[1] < a[1]
    return {(True, True): BOTH, (True, False): GROWN, (False, True): SHRUNK}.get((grows, shrinks), SAME)


def compare_limits(rows: Sequence[Sequence[Any]], members: Sequence[Characteristic]) -> Difference:
    """The limits that grow or shrink, in words."""
    phrases = {}
    for change, verb in ((GROWN, "grow"), (SHRUNK, "shrink"), (BOTH, "move")):
        named = [(row, item) for row, item in zip(rows, members, strict=True) if row[-1] == change]
        texts = [_limit_in_words(row, item) for row, item in named if np.isfinite([row[3], row[6]]).all()]
        more = len(texts) - MAX_LIMITS_NAMED
        some = [*texts[:MAX_LIMITS_NAMED], *([f"{more} more"] if more > 0 else [])]
        phrases[change] = [f"has limits that {verb}: {join_phrases(some)}"] if texts else []
    moved = phrases[BOTH]
    return Difference(phrases[GROWN] + moved, phrases[SHRUNK] + moved, [])


def _limit_in_words(row: Sequence[Any], item: Characteristic) -> str:
    """A limit in B, and in A in brackets, such as `sensorRange from 19.1 (15) m`."""
    _, _, _, *a, _, low, high, _ = row
    sides = zip(("from", "to"), (low, high), a, strict=True)
    moved = " ".join(f"{word} {b:g} ({before:g})" for word, b, before in sides if b != before)
    return f"{item.name} {moved}{item.suffix}"


def compare_originals(
    evaluators: Sequence[Evaluator], originals: Sequence[Evaluations], criteria: Sequence[Unsafe], a: str
) -> tuple[JsonObject, Difference]:
    """How both original vehicles end, how often they brake needlessly, and how much earlier B's brakes: the numbers,
    and what they say.
    """
    numbers = _ends_of_originals(evaluators, originals)
    both_rated = all(is_rated(one.study) for one in evaluators)
    difference = Difference([], [], [])
    in_a, in_b = (bool(unsafe.of(one)[0]) for unsafe, one in zip(criteria, originals, strict=True))
    if in_a != in_b:
        kind = difference.worse if in_b else difference.better
        kind.append(f"is {'unsafe' if in_b else 'safe'} with the original vehicle, which is not so in {a}")
    braking = _needless_braking(*evaluators)
    numbers |= braking
    before, after, scenes = braking.values()
    if scenes and before != after:
        kind = difference.worse if after > before else difference.better
        kind.append(f"brakes needlessly in {after} of {scenes} benign scenes ({before} in {a})")
    if both_rated:
        numbers |= {
            f"{side}_points": float(original.column(RATING_POINTS.name)[0])
            for side, original in zip(SIDES, originals, strict=True)
        }
        points_a = numbers["a_points"]
        points_b = numbers["b_points"]
        if points_a != points_b:
            kind = difference.better if points_b > points_a else difference.worse
            kind.append(f"earns {points_b:.4g} points ({points_a:.4g} in {a})")
    earlier, later = _metres_earlier(*evaluators)
    numbers |= {"metres_earlier": earlier, "metres_later": later}
    told = [(value, word) for value, word in ((earlier, "earlier"), (later, "later")) if (value or 0) > LEAST_METRES]
    if told:
        difference.facts.append(f"brakes {join_phrases([f'up to {value:.2g} m {word}' for value, word in told])}")
    return numbers, difference


def _ends_of_originals(evaluators: Sequence[Evaluator], originals: Sequence[Evaluations]) -> JsonObject:
    """How both original vehicles end, with the gap where bodies do not touch at a degree of 0."""
    numbers: JsonObject = {}
    for side, one, original in zip(SIDES, evaluators, originals, strict=True):
        numbers |= {f"{side}_outcome": str(original.outcome[0]), f"{side}_degree": float(original.f_safe[0])}
        if contact := assemble(one.study).contact:
            numbers[f"{side}_gap"] = float(original.gaps(contact)[0])
    return numbers


def _needless_braking(a: Evaluator, b: Evaluator) -> JsonObject:
    """In how many of A's benign scenes the original vehicles of A and B brake, None without any; and the number of
    these scenes.
    """
    systems = [assemble(one.study) for one in (a, b)]
    # What a study searches in its scenario, these scenes do not have.
    systems = [replace(one, characteristics=one.characteristics.vehicle) for one in systems]
    scenes = benign_scenes(a.study, systems[0])
    brakes = [needless_braking(system, scenes) for system in systems]
    counts = [sum(one) if one else None for one in brakes]
    return {"a_needless_braking": counts[0], "b_needless_braking": counts[1], "benign_scenes": len(brakes[0])}


def _metres_earlier(a: Evaluator, b: Evaluator) -> Iterator[float | None]:
    """By how much B's original vehicle begins to brake earlier, and later, where the difference is largest [m]; None in
    rated studies, in other scenarios than A's, and where either does not brake.
    """
    studies = a.study, b.study
    metres = np.array([np.nan])
    if (studies[0].scenario, studies[0].matrix) == (studies[1].scenario, studies[1].matrix) and not is_rated(a.study):
        onsets = [drive_new_cars(assemble(one.study), one.characteristics.original[np.newaxis])[0] for one in (a, b)]
        metres = onsets[0][0] - onsets[1][0]
    metres = metres[np.isfinite(metres)]
    for signed in (metres, -metres):
        yield float(max(0.0, signed.max())) if len(signed) else None
