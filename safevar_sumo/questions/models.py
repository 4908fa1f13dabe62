"""The models in which a claim is tested: each is a parameter set (calibration) of the study's
vehicle model, with the criterion of an unsafe vehicle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

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
"""Clearance to keep in a study that states no error of its model [m]."""
SEARCHED_MARGIN = 0.1
"""Clearance to keep if encounters are ranges [m]. In some of these encounters even the original
only just keeps the study's margin: wear may use up most of it, but the vehicle must not touch
anything.
"""


FitNumbers = tuple[int, ...]
"""Numbers of parameter sets."""


class Model(NamedTuple):
    """A parameter set of the vehicle model in which a claim about a study is tested.

    Attributes
    ----------
    fit
        The number of the parameter set under [spread]; 0 is the study's own set.
    evaluator
        Simulates settings with this parameter set.
    unsafe
        The criterion of an unsafe vehicle.
    """

    fit: int
    evaluator: Evaluator
    unsafe: Unsafe

    @property
    def characteristics(self) -> CharacteristicSet:
        """The characteristics of the study with this parameter set."""
        return self.evaluator.characteristics

    @property
    def in_phases(self) -> Model | None:
        """The same model for settings whose last value is the phase of the encounter; None if the
        study has no phases.
        """
        evaluator = self.evaluator.in_phases
        if evaluator is None:
            return None
        return self._replace(evaluator=evaluator)

    def evaluate(self, settings: FloatArray, stage: str) -> Evaluations:
        """The evaluations of M settings, shape (M, n)."""
        return self.evaluator.evaluate(settings, stage)

    def are_unsafe(self, settings: FloatArray, stage: str) -> BoolArray:
        """Which of M settings are unsafe, shape (M,)."""
        return self.are_unsafe_by(self.evaluate(settings, stage))

    def are_unsafe_by(self, evaluations: Evaluations) -> BoolArray:
        """Which of M evaluated settings are unsafe, shape (M,). Without a valid simulation a
        vehicle is neither safe nor unsafe.
        """
        return evaluations.valid & (self.unsafe.robustness(evaluations) < 0)


class Models(NamedTuple):
    """The models in which a claim is tested, the study's own first (`members`). Models in which the
    original vehicle itself is unsafe, or keeps less than the margin, are left out (`exclusions`).
    """

    members: Sequence[Model]
    exclusions: Sequence[Model]

    @property
    def own(self) -> Model:
        """The study's own model."""
        return self.members[0]

    @property
    def fits(self) -> FitNumbers:
        """The numbers of the parameter sets in which a claim is tested."""
        return tuple(member.fit for member in self.members)


def limit_criterion(
    evaluator: Evaluator,
    subject: Subject,
    unsafe: Unsafe | None,
    margin: float | None,
    original: Evaluations,
) -> Unsafe:
    """The criterion for a question about limits: the stated criterion `unsafe`, or else a
    collision, or less clearance than the margin [m]. The default margin is that of the study, or
    `SEARCHED_MARGIN` if encounters are ranges.
    """
    is_distance = unsafe is None and margin is not None
    criterion = evaluator.choose_criterion(
        Unsafe() if is_distance else unsafe, subject, original
    )
    return keeping_distance(evaluator, criterion, margin, is_stated=unsafe is not None)


def keeping_distance(
    evaluator: Evaluator, criterion: Unsafe, margin: float | None, *, is_stated: bool
) -> Unsafe:
    """The criterion with a clearance to keep [m], if the criterion is a collision. The clearance is
    the margin, or else `SEARCHED_MARGIN` if encounters are ranges, or else that of the study. A
    collision that the user states (`is_stated`) without a margin gets no clearance.
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
    """The clearance to keep [m]: the stated margin, else the model's error that the study states,
    else `DEFAULT_MARGIN`.
    """
    if margin is None:
        return study.model_error.get(SAFETY_DEGREE, DEFAULT_MARGIN)
    return margin


def check_margin(criterion: Unsafe, margin: float | None) -> None:
    """Refuse a margin if the criterion is not a collision."""
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
    """The models of a study with its first `fits` parameter sets, or with all sets if `fits` is
    None.

    All models have the criterion `unsafe`, but only the study's own model has its clearance to
    keep. A further model in which the original vehicle is unsafe is left out, unless
    `with_unsafe_originals`.
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
    return Models(members, unsafe_models)


def fit_names(fits: Sequence[int]) -> str:
    """Parameter sets in words: `parameter sets 2, 5 and 8`."""
    return (
        f"parameter set{'' if len(fits) == 1 else 's'} {join_phrases(map(str, fits))}"
    )
