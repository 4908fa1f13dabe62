"""What cases leave to the limit: the worlds in which vehicles drive, one for each test and each
parameter set of the vehicle model, and their simulations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.between import in_ranges
from safevar_sumo.questions.cases import Space
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.part import moving_axes, points_of_tests
from safevar_sumo.records import BoolArray, FloatArray, IntArray
from safevar_sumo.study import PHASE, MatrixTest
from safevar_sumo.sumo.simulators import simulations_of_setting
from safevar_sumo.sumo.system import assemble

STAGE = "limits"


class Exhausted(InputError):
    """Fewer simulations may follow than are asked for."""


class CaseWorld(NamedTuple):
    """Encounters with one parameter set: a model in which the axes of encounters are parameters,
    the phase last if they have one; and the test of the matrix with the values of its axes, if it
    moves.
    """

    model: Model
    test: MatrixTest | None = None

    @property
    def has_phase(self) -> bool:
        """Whether an encounter has a phase."""
        return PHASE in self.model.characteristics.scenario.names

    @property
    def places(self) -> int:
        """The number of places of a case: the phase, then each other axis."""
        return 1 + len(self.model.characteristics.scenario) - self.has_phase

    def settings(
        self,
        vehicles: FloatArray,
        places: FloatArray,
    ) -> FloatArray:
        """Vehicles, shape (M, n), at places, shape (M, k), as they are printed."""
        members = self.model.characteristics
        axes = members.scenario
        shares = places[:, 1 : self.places]
        if self.has_phase:
            shares = np.hstack([shares, places[:, :1]])
        encounters = axes.lower + shares * (axes.upper - axes.lower)
        return members.with_printed_encounters(np.hstack([vehicles, encounters]))

    def listed(self) -> FloatArray:
        """The places of its listed encounters, shape (E, k), at phase 0; of ranges, those at which
        the original vehicle leaves least.
        """
        axes = self.model.characteristics.scenario
        if self.test is None:
            evaluator = self.model.evaluator
            count = len(evaluator.characteristics.vehicle)
            hardest = evaluator.critical_encounters[:, count:]
            rows = np.vstack([axes.original, hardest])
        else:
            values = [
                [0.0] if name == PHASE else self.test.axes[name].at
                for name in axes.names
            ]
            rows = np.array([*product(*values)]).reshape(-1, len(axes))
        shares = (rows - axes.lower) / (axes.upper - axes.lower)
        phases = np.zeros((len(shares), 1))
        return np.hstack([phases, shares[:, : self.places - 1]])


class Oracle:
    """What cases leave to the limit.

    Attributes
    ----------
    worlds
        Those of the study's own parameter set, then of each other one.
    fits
        The number of the parameter set of each world.
    places
        The number of places of a case.
    own
        The model with the study's own parameter set.
    phases
        The progress of the question.
    """

    def __init__(
        self,
        models: Sequence[Model],
        new_car: Unsafe,
        *,
        between: bool,
    ) -> None:
        self.worlds = list[CaseWorld]()
        for model in models:
            self.worlds += worlds_of(
                model,
                new_car,
                between=between,
            )
        self.fits = [world.model.fit for world in self.worlds]
        self.places = max(world.places for world in self.worlds)
        self.own = models[0]
        self.vehicle = self.own.characteristics.vehicle
        evaluator = self.own.evaluator
        self.phases = evaluator.phases
        self._region = evaluator.region
        self._simulations = max(
            simulations_of_setting(world.model.evaluator.system)
            for world in self.worlds
        )
        self._tries_originals = any(
            world.model.new_car is not None for world in self.worlds
        )
        self._counts = dict[bytes, bool]()

    @property
    def available(self) -> float:
        """The number of cases that may follow; infinite without a limit."""
        evaluator = self.own.evaluator
        # The remark on phases, at last, drives the original vehicle twice.
        remark = 2 * len(evaluator.system.points)
        return (evaluator.account.left - remark) // self._simulations

    def __call__(self, cases: FloatArray, failed: float = np.inf) -> FloatArray:
        """What each of M cases leaves, shape (M,): below 0 it is unsafe, infinite where it does not
        count, and `failed` where it could not be simulated.
        """
        # Simulations of the original vehicle may follow.
        if (1 + self._tries_originals) * len(cases) > self.available:
            raise Exhausted(
                "simulations",
                "too few are left for the limits",
                "a larger number",
            )
        robustness = np.full(len(cases), np.inf)
        for number, rows, settings in self.in_worlds(cases):
            world = self.worlds[number]
            model = world.model
            runs = model.evaluate(settings, STAGE)
            of_world = model.robustness_by(runs)
            of_world[~(runs.valid | runs.infeasible)] = np.nan
            of_world[~model.evaluator.region.feasible(settings)] = np.inf
            unsafe = np.flatnonzero(of_world < 0)
            does_count = self._do_count(world, cases[rows[unsafe]])
            of_world[unsafe[~does_count]] = np.inf
            robustness[rows] = of_world
        return np.where(np.isnan(robustness), failed, robustness)

    def in_worlds(
        self,
        cases: FloatArray,
    ) -> Iterator[tuple[int, IntArray, FloatArray]]:
        """The numbers of the worlds of cases, each with their rows and their settings there."""
        n = len(self.vehicle)
        numbers = np.floor(cases[:, n]).astype(int)
        for number in np.unique(numbers).tolist():
            rows = np.flatnonzero(numbers == number)
            settings = self.worlds[number].settings(
                cases[rows, :n],
                cases[rows, n + 1 :],
            )
            yield number, rows, settings

    def _do_count(
        self,
        world: CaseWorld,
        cases: FloatArray,
    ) -> BoolArray:
        """Which cases of a world are encounters that count: in which the original is safe, too."""
        new_car = world.model.new_car
        if new_car is None or not len(cases):
            return np.ones(len(cases), dtype=bool)
        n = len(self.vehicle)
        keys = [case.tobytes() for case in cases[:, n:]]
        rows = {key: row for row, key in enumerate(keys) if key not in self._counts}
        if rows:
            places = cases[[*rows.values()], n + 1 :]
            originals = np.tile(self.vehicle.original, (len(rows), 1))
            runs = world.model.evaluate(world.settings(originals, places), STAGE)
            does_count = runs.valid & ~new_car.of(runs)
            self._counts |= dict(
                zip(
                    rows,
                    does_count.tolist(),
                    strict=True,
                )
            )
        return np.array([self._counts[key] for key in keys])

    def feasible(
        self,
        draw: Callable[[int], FloatArray],
        number: int,
    ) -> FloatArray:
        """So many drawn vehicles that satisfy the study's constraints."""
        n = len(self.vehicle)
        encounter = self._region.characteristics.original[n:]

        def draw_settings(count: int) -> FloatArray:
            return np.hstack([draw(count), np.tile(encounter, (count, 1))])

        return self._region.draw_feasible(draw_settings, number)[:, :n]

    def setting(self, case: FloatArray) -> tuple[Model, FloatArray]:
        """The model of a case, and its setting there."""
        n = len(self.vehicle)
        world = self.worlds[int(case[n])]
        rows = case[np.newaxis]
        (setting,) = world.settings(rows[:, :n], rows[:, n + 1 :])
        return world.model._replace(new_car=None), setting

    def space(
        self,
        fit: int,
        lower: FloatArray,
        upper: FloatArray,
        *,
        phases: bool = True,
    ) -> Space:
        """The cases of vehicles between two ends with a parameter set, at all phases or phase 0."""
        numbers = np.flatnonzero(np.equal(self.fits, fit))
        begin = np.zeros(1 + self.places)
        begin[0] = numbers[0]
        end = np.ones(1 + self.places)
        end[0] = np.nextafter(numbers[-1] + 1, 0)
        end[1] = phases
        return Space(np.append(lower, begin), np.append(upper, end), len(lower))

    def listed(self) -> FloatArray:
        """The listed encounters with the study's own parameter set: worlds and places, shape (E,
        1 + k).
        """
        tables = []
        for number in np.flatnonzero(np.equal(self.fits, 0)).tolist():
            places = self.worlds[number].listed()
            encounters = np.zeros((len(places), 1 + self.places))
            encounters[:, 0] = number
            encounters[:, 1 : 1 + places.shape[1]] = places
            tables.append(encounters)
        return np.vstack(tables)

    def hardest(self, number: float) -> FloatArray:
        """So many of the listed encounters: those in which the original vehicle leaves least."""
        encounters = self.listed()
        if number >= len(encounters):
            return encounters
        robustness = self(product_of(self.vehicle.original[np.newaxis], encounters))
        return encounters[np.argsort(robustness, kind="stable")[: int(number)]]


