"""Limits of each characteristic alone that hold in all parameter sets, between the points of a
matrix and in all encounters.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.between import MovingTest
from safevar_sumo.questions.boundary import Failing, last_safe_values
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.falsify import LEAST_SIMULATIONS, falsify_all
from safevar_sumo.questions.models import Model, judges_of
from safevar_sumo.questions.sampling import Interval, Stream
from safevar_sumo.questions.tolerance.scans import OneAtATimeScan
from safevar_sumo.records import FloatArray
from safevar_sumo.vehicles import Characteristic

VALUES = 17
"""Number of values of what is safe alone in the study's own parameter set that are simulated in
each model.
"""
FALSIFICATIONS, FALSIFICATION_SHARE, GENERATIONS = 20, 0.1, 5
"""Largest number of attacks on a limit, where encounters are ranges; the share of the
simulations that search for a counterexample of each, though never less than `LEAST_SIMULATIONS`,
and its number of generations, the first at the limit itself.
"""
ALONE_STAGE = "limits alone with each parameter set"
Beyond = tuple[FloatArray, Model] | None
"""A setting just beyond a limit, and the model in which it is unsafe; None where nothing is known
to be.
"""


class AloneLimit(NamedTuple):
    """How far one characteristic may go, all others as in the original, in all models.

    Attributes
    ----------
    safe
        The safe interval around the original, rounded inwards; ends of the domain stay. None if the
        original is unsafe.
    beyond
        What is just beyond each end.
    """

    scan: OneAtATimeScan
    safe: Interval | None
    beyond: tuple[Beyond, Beyond] = (None, None)

    @property
    def characteristic(self) -> Characteristic:
        return self.scan.characteristic

    @property
    def of_own_fit(self) -> Interval | None:
        """What is safe in the scan with the study's own set, rounded inwards."""
        return (
            None if self.scan.safe is None else self.characteristic.rounded_inwards(self.scan.safe)
        )

    @property
    def nearest_failure(self) -> Beyond:
        """What is beyond the end that is nearer to the original."""
        return min(filter(None, self.beyond), key=lambda pair: self._change(*pair), default=None)

    def within(self, outer: AloneLimit) -> AloneLimit:
        """The limit, each end of which is that of an outer limit where this is closer."""
        if self.safe is None or outer.safe is None:
            return self
        ends = [
            *zip(self.safe, self.beyond, strict=True),
            *zip(outer.safe, outer.beyond, strict=True),
        ]
        low, below = max(ends[::2], key=itemgetter(0))
        high, above = min(ends[1::2], key=itemgetter(0))
        return self._replace(safe=(low, high), beyond=(below, above))

    def _change(self, setting: FloatArray, model: Model) -> float:
        column = model.characteristics.names.index(self.characteristic.name)
        return abs(float(setting[column]) - self.characteristic.original)


class _Ends:
    """The ends of what is safe of one characteristic, which failures move towards the original."""

    def __init__(self, scan: OneAtATimeScan, column: int) -> None:
        assert scan.safe is not None
        self.item = scan.characteristic
        self.column = column
        self.scan = scan
        self.ends = [*scan.safe]
        self.failures = list[FloatArray]()
        self.beyond: list[Beyond] = [None, None]

    def first_unsafe(self, side: int) -> float | None:
        """The unsafe value of the scan that is nearest beyond an end; None without one."""
        end = self.ends[side]
        values = [value for pair in self.scan.of_state("unsafe") for value in pair]
        outside = [value for value in values if (value < end if side == 0 else value > end)]
        return min(outside, key=lambda value: abs(value - self.item.original), default=None)

    def give_up(self) -> None:
        """Leave no room around the original."""
        self.ends = [self.item.original, self.item.original]

    def limit(self) -> AloneLimit:
        safe = self.item.rounded_inwards((self.ends[0], self.ends[1]))
        return AloneLimit(self.scan, safe, (self.beyond[0], self.beyond[1]))


