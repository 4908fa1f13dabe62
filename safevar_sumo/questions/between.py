"""Encounters between the tests of a matrix: the axes that a test's scenario can move, as ranges.

Each such test alone, with its axes as searched parameters, is a study of its own; a setting there
has the vehicle's characteristics, then a place on each axis.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import compress, product
from typing import Any

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.phases import in_phases
from safevar_sumo.questions.scope import are_numbers, at_values, moving_axes, points_of_tests
from safevar_sumo.questions.words import join_phrases
from safevar_sumo.records import FloatArray
from safevar_sumo.scenarios import Scenario, searchable_in, weather_of
from safevar_sumo.study import PHASE, Domain, MatrixTest, Study
from safevar_sumo.sumo.system import System, assemble

DECIMALS = 2
"""Decimals of a place on an axis, as it is printed."""
PLACES = 8
"""Number of random places on the axes that each vehicle meets first."""
MOST_ENCOUNTERS = 8
"""Largest number of encounters of a test that a search finds and later ones meet, the worst
first.
"""


class MovingTest:
    """A test of a model's matrix, whose axes are ranges.

    Attributes
    ----------
    test
        The test of the matrix.
    axes
        The names of the axes that move.
    model
        The model in this test alone. An encounter counts only where the original is safe, too.
    """

    def __init__(self, model: Model, test: MatrixTest, domains: dict[str, Domain], new_car: Unsafe):
        study = model.evaluator.study
        assert study.matrix is not None
        self.test = test
        self.axes = tuple(domains)
        self._base = model
        moving = replace_in(
            study,
            matrix=replace_in(study.matrix, tests=[without_axes(test, domains)]),
            scenario=replace_in(study.scenario, search=domains),
        )
        evaluator = model.evaluator.for_study(moving, verified=0)
        # At points that are selected no original drives beside each vehicle: only those beside
        # failures have to.
        points = tuple(range(len(evaluator.system.points)))
        self.model = Model(model.fit, evaluator, model.unsafe, points, new_car)

    @property
    def original(self) -> FloatArray:
        """The original vehicle, shape (n,)."""
        return self._base.evaluator.characteristics.original

    def box(self, box: Box) -> Box:
        """A box of vehicles, at all places."""
        evaluator = self.model.evaluator
        count = len(evaluator.characteristics.vehicle)
        ends = evaluator.characteristics.lower, evaluator.characteristics.upper
        lower, upper = (
            np.concatenate([own[:count], last[count:]])
            for own, last in zip((box.lower, box.upper), ends, strict=True)
        )
        return Box(evaluator.region, lower, upper)

    def spread(self, vehicles: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Vehicles, shape (K, n), each at `PLACES` random places, shape (K PLACES, n + axes)."""
        members = self.model.characteristics
        settings = np.zeros((PLACES * len(vehicles), len(members)))
        settings[:, : vehicles.shape[1]] = np.repeat(vehicles, PLACES, axis=0)
        places = rng.random((len(settings), len(self.axes)))
        low, high = (ends[-len(self.axes) :] for ends in (members.lower, members.upper))
        settings[:, -len(self.axes) :] = low + places * (high - low)
        return settings

    def robustness(self, settings: FloatArray, stage: str) -> FloatArray:
        """What settings leave to the limit, shape (M,), at places as they are printed."""
        return self.model.robustness(self.at_printed_places(settings), stage)

    def at_printed_places(self, settings: FloatArray) -> FloatArray:
        """Settings whose places on the axes are rounded."""
        rounded = settings.copy()
        rounded[:, -len(self.axes) :] = np.round(settings[:, -len(self.axes) :], DECIMALS)
        return rounded

    def failures(self, settings: FloatArray) -> tuple[Model, FloatArray]:
        """The vehicles of unsafe settings, the worst first, shape (K, n), and the model at their
        first encounters alone, as tests of a matrix; settings in other encounters are left out.
        """
        settings = self.at_printed_places(settings)
        places = settings[:, -len(self.axes) :].tolist()
        first = [list(place) for place in [*dict.fromkeys(map(tuple, places))][:MOST_ENCOUNTERS]]
        settings = settings[[place in first for place in places]]
        model = with_tests(self._base, self.encounters(settings), alone=True)
        return model, settings[:, : -len(self.axes)]

    def encounters(self, settings: FloatArray) -> list[MatrixTest]:
        """The encounters of settings, as tests of a matrix."""
        places = np.unique(settings[:, -len(self.axes) :], axis=0).tolist()
        return [at_values(self.test, dict(zip(self.axes, place, strict=True))) for place in places]


def moving_tests(model: Model, new_car: Unsafe) -> list[MovingTest]:
    """The tests of a model's matrix with axes that move; an encounter counts unless the original is
    unsafe by `new_car` in it.
    """
    study = model.evaluator.study
    if study.matrix is None or study.matrix.protocol:
        return []
    tests = list[MovingTest]()
    for test, points in points_of_tests(study, assemble(study).points):
        domains = domains_of_axes(study, test, points[0].scenario)
        if domains:
            tests.append(MovingTest(model, test, domains, new_car))
    return tests


def domains_of_axes(study: Study, test: MatrixTest, scenario: Scenario) -> dict[str, Domain]:
    """The axes of a test that move, each from its least to its greatest value."""
    axes = axes_of(test, scenario)
    return {name: axes[name] for name in moving_axes(study, test, scenario)}


