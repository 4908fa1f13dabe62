"""The question `tolerance`: how far may each characteristic change alone, and how far may all
characteristics change together (the largest safe box)?

The filter of small changes is not applied, because the question is about the vehicle, and not about
changes that a search would count.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, NamedTuple

import numpy as np

from safevar_sumo.errors import InputError, warn
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer, contents
from safevar_sumo.questions.ask import Criterion, question
from safevar_sumo.questions.box import Box
from safevar_sumo.questions.case import Subject
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.model_spread import other_sets
from safevar_sumo.questions.models import limit_criterion, models_of
from safevar_sumo.questions.options import Fits, LimitTexts, Margin
from safevar_sumo.questions.part import (
    UpperEnd,
    names_left_out,
    smaller_cuts,
    study_up_to,
)
from safevar_sumo.questions.sampling import Stream
from safevar_sumo.questions.tolerance.asked import (
    CASES,
    CASES_OF_SET,
    LEAST_VALUES,
    USUAL,
    Asked,
    asked_of,
    cases_of_setting,
    columns_of,
    specified_limits,
    usual_alone,
)
from safevar_sumo.questions.tolerance.search import (
    OTHER_SETS_STAGE,
    OWN_SET_STAGE,
    FoundLimits,
    find_limits,
    nearest_limits,
    no_limits,
)
from safevar_sumo.questions.tolerance.tell import (
    FITS,
    IN_RANGES,
    LIMITS,
    NEAREST,
    NUMBERS,
    answer_limits,
)
from safevar_sumo.questions.tolerance.told import InRanges, Told
from safevar_sumo.records import Evaluations, FloatArray
from safevar_sumo.scenarios.declared import with_ranges
from safevar_sumo.study import Limit, Study
from safevar_sumo.vehicles.region import REJECTIONS

RANGES_STAGE = "counterexamples in the ranges"


class LimitsQuestion(NamedTuple):
    """The question of a user about limits.

    Attributes
    ----------
    base
        The evaluator of the whole study.
    unsafe
        The criterion of an unsafe vehicle, with the clearance to keep.
    stated, margin
        The criterion and the clearance [m] that the user states; None if not stated.
    columns
        The columns of the characteristics that vary.
    limits
        The specified limits, by name.
    """

    subject: Subject
    base: Evaluator
    unsafe: Unsafe
    stated: Unsafe | None
    margin: float | None
    columns: Sequence[int]
    limits: Mapping[str, Limit]
    fits: int | None
    at_tests: bool

    def is_unsafe(self, original: Evaluations) -> bool:
        """Whether the original vehicle is unsafe, or has no valid simulation. `original` is its
        evaluation.
        """
        return bool(not original.valid[0] or self.unsafe.of(original)[0])


@question
@contents(
    *NUMBERS,
    lead="limits",
    next="report",
    limits=LIMITS,
    fits=FITS,
    nearest=NEAREST,
    ranges=IN_RANGES,
)
def tolerance(
    subject: Subject,
    evaluator: Evaluator,
    *,
    limits: LimitTexts = (),
    characteristics: Annotated[tuple[str, ...], "A,B"] = (),
    margin: Margin = None,
    unsafe: Criterion = None,
    fits: Fits = None,
    up_to: Annotated[str | None, "NAME=V"] = None,
    at_tests: bool = False,
    quick: bool = False,
) -> Answer:
    """Find how far each characteristic may change before the vehicle becomes unsafe. You get the
    limit of each characteristic alone, and joint limits that hold at the same time. The answer
    states the tests, speeds and roads for which the limits hold.

    Example: python -m safevar_sumo tolerance autoware_july --characteristics
    brakeTorque,brakeResponse

    Parameters
    ----------
    limits
        Check this limit, such as "treadDepth >= 3"; may be repeated. The exit code is 3 if a limit
        does not hold.
    characteristics
        Change only these characteristics, separated by commas. Default: all characteristics of the
        study.
    margin
        Clearance that every vehicle must keep between bumpers, in metres. Default: the value of the
        study, else 0.3 m.
    unsafe
        What counts as unsafe: a collision, less than X m of clearance, or a metric beyond a limit.
        Default: the criterion of the study, else a collision or too little clearance.
    fits
        Number of parameter sets (calibrations) of the vehicle model in which the limits must hold.
        Default: all; 0 uses only the set of the study.
    up_to
        Use only encounters in which this value is not exceeded, such as speed=40. The unit is that
        of the study.
    at_tests
        Test the limits only at the listed test cases. Default: also at speeds and places between
        the listed values.
    quick
        Give a rough answer, with at most an eighth of the usual simulations. A rough answer
        confirms no limit that you state, so the exit code is then 3.
    """
    base = evaluator
    end = None
    if up_to is not None:
        end = UpperEnd.of(up_to)
        evaluator = base.for_study(study_up_to(base.study, end))
    study = evaluator.study
    columns = columns_of(evaluator.characteristics.vehicle.names, characteristics)
    smaller = smaller_cuts(base.study, end)
    usual = _usual_settings(evaluator, len(columns), fits)
    planned = {name: (1 + len(smaller)) * number for name, number in usual.items()}
    evaluator.begin(planned, minimum=1 + 2 * len(columns) * LEAST_VALUES)
    is_few = evaluator.account.is_limited
    if is_few and fits is None:
        # Few simulations do not suffice for other parameter sets.
        fits = 0
    specified = specified_limits(study, limits, columns)
    _check_drawable(evaluator)

    # The criterion is chosen for the whole study, also if encounters are left out (`up_to`):
    # otherwise a smaller value might give a stricter criterion.
    original = evaluator.evaluate_original()
    of_whole = original if end is None else _original_of(base)
    reference = of_whole if of_whole.valid[0] else original
    criterion = limit_criterion(base, subject, unsafe, margin, reference)
    request = LimitsQuestion(
        subject, base, criterion, unsafe, margin, columns, specified, fits, at_tests
    )

    # Limits up to a value must lie within the limits up to each smaller value: these are found
    # first.
    wider = None
    for cut in map(base.for_study, smaller):
        if not request.is_unsafe(_original_of(cut)):
            wider = find_limits(_asked_of(request, cut), wider)
    is_safe = not request.is_unsafe(original)
    task = _asked_of(request if is_safe else request._replace(fits=0), evaluator)
    results = find_limits(task, wider) if is_safe else no_limits(task)
    facts = Told(
        task=task,
        limits=results,
        unsafe=criterion,
        original=original,
        columns=columns,
        is_rough=quick or is_few,
        has_scan=not is_few,
        at_tests=at_tests,
        upper_end=end,
        tests_left_out=names_left_out(base.study, study),
    )
    ranges = nearest = None
    if is_safe and not facts.is_rough:
        ranges = _in_ranges(request, evaluator, results)
    if is_safe and facts.broken and not is_few:
        nearest = nearest_limits(task, results)
    return answer_limits(facts, nearest, ranges)


def _original_of(evaluator: Evaluator) -> Evaluations:
    """The evaluation of the original vehicle in an evaluator's part of the study."""
    return evaluator.evaluate(
        evaluator.characteristics.original_settings, "original vehicle"
    )


