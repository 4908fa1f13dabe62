"""What nobody knows of a car: the interval of what was measured, the values in place of what was
not, and the one of these that lowers the speed most.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from safevar_sumo.questions.permit.encounters import Span
from safevar_sumo.questions.permit.fleet import Fleet
from safevar_sumo.questions.permit.search import Permit, PermitSearch
from safevar_sumo.questions.permit.speeds import Cars
from safevar_sumo.questions.words import EXACT, join_phrases
from safevar_sumo.records import BoolArray, FloatArray
from safevar_sumo.study import Study, unit_text
from safevar_sumo.vehicles import CharacteristicSet


def assumed_cells(vehicle: CharacteristicSet, fleet: Fleet) -> list[str | None]:
    """For each car what was not measured with the value that is assumed, such as `brakeResponse
    0.2 s, sensorLatency 0.1 s`; None if all was measured.
    """
    return [
        ", ".join(_texts(vehicle, setting)[~measured]) or None
        for setting, measured in zip(fleet.settings, fleet.measured, strict=True)
    ]


def _texts(vehicle: CharacteristicSet, setting: FloatArray) -> NDArray[Any]:
    """The values of a car, such as `brakeResponse 0.2 s`, shape (n,)."""
    pairs = zip(vehicle, setting, strict=True)
    return np.array(
        [f"{item.name} {value:{EXACT}}{item.suffix}" for item, value in pairs]
    )


def assumed_in_words(study: Study, vehicle: CharacteristicSet, fleet: Fleet) -> str:
    """What is assumed of all cars, with its value and where that comes from, and in how many cars
    more than that is, in a sentence; empty if all was measured.
    """
    is_stated = fleet.measured.any(axis=0)
    texts = _texts(vehicle, fleet.settings[0])
    phrases = list[str]()
    for column in np.flatnonzero(~is_stated):
        item = vehicle.members[column]
        source = "by [unmeasured]" if item.name in study.unmeasured else "as new"
        phrases.append(f"{texts[column]} ({item.short_name}, {source})")
    if further := np.sum((fleet.measured < is_stated).any(axis=1)):
        cars = f"{further} of {len(fleet.names)} cars"
        phrases.append(
            f"values in {cars} that others state (column assumed, --details)"
        )
    return f"Assumed, because not measured: {join_phrases(phrases)}." if phrases else ""


def cars_of(vehicle: CharacteristicSet, fleet: Fleet) -> list[Cars]:
    """The cars of a list, with all values that their measured ones may really have."""
    ends = np.array(
        [
            [item.measured(value) for item, value in zip(vehicle, setting, strict=True)]
            for setting in fleet.settings
        ]
    )
    ends = np.where(
        fleet.measured[..., np.newaxis], ends, fleet.settings[..., np.newaxis]
    )
    return [Cars.measured(*car.T) for car in ends]


class WorstEnd(NamedTuple):
    """The assumed value of a car that lowers its speed most at an end of its domain: the name of
    the characteristic, the end as text, and the value at which the car is unsafe then.
    """

    name: str
    text: str
    value: float


def worst_end(
    search: PermitSearch,
    vehicle: CharacteristicSet,
    car: Cars,
    is_measured: BoolArray,
    permit: Permit,
) -> WorstEnd | None:
    """The worst end of a car; None where nothing is assumed, the car may not drive as it is, or no
    end lowers its speed on the grid.
    """
    if permit.up_to is None or is_measured.all():
        return None

    # Each assumed value at either end, all others as they are worst. Any failure shows that the car
    # may drive no faster, so the grid up to its own speed is enough, with the set that limits it.
    limiting = permit.least.failure
    own = car.lower if limiting is None else limiting.setting[: len(vehicle)]
    is_one = np.eye(len(vehicle), dtype=bool)[~is_measured]
    sides = [np.where(is_one, end, own) for end in (vehicle.lower, vehicle.upper)]
    failure = search.worst_end(Cars(own, own, np.vstack(sides)), permit)
    worst = own if failure is None else failure.setting[: len(vehicle)]
    if failure is None or (worst == own).all():
        return None
    column = np.argmax(worst != own)
    item = vehicle.members[column]
    return WorstEnd(item.name, f"{worst[column]:{EXACT}}{item.suffix}", failure.value)


def worst_end_in_words(worst: WorstEnd | None, span: Span) -> str:
    """The worst end of one car, in a sentence."""
    name = span.name.replace("_", " ")
    shown = "Of these, at the ends of their domains and with the parameter set that limits the car,"
    if worst is None:
        return f"{shown} none lowers the {name} on the grid."
    value = f"{max(worst.value, span.low):g}{unit_text(span.unit)}"
    end = f"{worst.name} {worst.text}"
    return (
        f"{shown} {end} lowers the {name} most: the car is unsafe already at {value}."
    )
