"""Limits of each characteristic alone that hold in all fits, between the points of a matrix and in all encounters."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.attack import attack
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
ATTACKS, ATTACK_SHARE = 3, 0.1
"""Largest number of attacks on a limit, in a study that searches its scenario; the share of `--attack` of each."""
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
                self.beyond[side] = members.setting({item.name: nearest}, item.name), own

    def move(self, model: Model, failure: FloatArray) -> None:
        """Move an end between the original and a failure: to the last safe value before it, in that encounter."""
        value = failure[self.column]
        side = int(value > self.item.original)
        safe, unsafe = self.item.original, value
        for _ in range(ROUNDS):
            values = safe + (unsafe - safe) * np.arange(1, PARTS + 1) / PARTS
            settings = np.tile(failure, (PARTS, 1))
            settings[:, self.column] = values
            first = int(np.argmax([*model.are_unsafe(settings[:-1], ALONE_STAGE), True]))
            safe, unsafe = (safe if first == 0 else values[first - 1]), values[first]
        self.ends[side] = float(safe)
        beyond = failure.copy()
        beyond[self.column] = unsafe
        self.beyond[side] = beyond, model

    def limit(self) -> AloneLimit:
        item, (low, high) = self.item, self.ends
        safe = (
            low if low <= item.lower else item.rounded(low, upwards=True),
            high if high >= item.upper else item.rounded(high, upwards=False),
        )
        return AloneLimit(self.scan, safe, (self.beyond[0], self.beyond[1]))


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
        settings = [_settings_within(each, encounters) for each in ends]
        lefts = np.split(model.left(np.concatenate(settings), ALONE_STAGE), np.cumsum([*map(len, settings)])[:-1])
        for each, rows, left in zip(ends, settings, lefts, strict=True):
            _move(each, model, rows[left < 0])
    for each in ends:
        values = failures[:, each.column]
        inside = failures[(values != each.item.original) & (values >= each.ends[0]) & (values <= each.ends[1])]
        for model in met if len(inside) else ():
            _move(each, model, inside[model.are_unsafe(inside, ALONE_STAGE)])
    if len(models[0].evaluator.characteristics.scenario) and budget:
        for each in ends:
            _attack_alone(each, models, round(ATTACK_SHARE * budget))
    return [each.limit() for each in ends]


def _settings_within(ends: _Ends, encounters: FloatArray) -> FloatArray:
    """Settings at values between the ends, in each of some encounters, shape (K, n)."""
    low, high = ends.ends
    values = np.linspace(low, high, VALUES)
    settings = np.repeat(encounters, len(values), axis=0)
    settings[:, ends.column] = np.tile(values, len(encounters))
    return settings


def _move(ends: _Ends, model: Model, failures: FloatArray) -> None:
    """Move the ends before failures, the nearest to the original first; those that are outside then do not matter."""
    order = np.argsort(np.abs(failures[:, ends.column] - ends.item.original), kind="stable")
    for failure in failures[order]:
        if ends.ends[0] <= failure[ends.column] <= ends.ends[1]:
            ends.move(model, failure)


def _attack_alone(ends: _Ends, models: Sequence[Model], budget: int) -> None:
    """Attack a limit in encounters that no scan met, until nothing is found."""
    characteristics, column = models[0].evaluator.characteristics, ends.column
    judges = [partial(model.left, stage="attack on limits alone") for model in models]
    for number in range(ATTACKS):
        lower = np.where(characteristics.of_vehicle, characteristics.original, characteristics.lower)
        upper = np.where(characteristics.of_vehicle, characteristics.original, characteristics.upper)
        limit = ends.limit().safe
        assert limit is not None
        lower[column], upper[column] = limit
        rng = np.random.default_rng((models[0].evaluator.study.search.seed, 6, column, number))
        found = attack(Box(models[0].evaluator.region, lower, upper), judges, [], budget, rng)
        is_unsafe: BoolArray = found.left < 0
        if not is_unsafe.any():
            break
        for judge in np.unique(found.judges[is_unsafe]):
            _move(ends, models[judge], found.settings[is_unsafe & (found.judges == judge)])
