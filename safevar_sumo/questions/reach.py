"""The falsification of specified limits, and the furthest value of one of their ends up to which a
falsification finds nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from safevar_sumo.questions.boundary import Failing, last_safe_values
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.falsify import LEAST_SIMULATIONS, Falsification, Judge, falsify
from safevar_sumo.questions.models import Models, judges_of
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import Limit
from safevar_sumo.vehicles import Characteristic

NEAREST_STAGE = "limits that would do"

POINTS = 128
"""Number of Sobol points, of corners, of random settings with half of their values at ends, and of
settings at a value that is tested, with which a falsification begins in each model.
"""
MAX_STEPS = 40
"""Largest number of values that are tried in search of the furthest one that holds."""
End = tuple[int, int]
"""An end of a box: 0, the lower one, or 1, the upper one; and the column."""


def falsify_limits(
    box: Box, judges: Sequence[Judge], budget: int, seed: tuple[int, ...], end: End | None = None
) -> Falsification:
    """Search a box for unsafe settings: at settings that cover it, in all models, and with `budget`
    further simulations.

    `end` is an end that is to be printed: a part of the first settings has just its value.
    """
    rng = np.random.default_rng(seed)
    # Sobol points and corners, and settings with many values at ends.
    spread = box.spread_and_corners(POINTS, int(np.random.SeedSequence(seed).generate_state(1)[0]))
    at_ends = box.with_ends(POINTS, rng)
    settings = np.concatenate([spread, at_ends])
    if end is not None:
        just_within = np.concatenate([spread[POINTS:], at_ends])
        just_within[:, end[1]] = box.end(*end)
        settings = np.concatenate([settings, just_within])
    settings = np.unique(settings, axis=0)
    return falsify(box, judges, [settings] * len(judges), budget + len(judges) * len(settings), rng)


def reach(
    box: Box, end: End, start: float, judges: Sequence[Judge], budget: int, seed: tuple[int, ...]
) -> float | None:
    """The furthest value of an end of a box, from `start` on, up to which a falsification finds
    nothing; None if it fails at the start.

    Where a setting fails, the value moves back to the last one before it with which its encounter
    is safe. A value is rounded towards the start as it is printed, and falsified again.
    """
    side, column = end
    item = box.region.characteristics.members[column]
    value = box.end(*end)
    new: Mapping[int, FloatArray] = {}
    for number in range(MAX_STEPS):
        # The last value before all failures with which their encounters are safe.
        for judge, rows in new.items():
            values = rows[:, column]
            inside = rows[values >= value if side == 0 else values <= value]
            if len(inside) and value != start:
                group = Failing(column, start, inside)
                [(last, _)] = last_safe_values([group], partial(_are_unsafe, judges[judge]))
                value = rounded_towards(start, last, item)
        # The failures within the limits with this value: first with the judges that failed last.
        limits = box.with_end(*end, value)
        stream = (*seed, number + 1)
        first = sorted(new)
        new = {}
        if len(first) < len(judges) and first:
            of_first = [judges[judge] for judge in first]
            found = falsify_limits(limits, of_first, min(budget, LEAST_SIMULATIONS), stream, end)
            new = {first[judge]: rows for judge, rows in found.failures.items()}
        if not new:
            found = falsify_limits(limits, judges, budget, stream, end)
            new = found.failures
        if not new:
            return value
        if value == start:
            break
    return None


def _are_unsafe(judge: Judge, settings: FloatArray) -> BoolArray:
    return judge(settings) < 0


def rounded_towards(start: float, value: float, item: Characteristic) -> float:
    """A value as it is printed, rounded towards a start, but not beyond it: a speed in km/h has one
    decimal.
    """
    scale = 10.0 ** (min(item.digits, 1) if item.unit == "km/h" else item.digits)
    scaled = np.round(value * scale, 6)
    if value < start:
        return min(float(np.ceil(scaled) / scale), start)
    return max(float(np.floor(scaled) / scale), start)


def nearest_limits(
    models: Models, limits: Mapping[str, Limit]
) -> list[tuple[str, str, float, float | None]]:
    """Rows of name, unit, specified value and the nearest one at which the specified limits hold in
    all models, the others as specified; None where they do not hold even with the original's value.
    """
    members = models.own.characteristics
    seed = models.own.evaluator.seed
    judges = judges_of(models.members, NEAREST_STAGE)
    # The specified limits in all encounters, all other characteristics as in the original.
    ends = [members.with_original_vehicle(last) for last in (members.lower, members.upper)]
    stated = list[tuple[int, int, float]]()
    for name, limit in limits.items():
        column = members.names.index(name)
        for side, value in enumerate((limit.at_least, limit.at_most)):
            if value is not None:
                ends[side][column] = value
                stated.append((side, column, value))
    box = Box(models.own.evaluator.region, ends[0], ends[1])
    rows = list[tuple[str, str, float, float | None]]()
    for side, column, value in stated:
        item = members.members[column]
        stream = seed, Stream.NEAREST_LIMIT, side, column
        found = reach(box, (side, column), item.original, judges, LEAST_SIMULATIONS, stream)
        rows.append((item.name, item.unit, value, found))
    return rows
