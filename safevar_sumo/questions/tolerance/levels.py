"""Limits that hold up to each of some values of a parameter, such as a speed: each level lies within that of the value
below, and simulates only what is between the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.attack import Attack, attack
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import Model, Models, models_of, with_points_between
from safevar_sumo.questions.tolerance.alone import VALUES, AloneLimit, AloneSearch, Beyond, Move, carry_out
from safevar_sumo.questions.tolerance.by_parameter import (
    Parameter,
    cells_between,
    study_between,
    with_feasible_encounter,
)
from safevar_sumo.questions.tolerance.scans import scan
from safevar_sumo.questions.tolerance.search import BoxGeometry
from safevar_sumo.questions.tolerance.together import LimitsTogether
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Limit

SEARCHED_VALUES, VALUES_OF_FITS = 51, 5
"""Numbers of values, over what is safe up to the value below, at which a characteristic is scanned in many encounters:
with the study's own fit, and with each.
"""
PROMISE_POINTS = 128
"""Number of Sobol points, and of corners, at which specified limits are tried in each fit."""
KNOWN = 16
"""Number of the worst of these with which the attack on specified limits begins in each fit."""
REACHES = 12
"""Largest number of attacks that seek the value up to which specified limits hold."""
STAGE = "specified limits up to a value"


class Level(NamedTuple):
    """Limits that hold up to a value of the parameter.

    Attributes
    ----------
    alone
        The limits of each characteristic alone; None where the original itself is unsafe, or safe in no encounter.
    models
        The fits in which they hold.
    search
        The search for the limits alone; None without such limits.
    failures
        How the specified limits fail up to the value; None where they hold, or none is specified.
    attack
        The attack on the specified limits.
    together
        The limits together; None if they were not sought.
    """

    value: float
    alone: list[AloneLimit] | None
    models: Models
    search: AloneSearch | None = None
    failures: list[tuple[Model, FloatArray]] | None = None
    attack: Attack | None = None
    together: LimitsTogether | None = None


class Reach(NamedTuple):
    """The value up to which specified limits hold, None if they hold up to none, and the attack that found nothing."""

    value: float | None = None
    attack: Attack | None = None


class LevelSearch:
    """The search for limits up to each value."""

    def __init__(
        self,
        evaluator: Evaluator,
        by: Parameter,
        unsafe: Unsafe,
        columns: Sequence[int],
        limits: dict[str, Limit],
        fits: int | None,
        budget: int,
    ) -> None:
        self.evaluator = evaluator
        self.by = by
        self.unsafe = unsafe
        self.columns = columns
        self.limits = limits
        self.fits = fits
        self.budget = budget
        self.is_searched = by.name in evaluator.study.scenario.search
        self.whole = models_of(evaluator, unsafe, fits) if evaluator.study.scenario.search else None

    def levels(self, known: FloatArray) -> list[Level]:
        """The limits up to each value, the least value first; before known failures of one characteristic, too."""
        levels = list[Level]()
        for number, value in enumerate(self.by.values):
            before = levels[-1] if levels else None
            with self.evaluator.stage(f"limits up to {self.by.text(value)}"):
                levels.append(self._level(value, self.by.values[number - 1] if number else None, before, known))
        return levels

    def _level(self, value: float, low: float | None, before: Level | None, known: FloatArray) -> Level:
        models = self.models(low, value)
        if models is None or (before is not None and before.alone is None):
            assert before is not None, "the least value is not below all points"
            return before._replace(value=value)
        within = None
        if before is not None:
            assert before.alone is not None
            within = [each.safe or (0.0, 0.0) for each in before.alone]
        own = models.own
        numbers = (SEARCHED_VALUES, VALUES_OF_FITS) if len(own.evaluator.characteristics.scenario) else (None, VALUES)
        scans = scan(own.evaluator, self.columns, self.unsafe, within, numbers[0])
        if any(one.safe is None for one in scans):
            return Level(value, None, models)
        judges = self._judges(models, low, value)
        inside = self._inside(known, own.evaluator)
        search = AloneSearch(scans, self.columns, judges, numbers[1])
        search.meet([own], inside)
        search.run(self.budget)
        alone = search.limits()
        if before is not None and before.alone is not None:
            alone = [nested_limit(each, earlier) for each, earlier in zip(alone, before.alone, strict=True)]
        if not self.limits:
            return Level(value, alone, models, search)
        if before is not None and before.failures:
            return before._replace(value=value, alone=alone, models=models, search=search)
        found, failures = self._attack(self._promise(own), judges, self.budget, 0)
        return Level(value, alone, models, search, failures, found)

    def models(self, low: float | None, high: float) -> Models | None:
        """The fits between two values; None if no test of a matrix drives there."""
        study = study_between(self.evaluator.study, self.by, low, high, at_end=self.budget > 0)
        is_empty = study.matrix is not None and not study.matrix.tests
        if is_empty and study.matrix != self.evaluator.study.matrix:
            return None
        if self.whole is None:
            return models_of(self.evaluator.for_study(study, verified=0), self.unsafe, self.fits)
        region = self.evaluator.region
        members = list[Model]()
        for model in self.whole.members:
            of_fit = study_between(model.evaluator.study, self.by, low, high, at_end=False)
            of_fit = with_feasible_encounter(of_fit, region) if self.is_searched else of_fit
            members.append(model._replace(evaluator=model.evaluator.for_study(of_fit, verified=0)))
        return self.whole._replace(members=tuple(members))

    def _judges(self, models: Models, low: float | None, high: float) -> Sequence[Model]:
        """The models, with further points between those of a matrix if there is an attack."""
        if not self.budget or self.whole is not None:
            return models.members
        cells = cells_between(self.evaluator.study, self.by, low, high)
        seed = self.evaluator.study.search.seed
        return [
            with_points_between(model, self.unsafe, np.random.default_rng((seed, 5, 0)), cells)[0]
            for model in models.members
        ]

    def up_to(self, value: float, settings: FloatArray) -> FloatArray:
        """Those of M settings, shape (M, n), whose encounter is up to a value of the searched parameter."""
        column = self.evaluator.characteristics.names.index(self.by.name)
        return np.asarray(settings[settings[:, column] <= value])

    def _inside(self, known: FloatArray, evaluator: Evaluator) -> FloatArray:
        """Known failures in encounters between two values."""
        members = evaluator.characteristics
        is_inside = (known >= members.lower) & (known <= members.upper)
        return np.asarray(known[(is_inside | members.of_vehicle).all(axis=1)])

    def _promise(self, own: Model) -> Box:
        """The specified limits in all encounters of a model, all other characteristics as in the original."""
        members = own.evaluator.characteristics
        region = own.evaluator.region
        everywhere = {item.name: Limit(at_least=item.lower, at_most=item.upper) for item in members.scenario}
        columns = [*self.columns, *np.flatnonzero(~members.of_vehicle).tolist()]
        geometry = BoxGeometry(region, columns, {**self.limits, **everywhere})
        return geometry.printed(geometry.fixed)

    def _attack(
        self, promise: Box, judges: Sequence[Model], budget: int, number: int
    ) -> tuple[Attack | None, list[tuple[Model, FloatArray]] | None]:
        """An attack on specified limits; how they fail, None if they hold."""
        seed = self.evaluator.study.search.seed
        settings = np.unique(promise.spread_and_corners(PROMISE_POINTS, seed + number), axis=0)
        lefts = [model.left(settings, STAGE) for model in judges]
        failures = [(model, settings[left < 0]) for model, left in zip(judges, lefts, strict=True)]
        found = None
        if budget:
            worst = [settings[np.argsort(left, kind="stable")[:KNOWN]] for left in lefts]
            lefts_of = [partial(model.left, stage=STAGE) for model in judges]
            found = attack(promise, lefts_of, worst, budget, np.random.default_rng((seed, 11, number)))
            is_unsafe = found.left < 0
            failures += [
                (judges[judge], found.settings[is_unsafe & (found.judges == judge)])
                for judge in np.unique(found.judges[is_unsafe])
            ]
        return found, [(model, rows) for model, rows in failures if len(rows)] or None

    def reach(self, levels: Sequence[Level]) -> Reach:
        """The value up to which the specified limits hold: between two values of a searched parameter, the last at
        which an attack finds nothing; of an axis, one of its values.
        """
        if not self.limits:
            return Reach()
        kept = [level for level in levels if level.alone is not None and not level.failures]
        last = Reach(kept[-1].value, kept[-1].attack) if kept else Reach()
        if len(kept) == len(levels) or not self.is_searched or levels[len(kept)].alone is None:
            return last
        level = levels[len(kept)]
        low = self.by.lowest if last.value is None else last.value
        own = level.models.own
        judges = level.models.members
        column = own.evaluator.characteristics.names.index(self.by.name)
        item = self.evaluator.characteristics.members[column]
        promise = self._promise(own)
        failures = level.failures
        high = level.value
        for number in range(1, REACHES + 1):
            for model, rows in failures or ():
                inside = rows[rows[:, column] <= high]
                if len(inside):
                    move = Move(column, low, inside)
                    carry_out([move], model)
                    high = move.safe
            high = item.rounded(high, upwards=False)
            if high <= low:
                break
            upper = promise.upper.copy()
            upper[column] = high
            found, failures = self._attack(Box(promise.region, promise.lower, upper), judges, self.budget, number)
            if failures is None:
                return Reach(high, found)
        return last


def nested_limit(limit: AloneLimit, before: AloneLimit) -> AloneLimit:
    """A limit up to a value, within that up to the value below; where both are the same, what is beyond that one is
    beyond it, too.
    """
    assert limit.safe is not None
    assert before.safe is not None
    ends = [max(limit.safe[0], before.safe[0]), min(limit.safe[1], before.safe[1])]
    beyond = list[Beyond]()
    for side in (0, 1):
        is_before = ends[side] == before.safe[side] and (ends[side] != limit.safe[side] or limit.beyond[side] is None)
        beyond.append(before.beyond[side] if is_before else limit.beyond[side])
    return limit._replace(safe=(ends[0], ends[1]), beyond=(beyond[0], beyond[1]))
