"""The rows of the answer: what each car may drive, and why no faster."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safevar_sumo.questions.counterexamples import OF_ENCOUNTER, failures_at, texts_of
from safevar_sumo.questions.permit.encounters import Span
from safevar_sumo.questions.permit.search import Permit
from safevar_sumo.questions.permit.speeds import LimitingFailure
from safevar_sumo.questions.tables import Column, Columns
from safevar_sumo.questions.words import change_texts, join_phrases
from safevar_sumo.records import JsonObject
from safevar_sumo.study import PHASE, unit_text

PHASE_COLUMN = Column("-", "steps by which that encounter begins later", ".4f")
DRIVE, LIMITED, STOP = "drive", "up to", "stop"
"""Verdicts: as fast as is needed, else as was driven or as the new car; up to a speed; not at all.
"""
CARS: Columns = {
    "car": "name of the car",
    "up_to": Column(
        "", "greatest value up to which it is safe", ".10g", head="may drive up to"
    ),
    "new_car_up_to": Column("", "that of the new car", ".10g", is_shown=False),
    "unit": Column("", "unit of these values", is_shown=False),
    "verdict": "drive, up to, or stop",
    "because": "why no faster",
    "test": Column("", "the test that limits it", is_shown=False),
    "encounter": Column("", "the encounter in which it is unsafe", is_shown=False),
    "outcome": Column("", "what happens there", is_shown=False),
    "phase": PHASE_COLUMN._replace(is_shown=False),
    "parameter_set": Column(
        "-", "number of the set of [spread] in which it does", "d", False
    ),
    "repair_first": "the measured characteristic that, as new again, raises the value most",
    "up_to_after_repair": Column(
        "", "the greatest value then", ".10g", head="then up to"
    ),
    "simulate": Column("", "the command that simulates its failure", is_detail=True),
    "assumed": Column(
        "", "what was not measured, with its assumed value", is_detail=True
    ),
    "assumed_matters_most": Column(
        "",
        "the assumed value that, at an end of its domain, lowers the value most",
        is_detail=True,
    ),
    "rough": Column(
        "", "whether the answer is rough and proves nothing", is_detail=True
    ),
    "parameter_sets": Column(
        "-", "number of parameter sets that were driven", "d", is_detail=True
    ),
    "margin": Column("m", "clearance to keep with the study's own set", is_detail=True),
    "unsafe": Column("", "what is unsafe", is_detail=True),
}
SETS: Columns = {
    "car": "name of the car",
    "fit": Column(
        "-", "number of the parameter set in [spread] (0: that of the study)", "d"
    ),
    "up_to": Column("", "greatest value up to which it is safe with this set", ".10g"),
    "test": "the test that limits it",
    "encounter": "the encounter in which it is unsafe",
    "phase": PHASE_COLUMN,
    "outcome": "what happens there",
    "simulate": "the command that simulates it",
}


NO_FAILURE: JsonObject = dict.fromkeys(
    ("test", "encounter", "phase", "outcome", "simulate")
)
"""The columns that say how a car fails, where it does not."""


def failure_columns(
    failures: Sequence[LimitingFailure | None], *, with_car: bool = False
) -> list[JsonObject]:
    """The columns of failures, simulated once more as they are printed, and each in a sentence
    without its end, `because`; `with_car` names the car's values in it, too.
    """
    found = [{**NO_FAILURE, "because": ""}] * len(failures)
    of_range = dict[int, dict[int, LimitingFailure]]()
    for number, failure in enumerate(failures):
        if failure is not None:
            of_range.setdefault(id(failure.encounters), {})[number] = failure
    for known in of_range.values():
        settings = np.array([failure.setting for failure in known.values()])
        encounters = next(iter(known.values())).encounters
        model = encounters.model
        members = model.characteristics
        described = failures_at(model, settings)
        for row, number in enumerate(known):
            failed = described[row]
            words = failed.words.partition(" (parameter set")[0]
            if with_car:
                values = dict(
                    zip(members.vehicle.names, settings[row].tolist(), strict=False)
                )
                changes = change_texts(members.vehicle, values, are_printed=True)
                words = f"with {join_phrases(changes or ['no change'])}, {words}"
            left_out = {*OF_ENCOUNTER, *members.names}
            met = {
                name: value
                for name, value in failed.point.items()
                if name not in left_out
            }
            met |= members.scenario.named(settings[row, ~members.of_vehicle])
            phase = met.pop(PHASE, None)
            texts = texts_of(model.evaluator.system.points[0], met)
            found[number] = {
                "test": encounters.test or None,
                "encounter": ", ".join(f"{name} {text}" for name, text in texts.items())
                or None,
                "phase": phase,
                "outcome": failed.breach,
                "simulate": failed.command,
                "because": words,
            }
    return found


def verdict_of(
    up_to: float | None,
    new_car: float,
    top: float,
    need: float | None,
    *,
    is_proven: bool,
) -> str:
    """What a car may do; without a search for counterexamples none may drive without a limit."""
    if up_to is None:
        return STOP
    is_enough = up_to >= (min(top, new_car) if need is None else need)
    return DRIVE if is_enough and is_proven else LIMITED


def because(
    permit: Permit,
    words: str,
    verdict: str,
    span: Span,
    new_car: float,
    need: float | None,
) -> str:
    """Why a car may drive no faster, in one sentence for a foreman."""
    unit = unit_text(span.unit)
    up_to = permit.up_to
    if up_to is None:
        return f"Not even at {span.low:g}{unit}: {words}."
    if not words:
        name = span.name.replace("_", " ")
        return f"Safe {span.up_to(up_to)}, the greatest {name} that was driven."
    if verdict != DRIVE:
        return f"{words[:1].upper()}{words[1:]}."
    if need is not None and up_to >= need:
        return f"Safe {span.up_to(up_to)}, and {need:g}{unit} is needed."
    return f"As fast as the new car, which is safe {span.up_to(new_car)}: {words}."


def set_rows(
    names: Sequence[str], permits: Sequence[Permit], *, with_car: bool
) -> list[JsonObject]:
    """The rows of `SETS`."""
    reached = [
        (name, each)
        for name, permit in zip(names, permits, strict=True)
        for each in permit.reached
    ]
    found = failure_columns([each.failure for _, each in reached], with_car=with_car)
    return [
        {"car": name, **each._asdict(), **columns}
        for (name, each), columns in zip(reached, found, strict=True)
    ]
