"""The question `repair`: which smallest change of the driving system keeps all vehicles safe within
a promised range of wear, and what does this change cost?

The first counterexamples are corners and Sobol points of the promise in the listed encounters.
Counterexamples that no driving system keeps safe are left out. The module `smallest` finds the
smallest changes that keep all known counterexamples safe: they survive. The module `survivors`
searches for counterexamples to these changes, and proves the changes with sampled vehicles. Each
unsafe vehicle is a new counterexample. Today's driving system counts as the change of no parameter.
"""

from __future__ import annotations

import os
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
import tomli_w

from safevar_sumo.campaign.evaluation import with_parameters
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import Unsafe
from safevar_sumo.output import check_writable, whole_file
from safevar_sumo.questions import cases
from safevar_sumo.questions.answer import Answer, contents
from safevar_sumo.questions.ask import Criterion, question
from safevar_sumo.questions.case import Subject
from safevar_sumo.questions.cause_limits import find_cause_limits
from safevar_sumo.questions.causes import find_minimal_causes
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import check_margin, margin_of, models_of
from safevar_sumo.questions.options import Fits, LimitTexts, Margin
from safevar_sumo.questions.repair.answer import REPAIRS, answer_of
from safevar_sumo.questions.repair.problem import Promise, RepairProblem, parameters_of
from safevar_sumo.questions.repair.smallest import MOST_CHANGED
from safevar_sumo.questions.repair.survivors import (
    Survivors,
    find_survivors,
    usual_test,
)
from safevar_sumo.questions.sampling import sobol_points
from safevar_sumo.questions.tolerance.oracle import Oracle, product_of
from safevar_sumo.records import BoolArray, FloatArray, NamedValues
from safevar_sumo.study import SCHEMA_LINE, Study, study_names, write_study

ROUNDS_STAGE = "smallest change that survives"
"""The phase of progress in which changes are searched and tested."""
USUAL_ROUNDS = 8
OF_ROUND = 2
"""The usual number of rounds of this phase; and the number of searches for a counterexample whose
cases a round usually simulates, in addition to one search for each test.
"""
SOBOL_VEHICLES = 256
"""Number of Sobol points of the promise among the first counterexamples, and number of corners: the
corners are the same points, rounded.
"""
CAUSES_OF = 4
"""Number of failures of full braking whose causes the answer states."""


@question
@contents(
    "unsafe",
    "margin",
    "promise",
    "worst_today",
    "kept_today",
    "repairs",
    "not_repairable",
    "simulations",
    "rough",
    "fits",
    "fits_tried",
    lead="repairs",
    repairs=REPAIRS,
)
def repair(
    subject: Subject,
    evaluator: Evaluator,
    *,
    promise: LimitTexts = (),
    margin: Margin = None,
    unsafe: Criterion = None,
    change: Annotated[tuple[str, ...], "PARAMETER"] = (),
    fits: Fits = None,
    out: Annotated[str | None, "FILE.toml"] = None,
    at_tests: bool = False,
    quick: bool = False,
) -> Answer:
    """Find the smallest change of the driving system's parameters that keeps worn vehicles safe.
    You get the new values, the price of the change (the original vehicle brakes earlier, or
    needlessly), and how the change was tested. If you give results (DIR), the change also makes
    unsafe vehicles of these results safe (if they are within the limits of wear, --promise).

    Example: python -m safevar_sumo repair autoware_july --promise "brakeTorque >= 0.9"

    Parameters
    ----------
    promise
        Limit of wear within which every vehicle must be safe, such as "treadDepth >= 3"; may be
        repeated. Write all for every value in the domains. Default: the limits under
        [repair.promise] of the study, else under [limits].
    margin
        Clearance that every vehicle must keep between bumpers, in metres. Default: the value of the
        study, else 0.3 m.
    unsafe
        What counts as unsafe: a collision, less than X m of clearance, or a metric beyond a limit.
        Default: a collision or too little clearance.
    change
        Parameter of the driving system that may change; may be repeated. Default: the parameters
        under [repair] of the study, else those that a shipped driving system names.
    fits
        Number of parameter sets (calibrations) of the vehicle model in which the repair must hold.
        Default: all; 0 uses only the set of the study.
    out
        Write a study with the first repair to this file.
    at_tests
        Test the repair only in the listed test cases. Default: test the repair also at speeds and
        places between the listed values.
    quick
        Give a rough answer that proves nothing, with at most an eighth of the usual simulations. A
        rough answer cannot be written to a file (--out).
    """
    study = evaluator.study
    evaluator.system.require("a driving system", "repair")
    if out is not None:
        if quick:
            raise InputError(
                "quick",
                f"a rough repair is not written to {out}",
                "--quick without --out, or --out without --quick",
            )
        _check_file(Path(out), study)
    criterion = evaluator.checked(unsafe or Unsafe())
    check_margin(criterion, margin)
    keep = margin_of(study, margin) if unsafe is None or margin is not None else 0.0
    unsafe_today = replace(criterion, keep=keep, contact=evaluator.system.contact)
    promised = Promise.of(study, evaluator.region, promise)
    parameters = parameters_of(study, change)
    models = models_of(evaluator, unsafe_today, fits, with_unsafe_originals=True)
    problem = RepairProblem(
        oracle=Oracle(models.members, unsafe_today, between=not at_tests),
        promise=promised,
        parameters=parameters,
        budget=evaluator.scaled(cases.USUAL_BUDGET),
    )
    # `repair` needs the usual number of simulations, and has no answer with fewer: a change without
    # a search for counterexamples is no repair.
    searches = USUAL_ROUNDS * (OF_ROUND + problem.oracle.fits.count(0))
    rounds = searches * problem.budget / len(evaluator.system.points)
    usual = round(rounds + MOST_CHANGED * usual_test(problem, len(models.members)))
    evaluator.begin({ROUNDS_STAGE: usual}, minimum=usual)
    cases_today, is_repairable = _worst_first(problem, _first_cases(problem, subject))
    survivors = Survivors([], len(models.members), ())
    if is_repairable.any():
        with evaluator.phases.stage(ROUNDS_STAGE):
            survivors = find_survivors(problem, models.fits, cases_today[is_repairable])
    worst = problem.outcome_today(cases_today[np.argmax(is_repairable)])
    not_repairable = _not_repairable(problem, cases_today[~is_repairable])
    answer = answer_of(problem, models, survivors, worst, not_repairable)
    if out is not None and answer.numbers["repairs"]:
        write_repair(Path(out), answer)
    return answer


