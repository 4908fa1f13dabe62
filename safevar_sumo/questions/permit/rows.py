"""The rows of the tables of `permit`: the verdict of each car, and the failure that limits it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safevar_sumo.questions.answer import JsonRows
from safevar_sumo.questions.counterexamples import OF_ENCOUNTER, failures_at, texts_of
from safevar_sumo.questions.permit import words
from safevar_sumo.questions.permit.fleet import Fleet
from safevar_sumo.questions.permit.permits import Permit
from safevar_sumo.questions.permit.speed_search import LimitingFailure
from safevar_sumo.questions.sentence import Sentence, Sentences
from safevar_sumo.questions.tables import shipped_columns
from safevar_sumo.questions.words import EXACT, change_texts, join_phrases
from safevar_sumo.records import FloatArray, JsonObject
from safevar_sumo.study import PHASE, Study
from safevar_sumo.vehicles import CharacteristicSet

DRIVE = "drive"
LIMITED = "up to"
STOP = "stop"
"""Verdicts on a car. DRIVE: as fast as the user needs or, without a stated need, as fast as the new
car or the fastest test. LIMITED: up to a speed. STOP: not at all.
"""
CARS, SETS = shipped_columns("permit").values()
NO_FAILURE: JsonObject = dict.fromkeys(
    ("test", "encounter", "phase", "outcome", "simulate")
)
"""The columns that describe a failure, for a car that does not fail."""


def failure_columns(
    failures: Sequence[LimitingFailure | None], *, with_car: bool = False
) -> JsonRows:
    """For each failure, the columns that describe it; `because` has the failure in words. A failure
    is None for a car that does not fail.

    The printed settings are simulated once more. With `with_car` the words name the car's changed
    values, too.
    """
    columns = [{**NO_FAILURE, "because": ""}] * len(failures)
    of_range = dict[int, dict[int, LimitingFailure]]()
    for number, failure in enumerate(failures):
        if failure is not None:
            of_range.setdefault(id(failure.encounters), {})[number] = failure
    for numbered in of_range.values():
        settings = np.array([failure.setting for failure in numbered.values()])
        encounters = next(iter(numbered.values())).encounters
        model = encounters.model
        members = model.characteristics
        described = failures_at(model, settings)
        for row, number in enumerate(numbered):
            failed = described[row]
            event = failed.words.partition(" (parameter set")[0]
            if with_car:
                values = members.vehicle.named(settings[row, members.of_vehicle])
                changes = change_texts(members.vehicle, values, are_printed=True)
                phrases = join_phrases(changes or ["no change"])
                event = words.WITH_CHANGES.format(changes=phrases, event=event)
            named = {*OF_ENCOUNTER, *members.names}
            encounter = {
                name: value for name, value in failed.point.items() if name not in named
            }
            encounter |= members.scenario.named(settings[row, ~members.of_vehicle])
            phase = encounter.pop(PHASE, None)
            texts = texts_of(model.evaluator.system.points[0], encounter)
            columns[number] = {
                "test": encounters.test or None,
                "encounter": ", ".join(f"{name} {text}" for name, text in texts.items())
                or None,
                "phase": phase,
                "outcome": failed.breach,
                "simulate": failed.command,
                "because": event,
            }
    return columns


def verdict_of(
    safe_value: float | None,
    new_car: float,
    top: float,
    need: float | None,
    *,
    is_proven: bool,
) -> str:
    """The verdict on a car that is safe up to `safe_value` (None: not even at the least speed).

    `top` is the fastest driven speed, `need` the speed that the user needs, or None. `is_proven`
    says whether counterexamples were searched: otherwise no car may drive without a limit.
    """
    if safe_value is None:
        return STOP
    is_enough = safe_value >= (min(top, new_car) if need is None else need)
    return DRIVE if is_enough and is_proven else LIMITED


def set_rows(
    names: Sequence[str], permits: Sequence[Permit], *, with_car: bool
) -> JsonRows:
    """The rows of the table `SETS`: a row for each car and each parameter set that was driven."""
    cells = [
        {"car": name, **reached._asdict(), "up_to": reached.safe_value}
        for name, permit in zip(names, permits, strict=True)
        for reached in permit.reached
    ]
    failures = failure_columns([row["failure"] for row in cells], with_car=with_car)
    return [row | columns for row, columns in zip(cells, failures, strict=True)]


def assumed_cells(vehicle: CharacteristicSet, fleet: Fleet) -> list[str | None]:
    """For each car, the characteristics that were not measured, with the assumed values, such as
    `brakeResponse 0.2 s, sensorLatency 0.1 s`; None if all values were measured.
    """
    return [
        ", ".join(_texts(vehicle, setting)[~measured]) or None
        for setting, measured in zip(fleet.settings, fleet.measured, strict=True)
    ]


def _texts(vehicle: CharacteristicSet, setting: FloatArray) -> NDArray[Any]:
    """The n values of a car as texts, such as `brakeResponse 0.2 s`, shape (n,)."""
    pairs = zip(vehicle, setting, strict=True)
    return np.array(
        [f"{item.name} {value:{EXACT}}{item.suffix}" for item, value in pairs]
    )


def assumed_sentences(
    study: Study, vehicle: CharacteristicSet, fleet: Fleet
) -> Sentences:
    """Say which values are assumed in all cars, and whether a value is stated by the study or is
    that of the new car. Then say in how many cars further values are assumed.
    """
    is_measured = fleet.measured.any(axis=0)
    values: dict[Sentence, list[str]] = {words.ASSUMED: [], words.ASSUMED_NEW: []}
    for item, value in compress(
        zip(vehicle, fleet.settings[0], strict=True), np.logical_not(is_measured)
    ):
        template = words.ASSUMED_NEW
        if item.name in study.unmeasured:
            template = words.ASSUMED
        values[template].append(f"{item.short_name} {value:{EXACT}}{item.suffix}")
    for template, texts in values.items():
        if texts:
            yield template(values=join_phrases(texts))
    if further := np.sum((fleet.measured < is_measured).any(axis=1)):
        count = f"{further} of {len(fleet.names)} cars"
        yield words.FURTHER_ASSUMED(count=count)