def _usual_settings(
    evaluator: Evaluator, columns: int, fits: int | None
) -> dict[str, float]:
    """The phases of progress, each with the number of settings that it usually simulates."""
    study = evaluator.study
    cases = cases_of_setting(evaluator)
    sets = len(other_sets(study, fits))
    scaled = evaluator.scaled
    phases = {
        OWN_SET_STAGE: usual_alone(evaluator, columns) + scaled(CASES) / cases,
        OTHER_SETS_STAGE: scaled(CASES_OF_SET * sets) / cases,
    }
    if study.states_ranges and not study.ranges:
        phases[RANGES_STAGE] = scaled(USUAL.cases + USUAL.cases_of_set * sets) / cases
    return phases


def _asked_of(request: LimitsQuestion, evaluator: Evaluator) -> Asked:
    """The task of finding the limits in an evaluator's part of the study."""
    models = models_of(evaluator, request.unsafe, request.fits)
    sought = asked_of(
        models,
        request.unsafe,
        request.columns,
        request.limits,
        at_tests=request.at_tests,
    )
    return sought._replace(avoided=_unsafe_solutions(request, evaluator))


def _unsafe_solutions(request: LimitsQuestion, evaluator: Evaluator) -> FloatArray:
    """The vehicles of the results' unsafe solutions, shape (K, n). Only vehicles count that change
    no other characteristics than those in `request.columns`.
    """
    members = evaluator.characteristics
    subject = request.subject
    vehicle = members.vehicle
    if isinstance(subject, Study):
        return np.zeros((0, len(vehicle)))
    frame = subject.solutions[request.unsafe.rows(subject.solutions)]
    settings = frame[list(members.names)].to_numpy(dtype=float)
    is_original = settings[:, : len(vehicle)] == vehicle.original
    varies = np.isin(range(len(vehicle)), request.columns)
    settings = np.unique(settings[is_original[:, ~varies].all(axis=1)], axis=0)
    if evaluator is not request.base and len(settings):
        # The solutions are unsafe in the whole study. In its part, some of their encounters were
        # left out: simulate the vehicles again.
        is_inside = (settings >= members.lower) & (settings <= members.upper)
        settings = settings[is_inside.all(axis=1)]
        runs = evaluator.evaluate(settings, "unsafe solutions")
        settings = settings[runs.valid & request.unsafe.of(runs)]
    return np.asarray(settings[:, : len(vehicle)])


