"""The falsification of a claim about a box: a search for a setting in it that is unsafe in any of
some models; and the largest value of a parameter, such as a speed, up to which it finds none.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from safevar_sumo.questions.attack import Attack, attack
from safevar_sumo.questions.boundary import Move, Tested, find_boundaries
from safevar_sumo.questions.box import Box
from safevar_sumo.records import FloatArray

LEAST_SIMULATIONS = 1000
"""Fewest simulations that search for a counterexample before a value is printed as one that holds.
"""
POINTS = 128
"""Number of Sobol points, of corners, of random settings with half of their values at ends, and of
settings at a value that is tested, with which a falsification begins in each model.
"""
KNOWN = 16
"""Number of the worst of these with which the search goes on in each model."""
MAX_STEPS = 40
"""Largest number of values that are tried in search of the largest one that holds."""
AnyModel = TypeVar("AnyModel", bound=Tested)


class Falsification(NamedTuple, Generic[AnyModel]):
    """The unsafe settings that a falsification found, shape (K, n), with the model of each group,
    none if the claim held; and its search.
    """

    failures: list[tuple[AnyModel, FloatArray]]
    attack: Attack | None


class Reach(NamedTuple, Generic[AnyModel]):
    """The largest value that holds, None if none does; the falsification that found nothing up to
    it; and all unsafe settings that were found beyond it.
    """

    value: float | None = None
    attack: Attack | None = None
    failures: Sequence[tuple[AnyModel, FloatArray]] = ()


def enough(budget: int) -> int:
    """The number of simulations with which a value that is printed is tested; 0 leaves the
    falsification out.
    """
    return max(budget, LEAST_SIMULATIONS) if budget else 0


def falsify(
    box: Box,
    models: Sequence[AnyModel],
    budget: int,
    seed: tuple[int, ...],
    stage: str,
    tested: tuple[int, float] | None = None,
) -> Falsification[AnyModel]:
    """Search a box for unsafe settings with `budget` simulations, in all models.

    `tested` is a column and its value that is to be printed: a part of the first settings has just
    this value.
    """
    rng = np.random.default_rng(seed)
    settings = _first_settings(box, seed, rng, tested)
    lefts = [model.left(settings, stage) for model in models]
    failures = [(model, settings[left < 0]) for model, left in zip(models, lefts, strict=True)]
    found = None
    if budget:
        # The search goes on from the worst of the first settings in each model.
        worst = [settings[np.argsort(left, kind="stable")[:KNOWN]] for left in lefts]
        judges = [partial(model.left, stage=stage) for model in models]
        found = attack(box, judges, worst, budget, rng)
        is_unsafe = found.left < 0
        failures += [
            (models[judge], found.settings[is_unsafe & (found.judges == judge)])
            for judge in np.unique(found.judges[is_unsafe])
        ]
    return Falsification([(model, rows) for model, rows in failures if len(rows)], found)


def _first_settings(
    box: Box, seed: tuple[int, ...], rng: np.random.Generator, tested: tuple[int, float] | None
) -> FloatArray:
    """The settings with which a falsification begins, shape (K, n)."""
    spread = box.spread_and_corners(POINTS, int(np.random.SeedSequence(seed).generate_state(1)[0]))
    at_ends = box.with_ends(POINTS, rng)
    settings = np.concatenate([spread, at_ends])
    if tested is not None:
        column, value = tested
        just_within = np.concatenate([spread[POINTS:], at_ends])
        just_within[:, column] = value
        settings = np.concatenate([settings, just_within])
    return np.unique(settings, axis=0)


def reach(
    box: Box,
    column: int,
    models: Sequence[AnyModel],
    budget: int,
    seed: tuple[int, ...],
    stage: str,
    known: Sequence[tuple[AnyModel, FloatArray]] = (),
) -> Reach[AnyModel]:
    """The largest value of a column of a box up to which a falsification finds nothing, from its
    lower end on.

    Where a setting fails, a `known` one or one that is found, the value moves down to the last one
    before it with which its encounter is safe. A value is rounded down as it is printed, and
    falsified again.
    """
    item = box.region.characteristics.members[column]
    low = float(box.lower[column])
    high = float(box.upper[column])
    failures = [*known]
    new = [*known]
    for number in range(MAX_STEPS):
        # The last value before all failures with which their encounters are safe.
        for model, rows in new:
            inside = rows[rows[:, column] <= high]
            if len(inside):
                move = Move(column, low, inside)
                find_boundaries([move], model, stage)
                failures.append((model, move.failure[np.newaxis]))
                high = move.safe
        if high < box.upper[column]:
            high = rounded_down(high, item.digits, item.unit)
        if high <= low:
            break
        upper = box.upper.copy()
        upper[column] = high
        found = falsify(
            Box(box.region, box.lower, upper),
            models,
            budget,
            (*seed, number),
            stage,
            (column, high),
        )
        if not found.failures:
            return Reach(high, found.attack, failures)
        new = found.failures
        failures += new
    return Reach(None, None, failures)


def rounded_down(value: float, digits: int, unit: str) -> float:
    """A value as it is printed: a speed in km/h has one decimal."""
    scale = 10.0 ** (min(digits, 1) if unit == "km/h" else digits)
    return float(np.floor(np.round(value * scale, 6)) / scale)
