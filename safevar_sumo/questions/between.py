"""Encounters between the tests of a matrix: the axes that a test's scenario can move, as ranges.

Each such test alone, with its axes as searched parameters, is a study of its own; a setting there
has the vehicle's characteristics, then a place on each axis.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np
from msgspec.structs import replace as replace_in

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.scope import moving_axes, points_of_tests
from safevar_sumo.records import FloatArray
from safevar_sumo.scenarios import Scenario, searchable_in
from safevar_sumo.study import Domain, MatrixTest, Study
from safevar_sumo.sumo.system import assemble

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
        alone = replace_in(
            test, over={name: values for name, values in test.over.items() if name not in domains}
        )
        moving = replace_in(
            study,
            matrix=replace_in(study.matrix, tests=[alone]),
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
        members = self.model.evaluator.characteristics
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
        return [
            replace_in(
                self.test,
                over={
                    **self.test.over,
                    **{name: [value] for name, value in zip(self.axes, place, strict=True)},
                },
            )
            for place in places
        ]


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
    return {
        name: Domain(
            unit=searchable_in(scenario)[name].unit,
            original=float(test.over[name][0]),
            lower=float(min(test.over[name])),
            upper=float(max(test.over[name])),
        )
        for name in moving_axes(study, test, scenario)
    }


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
        alone = replace_in(test, over={name: [value] for name, value in over.items()})
        yield (test.name, *over.items()), alone
