"""The answer of `repair`: the table of repairs, their prices and tests, and the sentences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer, tabulate
from safevar_sumo.questions.between import remark_on_phases
from safevar_sumo.questions.box import Proof
from safevar_sumo.questions.models import fit_names
from safevar_sumo.questions.repair import words
from safevar_sumo.questions.repair.price import price_of
from safevar_sumo.questions.repair.problem import RepairProblem
from safevar_sumo.questions.repair.survivors import Survivors
from safevar_sumo.questions.sentence import Sentences, Verdict, condition
from safevar_sumo.questions.tables import shipped_columns
from safevar_sumo.questions.words import (
    UNSAFE_MEANS,
    bound_in_words,
    encounter_in_words,
    join_phrases,
    number_of,
    single_set_in_words,
)
from safevar_sumo.records import Evaluations, FloatArray, JsonObject, NamedValues
from safevar_sumo.scenarios import distance_in_words
from safevar_sumo.study import unit_text

SHOWN_LIMITS = 3
"""Number of limits of full braking that the verdict names."""
(REPAIRS,) = shipped_columns("repair").values()


def answer_of(
    problem: RepairProblem,
    sets: int,
    survivors: Survivors,
    worst_today: Evaluations,
    not_repairable: list[NamedValues],
) -> Answer:
    """Make the answer from the changes that survive all searches. If today's parameters survive, no
    repair is necessary.

    Parameters
    ----------
    sets
        Number of parameter sets in which changes were tested.
    worst_today
        The evaluation, with today's driving system, of the worst promised vehicle that was tried
        and that a driving system can keep safe.
    not_repairable
        The causes of failures that no driving system can avoid: values by name.
    """
    unsafe = problem.unsafe
    worst = float(worst_today.column(unsafe.measure)[0])
    kept_today = any(
        not problem.changed_values(change) for change, _ in survivors.changes
    )
    repairs = []
    if not kept_today:
        rows = [_row(problem, *change, survivors.fits) for change in survivors.changes]
        repairs = sorted(rows, key=_cost_of)
    numbers = {
        "unsafe": str(unsafe),
        "margin": unsafe.keep if unsafe.is_collision else None,
        "promise": problem.promise.to_dict(),
        "worst_today": worst,
        "kept_today": kept_today,
        "repairs": len(repairs),
        "not_repairable": not_repairable,
        "simulations": sum(
            world.model.evaluator.simulated for world in problem.bench.worlds
        ),
        "fits": survivors.fits if survivors.changes else 0,
        "fits_tried": sets,
    }
    ending = f"has a safety degree of {distance_in_words(worst, unsafe.contact)}"
    if unsafe.bound:
        ending = unsafe.value_in_words(worst)
    if kept_today:
        template = words.NOT_NECESSARY[bool(not_repairable)]
        necessary = template(safe=_safe_in_words(unsafe))
        sentences = [necessary, words.WORST(ending=ending)]
    else:
        sentences = list(_repair(problem, repairs))
    tested = []
    if survivors.changes:
        proof = repairs[0] if repairs else _columns_of(survivors.changes[0][1])
        tested = list(_tested(problem, sets, survivors, proof))
    return Answer(
        question="repair",
        study=problem.study,
        verdict=Verdict([*sentences, *_notes(problem, not_repairable)]),
        numbers=numbers,
        tables={"repairs": tabulate("Repairs", REPAIRS, pd.DataFrame(repairs))},
        tested=Verdict(tested),
    )


def _safe_in_words(unsafe: Unsafe) -> str:
    """What all vehicles do with a repair, such as `stay safe`."""
    return f"keep {unsafe.keep:g} m of clearance" if unsafe.keep else "stay safe"


def _repair(problem: RepairProblem, repairs: Sequence[JsonObject]) -> Sentences:
    """Yield sentences on the first repair, which is the cheapest one, and on its price for a new
    vehicle.
    """
    if not repairs:
        names = join_phrases(parameter.name for parameter in problem.parameters)
        yield words.NOTHING_FOUND(names=names)
        return
    repair = repairs[0]
    smallest = min(row["largest_change"] for row in repairs)
    kind = "smallest" if repair["largest_change"] == smallest else "cheapest"
    number = number_of(repair["changed"], "parameter")
    yield words.REPAIR(
        kind=kind,
        number=number,
        change=repair["change"],
    )
    yield words.REPAIRED(safe=_safe_in_words(problem.unsafe))
    price = words.EARLIER
    if repair["metres_earlier"] is None:
        price = words.NO_BRAKING
    needless = words.NO_SCENES
    if repair["benign_scenes"]:
        needless = words.NEEDLESS_BRAKING
    yield from (price(**repair), needless(**repair))


def _notes(problem: RepairProblem, not_repairable: Sequence[NamedValues]) -> Sentences:
    """Yield notes on the promised wear, the criterion, and the wear that no driving system can keep
    safe.
    """
    yield words.WEAR(wear=problem.promise.in_words)
    if not problem.unsafe.keep:
        yield UNSAFE_MEANS(description=problem.unsafe.description)
    fewest = sorted(not_repairable, key=len)
    parts = [_limits_in_words(problem, part) for part in fewest[:SHOWN_LIMITS]]
    if parts:
        yield words.NOT_REPAIRABLE(parts=join_phrases(parts, "or"))
    if len(fewest) > SHOWN_LIMITS:
        number = len(fewest) - SHOWN_LIMITS
        yield words.MORE_NOT_REPAIRABLE(number=number)


def _tested(
    problem: RepairProblem, sets: int, survivors: Survivors, proof: JsonObject
) -> Sentences:
    """Say how a change was tested, and in how many parameter sets it holds."""
    bound = bound_in_words(proof["at_most"])
    yield words.PROOF(
        samples=proof["proof_samples"],
        bound=bound,
    )
    if sets > 1:
        yield words.SETS(
            fits=survivors.fits,
            number=sets,
        )
    if problem.evaluator.budget.effort >= 1:
        yield single_set_in_words(problem.study, sets)
    if survivors.broken:
        yield words.BROKEN(sets=fit_names(survivors.broken))
    yield condition(remark_on_phases(problem.bench.own.in_phases))


def _row(
    problem: RepairProblem, change: FloatArray, proof: Proof, fits: int
) -> JsonObject:
    """A row of `REPAIRS`: a repair, its price and its proof, by the names of columns."""
    values = problem.changed_values(change)
    texts = [
        words.CHANGE.format(
            meaning=row.meaning,
            name=name,
            old=f"{today:.6g}",
            new=f"{values[name]:.10g}{unit_text(row.unit)}",
        )
        for name, row, today in problem.parameters
        if name in values
    ]
    return {
        "parameters": values,
        "change": join_phrases(texts),
        "changed": len(values),
        "largest_change": float(np.max(np.abs(change - problem.today))),
        "fits": fits,
        **_columns_of(proof),
        **price_of(problem.study, values, problem.new_vehicle_settings),
    }


def _cost_of(repair: JsonObject) -> tuple[float, ...]:
    """The key that orders repairs: by needless braking, then by earlier braking, then by size."""
    names = ("needless_braking", "metres_earlier", "largest_change")
    return tuple(repair[name] or 0.0 for name in names)


def _columns_of(proof: Proof) -> JsonObject:
    """The results of a proof by the names of columns."""
    return {
        "proof_samples": proof.samples,
        "proof_failures": proof.failures,
        "at_most": proof.at_most,
    }


def _limits_in_words(problem: RepairProblem, part: NamedValues) -> str:
    """Wear that no driving system can keep safe, in words, such as `sensorRange below 21.4 m`, and
    its encounter.
    """
    characteristics = problem.promise.region.characteristics
    limits = []
    for member in characteristics.vehicle:
        if member.name in part:
            value = part[member.name]
            side = "below" if value < member.original else "above"
            limits.append(f"{member.name} {side} {member.text(value)}{member.suffix}")
    return (" with ".join(limits) or "even the original") + encounter_in_words(
        characteristics, part
    )
