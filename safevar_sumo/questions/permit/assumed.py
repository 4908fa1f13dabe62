"""What nobody measured on a car: the values that stand in its place, in words, and for one car the
one of them that lowers the speed most.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from safevar_sumo.questions.models import Models
from safevar_sumo.questions.permit.encounters import Span
from safevar_sumo.questions.permit.fleet import Fleet
from safevar_sumo.questions.permit.search import Permit, PermitSearch, with_value_of
from safevar_sumo.questions.permit.speeds import Cars
from safevar_sumo.questions.words import EXACT, join_phrases
from safevar_sumo.records import FloatArray
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
    return np.array([f"{item.name} {value:{EXACT}}{item.suffix}" for item, value in pairs])


def assumed_in_words(study: Study, vehicle: CharacteristicSet, fleet: Fleet) -> str:
    """What is assumed of all cars, with its value and where that comes from, and in how many cars
    more than that is, in a sentence; empty if all was measured.
    """
    is_stated = fleet.measured.any(axis=0)
    texts = _texts(vehicle, fleet.settings[0])
    phrases = list[str]()
    for column in np.flatnonzero(~is_stated):
        item = vehicle.members[column]
        source = "by [unmeasured]" if item.name in study.unmeasured else "as in a new car"
        phrases.append(f"{texts[column]} ({item.short_name}, {source})")
    if further := np.sum((fleet.measured < is_stated).any(axis=1)):
        cars = f"{further} of {len(fleet.names)} cars"
        phrases.append(f"values in {cars} that others state (column assumed, --details)")
    return f"Assumed, as not measured: {join_phrases(phrases)}." if phrases else ""


def worst_end_in_words(
    models: Models, span: Span, values: FloatArray, fleet: Fleet, permit: Permit
) -> str:
    """Which assumed value of one car lowers its speed most at an end of its domain, and to what at
    most, in a sentence; empty if nothing is assumed, or the car may not drive as it is.
    """
    up_to = permit.up_to
    if up_to is None or fleet.measured.all():
        return ""
    # The car with each assumed value at either end, side by side. Any failure shows that it may
    # drive no faster, so the grid up to its own speed is enough, with the set that limits it.
    vehicle = models.own.characteristics.vehicle
    (setting,) = fleet.settings
    cars = [
        Cars.one(with_value_of(setting, column, ends))
        for column in np.flatnonzero(~fleet.measured[0]).tolist()
        for ends in (vehicle.lower, vehicle.upper)
    ]
    limiting = Models((models.members[permit.least.fit],), ())
    grid = PermitSearch(limiting, span._replace(high=up_to), values[values <= up_to], budget=0)
    found = [each.least.failure for each in grid.reach(cars, [None] * len(cars))]
    failures = [failure for failure in found if failure is not None]
    name = span.name.replace("_", " ")
    shown = "Of these, at the ends of their domains and with the parameter set that limits the car,"
    if not failures:
        return f"{shown} none lowers the {name} on the grid."

    # The failure at the least value, and what is not as in the car itself.
    worst = min(failures, key=lambda failure: failure.value)
    other = worst.setting[: len(setting)]
    (text,) = _texts(vehicle, other)[other != setting]
    value = f"{max(worst.value, span.low):g}{unit_text(span.unit)}"
    return f"{shown} {text} lowers the {name} most: the car is unsafe already at {value}."
