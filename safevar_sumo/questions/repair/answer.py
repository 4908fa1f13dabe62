"""The answer of a repair: its verdict and tables, and the study with the first repair as a file."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import tomli_w

from safevar_sumo.campaign.evaluation import with_parameters
from safevar_sumo.errors import InputError
from safevar_sumo.output import check_writable, whole_file
from safevar_sumo.questions.answer import Answer, Column, tabulate
from safevar_sumo.questions.evaluator import CONFIDENCE
from safevar_sumo.questions.repair.attack import Proof
from safevar_sumo.questions.repair.price import price_of
from safevar_sumo.questions.repair.problem import RepairProblem
from safevar_sumo.questions.words import join_phrases
from safevar_sumo.records import FloatArray, JsonObject
from safevar_sumo.scenarios import distance_in_words
from safevar_sumo.study import SCHEMA_LINE, Study, study_names, unit_text, write_study

REPAIRS = {
    "parameters": Column("", "the parameters that change, with their new values", ".10g"),
    "changed": Column("-", "number of parameters that change"),
    "largest_change": Column("-", "largest change of a parameter, as a share of its range"),
    "metres_earlier": Column("m", "how much earlier a new vehicle brakes, at most over all points", ".2f"),
    "needless_braking": Column("-", "number of benign scenes in which a new vehicle brakes"),
    "benign_scenes": Column("-", "number of scenes in which nobody needs to brake"),
    "proof_samples": Column("-", "number of worn vehicles drawn after the parameters were chosen"),
    "proof_failures": Column("-", "number of them that are unsafe"),
    "at_most": Column("-", f"share of unsafe vehicles at most, with {100 * CONFIDENCE:g} % confidence", ".2g"),
}
CHANGES = {
    "repair": Column("-", "number of the repair"),
    "parameter": Column("", "parameter of the driving system"),
    "today": Column("", "its value today", ".6g"),
    "repaired": Column("", "its value with the repair", ".10g"),
    "unit": Column("", "unit of both"),
    "meaning": Column("", "what the parameter is"),
}
PRICE = {
    "repair": Column("-", "number of the repair"),
    "most_at": Column("", "point at which a new vehicle brakes earlier by the most metres"),
    "seconds_earlier": Column("s", "how much earlier it brakes there", ".2f"),
    "metres_earlier_mean": Column("m", "how much earlier it brakes on average over all points", ".2f"),
    "largest_deceleration": Column("m/s^2", "its largest deceleration with the repair", ".1f"),
    "needless_braking_today": Column("-", "number of benign scenes in which it brakes today"),
}


def answer_of(
    problem: RepairProblem,
    survivors: Sequence[tuple[FloatArray, Proof]],
    worst_today: float,
    not_repairable: list[dict[str, float]],
) -> Answer:
    """The answer from the changes that survive, each with its proof: today's parameters alone if they do.

    `worst_today` is the safety degree of today's driving system with the worst vehicle of the promise that was tried
    and that a driving system can keep safe [m]; below 0, minus the speed of the impact [m/s].
    """
    kept_today = bool(survivors) and not problem.changed_values(survivors[0][0])
    repairs = [] if kept_today else [_row(problem, *pair) for pair in survivors]
    changes = [
        (number, name, today, repair["parameters"][name], row.unit, row.meaning)
        for number, repair in enumerate(repairs, 1)
        for name, row, today in problem.parameters
        if name in repair["parameters"]
    ]
    rows = pd.DataFrame({"repair": number, **repair} for number, repair in enumerate(repairs, 1))
    tables = {
        "repairs": tabulate("Repairs", REPAIRS, rows),
        "changes": tabulate("Parameters that change", CHANGES, changes),
        "price": tabulate("Price on a new vehicle", PRICE, rows),
    }
    numbers = {
        "margin": problem.unsafe.keep,
        "promise": problem.promise.to_dict(),
        "worst_today": worst_today,
        "kept_today": kept_today,
        "repairs": len(repairs),
        "not_repairable": not_repairable,
        "simulations": problem.evaluator.simulated,
    }
    wear = f"({problem.promise.in_words}) with {problem.unsafe.keep:g} m left"
    if kept_today:
        where = " wherever any driving system can" if not_repairable else ""
        degree = distance_in_words(worst_today, problem.unsafe.contact)
        verdict = (
            f"The driving system of today keeps this promise {wear}{where}: the worst vehicle tried has a safety "
            f"degree of {degree}, and {_proof_in_words(survivors[0][1])}."
        )
    elif repairs:
        verdict = f"{_repair_in_words(problem, repairs[0], wear)}, and {_proof_in_words(survivors[0][1])}."
    else:
        names = join_phrases(parameter.name for parameter in problem.parameters)
        verdict = f"No change of one or two of {names} was found that survives this wear {wear}."
    if not_repairable:
        parts = "; or ".join(_limits_in_words(problem, part) for part in not_repairable)
        verdict += f" No driving system survives {parts}: that needs another part, not a parameter."
    return Answer(question="repair", study=problem.study, verdict=verdict, numbers=numbers, tables=tables)


def _row(problem: RepairProblem, change: FloatArray, proof: Proof) -> JsonObject:
    """A repair, its price and its proof, by the names of columns."""
    values = problem.changed_values(change)
    size = float(np.max(np.abs(change - problem.today)))
    price = price_of(problem.study, values)
    return {"parameters": values, "changed": len(values), "largest_change": size, **price, **proof._asdict()}


def _repair_in_words(problem: RepairProblem, repair: JsonObject, wear: str) -> str:
    """A repair and its price on a new vehicle."""
    values = repair["parameters"]
    changes = ", ".join(
        f"{name} {today:.6g} -> {values[name]:.10g}{unit_text(row.unit)} ({row.meaning})"
        for name, row, today in problem.parameters
        if name in values
    )
    number = "One change survives" if len(values) == 1 else "Two changes survive"
    metres = repair["metres_earlier"]
    earlier = "brakes nowhere" if metres is None else f"brakes up to {metres:.2f} m earlier"
    needless = "in an unknown share of benign scenes, of which the study has none"
    if repair["benign_scenes"]:
        needless = (
            f"in {repair['needless_braking']} of {repair['benign_scenes']} benign scenes "
            f"({repair['needless_braking_today']} today)"
        )
    return f"{number} this wear {wear}: {changes}. A new vehicle {earlier} and needlessly {needless}"


def _proof_in_words(proof: Proof) -> str:
    return (
        f"of {proof.proof_samples:,} fresh worn vehicles {proof.proof_failures} are unsafe (at most "
        f"{100 * proof.at_most:.2g} %, with {100 * CONFIDENCE:g} % confidence)"
    )


def _limits_in_words(problem: RepairProblem, part: Mapping[str, float]) -> str:
    """A part that no driving system survives, such as `sensorRange below 21.4 m`."""
    limits = [
        f"{member.name} {'below' if part[member.name] < member.original else 'above'} "
        f"{member.text(part[member.name])}{member.suffix}"
        for member in problem.promise.region.characteristics
        if member.name in part
    ]
    return " with ".join(limits) or "even the original"


def check_file(path: Path, study: Study) -> None:
    """Refuse a file that is no study file, cannot be written, or is one of the study's own, before the work begins."""
    if path.suffix != ".toml" or (path.exists() and any(map(path.samefile, study.origin.files))):
        raise InputError("out", str(path), "a file that ends in .toml, and is not the study's own")
    check_writable(path, "out")


def write_repair(path: Path, answer: Answer) -> None:
    """Write a study file with the first repair. It extends the study's file; without a file, it is the whole repaired
    study.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    study, values = answer.study, answer.table("repairs")["parameters"][0]
    comment = answer.verdict + (f" Only {study.origin.point} was simulated." if study.origin.point else "")
    if not study.origin.called and study.name not in study_names():
        write_study(path, with_parameters(study, values), comment)
        return
    base = os.path.abspath(study.origin.called) if study.origin.called else study.name
    tables = {"extends": base, "name": f"{study.name}-repaired", "ads": {"parameters": values}}
    with whole_file(path, "out") as file:
        file.write_text(f"{SCHEMA_LINE}# {comment}\n\n{tomli_w.dumps(tables)}", encoding="utf-8")
