"""What would do in place of limits that are not kept: the nearest value of each with which limits
together exist.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from safevar_sumo.questions.attack import attack
from safevar_sumo.questions.box import MAX_CORNERS, Box
from safevar_sumo.questions.models import Models
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.study import Limit
from safevar_sumo.vehicles import Characteristic

PARTS, ROUNDS = 8, 3
"""Each of `ROUNDS` rounds divides the interval from the original to the specified value into
`PARTS` parts.
"""
POINTS, ATTACK = 64, 1024
"""Number of Sobol points, and of corners, at which a value is tried; simulations of an attack on
it.
"""
STAGE = "limits that would do"


def nearest_limits(
    models: Models, limits: Mapping[str, Limit]
) -> list[tuple[str, str, float, float | None]]:
    """Rows of name, unit, specified value and the nearest one at which the specified limits hold in
    all models, the others as specified; None where they do not hold even with the original's value.
    """
    rows = []
    for name, limit in limits.items():
        item = next(
            member for member in models.own.evaluator.characteristics if member.name == name
        )
        for side, value in enumerate((limit.at_least, limit.at_most)):
            if value is not None:
                rows.append((name, item.unit, value, _nearest(models, limits, item, side, value)))
    return rows


def _nearest(
    models: Models, limits: Mapping[str, Limit], item: Characteristic, side: int, value: float
) -> float | None:
    """The value of one limit, from the original's on, up to which the others hold as specified."""
    safe = item.original
    unsafe = value
    if not _first_unsafe(models, [_box(models, limits, item, side, safe)]):
        return None
    for _ in range(ROUNDS):
        values = (safe + (unsafe - safe) * np.arange(1, PARTS + 1) / PARTS).tolist()
        safe_count = _first_unsafe(
            models, [_box(models, limits, item, side, each) for each in values]
        )
        if safe_count == PARTS:
            safe = values[-1]
            break
        safe = [safe, *values][safe_count]
        unsafe = values[safe_count]
    return _attacked(models, limits, item, side, safe)


def _attacked(
    models: Models, limits: Mapping[str, Limit], item: Characteristic, side: int, value: float
) -> float | None:
    """The value, rounded towards the original, moved in until an attack finds nothing."""
    judges = [partial(model.left, stage=STAGE) for model in models.members]
    step = max((item.upper - item.lower) / 50, 10.0**-item.digits)
    while True:
        value = item.rounded(value, upwards=side == 0)
        rng = Stream.NEAREST_LIMIT.generator(models.own.evaluator.study.search.seed, side)
        found = attack(_box(models, limits, item, side, value), judges, [], ATTACK, rng)
        if not (found.left < 0).any():
            return value
        if value == item.original:
            return None
        moved = value + (1, -1)[side] * step
        value = min(moved, item.original) if side == 0 else max(moved, item.original)


def _first_unsafe(models: Models, boxes: Sequence[Box]) -> int:
    """The number of boxes before the first in which something is unsafe in any model."""
    seed = models.own.evaluator.study.search.seed
    settings = [
        np.concatenate(
            [
                box.corners(seed, 0)[: MAX_CORNERS // len(boxes)],
                box.spread_and_corners(POINTS, seed),
            ]
        )
        for box in boxes
    ]
    ends = np.cumsum([*map(len, settings)])[:-1]
    is_safe = np.ones(len(boxes), dtype=bool)
    for model in models.members:
        lefts = np.split(model.left(np.concatenate(settings), STAGE), ends)
        is_safe &= [left.min() >= 0 for left in lefts]
    return int(np.argmin([*is_safe, False]))


def _box(
    models: Models, limits: Mapping[str, Limit], item: Characteristic, side: int, value: float
) -> Box:
    """The specified limits, one of them at another value; all other characteristics as in the
    original.
    """
    members = models.own.evaluator.characteristics
    ends: list[Any] = [
        np.where(members.of_vehicle, members.original, last)
        for last in (members.lower, members.upper)
    ]
    for name, limit in limits.items():
        column = members.names.index(name)
        for number, end in enumerate((limit.at_least, limit.at_most)):
            ends[number][column] = members.original[column] if end is None else end
    ends[side][members.names.index(item.name)] = value
    return Box(models.own.evaluator.region, *ends)
