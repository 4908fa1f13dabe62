"""The encounters in which `permit` drives cars: for each test of a study, the range of a parameter
such as the speed. Every test is driven alone. An encounter counts even if the original vehicle is
not safe in it.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError, SimulationError, check_name
from safevar_sumo.questions.between import in_phases
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.part import points_of_tests
from safevar_sumo.questions.sampling import sobol_points
from safevar_sumo.records import FloatArray, IntArray
from safevar_sumo.scenarios import SPEED_DIMENSION, searchable_in, unit_of
from safevar_sumo.scenarios.declared import with_ranges
from safevar_sumo.study import PHASE, Study, unit_text
from safevar_sumo.study.encounters import are_numbers
from safevar_sumo.sumo.system import assemble

SPREAD_PLACES = 4
"""Number of Sobol points over the other parameters at which a vehicle is driven at each speed."""
MOST_ENDS = 4
"""A vehicle is also driven at all combinations of the ends of the first `MOST_ENDS` other
parameters. Each combination takes random ends of further parameters.
"""
SPEED_UNITS = ("km/h", "m/s", "")
"""Units of parameters that may be a speed."""
GRID_PHASES = 2
"""Number of phases (moments between two decisions of the driving system) at each of these points.
"""
MOST_VEHICLES = 16
"""Number of vehicles that stand for a box of cars at each of these points."""


class Span(NamedTuple):
    """The parameter over which vehicles are driven, such as the speed, and its range.

    Attributes
    ----------
    low
        The least value of all tests.
    high
        The value at which the first test ends: above it not all tests can be driven.
    ending
        The names of the tests that end at `high`, if other tests go on.
    tests_above
        The names of the tests that begin above `high`, and are not driven.
    """

    name: str
    unit: str
    low: float
    high: float
    ending: tuple[str, ...] = ()
    tests_above: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """The name of the parameter as it stands in a sentence."""
        return self.name.replace("_", " ")

    def text(self, value: float) -> str:
        """A value of the parameter, such as `35 km/h`."""
        return f"{value:g}{unit_text(self.unit)}"

    def range_text(self, value: float, *, with_low: bool = True) -> str:
        """The range up to a value in words: `from 10 up to 35 km/h`, or `up to 35 km/h`."""
        reached = self.text(value)
        if not with_low:
            return f"up to {reached}"
        return (
            f"from {self.low:g} up to {reached}"
            if value > self.low
            else f"at {reached} alone"
        )


class EncounterRange(NamedTuple):
    """The encounters of a test alone, with one parameter set.

    Attributes
    ----------
    test
        The name of the test; "" without a matrix.
    model
        A parameter set with a study that has only this test, and varies all parameters that may
        vary in the test.
    column
        The column of the parameter in a setting; None if the test has a single value of it.
    low, high
        The range of the parameter. `low` is minus infinity if the test has no such parameter: then
        a failure counts at every value.
    """

    test: str
    model: Model
    column: int | None
    low: float
    high: float

    @property
    def axes(self) -> IntArray:
        """The columns of all other parameters of the encounter; the phase comes last."""
        is_other = ~self.model.characteristics.of_vehicle
        if self.column is not None:
            is_other[self.column] = False
        return np.flatnonzero(is_other)

    def settings(self, vehicles: FloatArray, places: FloatArray) -> FloatArray:
        """The settings of M vehicles, each at the place in the same row, shape (M, n). Values of
        the encounter are rounded as they are printed.

        A place has the value of the parameter, and then the position of each other axis in its
        range, from 0 to 1.
        """
        members = self.model.characteristics
        axes = self.axes
        width = members.upper - members.lower
        settings = members.lower + np.zeros((len(places), 1))
        settings[:, : vehicles.shape[1]] = vehicles
        settings[:, axes] += places[:, 1 : 1 + len(axes)] * width[axes]
        if self.column is not None:
            settings[:, self.column] = places[:, 0]
        return members.with_printed_encounters(settings)

    def values_in(self, settings: FloatArray) -> FloatArray:
        """The value of the parameter in each of M settings, shape (M,)."""
        if self.column is None:
            return np.full(len(settings), self.low)
        return settings[:, self.column]

    def places(self, value: float) -> FloatArray:
        """The places at a value of the parameter, shape (P, 1 + other axes): Sobol points over the
        other axes and ends of their ranges, each at `GRID_PHASES` phases.
        """
        has_phase = self.model.characteristics.names[-1] == PHASE
        shares = unit_places(len(self.axes) - has_phase, value)
        if has_phase:
            # Each place is driven at one random phase in each of `GRID_PHASES` equal parts of a
            # step.
            parts = np.tile(np.arange(GRID_PHASES), len(shares))
            seed = zlib.crc32(np.array([value, len(shares)]).tobytes())
            rng = np.random.default_rng(seed)
            phases = (parts + rng.random(len(parts))) / GRID_PHASES
            shares = np.column_stack([np.repeat(shares, GRID_PHASES, axis=0), phases])
        return np.column_stack([np.full(len(shares), value), shares])

    def robustness(self, settings: FloatArray, stage: str) -> FloatArray:
        """The robustness of M settings (below 0: unsafe), shape (M,); infinity for a setting that
        violates a constraint (see `Model.robustness_by`).

        Raises
        ------
        SimulationError
            If a setting cannot be simulated: then no car may be called safe.
        """
        evaluations = self.model.evaluate(settings, stage)
        if evaluations.failed.any():
            reason = evaluations.reason(int(np.argmax(evaluations.failed)))
            raise SimulationError(
                f"a car cannot be simulated in test {self.test!r}: {reason}"
            )
        return self.model.robustness_by(evaluations)


@lru_cache(maxsize=4096)
def unit_places(dimensions: int, value: float) -> FloatArray:
    """Sobol points and corners of the unit cube, shape (P, dimensions). `value` seeds their choice,
    so that each speed gets points of its own.
    """
    if not dimensions:
        return np.zeros((1, 0))
    seed = zlib.crc32(np.array([value]).tobytes())
    corners = np.array(list(product((0.0, 1.0), repeat=min(dimensions, MOST_ENDS))))
    shape = len(corners), dimensions - corners.shape[1]
    further = np.random.default_rng(seed).integers(0, 2, size=shape)
    spread = sobol_points(SPREAD_PLACES, dimensions, seed)
    return np.concatenate([spread, np.hstack([corners, further])])


def span_of(study: Study, by: str | None) -> Span:
    """The range of the speed that the study calls `by`, by default `SPEED_DIMENSION`.

    Raises
    ------
    InputError
        If the study varies no such speed. The message names the speeds that the study varies.
    """
    study = with_ranges(study)
    tests = points_of_tests(study, assemble(study).points)

    # Only speeds are offered. A parameter without a unit may be a speed, too: parameters of a
    # simulator or of a scenario's file have no unit.
    units = {name: domain.unit for name, domain in study.ranges.items()}
    name = by or SPEED_DIMENSION
    ends = {}
    for test, (point, *_) in tests:
        searchable = searchable_in(point.scenario)
        lists = study.lists_of(test)
        for axis in filter(lambda axis: are_numbers(lists[axis]), lists):
            if axis in searchable or SPEED_DIMENSION in axis:
                units[axis] = unit_of(point.scenario, axis)
        values = lists.get(name, ())
        if domain := study.ranges_of(test).get(name):
            values = [domain.lower, domain.upper]
        if values and are_numbers(values):
            ends["" if test is None else test.name] = min(values), max(values)
    speeds = [name for name, unit in units.items() if unit in SPEED_UNITS]
    problem = (
        f"study {study.name!r} varies no {'speed' if by is None or not speeds else by}"
    )
    if not speeds:
        problem += ", and permit asks up to which speed a car is safe"
        raise InputError("permit", problem, "a study that varies a speed")
    check_name("by", problem, name, speeds)

    names = np.array(list(ends))
    lows, tops = np.transpose(list(ends.values())).astype(float)
    # The range ends where the first test ends.
    high = tops.min()
    goes_on = tops.max() > high
    ending = names[goes_on & (tops == high)]
    tests_above = names[lows > high]
    return Span(
        name=name,
        unit=units[name],
        low=float(lows.min()),
        high=float(high),
        ending=tuple(ending.tolist()),
        tests_above=tuple(tests_above.tolist()),
    )


def encounters_of(model: Model, span: Span) -> list[EncounterRange]:
    """The encounters of each test of a model, up to the end of `span`. Tests that begin above this
    end are left out.
    """
    ranges = []
    for test, alone, fixed in _tests_alone(
        with_ranges(model.evaluator.study).all_count, span.name
    ):
        evaluator = model.evaluator.for_study(
            in_phases(alone, assemble(alone)), verified=0
        )
        members = evaluator.characteristics
        low = high = fixed
        column = None
        if span.name in alone.ranges:
            column = members.names.index(span.name)
            low = float(members.lower[column])
            high = float(members.upper[column])
        if low <= span.high:
            of_test = model._replace(evaluator=evaluator)
            top = min(high, span.high)
            ranges.append(EncounterRange(test, of_test, column, low, top))
    return ranges


def _tests_alone(study: Study, by: str) -> Iterator[tuple[str, Study, float]]:
    """Yield each test of a study, at each combination of the values of its listed axes, as a study
    with this test alone.

    With it come the test's name ("" without tests), and its listed value of the parameter `by`;
    minus infinity if the test does not list this parameter.
    """
    if not study.tests:
        yield "", study, -np.inf
    for test in study.tests:
        for alone in study.points_of(test):
            listed = study.lists_of(alone).get(by)
            yield (
                test.name,
                study.with_tests([alone]),
                float(listed[0]) if listed else -np.inf,
            )
