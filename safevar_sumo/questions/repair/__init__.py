"""Which smallest change of the driving system keeps all vehicles safe within a required range of
wear, and what does it cost?

The first counterexamples are corners and Sobol points of the range, without vehicles that no
driving system keeps safe. The smallest changes that survive them (`smallest`) are falsified and
validated (`validation`); what breaks a change is a new counterexample (`survivors`). Today's
driving system is the change of no parameter.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import tomli_w

from safevar_sumo.campaign.evaluation import with_parameters
from safevar_sumo.errors import InputError
from safevar_sumo.metrics import F_SAFE, Unsafe, margin_of
from safevar_sumo.output import check_writable, whole_file
from safevar_sumo.questions.answer import Answer, Column, Columns, contents, tabulate
from safevar_sumo.questions.ask import question
from safevar_sumo.questions.box import Proof
from safevar_sumo.questions.case import Subject
from safevar_sumo.questions.causes import find_cause_limits, find_minimal_causes
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.falsify import budget_of
from safevar_sumo.questions.models import Models, check_margin, fit_names, models_of
from safevar_sumo.questions.options import Criterion, Fits, LimitTexts, Margin
from safevar_sumo.questions.phases import remark_on_phases
from safevar_sumo.questions.repair.price import price_of
from safevar_sumo.questions.repair.problem import Promise, RepairProblem, parameters_of
from safevar_sumo.questions.repair.survivors import Survivors, find_survivors
from safevar_sumo.questions.sampling import CONFIDENCE, sobol_points
from safevar_sumo.questions.words import bound_in_words, encounter_in_words, join_phrases
from safevar_sumo.records import Evaluations, FloatArray, JsonObject, NamedValues
from safevar_sumo.scenarios import distance_in_words
from safevar_sumo.study import SCHEMA_LINE, Study, study_names, unit_text, write_study

ROUNDS_STAGE, USUAL_ROUNDS = "smallest change that survives", 8
"""The phase of progress, and its usual number of rounds: each takes about the simulations of a
falsification.
"""
SOBOL_VEHICLES = 256
"""Sobol points of the promise among the first counterexamples, and corners: the same points
rounded.
"""
CAUSES_OF = 4
"""Number of failures of full braking whose causes are told."""
SHOWN_LIMITS = 3
"""Number of limits of full braking that the verdict names."""
REPAIRS: Columns = {
    "parameters": Column(
        "", "the parameters that change, with their new values", ".10g", is_shown=False
    ),
    "change": "what changes, in words",
    "changed": Column("-", "number of parameters that change", is_shown=False),
    "fits": Column(
        "-", "number of parameter sets of the vehicle model in which it holds", is_shown=False
    ),
    "largest_change": Column(
        "-", "largest change of a parameter, as a share of its range", is_detail=True
    ),
    "metres_earlier": Column(
        "m",
        "how much earlier a new vehicle brakes, at most over all test cases",
        ".2f",
        head="brakes earlier",
    ),
    "metres_earlier_mean": Column(
        "m", "how much earlier it brakes on average over all test cases", ".2f", is_shown=False
    ),
    "seconds_earlier": Column(
        "s",
        "how much earlier it brakes in the test case with the most metres",
        ".2f",
        is_shown=False,
    ),
    "most_at": Column("", "the test case with the most metres", is_shown=False),
    "largest_deceleration": Column(
        "m/s^2", "largest deceleration of a new vehicle", ".1f", is_detail=True
    ),
    "needless_braking": Column(
        "-", "number of benign scenes in which the changed driving system brakes"
    ),
    "needless_braking_today": Column(
        "-", "number of benign scenes in which the driving system of today brakes"
    ),
    "benign_scenes": Column("-", "number of scenes in which nobody needs to brake"),
    "proof_samples": Column(
        "-",
        "number of worn vehicles sampled after the parameters were chosen",
        head="proof: vehicles sampled",
    ),
    "proof_failures": Column(
        "-", "number of these vehicles that are unsafe", head="of them unsafe"
    ),
    "at_most": Column(
        "-",
        f"upper bound of the share of unsafe vehicles, with {100 * CONFIDENCE:g} % confidence",
        ".2g",
    ),
}


@question
@contents(
    *(
        "unsafe",
        "margin",
        "promise",
        "worst_today",
        "kept_today",
        "repairs",
        "not_repairable",
        "simulations",
    ),
    *("rough", "fits", "fits_tried"),
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
    """Find the smallest change of the driving system that keeps worn vehicles safe, and its price.

    Failures of results that lie within the required range must be safe, too.

    Parameters
    ----------
    promise
        Wear up to which vehicles have to be safe (the required range), such as "treadDepth >= 3";
        may be repeated. Characteristics that are not named stay as in the original; "all" means the
        whole domain. By default the study's [repair.promise], else its [limits].
    margin
        Clearance that every vehicle must keep [m], between bumpers; by default the model's error
        that the study states, else 0.3 m.
    unsafe
        What is unsafe instead: a collision, a safety degree below X, or a metric such as "drac >
        6".
    change
        Parameter of the driving system that may change; may be repeated. By default those under
        [repair], else those that come with a shipped driving system.
    fits
        Number of parameter sets of the vehicle model (those of [spread]) in which a repair holds:
        the margin with the study's own, no collision with any other; by default all, 0 for the
        study's own alone.
    out
        Study file to write with the first repair; it extends the study.
    at_tests
        A repair for the points of the study's tests alone: nothing is simulated between the values
        of a matrix.
    quick
        A rough answer: the study's own parameter set alone, and a short search. Not with `out`.
    """
    study = evaluator.study
    evaluator.system.require("a driving system", "repair")
    if study.is_rated:
        text = (
            f"{study.name!r} is rated, and its repair would take a whole test matrix for every"
            " vehicle and change"
        )
        raise InputError(
            study.source, text, "the study without the rating, such as wear for euro_ncap_rating"
        )
    if out is not None:
        if quick:
            legal = "--quick without --out, or --out without --quick"
            raise InputError("quick", f"a rough repair is not written to {out}", legal)
        _check_file(Path(out), study)
    criterion = evaluator.checked(unsafe or Unsafe())
    check_margin(criterion, margin)
    keep = margin_of(study, margin) if unsafe is None or margin is not None else 0.0
    unsafe_today = replace(criterion, keep=keep, contact=evaluator.system.contact)
    promised = Promise.of(study, evaluator.region, promise)
    parameters = parameters_of(study, change)
    budget = budget_of(quick=quick)
    evaluator.begin({ROUNDS_STAGE: USUAL_ROUNDS * budget})
    models = models_of(evaluator, unsafe_today, 0 if quick else fits, with_unsafe_originals=True)
    problems = [
        RepairProblem(
            evaluator=model.evaluator,
            promise=promised,
            parameters=parameters,
            unsafe=model.unsafe,
            fit=model.fit,
            budget=budget,
        )
        for model in models.members
    ]
    problem = problems[0]
    between = [each for one in problems for each in ([] if at_tests else one.between(unsafe_today))]
    between += [each for one in problems for each in one.in_phases()]
    first = _first_vehicles(problem, subject)
    if not len(first):
        kept = "is safe" if problem.unsafe.bound else f"keeps {problem.unsafe.keep:g} m"
        text = f"{study.name!r}: the new vehicle {kept} in none of the tested encounters"
        raise InputError(study.source, text, "a smaller --margin, or narrower ranges of the axes")
    robustness = problem.robustness_with(problem.today, first, "the driving system of today")
    worst_first = np.argsort(robustness, kind="stable")
    vehicles = first[worst_first]
    # What no driving system survives needs another part, not a parameter; the rest is repaired.
    is_repairable = robustness[worst_first] >= 0
    is_unsafe = ~is_repairable
    is_repairable[is_unsafe] = problem.repairable(vehicles[is_unsafe])
    survivors = Survivors([], len(problems), ())
    worst = vehicles[0]
    if is_repairable.any():
        with evaluator.phases.stage(ROUNDS_STAGE):
            survivors = find_survivors(problems, between, vehicles[is_repairable])
        worst = vehicles[is_repairable][0]
    not_repairable = _not_repairable(problem, vehicles[~is_repairable])
    answer = _answer_of(problem, models, survivors, problem.worst_today(worst), not_repairable)
    if out is not None and answer.numbers["repairs"]:
        write_repair(Path(out), answer)
    return answer


def _first_vehicles(problem: RepairProblem, subject: Subject) -> FloatArray:
    """The new vehicle, corners and Sobol points of the promise, and failures of results in it;
    shape (L, n).
    """
    promise = problem.promise
    points = sobol_points(SOBOL_VEHICLES, len(promise.lower), problem.study.search.seed)
    settings = [
        promise.region.characteristics.original[np.newaxis],
        promise.at(np.round(points)),
        promise.at(points),
    ]
    if not isinstance(subject, Study):
        failures = subject.solutions[problem.unsafe.rows(subject.solutions)]
        settings.append(failures[list(promise.region.characteristics.names)].to_numpy(dtype=float))
    rows = np.unique(np.concatenate(settings), axis=0)
    return rows[problem.holds(rows)]


def _not_repairable(problem: RepairProblem, failures: FloatArray) -> list[NamedValues]:
    """What no driving system can survive: the minimal causes of failures of full braking, shrunk to
    the limit; for each characteristic of a cause the value from which on even full braking at once
    fails.
    """
    if not len(failures) or problem.best_driver is None:
        return []
    driver = problem.best_driver.evaluator
    unsafe = problem.unsafe
    evenly_spaced = np.linspace(0, len(failures) - 1, min(len(failures), CAUSES_OF)).astype(int)
    causes = [*chain(*find_minimal_causes(driver, failures[evenly_spaced], unsafe))]
    parts: dict[tuple[object, ...], NamedValues] = {}
    for limits, cause in zip(find_cause_limits(driver, causes, unsafe), causes, strict=True):
        # Of equal causes in many encounters only the first counts.
        kind = tuple(limits.boundary if cause.encounter else limits.boundary.items())
        parts.setdefault(kind, limits.boundary | cause.encounter)
    return list(parts.values())


def _answer_of(
    problem: RepairProblem,
    models: Models,
    survivors: Survivors,
    worst_today: Evaluations,
    not_repairable: list[NamedValues],
) -> Answer:
    """The answer from the changes that survive, each with its proof: today's parameters alone if
    they do.

    `worst_today` is how the driving system of today ends with the worst vehicle of the promise that
    was tried and that a driving system can keep safe.
    """
    unsafe = problem.unsafe
    worst = float(worst_today.column(unsafe.bound.measure if unsafe.bound else F_SAFE.name)[0])
    kept_today = any(not problem.changed_values(change) for change, _ in survivors.changes)
    repairs = []
    if not kept_today:
        repairs = [
            _row(problem, change, proof, survivors.fits) for change, proof in survivors.changes
        ]
        repairs.sort(key=_cost_of)
    tables = {"repairs": tabulate("Repairs", REPAIRS, pd.DataFrame(repairs))}
    numbers = {
        "unsafe": str(unsafe),
        "margin": unsafe.keep if unsafe.is_collision else None,
        "promise": problem.promise.to_dict(),
        "worst_today": worst,
        "kept_today": kept_today,
        "repairs": len(repairs),
        "not_repairable": not_repairable,
        "simulations": sum(model.evaluator.simulated for model in models.members),
        "fits": survivors.fits if survivors.changes else 0,
        "fits_tried": len(models.members),
    }
    verdict = _verdict(
        problem, survivors, worst=worst, repairs=repairs, not_repairable=not_repairable
    )
    tested = ""
    if survivors.changes:
        proof = repairs[0] if repairs else _columns_of(survivors.changes[0][1])
        tested = (
            f"{_proof_in_words(**proof)}{_fits_in_words(models, survivors)}."
            f" {remark_on_phases(models.own.in_phases)}".strip()
        )
    return Answer(
        question="repair",
        study=problem.study,
        verdict=verdict,
        numbers=numbers,
        tables=tables,
        tested=tested,
    )


def _verdict(
    problem: RepairProblem,
    survivors: Survivors,
    *,
    worst: float,
    repairs: list[JsonObject],
    not_repairable: list[NamedValues],
) -> str:
    """Whether a repair is necessary, the smallest that was found and its price, and what no driving
    system survives.
    """
    unsafe = problem.unsafe
    wear = problem.promise.in_words
    safe = f"keep {unsafe.keep:g} m of clearance" if unsafe.keep else "stay safe"
    demand = "" if unsafe.keep else f" Counted as unsafe: {unsafe.description}."
    if survivors.changes and not repairs:  # the driving system of today survives
        where = " that any driving system can keep safe" if not_repairable else ""
        degree = f"has a safety degree of {distance_in_words(worst, unsafe.contact)}"
        ending = unsafe.value_in_words(worst) if unsafe.bound else degree
        verdict = (
            "No repair is necessary: with the driving system of today all tested vehicles"
            f"{where} {safe} within the required range ({wear}). The worst of them {ending}."
        )
    elif repairs:
        verdict = _repair_in_words(repairs, wear, safe)
    else:
        names = join_phrases(parameter.name for parameter in problem.parameters)
        verdict = (
            f"No change of one or two of {names} was found with which all vehicles within the"
            f" required range ({wear}) {safe}."
        )
    verdict += demand
    if not_repairable:
        fewest = sorted(not_repairable, key=len)
        parts = "; or ".join(_limits_in_words(problem, part) for part in fewest[:SHOWN_LIMITS])
        more = len(fewest) - SHOWN_LIMITS
        others = f" ({more} more are in the numbers, not_repairable)" if more > 0 else ""
        verdict += (
            f" Remark: Even full braking at the first possible moment fails with {parts}{others}:"
            " that needs another part, not another parameter."
        )
    return verdict


def _fits_in_words(models: Models, survivors: Survivors) -> str:
    """In how many parameter sets the answer holds; empty with one model."""
    count = len(models.members)
    if count == 1:
        return ""
    broken = (
        f", not in {fit_names(survivors.broken)}, where it collides" if survivors.broken else ""
    )
    left_out = (
        f"; left out: {fit_names([model.fit for model in models.left_out])}, where the original is"
        " unsafe"
        if models.left_out
        else ""
    )
    return (
        f"; it holds in {survivors.fits} of {count} parameter sets of the vehicle model, each with"
        f" a search for counterexamples{broken}{left_out}"
    )


def _row(problem: RepairProblem, change: FloatArray, proof: Proof, fits: int) -> JsonObject:
    """A repair, its price and its proof, by the names of columns."""
    values = problem.changed_values(change)
    texts = [
        f"{name} {today:.6g} -> {values[name]:.10g}{unit_text(row.unit)} ({row.meaning})"
        for name, row, today in problem.parameters
        if name in values
    ]
    return {
        "parameters": values,
        "change": ", ".join(texts),
        "changed": len(values),
        "largest_change": float(np.max(np.abs(change - problem.today))),
        "fits": fits,
        **_columns_of(proof),
        **price_of(problem.study, values, problem.encounters),
    }


def _cost_of(repair: JsonObject) -> tuple[float, ...]:
    """What makes a repair the cheaper one, and of equal ones the smaller one."""
    names = ("needless_braking", "metres_earlier", "largest_change")
    return tuple(repair[name] or 0.0 for name in names)


def _columns_of(proof: Proof) -> JsonObject:
    """A proof by the names of columns."""
    return {
        "proof_samples": proof.samples,
        "proof_failures": proof.failures,
        "at_most": proof.at_most,
    }


def _repair_in_words(repairs: Sequence[JsonObject], wear: str, safe: str) -> str:
    """The first repair, which is the cheapest one, and its price on a new vehicle."""
    repair = repairs[0]
    smallest = min(one["largest_change"] for one in repairs)
    kind = "smallest" if repair["largest_change"] == smallest else "cheapest"
    found = f"{kind} change of the driving system that was"
    if repair["changed"] > 1:
        found = f"{kind} changes of the driving system that were"
    metres = repair["metres_earlier"]
    earlier = "brakes nowhere" if metres is None else f"brakes up to {metres:.2f} m earlier"
    needless = "; needless braking was not measured: the study has no benign scenes"
    if repair["benign_scenes"]:
        needless = (
            f", and needlessly in {repair['needless_braking']} of {repair['benign_scenes']} benign"
            f" scenes ({repair['needless_braking_today']} today)"
        )
    return (
        f"The {found} found: {repair['change']}. Then all tested vehicles within the"
        f" required range ({wear}) {safe}. The price: a new vehicle"
        f" {earlier}{needless}."
    )


def _proof_in_words(*, proof_samples: int, proof_failures: int, at_most: float, **_: object) -> str:
    """The validation of a change, without a full stop."""
    return (
        f"Of {proof_samples:,} worn vehicles that were sampled afterwards"
        f" {proof_failures or 'none'} {'is' if proof_failures < 2 else 'are'} unsafe:"
        f" {bound_in_words(at_most)} are"
    )


def _limits_in_words(problem: RepairProblem, part: NamedValues) -> str:
    """A part that no driving system survives, such as `sensorRange below 21.4 m`, and its
    encounter.
    """
    characteristics = problem.promise.region.characteristics
    limits = list[str]()
    for member in characteristics.vehicle:
        if member.name in part:
            value = part[member.name]
            side = "below" if value < member.original else "above"
            limits.append(f"{member.name} {side} {member.text(value)}{member.suffix}")
    return (" with ".join(limits) or "even the original") + encounter_in_words(
        characteristics, part
    )


def _check_file(path: Path, study: Study) -> None:
    """Refuse a file that is no study file, cannot be written, or is one of the study's own, before
    the work begins.
    """
    if path.suffix != ".toml" or (path.exists() and any(map(path.samefile, study.origin.files))):
        raise InputError("out", str(path), "a file that ends in .toml, and is not the study's own")
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
    values = answer.table("repairs")["parameters"][0]
    comment = answer.verdict + (
        f" Only {study.origin.point} was simulated." if study.origin.point else ""
    )
    if not study.origin.called and study.name not in study_names():
        write_study(path, with_parameters(study, values), comment)
        return
    base = os.path.abspath(study.origin.called) if study.origin.called else study.name
    tables = {"extends": base, "name": f"{study.name}-repaired", "ads": {"parameters": values}}
    with whole_file(path, "out") as file:
        file.write_text(f"{SCHEMA_LINE}# {comment}\n\n{tomli_w.dumps(tables)}", encoding="utf-8")
