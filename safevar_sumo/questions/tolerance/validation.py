"""The validation of joint limits: corners in all models, searches for counterexamples, and sampled
vehicles.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from safevar_sumo.questions.box import MAX_CORNERS, Box, Judgement, Proof, proof_size, prove
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.falsify import Falsification, falsify
from safevar_sumo.questions.models import Model, judges_of, with_points_between
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.records import FloatArray

MAX_UNSAFE_SHARE = 0.003
"""Upper bound of a box's unsafe share, with 95 % confidence, if every sampled setting is safe."""
KNOWN = 32
"""Number of the worst corners with the study's own parameter set with which a falsification begins;
of each other set an eighth.
"""
FIRST_CORNERS = 512
"""Number of corners that are tested first: most boxes fail soon."""
CONFIRMATIONS, STARTS = 3, 256
"""Number of further falsifications of a box that is to be printed, and of settings with which each
begins.
"""
VALIDATION_STAGE = "validation of joint limits"


class Failures(NamedTuple):
    """Unsafe settings, shape (K, n), and the model at the points where they are."""

    model: Model
    settings: FloatArray


class Validation(NamedTuple):
    """What the validation of a box gave: failures, or its corners, the falsification, its models
    and the upper bound.

    Attributes
    ----------
    corners
        The least that the corners keep with each parameter set [m].
    models
        The models that the falsification met, with points between those of the study's matrix.
    left_out
        Number of such points that do not count.
    """

    box: Box
    failures: Sequence[Failures] = ()
    corners: Mapping[int, float] = {}
    models: Sequence[Model] = ()
    falsification: Falsification | None = None
    proof: Proof | None = None
    left_out: int = 0


