"""The validation of joint limits with one parameter set: corners, searches for counterexamples at
the tests of a matrix and between them, and sampled vehicles.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.between import MovingTest, meeting
from safevar_sumo.questions.box import MAX_CORNERS, Box, Judgement, Proof, prove
from safevar_sumo.questions.falsify import Falsification, falsify
from safevar_sumo.questions.models import Model
from safevar_sumo.questions.narrowing import NarrowedJudge
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.records import FloatArray

MAX_UNSAFE_SHARE = 0.003
"""Upper bound of a box's unsafe share, with 95 % confidence, if every sampled setting is safe."""
KNOWN = 32
"""Number of the worst corners with which a falsification begins."""
KNOWN_BETWEEN = 64
"""Number of the worst corners that a search between the tests of a matrix begins with."""
FIRST_CORNERS = 512
"""Number of corners that are tested first: most boxes fail soon."""
PHASE_FAILURES = 4
"""Largest number of settings that fail at another phase, and that later boxes hold none of."""
STARTS = 256
"""Number of settings with which a further falsification begins."""
VALIDATION_STAGE = "validation of joint limits"


class Failures(NamedTuple):
    """Unsafe settings, shape (K, n), and the model at the points where they are."""

    model: Model
    settings: FloatArray


class Validation(NamedTuple):
    """What the validation of a box gave.

    Attributes
    ----------
    failures
        What is unsafe; none if the box passed.
    corners
        The least that the corners leave [m].
    least
        The least that the falsification found [m].
    attacked, at_all_points
        Number of simulations of the falsification at the tests' points, and of those that met all
        points; the others met those that were worst for some vehicle.
    between
        Number of simulations of the falsification between the tests' points.
    """

    box: Box
    failures: tuple[Failures, ...] = ()
    corners: float = np.inf
    least: float = np.inf
    attacked: int = 0
    at_all_points: int = 0
    between: int = 0
    proof: Proof | None = None

    def with_search(
        self, found: Falsification, *, between: int = 0, all_points: int = 0
    ) -> Validation:
        """With what a further search found."""
        return self._replace(
            least=min([self.least, *found.robustness[:1].tolist()]),
            attacked=self.attacked + (0 if between else found.simulated),
            at_all_points=self.at_all_points + all_points,
            between=self.between + between,
        )


