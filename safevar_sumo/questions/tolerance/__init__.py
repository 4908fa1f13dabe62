"""How far may each characteristic go alone, and together with all others: in the largest safe box?

The filter of small changes is not applied, as the question is about the vehicle.
"""

from __future__ import annotations

from typing import Annotated

from safevar_sumo.questions.answer import Answer, contents
from safevar_sumo.questions.ask import Criterion, question
from safevar_sumo.questions.case import Subject
from safevar_sumo.questions.cause_limits import settings_of_line
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.falsify import budget_of
from safevar_sumo.questions.models import limit_criterion
from safevar_sumo.questions.options import Fits, LimitTexts, Margin
from safevar_sumo.questions.part import names_left_out, smaller_cuts, study_up_to
from safevar_sumo.questions.tolerance.asked import Asked, columns_of, specified_limits
from safevar_sumo.questions.tolerance.frugal import PARTS, answer_roughly
from safevar_sumo.questions.tolerance.in_ranges import IN_RANGES
from safevar_sumo.questions.tolerance.limits import (
    FITS,
    INTERVALS,
    NEAREST,
    OF_BOX,
    answer_limits,
    phases_of,
)
from safevar_sumo.questions.tolerance.rows import LIMITS, UNCERTAINTY


@question
@contents(
    *("unsafe", "margin", "kept", "rough", "scope", "up_to", "boxes", *OF_BOX),
    lead="limits",
    next="report",
    limits=LIMITS,
    intervals=INTERVALS,
    uncertainty=UNCERTAINTY,
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
        Give a rough answer that confirms no limit, with at most an eighth of the usual simulations.
        The exit code is always 3 if you state limits, because no limit is confirmed.
    """
    whole = evaluator
    if up_to is not None:
        evaluator = whole.for_study(study_up_to(whole.study, up_to))
    study = evaluator.study
    columns = columns_of(evaluator.characteristics.vehicle.names, characteristics)
    smaller = [*map(whole.for_study, smaller_cuts(whole.study, up_to))]
    phases = phases_of(evaluator, len(columns), fits)
    planned = {name: (1 + len(smaller)) * cost for name, cost in phases.items()}
    evaluator.begin(planned, least=1 + 2 * len(columns) * (1 + settings_of_line(PARTS)))
    specified = specified_limits(study, limits, columns)
    original = evaluator.evaluate_original()
    # The criterion is that of the whole study: up to a smaller value nothing stricter counts.
    of_whole = original
    if up_to is not None:
        of_whole = whole.evaluate(whole.characteristics.original_settings, "original vehicle")
    asked = Asked(
        subject=subject,
        evaluator=evaluator,
        columns=columns,
        limits=specified,
        unsafe=limit_criterion(
            whole, subject, unsafe, margin, of_whole if of_whole.valid[0] else original
        ),
        original=original,
        criterion=unsafe,
        margin=margin,
        fits=fits,
        budget=budget_of(evaluator),
        is_quick=quick,
        at_tests=at_tests,
        up_to=up_to,
        left_out=names_left_out(whole.study, study),
        smaller=smaller,
    )
    is_safe = not asked.unsafe.of(original)[0]
    if evaluator.left is None or not is_safe:
        return answer_limits(asked)
    return answer_roughly(asked)
