"""Limits of each characteristic alone that hold in all fits, between the points of a matrix and in all encounters."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.attack import attack_all
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.evaluator import Interval
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.tolerance.scans import OneAtATimeScan
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.vehicles import Characteristic

VALUES = 17
"""Number of values of what is safe alone in the study's own fit that are simulated in each model."""
PARTS, ROUNDS = 8, 4
"""Each of `ROUNDS` rounds divides the interval from a safe to an unsafe value into `PARTS` parts."""
MOVED_BEFORE = 8
"""Number of failures, the nearest to the original, in whose encounters a limit is safe at once."""
ATTACKS, ATTACK_SHARE, GENERATIONS = 3, 0.1, 5
"""Largest number of attacks on a limit, in a study that searches its scenario; the share of `--attack` of each, and its
number of generations.
"""
ALONE_STAGE = "limits alone with each fit"


class AloneLimit(NamedTuple):
    """How far one characteristic may go, all others as in the original, in all models.

    Attributes
    ----------
    safe
        The safe interval around the original, rounded inwards; ends of the domain stay. None if the original is unsafe.
    beyond
        A setting just beyond each end, and the model in which it is unsafe; None where nothing is known to be.
    """

    scan: OneAtATimeScan
    safe: Interval | None
    beyond: tuple[tuple[FloatArray, Model] | None, tuple[FloatArray, Model] | None] = (None, None)

    @property
    def characteristic(self) -> Characteristic:
        return self.scan.characteristic


class _Ends:
    """The ends of what is safe of one characteristic, which failures move towards the original."""

    def __init__(self, scan: OneAtATimeScan, column: int, own: Model) -> None:
        item = scan.characteristic
        assert scan.safe is not None
        self.item, self.column, self.scan = item, column, scan
        self.ends, members = [*scan.safe], own.evaluator.characteristics
        self.beyond: list[tuple[FloatArray, Model] | None] = [None, None]
        for side, last in enumerate((item.lower, item.upper)):
            values = [value for pair in scan.of_state("unsafe") for value in pair]
            outside = [value for value in values if (value < self.ends[0], value > self.ends[1])[side]]
            if self.ends[side] != last and outside:
                nearest = min(outside, key=lambda value: abs(value - item.original))
                self.beyond[side] = members.setting({item.name: nearest}), own

    def limit(self) -> AloneLimit:
        item, (low, high) = self.item, self.ends
        safe = (
            low if low <= item.lower else item.rounded(low, upwards=True),
            high if high >= item.upper else item.rounded(high, upwards=False),
        )
        return AloneLimit(self.scan, safe, (self.beyond[0], self.beyond[1]))


class _Move:
    """The move of one end between the original and the nearest of some failures, shape (K, n): to the last value before
    it that is safe in the encounters of them all.
    """

    def __init__(self, ends: _Ends, side: int, failures: FloatArray) -> None:
        self.ends, self.side = ends, side
        distances = np.abs(failures[:, ends.column] - ends.item.original)
        self.encounters = failures[np.argsort(distances, kind="stable")[:MOVED_BEFORE]]
        self.failure = self.encounters[0]
        self.safe = ends.item.original

    @property
    def values(self) -> FloatArray:
        unsafe = self.failure[self.ends.column]
        return np.asarray(self.safe + (unsafe - self.safe) * np.arange(1, PARTS) / PARTS)

    @property
    def settings(self) -> FloatArray:
        """The settings of a round, shape (K (`PARTS` - 1), n)."""
        settings = np.repeat(self.encounters, PARTS - 1, axis=0)
        settings[:, self.ends.column] = np.tile(self.values, len(self.encounters))
        return settings

    def narrow(self, are_unsafe: BoolArray) -> None:
        """Take what a round gave."""
        is_unsafe, values = are_unsafe.reshape(len(self.encounters), PARTS - 1), self.values
        first = int(np.argmax(np.append(is_unsafe.any(axis=0), True)))
        self.safe = self.safe if first == 0 else float(values[first - 1])
        if first < len(values):
            self.failure = self.encounters[np.argmax(is_unsafe[:, first])].copy()
            self.failure[self.ends.column] = values[first]

    def end(self, model: Model) -> None:
        self.ends.ends[self.side] = self.safe
        self.ends.beyond[self.side] = self.failure, model


def limits_alone(
    scans: Sequence[OneAtATimeScan],
    columns: Sequence[int],
    models: Sequence[Model],
    budget: int,
    met: Sequence[Model],
    failures: FloatArray,
) -> list[AloneLimit]:
    """The limits alone that hold in all models, from scans with the study's own fit, the first model; and before the
    failures of one characteristic that the search for limits together met in some models, shape (K, n).
    """
    if any(scan.safe is None for scan in scans):
        return [AloneLimit(scan, None) for scan in scans]
    ends = [_Ends(scan, column, models[0]) for scan, column in zip(scans, columns, strict=True)]
    encounters = models[0].evaluator.critical_encounters
    encounters = np.concatenate([models[0].evaluator.characteristics.original[np.newaxis], encounters])
    for model in models:
        _move_before(ends, model, encounters, VALUES)
        while _move_before(ends, model, encounters, 2):
            pass
    for model in met if len(failures) else ():
        _move(ends, model, [_alone_in(each, failures, model) for each in ends])
    if len(models[0].evaluator.characteristics.scenario) and budget:
        _attack_alone(ends, models, round(ATTACK_SHARE * budget))
    return [each.limit() for each in ends]


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
    while moves := [
        _Move(each, side, of_side)
        for each, rows in zip(ends, failures, strict=True)
        for side, of_side in enumerate(_by_side(each, rows))
        if len(of_side)
    ]:
        for _ in range(ROUNDS):
            settings = [each.settings for each in moves]
            are_unsafe = model.are_unsafe(np.concatenate(settings), ALONE_STAGE)
            parts = np.split(are_unsafe, np.cumsum([*map(len, settings)])[:-1])
            for each, part in zip(moves, parts, strict=True):
                each.narrow(part)
        for each in moves:
            each.end(model)
        has_moved = True
    return has_moved


def _by_side(ends: _Ends, failures: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The failures within the ends, below and above the original."""
    values, original = failures[:, ends.column], ends.item.original
    below = failures[(values >= ends.ends[0]) & (values < original)]
    above = failures[(values > original) & (values <= ends.ends[1])]
    return below, above


def _attack_alone(ends: Sequence[_Ends], models: Sequence[Model], budget: int) -> None:
    """Attack the limits in encounters that no scan met, until nothing is found."""
    members, seed = models[0].evaluator.characteristics, models[0].evaluator.study.search.seed
    judges = [partial(model.left, stage="attack on limits alone") for model in models]
    waiting = [*ends]
    for number in range(ATTACKS):
        boxes = list[Box]()
        for each in waiting:
            lower = np.where(members.of_vehicle, members.original, members.lower)
            upper = np.where(members.of_vehicle, members.original, members.upper)
            limit = each.limit().safe
            assert limit is not None
            lower[each.column], upper[each.column] = limit
            boxes.append(Box(models[0].evaluator.region, lower, upper))
        rngs = [np.random.default_rng((seed, 6, each.column, number)) for each in waiting]
        found = attack_all(boxes, judges, [()] * len(boxes), budget, rngs, max(budget // GENERATIONS, 1))
        for judge, model in enumerate(models):
            _move(waiting, model, [one.settings[(one.left < 0) & (one.judges == judge)] for one in found])
        waiting = [each for each, one in zip(waiting, found, strict=True) if (one.left < 0).any()]
        if not waiting:
            break
