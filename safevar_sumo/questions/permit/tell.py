"""Makes the answer of `permit` from what was found: numbers, tables, verdict, and the list (CSV)
that fleet software reads.
"""

from __future__ import annotations

import pandas as pd

from safevar_sumo.questions.answer import Answer, JsonRows
from safevar_sumo.questions.counterexamples import limit_text
from safevar_sumo.questions.permit import words
from safevar_sumo.questions.permit.fleet import ROUGH, YES
from safevar_sumo.questions.permit.found import (
    DRIVE,
    LIMITED,
    STOP,
    Example,
    Found,
    FoundCar,
)
from safevar_sumo.questions.permit.verdict import (
    reason_of,
    slots_of,
    tested_sentence,
    too_slow,
    verdict_sentences,
)
from safevar_sumo.questions.sentence import Verdict
from safevar_sumo.questions.tables import NamedColumns, shipped_columns, tabulate
from safevar_sumo.records import JsonObject

NUMBERS = (
    "unsafe",
    "margin",
    "scope",
    "cars",
    "drive",
    "limited",
    "stop",
    "fits",
    "attacked",
    "step",
    "need",
    "not_driven_above",
    "rough",
)
CARS, SETS = shipped_columns("permit").values()
IN_UNIT = "up_to", "new_car_up_to", "up_to_after_repair"
"""The columns whose unit is that of the speed."""
DIGEST = "study_digest"
"""The column of the list with the digest that identifies the study, its models and versions."""
SHOWN_WHOLE = 50
"""Largest number of cars that one screen shows completely, because the list is the answer."""


def tell(found: Found) -> Answer:
    """The answer of `permit`."""
    columns = _in_unit(found, CARS)
    if found.is_test:
        columns["up_to"] = columns["up_to"]._replace(head="passes the test up to")
    rows = [_row_of(found, row, car) for row, car in enumerate(found.cars)]
    cars = pd.DataFrame(rows, columns=list(columns))
    ordered = cars.sort_values(
        "up_to", kind="stable", na_position="first", ignore_index=True
    )
    title = f"The cars, first those that {slots_of(found)['may_not']}"
    sets = tabulate("By parameter set", _in_unit(found, SETS), _set_rows(found))
    return Answer(
        question="permit",
        study=found.study,
        verdict=Verdict(verdict_sentences(found)),
        tested=Verdict([tested_sentence(found)]),
        numbers=_numbers(found),
        tables={
            "cars": tabulate(title, columns, ordered, shown_whole=SHOWN_WHOLE),
            "sets": sets,
        },
        folded=("sets",),
        failures=_failures(found),
        listing=_listing(found, cars),
    )


def _numbers(found: Found) -> JsonObject:
    """The numbers of the answer, by the names in `NUMBERS`."""
    counts = found.counts
    return {
        "unsafe": str(found.unsafe),
        "margin": found.unsafe.keep,
        "scope": found.scope,
        "cars": len(found.cars),
        "drive": counts[DRIVE],
        "limited": counts[LIMITED],
        "stop": counts[STOP],
        "fits": found.sets,
        "attacked": found.attacked,
        "step": found.step,
        "need": found.need,
        "not_driven_above": found.span.high,
        "rough": found.is_rough,
    }


def _failures(found: Found) -> tuple[str, ...]:
    """The reasons for which a gate (a command that must succeed) fails; () if it passes. A rough
    answer lets no car drive.
    """
    failures = []
    if found.too_slow:
        failures.append(too_slow(found).text)
    if found.need is not None and found.is_rough:
        failures.append(words.ROUGH_NEED)
    return tuple(failures)


def _in_unit(found: Found, columns: NamedColumns) -> NamedColumns:
    """The same columns; columns of speeds have the unit of the parameter."""
    named = dict(columns)
    for name in IN_UNIT:
        if name in named:
            named[name] = named[name]._replace(unit=found.span.unit)
    return named


def _row_of(found: Found, row: int, car: FoundCar) -> JsonObject:
    """The row of `CARS` for the car in a row of the list."""
    unsafe = found.unsafe
    least = car.permit.least
    cells: JsonObject = {
        **dict.fromkeys(CARS),
        "car": car.name,
        "up_to": least.safe_value,
        "new_car_up_to": found.new_car,
        "unit": found.span.unit,
        "verdict": found.verdict_of(car),
        "assumed": assumed_in_words(found, row) or None,
        "rough": found.is_rough,
        "parameter_sets": found.sets,
        "margin": unsafe.keep,
        "unsafe": str(unsafe),
    }
    if least.example is not None:
        cells |= least.example._asdict()
        cells["parameter_set"] = least.number
    cells["because"] = reason_of(found, car).text
    if car.repaired is not None:
        cells["repair_first"] = car.repaired.name
        cells["up_to_after_repair"] = car.repaired.safe_value
    if car.worst_end is not None:
        cells["assumed_matters_most"] = car.worst_end.name
    return cells


def assumed_in_words(found: Found, row: int) -> str:
    """The characteristics of the car in a row of the list that were not measured, with the assumed
    values, such as `brakeResponse 0.2 s, sensorLatency 0.1 s`; "" if all values were measured.
    """
    fleet = found.fleet
    texts = []
    for column, item in enumerate(found.vehicle.members):
        if not fleet.measured[row, column]:
            value = limit_text(item, fleet.settings[row, column])
            texts.append(f"{item.name} {value}")
    return ", ".join(texts)


def _set_rows(found: Found) -> JsonRows:
    """The rows of the table `SETS`: a row for each car and each parameter set that was driven."""
    rows = []
    for car in found.cars:
        for reached in car.permit.reached:
            example = reached.example or Example("")
            row = {
                "car": car.name,
                "fit": reached.number,
                "up_to": reached.safe_value,
            }
            rows.append(row | example._asdict())
    return rows


def _listing(found: Found, cars: pd.DataFrame) -> pd.DataFrame:
    """The list for fleet software: the user's columns, then the columns of the answer. The cars
    keep the user's order.
    """
    table = found.fleet.table
    if found.is_box:
        # With limits, the columns of values are not measured: only the name remains.
        table = table[table.columns[:1]]
    listing = pd.concat([table, cars.drop(columns="car")], axis=1)
    listing[ROUGH] = YES if found.is_rough else "no"
    listing[DIGEST] = found.digest
    return listing
