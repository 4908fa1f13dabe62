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
from safevar_sumo.questions.models import Model, with_points_between
from safevar_sumo.questions.narrowing import NarrowedJudge
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
FIRST_SHARE = 0.5
"""Share of a falsification that first meets only the models in which earlier boxes failed."""
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
    at_all_points
        Number of simulations of the falsification that met all points; the others met those that
        were worst for some vehicle.
    """

    box: Box
    failures: Sequence[Failures] = ()
    corners: Mapping[int, float] = {}
    models: Sequence[Model] = ()
    falsification: Falsification | None = None
    proof: Proof | None = None
    left_out: int = 0
    at_all_points: int = 0


class Validator:
    """Validates boxes in some models; `budget` simulations falsify each. Progress is shown by the
    evaluator of the question.
    """

    def __init__(self, models: Sequence[Model], budget: int, evaluator: Evaluator) -> None:
        self.models = models
        self.budget = budget
        self.evaluator = evaluator
        self.seed = models[0].evaluator.study.search.seed
        self._proofs = 0
        """Number of upper bounds so far."""
        self._failing = {0}
        """Numbers of the models in which earlier boxes failed: these come first."""

    def validate(self, box: Box, attempt: int) -> Validation:
        """Test some corners of a box where earlier ones failed, and falsify it in all models.

        In a study that searches its scenario all corners are tested: few encounters break a box,
        and the search of the next one has to know them.
        """
        corners = self._corners(box, attempt)
        first = corners[:FIRST_CORNERS]
        is_searched = len(box.region.characteristics.scenario) > 0
        total = self.budget + len(corners if is_searched else first)
        with self.evaluator.stage(VALIDATION_STAGE, total):
            tested = self._test_corners(first, self._failing)
            if tested.failures:
                return Validation(box, tested.failures)
            validation = self._falsify(box, first, tested.robustness, attempt)
            if is_searched and not validation.failures:
                tested = self._test_corners(corners, [0])
            return validation._replace(failures=validation.failures or tested.failures)

    def complete(self, validation: Validation, attempt: int) -> Validation:
        """Test a box that is to be printed with all that it has to pass beside `validate`; the
        first part that finds failures is the last.
        """
        box = validation.box
        corners = self._corners(box, attempt)
        first = corners[:MAX_CORNERS]
        total = len(self.models) * len(first) + CONFIRMATIONS * self.budget
        total += proof_size(self._proofs + 1, MAX_UNSAFE_SHARE)
        with self.evaluator.stage(VALIDATION_STAGE, total):
            # All corners where earlier boxes failed.
            failing = {*self._failing}
            tested = self._test_corners(first, failing)
            # Further searches for counterexamples.
            if not tested.failures:
                validation = self._confirm(validation, attempt)
                if validation.failures:
                    return validation
            # All corners in all other models; of a study that searches its scenario there are more.
            if not tested.failures:
                others = {*range(len(self.models))} - failing
                tested = tested.joined(self._test_corners(first, others))
            if not tested.failures:
                more = self._test_corners(corners[MAX_CORNERS:], [0])
                tested = tested._replace(failures=more.failures)
            if tested.failures:
                return validation._replace(failures=tested.failures)
            least = {
                model.fit: model.unsafe.value(float(tested.robustness[number].min(initial=np.inf)))
                for number, model in enumerate(self.models)
            }
            validation = validation._replace(corners=least)
            # Sampled vehicles, for the upper bound.
            return self._prove(validation, attempt)

    def _corners(self, box: Box, attempt: int) -> FloatArray:
        """The corners of a box; the first `MAX_CORNERS` in random order."""
        corners = box.corners(self.seed, attempt)
        rng = Stream.FIRST_CORNERS.generator(self.seed, attempt)
        return np.concatenate([rng.permutation(corners[:MAX_CORNERS]), corners[MAX_CORNERS:]])

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
        """Falsify a box, beginning at its worst corners in each model, or in the first: at first in
        the models in which earlier boxes failed, then in all.
        """
        if not self.budget:
            return Validation(box, models=self.models)
        models, left_out = self._denser(attempt)
        orders = {
            number: np.argsort(values, kind="stable") for number, values in robustness.items()
        }
        worst = [
            corners[orders.get(number, orders[0])[: KNOWN if number == 0 else KNOWN // 8]]
            for number in range(len(models))
        ]
        rng = Stream.JOINT_LIMITS.generator(self.seed, attempt)
        return self._search(Validation(box, models=models, left_out=left_out), worst, rng)

    def _search(
        self, validation: Validation, starts: Sequence[FloatArray], rng: np.random.Generator
    ) -> Validation:
        """Search a box for counterexamples, from settings for each model: at first in the models in
        which earlier boxes failed, then in all.
        """
        everywhere = [*range(len(starts))]
        first = sorted(self._failing)
        left = self.budget
        if len(first) < len(everywhere):
            left = self.budget - round(FIRST_SHARE * self.budget)
            validation = self._search_in(first, validation, starts, self.budget - left, rng)
        if not validation.failures:
            validation = self._search_in(everywhere, validation, starts, left, rng)
        return validation

    def _search_in(
        self,
        numbers: Sequence[int],
        validation: Validation,
        starts: Sequence[FloatArray],
        budget: int,
        rng: np.random.Generator,
    ) -> Validation:
        """Search a box for counterexamples in some of a validation's models, by their numbers."""
        models = validation.models
        judges = [NarrowedJudge(models[number], VALIDATION_STAGE) for number in numbers]
        known = [starts[number] for number in numbers]
        found = falsify(validation.box, judges, known, budget, rng)
        found = found._replace(judges=np.array(numbers, dtype=np.intp)[found.judges])
        self._failing |= {*found.failures}
        earlier = validation.falsification
        return validation._replace(
            failures=failures_in(models, found.failures),
            falsification=found if earlier is None else earlier.merged(found),
            at_all_points=validation.at_all_points + sum(each.at_all_points for each in judges),
        )

    def _confirm(self, validation: Validation, attempt: int) -> Validation:
        """Falsify a box `CONFIRMATIONS` times more, each time with other settings and points
        between those of a matrix.
        """
        if not self.budget:
            return validation
        for number in range(CONFIRMATIONS):
            rng = Stream.VALIDATION.generator(self.seed, attempt, number)
            models, _ = self._denser(attempt + number)
            starts = [validation.box.with_ends(STARTS // len(models), rng) for _ in models]
            found = self._search(validation._replace(models=models), starts, rng)
            validation = found._replace(models=validation.models)
            if validation.failures:
                break
        return validation

    def _denser(self, attempt: int) -> tuple[list[Model], int]:
        """The models with points between those of a matrix, too, and the number of these that do
        not count.
        """
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

    def joined(self, other: _Corners) -> _Corners:
        """The same corners in the models of both."""
        return _Corners({**self.robustness, **other.robustness}, self.failures + other.failures)


def failures_in(models: Sequence[Model], found: Mapping[int, FloatArray]) -> list[Failures]:
    """Unsafe settings by the number of their model, each with this model at the points where they
    are unsafe.
    """
    return [
        Failures(models[number].at_worst_points(rows, VALIDATION_STAGE), rows)
        for number, rows in found.items()
        if len(rows)
    ]
