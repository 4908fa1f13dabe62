"""The trial of a box: its corners in all fits, an attack over all fits, and settings drawn at
random.
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
"""Number of the worst corners of the study's own fit with which an attack begins; of each other fit
an eighth.
"""
FIRST_CORNERS = 512
"""Number of corners that are tried first: most boxes fail soon."""
CONFIRMATIONS, STARTS = 3, 256
"""Number of further attacks on a box that is to be printed, and of settings with which each begins.
"""
TRIAL_STAGE = "test of the limits together"


class Failures(NamedTuple):
    """Unsafe settings, shape (K, n), and the model at the points where they are."""

    model: Model
    settings: FloatArray


class Trial(NamedTuple):
    """What the trial of a box gave: failures, or its corners, the attack, its models and the proof.

    Attributes
    ----------
    corners
        The least that the corners keep with each fit [m].
    judges
        The models that the attack met, with points between those of the study's matrix.
    left_out
        Number of such points that do not count.
    """

    box: Box
    failures: Sequence[Failures] = ()
    corners: Mapping[int, float] = {}
    judges: Sequence[Model] = ()
    falsification: Falsification | None = None
    proof: Proof | None = None
    left_out: int = 0


class Trials:
    """The trials of boxes in some models; `budget` simulations attack each. Progress is shown by
    the evaluator of the question.
    """

    def __init__(self, models: Sequence[Model], budget: int, evaluator: Evaluator) -> None:
        self.models = models
        self.budget = budget
        self.evaluator = evaluator
        self.seed = models[0].evaluator.study.search.seed
        self._proofs = 0
        self._failing = {0}
        """Number of proofs so far; numbers of the models in which corners of earlier boxes failed,
        which come first.
        """

    def whole(self, box: Box, attempt: int) -> Trial:
        """Try a box in all models: the first part that finds failures is the last.

        Some corners in the models in which corners failed before; a search for counterexamples from
        the worst of them; all corners in all models, of which the study's own fit meets more in a
        study that searches its scenario; and settings drawn at random.
        """
        corners = box.corners(self.seed, attempt)
        rng = Stream.FIRST_CORNERS.generator(self.seed, attempt)
        some = rng.permutation(corners[:MAX_CORNERS])[:FIRST_CORNERS]
        total = len(self.models) * min(len(corners), MAX_CORNERS) + self.budget
        with self.evaluator.stage(
            TRIAL_STAGE, total + proof_size(self._proofs + 1, MAX_UNSAFE_SHARE)
        ):
            lefts = self._left(some, self._failing)
            if failures := self._failures(some, lefts):
                return Trial(box, failures)
            trial = self._falsify(box, some, lefts, attempt)
            if trial.failures:
                return trial
            lefts = self._left(corners[:MAX_CORNERS], range(len(self.models)))
            failures = self._failures(corners[:MAX_CORNERS], lefts)
            if len(more := corners[MAX_CORNERS:]):
                failures += failures_of(
                    self.models[0], more, self.models[0].left(more, TRIAL_STAGE)
                )
            if failures:
                return trial._replace(failures=failures)
            least = {
                model.fit: model.unsafe.value(float(lefts[number].min(initial=np.inf)))
                for number, model in enumerate(self.models)
            }
            return self._prove(trial._replace(corners=least), attempt)

    def _left(self, corners: FloatArray, numbers: Iterable[int]) -> dict[int, FloatArray]:
        """What corners leave in some models, by their numbers."""
        return {
            number: self.models[number].left(corners, TRIAL_STAGE) for number in sorted(numbers)
        }

    def _failures(self, corners: FloatArray, lefts: Mapping[int, FloatArray]) -> list[Failures]:
        """The corners that fail in some models, which later boxes meet first."""
        self._failing |= {number for number, left in lefts.items() if (left < 0).any()}
        return [
            one
            for number in lefts
            for one in failures_of(self.models[number], corners, lefts[number])
        ]

    def _falsify(
        self, box: Box, corners: FloatArray, lefts: Mapping[int, FloatArray], attempt: int
    ) -> Trial:
        """Attack a box in all models, beginning at its worst corners in each, or in the first."""
        if not self.budget:
            return Trial(box, judges=self.models)
        judges, left_out = self._denser(attempt)
        orders = {number: np.argsort(left, kind="stable") for number, left in lefts.items()}
        worst = [
            corners[orders.get(number, orders[0])[: KNOWN if number == 0 else KNOWN // 8]]
            for number in range(len(self.models))
        ]
        rng = Stream.JOINT_LIMITS.generator(self.seed, attempt)
        found = falsify(box, judges_of(judges, TRIAL_STAGE), worst, self.budget, rng)
        failures = _failures_found(found, judges)
        return Trial(box, failures, judges=judges, falsification=found, left_out=left_out)

    def confirmed(self, trial: Trial, attempt: int) -> Trial:
        """A trial that passed, with `CONFIRMATIONS` more attacks of as many simulations, which
        begin anew elsewhere.
        """
        if trial.falsification is None:
            return trial
        box = trial.box
        with self.evaluator.stage(TRIAL_STAGE, CONFIRMATIONS * self.budget):
            found = trial.falsification
            for number in range(CONFIRMATIONS):
                rng = Stream.VALIDATION.generator(self.seed, attempt, number)
                judges, _ = self._denser(attempt + number)
                starts = [box.with_ends(STARTS // len(judges), rng) for _ in judges]
                rows = judges_of(judges, TRIAL_STAGE)
                found = found.merged(falsify(box, rows, starts, self.budget, rng))
                if found.failures:
                    break
        return trial._replace(falsification=found, failures=_failures_found(found, judges))

    def _denser(self, attempt: int) -> tuple[list[Model], int]:
        """The models with points between those of a matrix, too, and the number of these that do
        not count.
        """
        own = self.models[0].unsafe
        found = [with_points_between(model, own, attempt) for model in self.models]
        return [model for model, _ in found], found[0][1]

    def _prove(self, trial: Trial, attempt: int) -> Trial:
        self._proofs += 1
        model = trial.judges[0]

        def judge(settings: FloatArray) -> Judgement:
            evaluations = model.evaluate(settings, TRIAL_STAGE)
            failed = ~evaluations.valid & ~evaluations.infeasible
            return Judgement(model.left_by(evaluations) < 0, failed, ~evaluations.infeasible)

        rng = Stream.CONFIDENCE_BOUND.generator(self.seed, attempt)
        proof, unsafe = prove(
            lambda number: trial.box.draw(number, rng), judge, MAX_UNSAFE_SHARE, self._proofs
        )
        return trial._replace(
            proof=proof, failures=failures_of(model, unsafe, np.full(len(unsafe), -1.0))
        )


def _failures_found(found: Falsification, judges: Sequence[Model]) -> list[Failures]:
    """What a falsification found, each with its model at the points where it is unsafe."""
    return [
        Failures(judges[judge].at_worst_points(rows, TRIAL_STAGE), rows)
        for judge, rows in found.failures.items()
    ]


def failures_of(model: Model, settings: FloatArray, left: FloatArray) -> list[Failures]:
    """The settings that leave less than nothing, and the model at the points where they do; empty
    if none does.
    """
    unsafe = settings[left < 0]
    return [Failures(model.at_worst_points(unsafe, TRIAL_STAGE), unsafe)] if len(unsafe) else []
