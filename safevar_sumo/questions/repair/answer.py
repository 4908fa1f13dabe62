"""The answer about repairs: their table, what they cost, and its sentences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from safevar_sumo.metrics import F_SAFE
from safevar_sumo.questions.answer import Answer, Column, Columns, tabulate
from safevar_sumo.questions.box import Proof
from safevar_sumo.questions.models import Models, fit_names
from safevar_sumo.questions.phases import remark_on_phases
from safevar_sumo.questions.repair.price import price_of
from safevar_sumo.questions.repair.problem import RepairProblem
from safevar_sumo.questions.repair.survivors import Survivors
from safevar_sumo.questions.sampling import CONFIDENCE
from safevar_sumo.questions.words import (
    bound_in_words,
    encounter_in_words,
    join_phrases,
)
from safevar_sumo.records import Evaluations, FloatArray, JsonObject, NamedValues
from safevar_sumo.scenarios import distance_in_words
from safevar_sumo.study import unit_text

SHOWN_LIMITS = 3
"""Number of limits of full braking that the verdict names."""
REPAIRS: Columns = {
    "parameters": Column(
        "", "the parameters that change, with their new values", ".10g", is_shown=False
    ),
    "change": "what changes, in words",
    "changed": Column("-", "number of parameters that change", is_shown=False),
    "fits": Column(
        "-",
        "number of parameter sets of the vehicle model in which it holds",
        is_shown=False,
    ),
    "largest_change": Column(
        "-", "largest change of a parameter (share of its range)", is_detail=True
    ),
    "metres_earlier": Column(
        "m",
        "how much earlier a new vehicle brakes, at most over all test cases",
        ".2f",
        head="brakes earlier",
    ),
    "metres_earlier_mean": Column(
        "m",
        "how much earlier it brakes on average over all test cases",
        ".2f",
        is_shown=False,
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


def answer_of(
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
    worst = float(
        worst_today.column(unsafe.bound.measure if unsafe.bound else F_SAFE.name)[0]
    )
    kept_today = any(
        not problem.changed_values(change) for change, _ in survivors.changes
    )
    repairs = []
    if not kept_today:
        repairs = [
            _row(problem, change, proof, survivors.fits)
            for change, proof in survivors.changes
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
        "simulations": sum(
            world.model.evaluator.simulated for world in problem.oracle.worlds
        ),
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
            f"{where} {safe} within the required range ({wear}). The worst vehicle {ending}."
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
        parts = "; or ".join(
            _limits_in_words(problem, part) for part in fewest[:SHOWN_LIMITS]
        )
        more = len(fewest) - SHOWN_LIMITS
        others = (
            f" ({more} more are in the numbers, not_repairable)" if more > 0 else ""
        )
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
        f", not in {fit_names(survivors.broken)}, where it collides"
        if survivors.broken
        else ""
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


def _row(
    problem: RepairProblem, change: FloatArray, proof: Proof, fits: int
) -> JsonObject:
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
        **price_of(problem.study, values, problem.new_vehicles),
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
    earlier = (
        "brakes nowhere" if metres is None else f"brakes up to {metres:.2f} m earlier"
    )
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


def _proof_in_words(
    *, proof_samples: int, proof_failures: int, at_most: float, **_: object
) -> str:
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
