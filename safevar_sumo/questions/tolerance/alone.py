"""Limits of each characteristic alone that hold in all fits, between the points of a matrix and in all encounters."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.attack import attack_all
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.sampling import Interval
from safevar_sumo.questions.tolerance.scans import OneAtATimeScan
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.vehicles import Characteristic

VALUES = 17
"""Number of values of what is safe alone in the study's own fit that are simulated in each model."""
PARTS, ROUNDS = 8, 4
"""Each of `ROUNDS` rounds divides the interval from a safe to an unsafe value into `PARTS` parts."""
MOVED_BEFORE = 8
"""Number of failures, the nearest to the original, in whose encounters a limit is safe at once."""
ATTACKS, ATTACK_SHARE, GENERATIONS = 8, 0.1, 5
"""Largest number of attacks on a limit, in a study that searches its scenario; the share of `--attack` of each, and its
number of generations, the first at the limit itself.
"""
ALONE_STAGE = "limits alone with each fit"
Beyond = tuple[FloatArray, Model] | None
"""A setting just beyond a limit, and the model in which it is unsafe; None where nothing is known to be."""


class AloneLimit(NamedTuple):
    """How far one characteristic may go, all others as in the original, in all models.

    Attributes
    ----------
    safe
        The safe interval around the original, rounded inwards; ends of the domain stay. None if the original is unsafe.
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
        """What is safe in the scan with the study's own fit, rounded inwards."""
        return None if self.scan.safe is None else self.characteristic.rounded_inwards(self.scan.safe)

    @property
    def nearest_failure(self) -> Beyond:
        """What is beyond the end that is nearer to the original."""
        return min(filter(None, self.beyond), key=lambda pair: self._change(*pair), default=None)

    def _change(self, setting: FloatArray, model: Model) -> float:
        column = model.evaluator.characteristics.names.index(self.characteristic.name)
        return abs(float(setting[column]) - self.characteristic.original)


class _Ends:
    """The ends of what is safe of one characteristic, which failures move towards the original."""

    def __init__(self, scan: OneAtATimeScan, column: int, own: Model) -> None:
        item = scan.characteristic
        assert scan.safe is not None
        self.item = item
        self.column = column
        self.scan = scan
        self.ends = [*scan.safe]
        members = own.evaluator.characteristics
        self.failures = list[FloatArray]()
        self.beyond: list[Beyond] = [None, None]
        for side, last in enumerate((item.lower, item.upper)):
            values = [value for pair in scan.of_state("unsafe") for value in pair]
            outside = [value for value in values if (value < self.ends[0] if side == 0 else value > self.ends[1])]
            if self.ends[side] != last and outside:
                nearest = min(outside, key=lambda value: abs(value - item.original))
                self.beyond[side] = members.setting({item.name: nearest}), own

    def limit(self) -> AloneLimit:
        safe = self.item.rounded_inwards((self.ends[0], self.ends[1]))
        return AloneLimit(self.scan, safe, (self.beyond[0], self.beyond[1]))


class Move:
    """The move of an end of one column between a safe value and the nearest of some failures, shape (K, n): to the last
    value before it that is safe in the encounters of them all.

    Attributes
    ----------
    safe, failure
        The last safe value, and the failure just beyond it, shape (n,).
    """

    def __init__(self, column: int, start: float, failures: FloatArray) -> None:
        self.column = column
        self.safe = start
        order = np.argsort(np.abs(failures[:, column] - start), kind="stable")
        self.encounters = failures[order[:MOVED_BEFORE]]
        self.failure = self.encounters[0]

    @property
    def _values(self) -> FloatArray:
        """The values of a round."""
        return np.asarray(self.safe + (self.failure[self.column] - self.safe) * np.arange(1, PARTS) / PARTS)

    @property
    def settings(self) -> FloatArray:
        """The settings of a round, shape (K (`PARTS` - 1), n)."""
        settings = np.repeat(self.encounters, PARTS - 1, axis=0)
        settings[:, self.column] = np.tile(self._values, len(self.encounters))
        return settings

    def narrow(self, are_unsafe: BoolArray) -> None:
        """Take what a round gave."""
        is_unsafe = are_unsafe.reshape(len(self.encounters), PARTS - 1)
        values = self._values
        first = int(np.argmax(np.append(is_unsafe.any(axis=0), True)))
        self.safe = self.safe if first == 0 else float(values[first - 1])
        if first < len(values):
            self.failure = self.encounters[np.argmax(is_unsafe[:, first])].copy()
            self.failure[self.column] = values[first]


def carry_out(moves: Sequence[Move], model: Model) -> None:
    """Carry out moves before failures in a model, side by side."""
    for _ in range(ROUNDS):
        settings = [each.settings for each in moves]
        are_unsafe = model.are_unsafe(np.concatenate(settings), ALONE_STAGE)
        parts = np.split(are_unsafe, np.cumsum([*map(len, settings)])[:-1])
        for each, part in zip(moves, parts, strict=True):
            each.narrow(part)


