"""Models of the vehicle in which a claim is tested: the parameter sets of its study, at the study's
points and between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.case import Subject
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.model_spread import other_sets
from safevar_sumo.questions.words import join_phrases
from safevar_sumo.records import BoolArray, Evaluations, FloatArray
from safevar_sumo.study import SAFETY_DEGREE, Study
from safevar_sumo.vehicles import CharacteristicSet

DEFAULT_MARGIN = 0.3
"""Distance to keep in a study that states no error of its model [m]."""
SEARCHED_MARGIN = 0.1
"""Distance to keep where encounters are ranges [m]: where the original keeps just its
margin, wear may use up the rest, and contact is no limit to release.
"""


class Model(NamedTuple):
    """A parameter set of the vehicle model, in which a claim about a study is tested, and what is
    unsafe with it.

    Attributes
    ----------
    fit
        Its number among the sets of [spread]; the study's own is 0.
    new_car
        What the original must not be in an encounter that counts, beside the rule of the study.
    """

    fit: int
    evaluator: Evaluator
    unsafe: Unsafe
    new_car: Unsafe | None = None

    @property
    def characteristics(self) -> CharacteristicSet:
        """Those of its study."""
        return self.evaluator.characteristics

    @property
    def in_phases(self) -> Model | None:
        """The model of settings that end with the phase of their encounter; None without phases."""
        evaluator = self.evaluator.in_phases
        if evaluator is None:
            return None
        return self._replace(evaluator=evaluator)

    def evaluate(self, settings: FloatArray, stage: str) -> Evaluations:
        """The evaluations of M settings, shape (M, n)."""
        return self.evaluator.evaluate(settings, stage)

    def robustness(self, settings: FloatArray, stage: str) -> FloatArray:
        """What each of M settings leaves to the limit, shape (M,): below 0 it is unsafe; infinite
        where it does not count.
        """
        robustness = np.where(
            self.evaluator.region.feasible(settings),
            self.robustness_by(self.evaluate(settings, stage)),
            np.inf,
        )
        failing = np.flatnonzero(robustness < 0)
        if self.new_car is not None and len(failing):
            members = self.characteristics
            originals = self.evaluate(
                members.with_original_vehicle(settings[failing]), stage
            )
            counts = originals.valid & ~self.new_car.of(originals)
            robustness[failing[~counts]] = np.inf
        return robustness

    def robustness_by(self, evaluations: Evaluations) -> FloatArray:
        """What evaluated settings leave; see `robustness`."""
        return np.where(evaluations.valid, self.unsafe.robustness(evaluations), np.inf)

    def are_unsafe(self, settings: FloatArray, stage: str) -> BoolArray:
        """Which of M settings are unsafe, shape (M,)."""
        return self.robustness(settings, stage) < 0


class Models(NamedTuple):
    """The parameter sets in which a claim is tested, the study's own first, and those left out, in
    which the original itself is unsafe, or keeps less than the margin.
    """

    members: tuple[Model, ...]
    exclusions: tuple[Model, ...]

    @property
    def own(self) -> Model:
        return self.members[0]

    @property
    def fits(self) -> tuple[int, ...]:
        return tuple(member.fit for member in self.members)


def limit_criterion(
    evaluator: Evaluator,
    subject: Subject,
    unsafe: Unsafe | None,
    margin: float | None,
    original: Evaluations,
) -> Unsafe:
    """What is unsafe for limits: the stated criterion as it is, else a collision or less than the
    margin [m], which is by default that of the study; `SEARCHED_MARGIN` in one that searches its
    scenario, whose originals keep more.
    """
    is_distance = unsafe is None and margin is not None
    criterion = evaluator.choose_criterion(
        Unsafe() if is_distance else unsafe, subject, original
    )
    return keeping_distance(evaluator, criterion, margin, is_stated=unsafe is not None)


def keeping_distance(
    evaluator: Evaluator, criterion: Unsafe, margin: float | None, *, is_stated: bool
) -> Unsafe:
    """A criterion of an evaluator's study, with the distance to keep from a collision: the margin
    [m], else `SEARCHED_MARGIN` or that of the study; one that is stated without a margin stands
    alone.
    """
    check_margin(criterion, margin)
    criterion = replace(criterion, contact=evaluator.system.contact)
    if not criterion.is_collision or (margin is None and is_stated):
        return criterion
    study = evaluator.study
    is_searched = margin is None and study.ranges
    return replace(
        criterion, keep=SEARCHED_MARGIN if is_searched else margin_of(study, margin)
    )


def margin_of(study: Study, margin: float | None) -> float:
    """The distance to keep [m]: the stated one, else the study's error of its model, else
    `DEFAULT_MARGIN`.
    """
    if margin is None:
        return study.model_error.get(SAFETY_DEGREE, DEFAULT_MARGIN)
    return margin


def check_margin(criterion: Unsafe, margin: float | None) -> None:
    """Refuse a distance to keep beside another criterion than a collision."""
    if margin is not None and not criterion.is_collision:
        raise InputError(
            "margin",
            f"{margin:g} m beside {str(criterion)!r}",
            "a collision, from which a distance is kept",
        )


def models_of(
    evaluator: Evaluator,
    unsafe: Unsafe,
    fits: int | None,
    *,
    with_unsafe_originals: bool = False,
) -> Models:
    """The first `fits` parameter sets of a study, by default all: what is unsafe holds in the
    study's own, and a distance to keep there alone. No other set may collide. Those with an unsafe
    original are left out unless they are wanted.
    """
    in_fits = replace(unsafe, keep=0.0)
    members = [Model(0, evaluator, unsafe)]
    unsafe_models = []
    for number, fitted in enumerate(other_sets(evaluator.study, fits), 1):
        model = Model(number, evaluator.for_study(fitted, verified=0), in_fits)
        if with_unsafe_originals:
            members.append(model)
            continue
        original = model.evaluator.evaluate(
            evaluator.characteristics.original_settings,
            "original with each parameter set",
        )
        if unsafe.of(original)[0] or not original.valid[0]:
            unsafe_models.append(model._replace(unsafe=unsafe))
        else:
            members.append(model)
    return Models(tuple(members), tuple(unsafe_models))


def fit_names(fits: Sequence[int]) -> str:
    """Parameter sets in words: `parameter sets 2, 5 and 8`."""
    return (
        f"parameter set{'' if len(fits) == 1 else 's'} {join_phrases(map(str, fits))}"
    )