def product_of(vehicles: FloatArray, encounters: FloatArray) -> FloatArray:
    """Each vehicle in each encounter."""
    repeated = np.repeat(
        vehicles,
        len(encounters),
        axis=0,
    )
    return np.hstack([repeated, np.tile(encounters, (len(vehicles), 1))])


def worlds_of(
    model: Model,
    new_car: Unsafe,
    *,
    between: bool,
) -> list[CaseWorld]:
    """The worlds of a parameter set: each test that moves, and all other points together."""
    moving = moving_tests(model, new_car) if between else []
    worlds = [CaseWorld(alone.in_phases or alone, test) for test, alone in moving]
    names = {test.name for test, _ in moving}
    evaluator = model.evaluator
    standing = [test for test in evaluator.study.tests if test.name not in names]
    if moving and standing:
        study = evaluator.study.with_tests(standing)
        model = model._replace(evaluator=evaluator.for_study(study, verified=0))
    if standing or not moving:
        worlds.append(CaseWorld(model.in_phases or model))
    return worlds


def moving_tests(model: Model, new_car: Unsafe) -> list[tuple[MatrixTest, Model]]:
    """The tests of a model's matrix with axes that move, each with the model in this test alone,
    whose axes are ranges; an encounter counts unless the original is unsafe by `new_car` in it.
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
            # The original is simulated only where a vehicle fails.
            moving = Model(model.fit, evaluator, model.unsafe, new_car=new_car)
            tests.append((listed, moving))
    return tests