class AloneSearch:
    """The search for limits alone, from scans with the study's own parameter set: one model after
    another moves them in.
    """

    def __init__(self, scans: Sequence[OneAtATimeScan], columns: Sequence[int], own: Model) -> None:
        self.scans = scans
        self.models = list[Model]()
        evaluator = own.evaluator
        self._encounters = np.concatenate(
            [[evaluator.characteristics.original], evaluator.critical_encounters]
        )
        self.ends = list[_Ends]()  # none where the original is unsafe
        if all(scan.safe is not None for scan in scans):
            self.ends = [_Ends(scan, column) for scan, column in zip(scans, columns, strict=True)]
            _find_beyond(self.ends, own)

    def add(self, model: Model, tests: Sequence[MovingTest] = ()) -> None:
        """Move limits in before what fails in a further model: in the encounters that the scans
        met, and between the points of some tests.
        """
        self.models.append(model)
        if not self.ends:
            return
        # Then the ends as they are printed, until all are safe in all models: where one moves, it
        # is new to the others.
        models, number = [model], VALUES
        while any(
            [
                *[_move_before(self.ends, each, self._encounters, number) for each in models],
                *[_move_between(self.ends, test) for test in tests],
            ]
        ):
            models, number = self.models, 2

    def attack(self, model: Model, budget: int) -> None:
        """Move ends in before what a falsification in a model finds in other encounters, where
        these are ranges.
        """
        if self.ends and len(model.characteristics.scenario):
            share = max(
                round(FALSIFICATION_SHARE * budget), model.evaluator.scaled(LEAST_SIMULATIONS)
            )
            _falsify_alone(self.ends, model, share)

    def meet(self, models: Sequence[Model], failures: FloatArray) -> None:
        """Move the limits before failures that another search met, each of one characteristic,
        shape (K, n).
        """
        for model in models if len(failures) and self.ends else ():
            _move(self.ends, model, [_alone_in(each, failures, model) for each in self.ends])

    @property
    def failures(self) -> FloatArray:
        """Settings beyond the limits that failed in some model, shape (K, n)."""
        rows = [failure for each in self.ends for failure in each.failures]
        return np.array(rows).reshape(-1, self._encounters.shape[1])

    def limits(self) -> list[AloneLimit]:
        return [each.limit() for each in self.ends] or [
            AloneLimit(scan, None) for scan in self.scans
        ]


def _find_beyond(ends: Sequence[_Ends], own: Model) -> None:
    """Find what is just beyond the ends of scans: their first unsafe values, each in its worst
    encounter.
    """
    members = own.characteristics
    places = [(each, side, each.first_unsafe(side)) for each in ends for side in (0, 1)]
    found = [(each, side, value) for each, side, value in places if value is not None]
    settings = np.array([members.setting({each.item.name: value}) for each, _, value in found])
    worst = own.evaluator.evaluate_over_encounters(
        settings.reshape(-1, len(members)), own.unsafe, ALONE_STAGE
    )
    for (each, side, _), setting in zip(found, worst.settings, strict=True):
        each.beyond[side] = setting, own


def _move_before(ends: Sequence[_Ends], model: Model, encounters: FloatArray, number: int) -> bool:
    """Move ends before the failures at some values between them, the ends among them, in each of
    some encounters; whether one has moved.
    """
    settings = [_settings_within(each, encounters, number) for each in ends]
    robustness = model.robustness(np.concatenate(settings), ALONE_STAGE)
    of_each = np.split(robustness, np.cumsum([*map(len, settings)])[:-1])
    failures = [rows[values < 0] for rows, values in zip(settings, of_each, strict=True)]
    return _move(ends, model, failures)