def _check_drawable(evaluator: Evaluator) -> None:
    """Refuse a study in which hardly any setting is feasible, before the long searches begin."""
    region = evaluator.region
    members = region.characteristics
    domain = Box(region, members.lower, members.upper)
    if not len(domain.draw(1, np.random.default_rng(evaluator.seed))):
        raise InputError(
            evaluator.study.source,
            f"fewer than 1 in {REJECTIONS} random settings satisfy the constraints, which leaves no"
            f" box to test: {region}",
            "characteristics that the constraints do not tie to each other",
        )


def _in_ranges(
    request: LimitsQuestion, evaluator: Evaluator, limits: FoundLimits
) -> InRanges | None:
    """Search for counterexamples to the limits in the ranges that a study states beside its listed
    encounters. The limits are the joint limits, or else the specified limits. The result is None if
    the study states no such ranges, if there are no limits, or if the original vehicle cannot be
    evaluated in the ranges.
    """
    study = study_in_ranges(evaluator.study)
    sides = limits.specified if limits.sides is None else limits.sides
    if study is None or not sides.any():
        return None
    wider = evaluator.for_study(study)
    try:
        original = wider.evaluate_original()
    except InputError as error:
        warn(f"the limits are not tried in the ranges of the study: {error.problem}")
        return None
    unsafe = limit_criterion(wider, study, request.stated, request.margin, original)
    task = _asked_of(request._replace(unsafe=unsafe, subject=study, base=wider), wider)
    space = task.boxes(task.domain).cases_in(sides)
    attacks = {}
    with evaluator.phases.stage(RANGES_STAGE):
        for fit in task.fits:
            search = task.search(Stream.WIDER_SCOPE, fit)
            attacks[fit] = search(space, task.nothing)
    return InRanges(task, unsafe, attacks)


def study_in_ranges(study: Study) -> Study | None:
    """The study with the ranges that it states beside its listed encounters; None without such
    ranges.
    """
    return None if study.ranges or not study.states_ranges else with_ranges(study)