class Validator:
    """Validates boxes in one model, whose matrix gains the encounters that fail between its tests.
    `budget` simulations falsify each box at the tests' points, and as many as `budget_between` in
    each of the tests that move; the worst settings meet their worst phases if `with_phases`.
    """

    def __init__(
        self,
        model: Model,
        tests: Sequence[MovingTest],
        budgets: tuple[int, int],
        *,
        with_phases: bool,
    ) -> None:
        self.model = model
        self.tests = tests
        self.budget, self.budget_between = budgets
        self._with_phases = with_phases
        self.seed = model.evaluator.seed
        self._judge = NarrowedJudge(model, VALIDATION_STAGE)
        self._worst = list[tuple[MovingTest | None, FloatArray]]()
        """The worst settings of the last box, at the tests and between them."""
        self._proofs = 0
        """Number of upper bounds so far."""

    def validate(self, box: Box, attempt: int) -> Validation:
        """Test some corners of a box, and falsify it between the tests and at them.

        Where encounters are ranges all corners are tested: few encounters break a box,
        and the search of the next one has to know them.
        """
        corners = self._corners(box, attempt)
        first = corners[:FIRST_CORNERS]
        is_searched = len(box.region.characteristics.scenario) > 0
        validation, robustness = self._test(Validation(box), first)
        if validation.failures:
            return validation
        # Phases first: they cut off most of what fails between the tests.
        self._worst = [(None, first)]
        validation = self._meet_phases(validation)
        if validation.failures:
            return validation
        worst = first[np.argsort(robustness, kind="stable")]
        rng = Stream.JOINT_LIMITS.generator(self.seed, attempt, self.model.fit)
        validation = self._search(validation, worst[:KNOWN_BETWEEN], worst[:KNOWN], rng)
        if is_searched and not validation.failures:
            validation, _ = self._test(validation, corners)
        return validation

    def complete(self, validation: Validation, attempt: int, confirmations: int) -> Validation:
        """Test a box that is to be printed with all that it has to pass beside `validate`; the
        first part that finds failures is the last.
        """
        box = validation.box
        corners = self._corners(box, attempt)
        rngs = [
            Stream.VALIDATION.generator(self.seed, attempt, number, self.model.fit)
            for number in range(confirmations)
        ]
        validation, robustness = self._test(validation, corners[:MAX_CORNERS])
        worst = corners[np.argsort(robustness, kind="stable")]
        self._worst = []
        # Further searches for counterexamples.
        for rng in rngs:
            if not validation.failures:
                starts = box.with_ends(STARTS, rng)
                known = np.concatenate([worst[: KNOWN_BETWEEN // 2], starts[:KNOWN]])
                validation = self._search(validation, known, starts, rng)
        # Of a study whose encounters are ranges there are more corners.
        if not validation.failures:
            validation, _ = self._test(validation, corners[MAX_CORNERS:])
        return validation if validation.failures else self._meet_phases(validation)

    def _meet_phases(self, validation: Validation) -> Validation:
        """Have the worst settings of a box that passed meet their worst phases."""
        for test, settings in self._worst if self._with_phases else []:
            model = (self.model if test is None else test.model)._replace(at_worst_phase=True)
            if model.in_phases is None or not len(settings):
                continue
            left = model.robustness(settings, VALIDATION_STAGE)
            worst = settings[np.argsort(left, kind="stable")[:PHASE_FAILURES]]
            if left.min() < 0 and test is not None:
                model, worst = test.as_tests(worst[: np.count_nonzero(left < 0)])
                failures = Failures(model._replace(at_worst_phase=True), worst)
                validation = validation._replace(failures=(*validation.failures, failures))
            elif left.min() < 0:
                found = self._failures(worst[: np.count_nonzero(left < 0)], model=model)
                validation = validation._replace(failures=(*validation.failures, *found))
            validation = validation._replace(least=min(validation.least, float(left.min())))
        return validation

    def recheck(self, box: Box, attempt: int) -> Validation:
        """Test corners of a box that is within one that passed."""
        return self._test(Validation(box), self._corners(box, attempt)[:FIRST_CORNERS])[0]

    def prove(self, validation: Validation, attempt: int) -> Validation:
        """Sample vehicles, for the upper bound of the unsafe share."""
        self._proofs += 1
        model = self.model

        def judge(settings: FloatArray) -> Judgement:
            evaluations = model.evaluate(settings, VALIDATION_STAGE)
            failed = ~evaluations.valid & ~evaluations.infeasible
            return Judgement(model.robustness_by(evaluations) < 0, failed, ~evaluations.infeasible)

        rng = Stream.CONFIDENCE_BOUND.generator(self.seed, attempt)
        share = MAX_UNSAFE_SHARE / model.evaluator.account.effort
        proof, unsafe = prove(
            lambda number: validation.box.draw(number, rng), judge, share, self._proofs
        )
        return validation._replace(proof=proof, failures=self._failures(unsafe))

    def _corners(self, box: Box, attempt: int) -> FloatArray:
        """The corners of a box, or some of them where less is searched; the first `MAX_CORNERS` in
        random order.
        """
        corners = box.corners(self.seed, attempt)
        rng = Stream.FIRST_CORNERS.generator(self.seed, attempt)
        corners = np.concatenate([rng.permutation(corners[:MAX_CORNERS]), corners[MAX_CORNERS:]])
        return corners[: max(self.model.evaluator.scaled(len(corners)), 1)]

    def _test(self, validation: Validation, corners: FloatArray) -> tuple[Validation, FloatArray]:
        """Test corners: what they leave, shape (M,)."""
        robustness = self.model.robustness(corners, VALIDATION_STAGE)
        least = min(validation.corners, float(robustness.min(initial=np.inf)))
        failures = self._failures(corners[robustness < 0])
        return validation._replace(corners=least, failures=failures), robustness

    def _search(
        self,
        validation: Validation,
        known_between: FloatArray,
        known: FloatArray,
        rng: np.random.Generator,
    ) -> Validation:
        """Search a box for counterexamples, from known settings: between the tests of a matrix,
        where a simulation costs least, and then at them.
        """
        box = validation.box
        budget = self.budget_between
        for test in self.tests:
            starts = test.spread(known_between, rng)
            judges = [lambda rows, test=test: test.robustness(rows, VALIDATION_STAGE)]
            found = falsify(test.box(box), judges, [starts], budget, rng)
            self._worst.append((test, test.as_printed(found.settings)))
            validation = validation.with_search(found, between=found.simulated)
            failing = [*found.failures.values()]
            if failing:
                # What failed is a test of its own from now on.
                model, vehicles = test.as_tests(failing[0])
                matrix = model.evaluator.study.matrix
                assert matrix is not None
                self.model = meeting(self.model, matrix.tests)
                self._judge.model = self.model
                validation = validation._replace(
                    failures=(*validation.failures, Failures(model, vehicles))
                )
        if validation.failures:
            return validation
        before = self._judge.at_all_points
        found = falsify(box, [self._judge], [known], self.budget, rng)
        self._worst.append((None, found.settings))
        validation = validation.with_search(found, all_points=self._judge.at_all_points - before)
        return validation._replace(failures=self._failures(*found.failures.values()))

    def _failures(self, *settings: FloatArray, model: Model | None = None) -> tuple[Failures, ...]:
        """Unsafe settings, each with the model at the points where they are unsafe."""
        return tuple(
            Failures((model or self.model).at_worst_points(rows, VALIDATION_STAGE), rows)
            for rows in settings
            if len(rows)
        )