def _move_between(ends: Sequence[_Ends], test: MovingTest) -> bool:
    """Move ends before what fails between a test's points at the ends themselves; whether one has
    moved.
    """
    vehicles = [
        _settings_within(each, test.base.characteristics.original_settings, 2) for each in ends
    ]
    rng = Stream.TESTS_BETWEEN.generator(test.model.evaluator.seed)
    settings = [test.spread(rows, rng) for rows in vehicles]
    robustness = test.robustness(np.concatenate(settings), ALONE_STAGE)
    is_unsafe = np.split(robustness < 0, np.cumsum([*map(len, settings)])[:-1])
    has_moved = False
    for each, rows, fails in zip(ends, settings, is_unsafe, strict=True):
        if fails.any():
            model, failures = test.as_tests(rows[fails])
            has_moved |= _move([each], model, [failures])
    return has_moved


def _settings_within(ends: _Ends, encounters: FloatArray, number: int) -> FloatArray:
    """Settings at values between the ends as they are printed, in each of some encounters, shape
    (K, n).
    """
    low, high = ends.limit().safe or ends.ends
    values = np.linspace(low, high, number)
    settings = np.repeat(encounters, len(values), axis=0)
    settings[:, ends.column] = np.tile(values, len(encounters))
    return settings


def _alone_in(ends: _Ends, failures: FloatArray, model: Model) -> FloatArray:
    """Those of some settings that change this characteristic, within its ends, and are unsafe in a
    model.
    """
    values = failures[:, ends.column]
    inside = failures[
        (values != ends.item.original) & (values >= ends.ends[0]) & (values <= ends.ends[1])
    ]
    return np.asarray(inside[model.are_unsafe(inside, ALONE_STAGE)] if len(inside) else inside)


def _move(ends: Sequence[_Ends], model: Model, failures: Sequence[FloatArray]) -> bool:
    """Move all ends before their failures in a model at once; those that are outside then do not
    matter. Whether any end has moved.
    """
    has_moved = False
    while groups := {
        (number, side): Failing(each.column, each.item.original, of_side)
        for number, (each, rows) in enumerate(zip(ends, failures, strict=True))
        for side, of_side in enumerate(_by_side(each, rows))
        if len(of_side)
    }:
        found = last_safe_values([*groups.values()], partial(model.are_unsafe, stage=ALONE_STAGE))
        for (number, side), (safe, failure) in zip(groups, found, strict=True):
            ends[number].ends[side] = safe
            ends[number].beyond[side] = failure, model
            ends[number].failures.append(failure)
        has_moved = True
    return has_moved


def _by_side(ends: _Ends, failures: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The failures within the ends, below and above the original."""
    values = failures[:, ends.column]
    original = ends.item.original
    below = failures[(values >= ends.ends[0]) & (values < original)]
    above = failures[(values > original) & (values <= ends.ends[1])]
    return below, above


def _falsify_alone(ends: Sequence[_Ends], model: Model, budget: int) -> None:
    """Falsify the limits in encounters that no scan met, until nothing is found."""
    members = model.characteristics
    seed = model.evaluator.seed
    judges = judges_of([model], "falsification of limits alone")
    waiting = [*ends]
    nothing = np.zeros((0, len(members)))
    size = max(budget // GENERATIONS, 1)
    for number in range(FALSIFICATIONS):
        boxes = list[Box]()
        known = list[list[FloatArray]]()
        rngs = [Stream.LIMITS_ALONE.generator(seed, each.column, number) for each in waiting]
        for each, rng in zip(waiting, rngs, strict=True):
            lower = np.where(members.of_vehicle, members.original, members.lower)
            upper = np.where(members.of_vehicle, members.original, members.upper)
            limit = each.limit().safe
            assert limit is not None
            lower[each.column], upper[each.column] = limit
            boxes.append(Box(model.evaluator.region, lower, upper))
            at_limit = boxes[-1].draw(size, rng)
            at_limit[:, each.column] = np.resize(limit, len(at_limit))  # both ends in turn
            known.append([at_limit])
        found = [each.failures for each in falsify_all(boxes, judges, known, budget, rngs, size)]
        _move(waiting, model, [failures.get(0, nothing) for failures in found])
        waiting = [each for each, failures in zip(waiting, found, strict=True) if failures]
        if not waiting:
            return
    for each in waiting:
        each.give_up()
