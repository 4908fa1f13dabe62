"""Adapts studies and results to a criterion. If the criterion bounds a metric, simulations measure
this metric, and the metric decides which point of a matrix is worst.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from msgspec.structs import replace as replace_in

from safevar_sumo.errors import InputError, check_name
from safevar_sumo.metrics import OPTIONAL_METRICS, Unsafe
from safevar_sumo.questions.case import Results, Subject
from safevar_sumo.questions.evaluator import Evaluator, open_evaluator
from safevar_sumo.study import Study
from safevar_sumo.study.encounters import DecidingMetric
from safevar_sumo.sumo.system import assemble
from safevar_sumo.terminal import Progress

SOLUTIONS_STAGE = "solutions by the measure"


def study_by(study: Study, unsafe: Unsafe) -> Study:
    """The study that measures the metric of a criterion. In a matrix, a setting counts at the point
    at which this metric is worst. A criterion that bounds no metric leaves the study as it is.

    Raises
    ------
    InputError
        If the study has no such metric.
    """
    if unsafe.bound is None:
        return study
    name = unsafe.bound.measure
    metrics = study.metrics
    matrix = study.matrix
    measured = [metric.name for metric in assemble(study).measuring.scoring.metrics]
    legal = {*measured, *OPTIONAL_METRICS}
    check_name("unsafe", f"study {study.name!r} has no metric {name!r}", name, legal)
    if name not in measured:
        metrics = replace_in(metrics, also=[*metrics.also, name])
    allows = any(test.allowed_impact_speed for test in study.tests)
    if allows and not unsafe.is_of_impacts:
        raise InputError(
            "unsafe",
            f"{str(unsafe)!r}: tests of study {study.name!r} allow an impact",
            "a bound on impact_excess, or collision",
        )

    if matrix is not None:
        deciding = DecidingMetric(name, unsafe.bound.worst_is_largest)
        matrix = replace_in(matrix, aggregate=str(deciding))
    return replace_in(study, metrics=metrics, matrix=matrix)


def subject_by(
    subject: Subject | Path, unsafe: Unsafe, evaluator: Evaluator
) -> Subject | Path:
    """The subject of a question, adapted to a criterion. Files stay as they are."""
    if isinstance(subject, Path):
        return subject
    if isinstance(subject, Study):
        return study_by(subject, unsafe)
    return case_by(subject, unsafe, evaluator)


def cases_by(
    cases: Sequence[Results],
    unsafe: Unsafe | None,
    jobs: int | None,
    progress: Progress,
    cluster: str | None = None,
) -> list[Results]:
    """Results, adapted to a criterion. Without a criterion, results stay as they are, unless their
    study states a clearance as its criterion.

    Raises
    ------
    InputError
        If a study has no metric of the criterion's name.
    """
    cases = list(cases)
    for place, case in enumerate(cases):
        criterion = unsafe or case.unsafe
        if unsafe is None and criterion.below is None:
            continue
        with open_evaluator(case.study, None, jobs, progress, cluster) as evaluator:
            cases[place] = case_by(case, criterion, evaluator)
    return cases


def case_by(case: Results, unsafe: Unsafe, evaluator: Evaluator) -> Results:
    """Results, adapted to a criterion. If the criterion bounds a metric that the results lack, or
    that belongs to another point of a matrix, all solutions are simulated again.
    """
    study = study_by(case.study, unsafe)
    evaluator = evaluator.for_study(study, verified=0)
    case = replace(case, stated=evaluator.checked(unsafe))
    if study == case.study:
        return case
    evaluations = evaluator.evaluate(case.settings, SOLUTIONS_STAGE)
    return case.simulated_as(study, evaluator.system.measuring.scoring, evaluations)