class AloneSearch:
    """The search for limits alone that hold in all models, each at some `values`, from scans with the study's own fit,
    the first model.
    """

    def __init__(
        self, scans: Sequence[OneAtATimeScan], columns: Sequence[int], models: Sequence[Model], values: int = VALUES
    ) -> None:
        self.scans = scans
        self.models = models
        self.values = values
        self.ends = list[_Ends]()  # none where the original is unsafe
        if all(scan.safe is not None for scan in scans):
            self.ends = [_Ends(scan, column, models[0]) for scan, column in zip(scans, columns, strict=True)]

    def run(self, budget: int) -> None:
        """Try values in all models, in the encounters that the scans met and in those of an attack on the limits."""
        evaluator = self.models[0].evaluator
        encounters = np.concatenate([[evaluator.characteristics.original], evaluator.critical_encounters])
        for model in self.models if self.ends else ():
            _move_before(self.ends, model, encounters, self.values)
            while _move_before(self.ends, model, encounters, 2):  # the ends alone, until all are safe
                pass
        if len(evaluator.characteristics.scenario) and budget:
            _attack_alone(self.ends, self.models, round(ATTACK_SHARE * budget))

    def meet(self, models: Sequence[Model], failures: FloatArray) -> None:
        """Move the limits before failures that another search met, each of one characteristic, shape (K, n)."""
        for model in models if len(failures) and self.ends else ():
            _move(self.ends, model, [_alone_in(each, failures, model) for each in self.ends])

    @property
    def failures(self) -> FloatArray:
        """Settings beyond the limits that failed in some model, shape (K, n)."""
        rows = [failure for each in self.ends for failure in each.failures]
        return np.array(rows).reshape(-1, len(self.models[0].evaluator.characteristics))

    def limits(self) -> list[AloneLimit]:
        return [each.limit() for each in self.ends] or [AloneLimit(scan, None) for scan in self.scans]


def _move_before(ends: Sequence[_Ends], model: Model, encounters: FloatArray, number: int) -> bool:
    """Move ends before the failures at some values between them, the ends among them, in each of some encounters;
    whether one has moved.
    """
    settings = [_settings_within(each, encounters, number) for each in ends]
    lefts = np.split(model.left(np.concatenate(settings), ALONE_STAGE), np.cumsum([*map(len, settings)])[:-1])
    return _move(ends, model, [rows[left < 0] for rows, left in zip(settings, lefts, strict=True)])


def _settings_within(ends: _Ends, encounters: FloatArray, number: int) -> FloatArray:
    """Settings at values between the ends, in each of some encounters, shape (K, n)."""
    low, high = ends.ends
    values = np.linspace(low, high, number)
    settings = np.repeat(encounters, len(values), axis=0)
    settings[:, ends.column] = np.tile(values, len(encounters))
    return settings


def _alone_in(ends: _Ends, failures: FloatArray, model: Model) -> FloatArray:
    """Those of some settings that change this characteristic, within its ends, and are unsafe in a model."""
    values = failures[:, ends.column]
    inside = failures[(values != ends.item.original) & (values >= ends.ends[0]) & (values <= ends.ends[1])]
    return np.asarray(inside[model.are_unsafe(inside, ALONE_STAGE)]) if len(inside) else inside


def _move(ends: Sequence[_Ends], model: Model, failures: Sequence[FloatArray]) -> bool:
    """Move all ends before their failures in a model at once; those that are outside then do not matter. Whether any
    end has moved.
    """
    has_moved = False
    while moves := {
        (number, side): Move(each.column, each.item.original, of_side)
        for number, (each, rows) in enumerate(zip(ends, failures, strict=True))
        for side, of_side in enumerate(_by_side(each, rows))
        if len(of_side)
    }:
        carry_out([*moves.values()], model)
        for (number, side), move in moves.items():
            ends[number].ends[side] = move.safe
            ends[number].beyond[side] = move.failure, model
            ends[number].failures.append(move.failure)
        has_moved = True
    return has_moved


def _by_side(ends: _Ends, failures: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The failures within the ends, below and above the original."""
    values = failures[:, ends.column]
    original = ends.item.original
    below = failures[(values >= ends.ends[0]) & (values < original)]
    above = failures[(values > original) & (values <= ends.ends[1])]
    return below, above


def _attack_alone(ends: Sequence[_Ends], models: Sequence[Model], budget: int) -> None:
    """Attack the limits in encounters that no scan met, until nothing is found."""
    members = models[0].evaluator.characteristics
    seed = models[0].evaluator.study.search.seed
    judges = [partial(model.left, stage="attack on limits alone") for model in models]
    waiting = [*ends]
    size = max(budget // GENERATIONS, 1)
    for number in range(ATTACKS):
        boxes = list[Box]()
        known = list[list[FloatArray]]()
        rngs = [np.random.default_rng((seed, 6, each.column, number)) for each in waiting]
        for each, rng in zip(waiting, rngs, strict=True):
            lower = np.where(members.of_vehicle, members.original, members.lower)
            upper = np.where(members.of_vehicle, members.original, members.upper)
            limit = each.limit().safe
            assert limit is not None
            lower[each.column], upper[each.column] = limit
            boxes.append(Box(models[0].evaluator.region, lower, upper))
            at_limit = boxes[-1].draw(size, rng)
            at_limit[:, each.column] = np.resize(limit, len(at_limit))  # both ends in turn
            known.append(np.array_split(at_limit, len(models)))
        found = attack_all(boxes, judges, known, budget, rngs, size)
        for judge, model in enumerate(models):
            _move(waiting, model, [one.settings[(one.left < 0) & (one.judges == judge)] for one in found])
        waiting = [each for each, one in zip(waiting, found, strict=True) if (one.left < 0).any()]
        if not waiting:
            break
