"""Limits that hold up to each of some values of a parameter, such as a speed: each level lies
within that of the value below, and simulates only what is between the two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.between import with_random_places
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.falsify import Falsification, enough
from safevar_sumo.questions.models import Model, Models, judges_of, models_of
from safevar_sumo.questions.reach import Reach, falsify_limits, reach
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.questions.tolerance.alone import VALUES, AloneLimit, AloneSearch, Beyond
from safevar_sumo.questions.tolerance.asked import Asked
from safevar_sumo.questions.tolerance.by_parameter import (
    Parameter,
    cells_between,
    study_between,
    with_feasible_encounter,
)
from safevar_sumo.questions.tolerance.left_out import (
    STAGE as LEFT_OUT_STAGE,
    Contacts,
    OriginalReach,
    contacts_left_out,
    original_reach,
)
from safevar_sumo.questions.tolerance.scans import scan
from safevar_sumo.questions.tolerance.search import BoxGeometry
from safevar_sumo.records import FloatArray
from safevar_sumo.study import Limit

SEARCHED_VALUES, VALUES_OF_FITS = 51, 5
"""Numbers of values, over what is safe up to the value below, at which a characteristic is scanned
in many encounters: with the study's own parameter set, and with each.
"""
POINT_SETS = 3
"""Number of sets of points between those of a matrix: limits alone are found at the first, and
tried at the others as they are printed.
"""
STAGE = "specified limits up to a value"


class Level(NamedTuple):
    """Limits that hold up to a value of the parameter.

    Attributes
    ----------
    alone
        The limits of each characteristic alone; None where the original itself is unsafe, or safe
        in no encounter.
    models
        The parameter sets in which they hold.
    search
        The search for the limits alone; None without such limits.
    failures
        How the specified limits fail up to the value, by the number of the model; none where they
        hold, or none is specified.
    falsification
        That of the specified limits.
    """

    value: float
    alone: list[AloneLimit] | None
    models: Models
    search: AloneSearch | None = None
    failures: Mapping[int, FloatArray] = {}
    falsification: Falsification | None = None


class LevelSearch:
    """The search for limits up to each value."""

    def __init__(self, asked: Asked, by: Parameter) -> None:
        evaluator = asked.evaluator
        self.asked = asked
        self.evaluator = evaluator
        self.by = by
        self.unsafe = asked.unsafe
        self.columns = asked.columns
        self.limits = asked.limits
        self.fits = asked.fits
        self.budget = asked.budget
        self.is_searched = by.name in evaluator.study.scenario.search
        self.column = evaluator.characteristics.names.index(by.name) if self.is_searched else -1
        self.whole = None
        if evaluator.study.scenario.search:
            self.whole = models_of(evaluator, asked.unsafe, asked.fits)

    @cached_property
    def original(self) -> OriginalReach:
        """How far the original vehicle itself keeps its margin."""
        with self.evaluator.stage(LEFT_OUT_STAGE):
            return original_reach(self.evaluator, self.by, self.unsafe)

    def contacts(self, levels: Sequence[Level]) -> Contacts | None:
        """Contacts, in encounters that do not count, of vehicles within the specified limits, or
        without such limits within each limit alone up to the greatest value; None if no scenario is
        searched, or nothing was falsified.
        """
        alone = levels[-1].alone
        if self.whole is None or not self.budget or alone is None:
            return None
        members = self.evaluator.characteristics
        box = self._specified(self.whole.own)
        if self.is_searched:
            box.upper[self.column] = self.by.values[-1]
        boxes = [box]
        if not self.limits:
            boxes = []
            for column, limit in zip(self.columns, alone, strict=True):
                lower = np.where(members.of_vehicle, members.original, box.lower)
                upper = np.where(members.of_vehicle, members.original, box.upper)
                lower[column], upper[column] = limit.safe or (members.original[column],) * 2
                boxes.append(Box(box.region, lower, upper))
        with self.evaluator.stage(LEFT_OUT_STAGE):
            return contacts_left_out(
                self.whole.members, boxes, self.by.name if self.is_searched else ""
            )

    def levels(self, known: FloatArray) -> list[Level]:
        """The limits up to each value, the least value first; before known failures of one
        characteristic, too.
        """
        levels = list[Level]()
        for number, value in enumerate(self.by.values):
            before = levels[-1] if levels else None
            with self.evaluator.stage(f"limits up to {self.by.text(value)}"):
                levels.append(
                    self._level(
                        value, self.by.values[number - 1] if number else None, before, known
                    )
                )
        return self._nested(levels)

    def _nested(self, levels: Sequence[Level]) -> list[Level]:
        """The levels with limits alone before all failures up to their values that the search of
        any of them met.
        """
        searches = [level.search for level in levels if level.search is not None]
        if not self.is_searched or not searches:
            return [*levels]
        failures = np.concatenate([search.failures for search in searches])
        nested = list[Level]()
        for level in levels:
            if level.search is not None:
                level.search.meet(level.models.members, self.up_to(level.value, failures))
                alone = level.search.limits()
                before = nested[-1].alone if nested else None
                if before is not None:
                    alone = [
                        nested_limit(limit, earlier)
                        for limit, earlier in zip(alone, before, strict=True)
                    ]
                level = level._replace(alone=alone)
            nested.append(level)
        return nested

    def _level(
        self, value: float, low: float | None, before: Level | None, known: FloatArray
    ) -> Level:
        models = self.models(low, value)
        if models is None or (before is not None and before.alone is None):
            assert before is not None, "the least value is not below all points"
            return before._replace(value=value)
        within = None
        if before is not None:
            assert before.alone is not None
            within = [each.safe or (0.0, 0.0) for each in before.alone]
        own = models.own
        numbers = (
            (SEARCHED_VALUES, VALUES_OF_FITS)
            if len(own.evaluator.characteristics.scenario)
            else (None, VALUES)
        )
        scans = scan(own.evaluator, self.columns, self.unsafe, within, numbers[0])
        if any(one.safe is None for one in scans):
            return Level(value, None, models)
        judges, *further = [self._judges(models, low, value, count) for count in range(POINT_SETS)]
        inside = self._inside(known, own.evaluator)
        search = AloneSearch(scans, self.columns, judges[0], numbers[1])
        search.meet([own], inside)
        for model in judges:
            search.add(model)
        whole = self.models(None, value) if self.is_searched else None
        others = [model for each in further for model in each if model not in judges]
        while search.recheck([*judges, *others] if others else []):
            pass
        search.attack(judges if whole is None else whole.members, self.budget)
        alone = search.limits()
        if before is not None and before.alone is not None:
            alone = [
                nested_limit(each, earlier)
                for each, earlier in zip(alone, before.alone, strict=True)
            ]
        if not self.limits:
            return Level(value, alone, models, search)
        if before is not None and before.failures:
            return before._replace(value=value, alone=alone, models=models, search=search)
        found = falsify_limits(
            self._specified(models.own),
            judges_of(judges, STAGE),
            enough(self.budget),
            (self.evaluator.study.search.seed, Stream.SPECIFIED_BETWEEN),
            (1, self.column) if self.is_searched else None,
        )
        return Level(value, alone, models, search, found.failures, found)

    def models(self, low: float | None, high: float) -> Models | None:
        """The parameter sets between two values; None if no test of a matrix drives there."""
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

    def _judges(
        self, models: Models, low: float | None, high: float, count: int
    ) -> Sequence[Model]:
        """The models, with points between those of a matrix if there is an attack."""
        if not self.budget or self.whole is not None:
            return models.members
        cells = cells_between(self.evaluator.study, self.by, low, high)
        return [with_random_places(model, self.unsafe, cells, count) for model in models.members]

    def up_to(self, value: float, settings: FloatArray) -> FloatArray:
        """Those of M settings, shape (M, n), whose encounter is up to a value of the searched
        parameter.
        """
        column = self.evaluator.characteristics.names.index(self.by.name)
        return np.asarray(settings[settings[:, column] <= value])

    def _inside(self, known: FloatArray, evaluator: Evaluator) -> FloatArray:
        """Known failures in encounters between two values."""
        members = evaluator.characteristics
        is_inside = (known >= members.lower) & (known <= members.upper)
        return np.asarray(known[(is_inside | members.of_vehicle).all(axis=1)])

    def _specified(self, own: Model) -> Box:
        """The specified limits in all encounters of a model, all other characteristics as in the
        original.
        """
        members = own.evaluator.characteristics
        region = own.evaluator.region
        everywhere = {
            item.name: Limit(at_least=item.lower, at_most=item.upper) for item in members.scenario
        }
        columns = [*self.columns, *np.flatnonzero(~members.of_vehicle).tolist()]
        geometry = BoxGeometry(region, columns, {**self.limits, **everywhere})
        return geometry.printed(geometry.fixed)

    def reach(self, levels: Sequence[Level]) -> Reach:
        """The value up to which the specified limits hold, at most that up to which the original
        keeps its margin: between two values of a searched parameter, the last at which a
        falsification finds nothing; of an axis, one of its values.
        """
        last = Reach()
        if not self.limits or not self.budget:
            return last
        keeps_up_to = self.original.keeps_up_to
        last_value = -np.inf if keeps_up_to is None else keeps_up_to
        low = self.by.lowest
        for level in levels:
            high = min(level.value, last_value)
            if level.alone is None or high <= low:
                break
            if not level.failures and high == level.value:
                last = Reach(level.value, level.falsification)
                low = level.value
                continue
            if self.is_searched:
                box = self._specified(level.models.own)
                upper = box.upper.copy()
                upper[self.column] = high
                box = Box(box.region, box.lower, upper)
                judges = judges_of(level.models.members, STAGE)
                stream = self.evaluator.study.search.seed, Stream.SPECIFIED_UP_TO
                start = float(box.lower[self.column])
                end = (1, self.column)
                found = reach(box, end, start, judges, enough(self.budget), stream, level.failures)
                last = last if found.value is None else found
            break
        return last


def nested_limit(limit: AloneLimit, before: AloneLimit) -> AloneLimit:
    """A limit up to a value, within that up to the value below; where both are the same, what is
    beyond that one is beyond it, too.
    """
    assert limit.safe is not None
    assert before.safe is not None
    ends = [max(limit.safe[0], before.safe[0]), min(limit.safe[1], before.safe[1])]
    beyond = list[Beyond]()
    for side in (0, 1):
        is_before = ends[side] == before.safe[side] and (
            ends[side] != limit.safe[side] or limit.beyond[side] is None
        )
        beyond.append(before.beyond[side] if is_before else limit.beyond[side])
    return limit._replace(safe=(ends[0], ends[1]), beyond=(beyond[0], beyond[1]))