class Validator:
    """Validates boxes in some models; `budget` simulations falsify each. With `is_quick` they do
    so at the study's own points, and no vehicles are sampled. Progress is shown by the evaluator of
    the question.
    """

    def __init__(
        self, models: Sequence[Model], budget: int, evaluator: Evaluator, *, is_quick: bool = False
    ) -> None:
        self.models = models
        self.budget = budget
        self.is_quick = is_quick
        self.evaluator = evaluator
        self.seed = models[0].evaluator.study.search.seed
        self._proofs = 0
        """Number of upper bounds so far."""
        self._failing = {0}
        """Numbers of the models in which corners of earlier boxes failed: these come first."""

    def validate(self, box: Box, attempt: int) -> Validation:
        """Validate a box in all models: the first part that finds failures is the last."""
        corners = box.corners(self.seed, attempt)
        some = Stream.FIRST_CORNERS.generator(self.seed, attempt).permutation(corners[:MAX_CORNERS])
        total = len(self.models) * min(len(corners), MAX_CORNERS) + self.budget
        total += proof_size(self._proofs + 1, MAX_UNSAFE_SHARE)
        with self.evaluator.stage(VALIDATION_STAGE, total):
            # Some corners, in the models in which corners failed before.
            tested = self._test_corners(some[:FIRST_CORNERS], self._failing)
            if tested.failures:
                return Validation(box, tested.failures)
            # A search for counterexamples, from the worst of them.
            validation = self._falsify(box, some[:FIRST_CORNERS], tested.robustness, attempt)
            if validation.failures:
                return validation
            # All corners in all models; of a study that searches its scenario there are more.
            tested = self._test_corners(corners[:MAX_CORNERS], range(len(self.models)))
            more = self._test_corners(corners[MAX_CORNERS:], [0])
            if failures := [*tested.failures, *more.failures]:
                return validation._replace(failures=failures)
            least = {
                model.fit: model.unsafe.value(float(tested.robustness[number].min(initial=np.inf)))
                for number, model in enumerate(self.models)
            }
            validation = validation._replace(corners=least)
            if self.is_quick:
                return validation
            # Sampled vehicles, for the upper bound.
            return self._prove(validation, attempt)

    def _test_corners(self, corners: FloatArray, numbers: Iterable[int]) -> _Corners:
        """Test corners in some models, by their numbers; those in which one fails are the first
        that later boxes meet.
        """
        robustness = {
            number: self.models[number].robustness(corners, VALIDATION_STAGE)
            for number in sorted(numbers)
        }
        found = {number: corners[values < 0] for number, values in robustness.items()}
        failures = failures_in(self.models, found)
        self._failing |= {number for number, rows in found.items() if len(rows)}
        return _Corners(robustness, failures)

    def _falsify(
        self, box: Box, corners: FloatArray, robustness: Mapping[int, FloatArray], attempt: int
    ) -> Validation:
        """Falsify a box in all models, beginning at its worst corners in each, or in the first."""
        if not self.budget:
            return Validation(box, models=self.models)
        models, left_out = self._denser(attempt)
        orders = {
            number: np.argsort(values, kind="stable") for number, values in robustness.items()
        }
        worst = [
            corners[orders.get(number, orders[0])[: KNOWN if number == 0 else KNOWN // 8]]
            for number in range(len(self.models))
        ]
        rng = Stream.JOINT_LIMITS.generator(self.seed, attempt)
        found = falsify(box, judges_of(models, VALIDATION_STAGE), worst, self.budget, rng)
        failures = failures_in(models, found.failures)
        return Validation(box, failures, models=models, falsification=found, left_out=left_out)

    def confirm(self, validation: Validation, attempt: int) -> Validation:
        """Falsify a box that passed its validation `CONFIRMATIONS` times more, each time with other
        settings and points between those of a matrix.
        """
        found = validation.falsification
        if found is None:
            return validation
        failures = list[Failures]()
        with self.evaluator.stage(VALIDATION_STAGE, CONFIRMATIONS * self.budget):
            for number in range(CONFIRMATIONS):
                rng = Stream.VALIDATION.generator(self.seed, attempt, number)
                models, _ = self._denser(attempt + number)
                starts = [validation.box.with_ends(STARTS // len(models), rng) for _ in models]
                judges = judges_of(models, VALIDATION_STAGE)
                another = falsify(validation.box, judges, starts, self.budget, rng)
                found = found.merged(another)
                failures = failures_in(models, another.failures)
                if failures:
                    break
        return validation._replace(falsification=found, failures=failures)

    def _denser(self, attempt: int) -> tuple[list[Model], int]:
        """The models with points between those of a matrix, too, and the number of these that do
        not count.
        """
        if self.is_quick:
            return [*self.models], 0
        own = self.models[0].unsafe
        found = [with_points_between(model, own, attempt) for model in self.models]
        return [model for model, _ in found], found[0][1]

    def _prove(self, validation: Validation, attempt: int) -> Validation:
        self._proofs += 1
        model = validation.models[0]

        def judge(settings: FloatArray) -> Judgement:
            evaluations = model.evaluate(settings, VALIDATION_STAGE)
            failed = ~evaluations.valid & ~evaluations.infeasible
            return Judgement(model.robustness_by(evaluations) < 0, failed, ~evaluations.infeasible)

        rng = Stream.CONFIDENCE_BOUND.generator(self.seed, attempt)
        proof, unsafe = prove(
            lambda number: validation.box.draw(number, rng), judge, MAX_UNSAFE_SHARE, self._proofs
        )
        return validation._replace(proof=proof, failures=failures_in([model], {0: unsafe}))


class _Corners(NamedTuple):
    """The robustness of corners in some models, by their numbers, and those that are unsafe."""

    robustness: Mapping[int, FloatArray]
    failures: list[Failures]


def failures_in(models: Sequence[Model], found: Mapping[int, FloatArray]) -> list[Failures]:
    """Unsafe settings by the number of their model, each with this model at the points where they
    are unsafe.
    """
    return [
        Failures(models[number].at_worst_points(rows, VALIDATION_STAGE), rows)
        for number, rows in found.items()
        if len(rows)
    ]
