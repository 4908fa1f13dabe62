"""Checks of the vehicle of a study: its characteristics, their units, and values that are plausible
in these units.
"""

from __future__ import annotations

from typing import Any

import msgspec

from safevar_sumo.errors import InputError, check_name
from safevar_sumo.study import Study
from safevar_sumo.study.characteristics import unit_text
from safevar_sumo.sumo.measuring import RESULT_COLUMNS
from safevar_sumo.vehicles import Vehicle
from safevar_sumo.vehicles.base import Plausible

MIN_HEADWAY = 0.5
"""Smallest original headway of SUMO's driver [s]. A smaller `tau` is an error: in older studies
`tau` was the lag of a vehicle's actuators.
"""


def check_units(study: Study, vehicle: Vehicle) -> None:
    """Refuse characteristics that the vehicle does not have, that have other units than the
    vehicle's, or that are missing.
    """
    table = study.vehicle.characteristics
    units = vehicle.UNITS
    if (
        "actuatorLag" in units
        and "tau" in table
        and ("actuatorLag" not in table or table["tau"].original < MIN_HEADWAY)
    ):
        raise InputError(
            "",
            f"vehicle.characteristics.tau.original = {table['tau'].original:g}: tau is the headway"
            " of SUMO's driver",
            f"at least {MIN_HEADWAY:g} s; the lag from pedal to wheel force is"
            " vehicle.characteristics.actuatorLag",
        )
    for name, entry in table.items():
        key = f"vehicle.characteristics.{name}"
        if name in RESULT_COLUMNS:
            raise InputError(
                "",
                f"{key}: the name is a column of results",
                f"none of {', '.join(RESULT_COLUMNS)}",
            )
        model = study.vehicle.model or study.scenario.model
        check_name("", f"{key}: {model} has no such characteristic", name, units)
        if entry.unit != units[name]:
            raise InputError("", f"{key}.unit = {entry.unit!r}", repr(units[name]))
    required = [name for name in units if name not in vehicle.OPTIONAL]
    for name in required:
        if name not in table:
            problem = f"vehicle.characteristics.{name} is missing"
            raise InputError("", problem, f"all of {', '.join(required)}")


def check_plausible(study: Study, vehicle: Vehicle) -> None:
    """Refuse values of characteristics and parameters outside the ranges that the vehicle states as
    plausible: such values are probably in another unit.
    """
    try:
        ranges = msgspec.convert(vehicle.PLAUSIBLE, dict[str, Plausible])
    except msgspec.ValidationError as error:
        raise InputError(
            "",
            f"vehicle.model = {study.vehicle.model!r}: PLAUSIBLE: {error}",
            "(lowest, highest) or (lowest, highest, unit) by name",
        ) from None
    for name, (lowest, highest, own_unit) in ranges.items():
        entry = study.vehicle.characteristics.get(name)
        if entry is None and name in vehicle.OPTIONAL:
            continue
        if entry is None and not hasattr(vehicle, name):
            raise InputError(
                "",
                f"vehicle.model = {study.vehicle.model!r}: PLAUSIBLE has {name!r}",
                "names of characteristics and of parameters",
            )
        values: list[tuple[str, Any]] = [
            (f"parameters.{name}", getattr(vehicle, name, None))
        ]
        if entry is not None:
            values = [
                (f"characteristics.{name}.{end}", getattr(entry, end))
                for end in ("original", "lower", "upper")
            ]
        unit = unit_text(own_unit if entry is None else entry.unit)
        for key, value in values:
            is_number = isinstance(value, int | float)
            if not (is_number and lowest <= value <= highest):
                legal = f"a plausible value, {lowest:g} to {highest:g}{unit}"
                text = f"{value:g}{unit}" if is_number else repr(value)
                raise InputError("", f"vehicle.{key} = {text}", legal)
