"""The limits of each characteristic: what a workshop needs to know, in its unit and rounded to the safe side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.protocol.rater import is_rated
from safevar_sumo.questions.evaluator import Evaluator, Interval
from safevar_sumo.questions.tolerance.joint import JointLimits
from safevar_sumo.questions.tolerance.scans import OneAtATimeScan
from safevar_sumo.records import KMH_PER_MS, FloatArray
from safevar_sumo.scenarios import Scenario
from safevar_sumo.study import Limit
from safevar_sumo.sumo.encounters import encounter
from safevar_sumo.sumo.system import assemble
from safevar_sumo.vehicles import Characteristic

NO_BOX = "no safe box"
Ends = tuple[float | None, float | None]
NOWHERE: Ends = None, None


def limit_rows(
    evaluator: Evaluator,
    scans: Sequence[OneAtATimeScan],
    box: JointLimits | None,
    limits: Mapping[str, Limit],
    unsafe: Unsafe,
) -> tuple[list[tuple[Any, ...]], list[str]]:
    """The rows of the table of limits, and what is wrong with each of the user's limits that is not kept.

    `box` is None in a rated study, and around an unsafe original.
    """
    nearest = {one.characteristic.name: one.nearest_unsafe(one.characteristic.original) for one in scans}
    beyond_alone = _failures_alone(evaluator, nearest, unsafe)
    beyond = {} if box is None else describe_failures(evaluator, box.beyond, unsafe)
    rows, broken = [], []
    for one in scans:
        item, is_sought = one.characteristic, not is_rated(evaluator.study)
        name, limit = item.name, limits.get(item.name)
        specified = NOWHERE if limit is None else (limit.at_least, limit.at_most)
        together = box.box[name] if box is not None and box.kept else None
        by, end = _outside(one, specified)
        is_kept = limit is None or (one.safe is not None and not by and (together is not None or not is_sought))
        if not is_kept:
            why = "kept alone, not together with all limits"
            if by:
                end = end if one.nearest_unsafe(end) == end else nearest[name] or end
                fails = _failures_alone(evaluator, {name: end}, unsafe).get(name, "the car fails in other encounters")
                why = f"{fails} (outside by {by:.3g}{item.suffix})"
            broken.append(f"{name} {end:.5g}{item.suffix}: {why}")
        rows.append(
            (
                *(name, item.unit, item.original),
                *(*(_rounded(one) or NOWHERE), *(together or NOWHERE), *specified),
                *(is_kept, beyond.get(name) or beyond_alone.get(name)),
                _sentence(item, together, specified, beyond.get(name)) if is_sought else None,
            )
        )
    return rows, broken


def _rounded(one: OneAtATimeScan) -> Interval | None:
    """What is safe alone, rounded inwards; ends of the domain stay."""
    if one.safe is None:
        return None
    item, (low, high) = one.characteristic, one.safe
    return (
        low if low <= item.lower else item.rounded(low, upwards=True),
        high if high >= item.upper else item.rounded(high, upwards=False),
    )


def _outside(one: OneAtATimeScan, specified: Ends) -> tuple[float, float]:
    """How far the user's limit is outside what is safe alone [unit], 0 if it is inside, and the end that is."""
    original = one.characteristic.original
    ends = zip(specified, one.safe or (original, original), (-1, 1), strict=True)
    by = [(max(sign * (end - safe), 0.0), end) for end, safe, sign in ends if end is not None]
    return max(by, default=(0.0, original))


def _failures_alone(evaluator: Evaluator, values: Mapping[str, float | None], unsafe: Unsafe) -> dict[str, str]:
    """How a value of one characteristic alone fails, in words, by its name; nothing without a value."""
    members = evaluator.characteristics
    settings = {name: members.setting({name: value}, name) for name, value in values.items() if value is not None}
    return describe_failures(evaluator, settings, unsafe)


def describe_failures(evaluator: Evaluator, settings: Mapping[str, FloatArray], unsafe: Unsafe) -> dict[str, str]:
    """How unsafe settings fail at their worst points, in words, by the same names."""
    if not settings:
        return {}
    points, members = assemble(evaluator.study).points, evaluator.characteristics
    runs = evaluator.evaluate(np.array(list(settings.values())), "what fails first")
    worst = np.zeros(len(runs), dtype=int) if runs.worst_points is None else runs.worst_points
    words, names = {}, members.scenario.names
    columns = (settings, worst.tolist(), runs.settings[:, ~members.of_vehicle].tolist(), runs.collided, runs.f_safe)
    for is_unsafe, (name, point, values, collided, degree) in zip(
        unsafe.of(runs), zip(*columns, strict=True), strict=True
    ):
        if is_unsafe or not names:
            scenario = encounter(points[point], dict(zip(names, values, strict=True))).scenario
            words[name] = _failure_in_words(scenario, unsafe, bool(collided), degree)
    return words


def _failure_in_words(scenario: Scenario, unsafe: Unsafe, collided: bool, degree: float) -> str:
    """A failure at a safety degree, such as `the car hits a pedestrian with 12 km/h in the test at 40 km/h`."""
    if unsafe.points is not None:  # points are of the whole matrix
        return f"the car {unsafe.in_words}"
    test = "" if scenario.test_speed is None else f" in the test at {KMH_PER_MS * scenario.test_speed:.3g} km/h"
    if collided:
        impact_speed = -KMH_PER_MS * degree  # nearly 0 at the limit itself: then it says nothing
        impact = "" if impact_speed < 1 else f" with {impact_speed:.2g} km/h"
        return f"the car hits {scenario.obstacle()}{impact}{test}"
    centre = " from centre to centre" if scenario.centre_to_centre and unsafe.below else ""
    return f"the car keeps less than {unsafe.below or unsafe.keep:.3g} m{centre} from {scenario.obstacle()}{test}"


def _sentence(item: Characteristic, ends: Interval | None, specified: Ends, beyond: str | None) -> str:
    """A sentence for a maintenance manual: all of these may be obeyed together. The original, and what the user
    specified, have their own digits.
    """
    name = item.short_name[:1].upper() + item.short_name[1:]
    if ends is None:
        return f"{name}: {NO_BOX}."
    own, domain = (item.original, *specified), (item.lower, item.upper)
    keep = " and ".join(
        f"{word} {f'{end:g}' if end in own else item.text(end)}{item.suffix}"
        for word, end, last in zip(("at least", "at most"), ends, domain, strict=True)
        if end != last
    )
    if not keep:
        return f"{name}: anything from {item.lower:g} to {item.upper:g}{item.suffix}."
    failure = f"; beyond, with the other characteristics at their limits, {beyond}" if beyond else ""
    return f"{name}: keep {keep}{failure}."
