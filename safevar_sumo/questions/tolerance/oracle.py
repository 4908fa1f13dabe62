"""The oracle simulates cases, and returns the robustness of each case. The robustness is the
distance of a simulated vehicle to the limit of the criterion, in the criterion's unit: below 0 the
case is unsafe.

A case is a row of 1 + n + k numbers, in this order:

- vehicle: n values, in the order of the vehicle's characteristics and in their units;
- world: one number, whose floor is an index into `Oracle.worlds`. A world is a test (or all tests
  without moving axes together) with one parameter set of the vehicle model;
- places: k numbers from 0 to 1. The first place is the phase (the moment between two decisions of
  the driving system at which the encounter begins). Each further place is the share of the range of
  one axis of encounters. A world with fewer axes than another one ignores the last places.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace as replace_in
from numpy.random import Generator

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.between import in_ranges
from safevar_sumo.questions.boundary import find_boundaries
from safevar_sumo.questions.cases import Space
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.part import moving_axes, points_of_tests
from safevar_sumo.records import BoolArray, FloatArray, IntArray
from safevar_sumo.study import PHASE, MatrixTest
from safevar_sumo.sumo.simulators import simulations_of_setting
from safevar_sumo.sumo.system import assemble

LIMITS_STAGE = "limits"
EDGE_PARTS = 4, 4, 4, 4
"""Into how many parts each round divides a line to an encounter that does not count."""


class Exhausted(InputError):
    """The question asks for more simulations than it still may do."""


class CaseWorld(NamedTuple):
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
        """Whether encounters of this world have a phase."""
        return PHASE in self.model.characteristics.scenario.names

    @property
    def places(self) -> int:
        """The number k of places that this world uses: 1 for the phase (also in a world without
        phases, which ignores this place), and 1 for each other axis.
        """
        return 1 + len(self.model.characteristics.scenario) - self.has_phase

    def settings(
        self,
        vehicles: FloatArray,
        places: FloatArray,
    ) -> FloatArray:
        """The settings of M cases, with encounters rounded to the digits that answers print.

        Parameters
        ----------
        vehicles
            Values of the vehicles, shape (M, n).
        places
            The phase and then the share of the range of each axis, from 0 to 1, shape (M, k). The
            array may have further columns, which only other worlds use.
        """
        members = self.model.characteristics
        axes = members.scenario
        # A case has the phase before the axes, but a setting has the phase last.
        shares = places[:, 1 : self.places]
        if self.has_phase:
            shares = np.hstack([shares, places[:, :1]])
        encounters = axes.lower + shares * (axes.upper - axes.lower)
        return members.with_printed_encounters(np.hstack([vehicles, encounters]))

    def listed(self) -> FloatArray:
        """The places of the E listed encounters of this world, at phase 0, shape (E, k).

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
            values = [
                [0.0] if name == PHASE else self.test.axes[name].at
                for name in axes.names
            ]
            rows = np.array(list(product(*values))).reshape(-1, len(axes))
        shares = (rows - axes.lower) / (axes.upper - axes.lower)
        phases = np.zeros((len(shares), 1))
        return np.hstack([phases, shares[:, : self.places - 1]])


