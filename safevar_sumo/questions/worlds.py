"""The worlds in which a question drives vehicles: one for each test and each parameter set of the
vehicle model. A world turns drives into settings, which its evaluator simulates. A question gives
its bench the rule of which drives count in these worlds: a failure that does not count says nothing
about what the question asks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.between import in_ranges
from safevar_sumo.questions.drives import Drives, Encounters
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.part import moving_axes, points_of_tests
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import PHASE, MatrixTest
from safevar_sumo.sumo.system import assemble


@dataclass(frozen=True)
class DrivenWorld:
    """A world holds encounters that are simulated with one parameter set of the vehicle model.

    Attributes
    ----------
    model
        The parameter set. Its settings are a vehicle and then the values of the axes of encounters.
        If encounters have a phase, the phase is the last value.
    test
        The test of the matrix, with the listed values of its axes, if axes of the test move; None
        for the world of all other encounters.
    """

    model: Model
    test: MatrixTest | None = None

    @property
    def has_phase(self) -> bool:
        """Whether encounters of this world have a phase; otherwise it is ignored."""
        return PHASE in self.model.characteristics.scenario.names

    @property
    def axes(self) -> int:
        """The number of axes whose shares this world uses."""
        return len(self.model.characteristics.scenario) - self.has_phase

    def settings(self, drives: Drives) -> FloatArray:
        """The settings of M drives in this world, shape (M, n + axes + 1), with encounters rounded
        to the digits that answers print.
        """
        settings = np.hstack([drives.vehicle, self.values(drives.encounters)])
        return self.model.characteristics.with_printed_encounters(settings)

    def values(self, encounters: Encounters) -> FloatArray:
        """The values of the axes, and the phase, of E encounters, shape (E, axes + 1)."""
        return self.in_ranges(encounters.place[:, : self.axes], encounters.phase)

    def in_ranges(self, shares: FloatArray, phase: FloatArray) -> FloatArray:
        """The values at shares of the ranges of the axes; the phase is the last value, if any."""
        axes = self.model.characteristics.scenario
        if self.has_phase:
            shares = np.column_stack([shares, phase])
        return axes.lower + shares * (axes.upper - axes.lower)

    def listed(self) -> FloatArray:
        """The shares of the axes of the E listed encounters, shape (E, axes).

        If the study has ranges of encounters in place of lists, the encounters are the original one
        and those in which the original vehicle is least safe.
        """
        axes = self.model.characteristics.scenario
        if self.test is None:
            evaluator = self.model.evaluator
            count = len(evaluator.characteristics.vehicle)
            hardest = evaluator.critical_encounters[:, count:]
            rows = np.vstack([axes.original, hardest])
        else:
            values = []
            for name in axes.names:
                values.append([0.0] if name == PHASE else self.test.axes[name].at)
            rows = np.array(list(product(*values)))
        shares = (rows - axes.lower) / (axes.upper - axes.lower)
        return shares[:, : self.axes]


def worlds_of(models: Sequence[Model], *, between: bool) -> list[DrivenWorld]:
    """The worlds of some parameter sets. With `between`, each test with moving axes has a world,
    whose encounters lie between the test's listed values, too. All other encounters of a set share
    one world.
    """
    worlds = []
    for model in models:
        worlds += _worlds_of_set(model, between=between)
    return worlds


def _worlds_of_set(model: Model, *, between: bool) -> list[DrivenWorld]:
    moving = moving_tests(model) if between else []
    worlds = [DrivenWorld(alone.in_phases or alone, test) for test, alone in moving]
    names = {test.name for test, _ in moving}
    evaluator = model.evaluator
    standing = [test for test in evaluator.study.tests if test.name not in names]
    if moving and standing:
        study = evaluator.study.with_tests(standing)
        model = model._replace(evaluator=evaluator.for_study(study, verified=0))
    if standing or not moving:
        worlds.append(DrivenWorld(model.in_phases or model))
    return worlds


def moving_tests(model: Model) -> list[tuple[MatrixTest, Model]]:
    """The tests of a model's matrix that have moving axes, each with a model of this test alone. In
    this model the moving axes are ranges, from the least to the greatest listed value.
    """
    study = model.evaluator.study
    tests = []
    for test, points in points_of_tests(study, assemble(study).points):
        axes = moving_axes(study, test, points)
        lists = study.lists_of(test)
        # An axis with one value does not move.
        domains = {name: axes[name] for name in axes if len(lists[name]) > 1}
        if test and domains:
            listed = replace_in(test, over={**lists})
            evaluator = model.evaluator.for_study(
                in_ranges(study, [(listed, domains)]), verified=0
            )
            tests.append((listed, model._replace(evaluator=evaluator)))
    return tests


class Rule(NamedTuple):
    """The rule of a question. The bench asks it only about drives that satisfy the constraints, and
    that are unsafe or cannot be simulated: all safe drives count.

    Attributes
    ----------
    counts
        Says which of M drives count, shape (M,). If it simulates for this, progress is shown for
        the stage that it is given.
    further
        The largest number of drives that it simulates to decide about one drive.
    """

    counts: Callable[[Drives, str], BoolArray]
    further: int = 0


def _count_all(drives: Drives, stage: str) -> BoolArray:
    return np.ones(len(drives), dtype=bool)


EVERY_DRIVE = Rule(_count_all)
"""The rule by which every drive counts."""


def where_original_is_safe(worlds: Sequence[DrivenWorld], unsafe: Unsafe) -> Rule:
    """The rule by which a drive counts if the original vehicle is safe in its encounter by the
    criterion `unsafe`: otherwise a failure says nothing about changes of the vehicle. Listed
    encounters count anyway. The original vehicle drives in each encounter only once.
    """
    known = dict[bytes, bool]()

    def is_safe_in(encounters: Encounters, stage: str) -> BoolArray:
        """Whether the original vehicle is safe in each of E encounters, shape (E,)."""
        is_safe = np.ones(len(encounters), dtype=bool)
        for number, rows in encounters.by_world():
            world = worlds[number]
            if world.test is not None:
                model = world.model
                original = model.characteristics.vehicle.original_settings
                drives = Drives.product(original, encounters[rows])
                runs = model.evaluator.evaluate(world.settings(drives), stage)
                is_safe[rows] = runs.valid & ~unsafe.of(runs)
        return is_safe

    def counts(drives: Drives, stage: str) -> BoolArray:
        keys = drives.encounters.identities()
        rows = {key: row for row, key in enumerate(keys) if key not in known}
        unknown = drives.encounters[np.array(list(rows.values()), dtype=np.intp)]
        known.update(zip(rows, is_safe_in(unknown, stage).tolist(), strict=True))
        return np.array([known[key] for key in keys], dtype=bool)

    has_moving_tests = any(world.test is not None for world in worlds)
    return Rule(counts, further=int(has_moving_tests))