def axes_of(test: MatrixTest, scenario: Scenario) -> dict[str, Domain]:
    """The axes of a test that its scenario can move, each from its least to its greatest value; one
    with a single value as far as is legal.
    """
    searchable = searchable_in(scenario)
    return {
        name: Domain(
            unit=searchable[name].unit,
            original=float(values[0]),
            lower=float(min(values) if len(values) > 1 else searchable[name].lower),
            upper=float(max(values) if len(values) > 1 else searchable[name].upper),
        )
        for name, values in test.over.items()
        if name in searchable and are_numbers(values)
    }


def without_axes(test: MatrixTest, axes: Collection[str]) -> MatrixTest:
    """A test whose matrix does not have these axes."""
    return replace_in(test, over={name: test.over[name] for name in test.over if name not in axes})


def with_tests(model: Model, tests: Sequence[MatrixTest], *, alone: bool = False) -> Model:
    """A model at further tests beside those of its matrix, or at these `alone`; a point that the
    matrix has counts once.
    """
    study = model.evaluator.study
    assert study.matrix is not None
    known = [] if alone else study.matrix.tests
    points = dict(point for test in tests for point in _points_of(test))
    for name, _ in (point for test in known for point in _points_of(test)):
        points.pop(name, None)
    matrix = replace_in(study.matrix, tests=[*known, *points.values()])
    return model._replace(
        evaluator=model.evaluator.for_study(replace_in(study, matrix=matrix), verified=0), points=()
    )


def _points_of(test: MatrixTest) -> Iterator[tuple[tuple[Any, ...], MatrixTest]]:
    """The test at each of its points alone, with what tells it from others."""
    for place in product(*test.over.values()):
        over = dict(zip(test.over, place, strict=True))
        yield (test.name, *over.items()), at_values(test, over)


def with_encounters(
    study: Study, system: System, changes: Mapping[str, str | float]
) -> tuple[Study, System]:
    """A study and its system; if axes of its matrix, or the phase, are among the names of a user's
    changes, they are searched parameters, in the tests that have all of these axes, and their
    values, as far as these are numbers.

    Raises
    ------
    InputError
        If the phase is set, and the study's encounters have none; or axes that no test has
        together.
    """
    known = system.characteristics.names
    found = _with_axes(
        study, system, {name: value for name, value in changes.items() if name not in known}
    )
    if PHASE in changes and PHASE not in system.characteristics.names:
        phased = in_phases(found, assemble(found))
        if phased == found:
            problem = f"study {study.name!r} has no {PHASE}"
            expected = "a study whose actors move on tracks, and react to nobody"
            raise InputError("", problem, expected)
        found = phased
    if found == study:
        return study, system

    # Whether an encounter counts does not become a question by this.
    scoring = system.measuring.scoring
    searched = assemble(found)
    return found, replace(searched, measuring=searched.measuring._replace(scoring=scoring))


def _with_axes(study: Study, system: System, places: Mapping[str, str | float]) -> Study:
    """A study that searches those of the places that are axes of its matrix which a scenario can
    move, in the tests that have all of them, at its point if it is at one.
    """
    matrix = study.matrix
    if matrix is None or matrix.protocol or study.scenario.search:
        return study
    here = {test.name: own for test, own in points_of_tests(study, system.points)}
    moving = [
        (test, axes_of(test, here[test.name][0].scenario))
        for test in matrix.tests
        if test.name in here
    ]
    axes = places.keys() & {name for _, domains in moving for name in domains}
    if not axes:
        return study

    # The tests in which the values lie; if there is none, the one whose domains end last, which
    # the error names.
    kept = [(test, domains) for test, domains in moving if axes <= domains.keys()]
    if not kept:
        problem = f"no test has {join_phrases(sorted(axes))} together"
        raise InputError("", problem, "values of one test's axes")
    farthest = max(kept, key=lambda each: [each[1][name].upper for name in sorted(axes)])
    has_all = [all(_has(domains[name], places[name]) for name in axes) for _, domains in kept]
    kept = [*compress(kept, has_all)] or [farthest]

    # At a point, the rest of its test stays as it is there.
    tests = [without_axes(test, axes) for test, _ in kept]
    if matrix.point:
        of_point = dict(system.points[0].parameters)
        tests = [
            replace_in(
                at_values(test, {name: of_point[name] for name in test.over}),
                weathers=[
                    weather
                    for weather in test.weathers
                    if weather_of(weather).name == of_point["weather"]
                ],
            )
            for test in tests
        ]
    domains = {
        name: _common(name, [own[name] for _, own in kept]) for name in kept[0][1] if name in axes
    }
    return replace_in(
        study,
        matrix=replace_in(matrix, tests=tests, point=""),
        scenario=replace_in(study.scenario, search=domains),
    )


def _common(name: str, domains: Sequence[Domain]) -> Domain:
    """What domains of an axis have in common."""
    lower = max(domain.lower for domain in domains)
    upper = min(domain.upper for domain in domains)
    if lower >= upper:
        raise InputError("", f"{name}: the tests have no range in common", "--point, for one test")
    original = min(max(domains[0].original, lower), upper)
    return replace_in(domains[0], original=original, lower=lower, upper=upper)


def _has(domain: Domain, value: str | float) -> bool:
    """Whether a value, or both ends of a sweep, lie in a domain; a share of the original may."""
    ends = str(value).partition(":")[0].split("..")
    try:
        return all(domain.lower <= float(end) <= domain.upper for end in ends)
    except ValueError:
        return True