class Oracle:
    """An oracle simulates cases, and returns the robustness of each case.

    Attributes
    ----------
    worlds
        The worlds of the study's own parameter set, followed by the worlds of each other set.
    fits
        The number of the parameter set of each world; worlds of the same set are adjacent.
    places
        The number k of places of a case, which is the largest number that a world uses.
    own
        The model with the study's own parameter set.
    vehicle
        The n characteristics of the vehicle.
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
        """The number of cases that may still be simulated; NaN if the question has no limit.

        Python computes infinity // n as NaN. No comparison with NaN is true, so no number of cases
        is too large then.
        """
        evaluator = self.own.evaluator
        # The answer's remark on phases drives the original vehicle twice, after all cases.
        remark = 2 * len(evaluator.system.points)
        return (evaluator.account.left - remark) // self._simulations

    def __call__(self, cases: FloatArray, failed: float = np.inf) -> FloatArray:
        """The robustness of each of M cases, shape (M,): below 0 the case is unsafe, and from 0 on
        it is safe.

        The robustness is infinite if the case does not count: its setting violates a constraint of
        the study, or the original vehicle is unsafe in its encounter, too. The robustness is
        `failed` if the case could not be simulated.

        Raises
        ------
        Exhausted
            If the simulations that are still allowed may not suffice.
        """
        # Each unsafe case may need one more simulation: of the original vehicle in its encounter.
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
            runs = model.evaluate(settings, LIMITS_STAGE)
            # NaN marks cases that could not be simulated, until `failed` replaces it at the end.
            of_world = model.robustness_by(runs, failed=np.nan)
            unsafe = np.flatnonzero(of_world < 0)
            does_count = self._do_count(world, cases[rows[unsafe]])
            of_world[unsafe[~does_count]] = np.inf
            robustness[rows] = of_world
        return np.where(np.isnan(robustness), failed, robustness)

    def in_worlds(
        self,
        cases: FloatArray,
    ) -> Iterator[tuple[int, IntArray, FloatArray]]:
        """For each world in which some of M cases drive: the number of the world, the rows of these
        cases, and the settings of these cases in this world.
        """
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
        """Which of M cases of one world count, shape (M,); see `Model.do_count`."""
        if world.model.new_car is None or not len(cases):
            return np.ones(len(cases), dtype=bool)
        n = len(self.vehicle)
        # World and places identify an encounter: the original drives in each one only once.
        keys = [case.tobytes() for case in cases[:, n:]]
        rows = {key: row for row, key in enumerate(keys) if key not in self._counts}
        if rows:
            places = cases[list(rows.values()), n + 1 :]
            originals = np.tile(self.vehicle.original, (len(rows), 1))
            does_count = world.model.do_count(
                world.settings(originals, places), LIMITS_STAGE
            )
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
        """`number` vehicles that satisfy the study's constraints, shape (number, n). The function
        `draw` returns as many random vehicles as it is asked for.
        """
        n = len(self.vehicle)
        encounter = self._region.characteristics.original[n:]

        def draw_settings(count: int) -> FloatArray:
            return np.hstack([draw(count), np.tile(encounter, (count, 1))])

        return self._region.draw_feasible(draw_settings, number)[:, :n]

    def setting(self, case: FloatArray) -> tuple[Model, FloatArray]:
        """The model in which a case, shape (n + 1 + k,), is simulated, and the setting of the case
        in this model.
        """
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
        """All cases with a parameter set: vehicles from `lower` to `upper`, each of shape (n,), in
        all worlds of this set, and at all places. Without `phases` the phase is always 0.
        """
        numbers = np.flatnonzero(np.equal(self.fits, fit))
        begin = np.zeros(1 + self.places)
        begin[0] = numbers[0]
        end = np.ones(1 + self.places)
        # The floor of the largest number is still the last world of the set.
        end[0] = np.nextafter(numbers[-1] + 1, 0)
        end[1] = phases
        return Space(np.append(lower, begin), np.append(upper, end), len(lower))

    def listed(self) -> FloatArray:
        """The E listed encounters of all worlds of the study's own parameter set: the number of the
        world and the places, shape (E, 1 + k).
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
        """The `number` listed encounters in which the original vehicle has the least robustness,
        shape (number, 1 + k); all listed encounters if there are fewer.
        """
        encounters = self.listed()
        if number >= len(encounters):
            return encounters
        robustness = self(product_of(self.vehicle.original[np.newaxis], encounters))
        return encounters[np.argsort(robustness, kind="stable")[: int(number)]]

    def edges(self, fit: int, number: int, rng: Generator) -> FloatArray:
        """Encounters with a parameter set that only just count, shape (E, 1 + k): next to them the
        original vehicle is unsafe. The encounters in which only other vehicles fail may be a sliver
        there, which no search meets that draws from all encounters.

        They are sought on `number` random lines, along each of which one place changes.
        """
        n = len(self.vehicle)
        original = self.vehicle.original
        if not number or self.places == 1:
            return np.zeros((0, 1 + self.places))
        starts = self.space(fit, original, original).draw(number, rng)
        # Two thirds of the places are at an end, as slivers are widest at the ends of ranges.
        starts[:, n + 1 :] = np.clip(3 * starts[:, n + 1 :] - 1, 0, 1)
        # No line leads along the phases, the first place.
        columns = rng.integers(n + 2, starts.shape[1], number)
        ends = starts.copy()
        ends[range(number), columns] = 1 - starts[range(number), columns]

        # From an encounter that counts to one that does not.
        do_count = np.isfinite(self(np.concatenate([starts, ends])))
        is_line = do_count[:number] & ~do_count[number:]
        edges = find_boundaries(
            starts[is_line],
            ends[is_line],
            lambda cases: np.isinf(self(cases)),
            EDGE_PARTS,
        )
        return edges.safe[:, n:]


def product_of(vehicles: FloatArray, encounters: FloatArray) -> FloatArray:
    """The cases of each of M vehicles, shape (M, n), in each of E encounters (world and places),
    shape (E, 1 + k). The result has shape (M * E, n + 1 + k); the cases of a vehicle are adjacent.
    """
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
    """The worlds of a parameter set. With `between`, each test with moving axes has a world, whose
    encounters lie between the test's listed values, too. All other test cases share one world.
    """
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
    """The tests of a model's matrix that have moving axes, each with a model of this test alone.

    In this model the moving axes are ranges, from the least to the greatest listed value. An
    encounter counts unless the original vehicle is unsafe in it by the criterion `new_car`.
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
            # Because of `new_car`, the original drives only where a vehicle has failed.
            moving = Model(model.fit, evaluator, model.unsafe, new_car=new_car)
            tests.append((listed, moving))
    return tests