def _first_cases(problem: RepairProblem, subject: Subject) -> FloatArray:
    """The first cases, which may be counterexamples. They are the new vehicle, corners and Sobol
    points of the promise, and promised failures of results, each in all listed encounters that
    count. The failures are also taken in their own encounters.
    """
    promise = problem.promise
    members = promise.region.characteristics
    number = problem.evaluator.scaled(SOBOL_VEHICLES)
    points = sobol_points(number, len(promise.lower), problem.study.search.seed)
    failures = members.original[np.newaxis][:0]
    if not isinstance(subject, Study):
        rows = subject.solutions[problem.unsafe.rows(subject.solutions)]
        failures = rows[list(members.names)].to_numpy(dtype=float)
        failures = failures[promise.holds(failures)]
    points = np.vstack([np.round(points), points])
    settings = np.vstack([members.original, promise.at(points)])
    settings = np.vstack([settings[promise.holds(settings)], failures])
    vehicles = np.unique(settings[:, : problem.size], axis=0)
    listed = product_of(vehicles, problem.encounters)
    cases = problem.cases_of(failures)
    cases = np.vstack([listed, cases[problem.is_promised(cases)]])
    if not len(cases):
        keep = problem.unsafe.keep
        demand = f"keeps {keep:g} m" if keep else "is safe"
        study = problem.study
        raise InputError(
            study.source,
            f"{study.name!r}: the new vehicle {demand} in none of the tested encounters",
            "a smaller --margin, or narrower ranges of the axes",
        )
    return cases


def _worst_first(
    problem: RepairProblem, cases: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """The cases in another order: the case that is least safe today comes first. The second result
    says which of them a driving system can keep safe. All other vehicles need a repaired part, not
    a changed parameter.
    """
    robustness = problem.robustness_of_change(
        problem.today, cases, "the driving system of today"
    )
    worst_first = np.argsort(robustness, kind="stable")
    ordered = cases[worst_first]
    is_repairable = robustness[worst_first] >= 0
    is_unsafe = ~is_repairable
    is_repairable[is_unsafe] = problem.repairable(ordered[is_unsafe])
    return ordered, is_repairable


def _not_repairable(problem: RepairProblem, cases: FloatArray) -> list[NamedValues]:
    """The wear that no driving system can keep safe, as minimal causes of failures of full braking.
    A cause has, for each of its characteristics, the value from which on even full braking at once
    fails.
    """
    driver = problem.best_driver(problem.oracle.own)
    if not len(cases) or driver is None:
        return []
    unsafe = problem.unsafe
    evenly_spaced = np.linspace(0, len(cases) - 1, min(len(cases), CAUSES_OF))
    number = len(problem.promise.lower)
    failures = np.array(
        [
            problem.oracle.setting(case)[1][:number]
            for case in cases[evenly_spaced.astype(int)]
        ]
    )
    causes = list(chain(*find_minimal_causes(driver, failures, unsafe)))
    parts: dict[tuple[object, ...], NamedValues] = {}
    for limits, cause in zip(
        find_cause_limits(driver, causes, unsafe), causes, strict=True
    ):
        # The same characteristics may be a cause in many encounters: only the first cause counts.
        kind = tuple(limits.boundary if cause.encounter else limits.boundary.items())
        parts.setdefault(kind, limits.boundary | cause.encounter)
    return list(parts.values())


def _check_file(path: Path, study: Study) -> None:
    """Refuse an output file before the work begins: it must end in .toml, must be writable, and
    must not be a file of the study itself.
    """
    if path.suffix != ".toml" or (
        path.exists() and any(map(path.samefile, study.origin.files))
    ):
        raise InputError(
            "out", str(path), "a file that ends in .toml, and is not the study's own"
        )
    check_writable(path, "out")


def write_repair(path: Path, answer: Answer) -> None:
    """Write a study file with the first repair. It extends the study's file; without a file, it is
    the whole repaired study.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    study = answer.study
    origin = study.origin
    values = answer.table("repairs")["parameters"][0]
    comment = answer.verdict + (
        f" Only {origin.point} was simulated." if origin.point else ""
    )
    if not origin.called and study.name not in study_names():
        write_study(path, with_parameters(study, values), comment)
        return
    base = os.path.abspath(origin.called) if origin.called else study.name
    tables = {
        "extends": base,
        "name": f"{study.name}-repaired",
        "ads": {"parameters": values},
    }
    with whole_file(path, "out") as file:
        file.write_text(
            f"{SCHEMA_LINE}# {comment}\n\n{tomli_w.dumps(tables)}", encoding="utf-8"
        )
