"""Free parameters of studies: by their keys in the study files, alone or shared by several studies that are fitted together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgspec

from safevar_sumo.errors import InputError
from safevar_sumo.scenarios import weather_of
from safevar_sumo.study import FreeParameter, Study, invalid
from safevar_sumo.sumo.system import models_of

FITTED = ("vehicle.parameters.", "ads.parameters.", "weather.")


class Free(NamedTuple):
    """A free parameter: its key, the numbers of the studies that take its value, and its bounds."""

    key: str
    studies: tuple[int, ...]
    bounds: FreeParameter

    def label(self, studies: Sequence[Study]) -> str:
        """Its key; with the study's name where only one of several takes it."""
        return self.key if len(self.studies) == len(studies) else f"{', '.join(studies[k].name for k in self.studies)}: {self.key}"


def free_parameters(studies: Sequence[Study]) -> list[Free]:
    """What is free in some studies that are fitted together.

    A parameter is shared by all studies that give it the same value now, unless a study's table says that it is its `own`. What the
    others give another value, or do not give at all, they keep.

    Raises
    ------
    InputError
        If a study declares something that cannot be fitted, or its value is outside its bounds.
    """
    found: list[Free] = []
    for number, study in enumerate(studies):
        for key, bounds in study.calibration.items():
            if any(key == free.key and number in free.studies for free in found):
                continue
            value = value_of(study, key)
            if not bounds.lower <= value <= bounds.upper:
                legal = f"a value in its bounds, [{bounds.lower:g}, {bounds.upper:g}]"
                raise InputError(f"study {study.name!r}", f"{key} = {value}", legal)
            check_bounds(study, key, bounds)
            others = () if bounds.own else (k for k, other in enumerate(studies) if k > number and _shares(other, key, value))
            found.append(Free(key, (number, *others), bounds))
    return found


def _shares(study: Study, key: str, value: float) -> bool:
    """Whether a study takes the value that another one gives a parameter."""
    declared = study.calibration.get(key)
    if declared is not None and declared.own:
        return False
    try:
        return value_of(study, key) == value
    except InputError:
        return False


def check_bounds(study: Study, name: str, bounds: FreeParameter) -> None:
    """A search goes as far as its bounds: the models must take them."""
    for side in ("lower", "upper"):
        bound = getattr(bounds, side)
        try:
            models_of(with_values(study, {name: bound}), name)
        except InputError as error:
            legal = error.legal or error.problem
            raise InputError(f"study {study.name!r}", f"calibration.{name!r}.{side} = {bound:g}", legal) from None


def with_values(study: Study, values: Mapping[str, float]) -> Study:
    """A study with other values of some parameters, named by their keys in the study file.

    Raises
    ------
    InputError
        If there is no such parameter, or it does not take the value.
    """
    raw = _raw(study)
    for name, value in values.items():
        table, key = _place(study, raw, name)
        table[key] = value
    try:
        return msgspec.convert(raw, Study)
    except msgspec.ValidationError as error:
        raise invalid(f"study {study.name!r}", raw, error) from None


def value_of(study: Study, name: str) -> float:
    """What a parameter is in the study."""
    table, key = _place(study, _raw(study), name)
    return float(table[key])


def _raw(study: Study) -> Any:
    """The study as tables; a weather that is given by its name as the table behind it."""
    return msgspec.to_builtins(msgspec.structs.replace(study, weather=weather_of(study.weather, f"study {study.name!r}")))


def _place(study: Study, raw: Any, name: str) -> tuple[Any, Any]:
    """The table or list that a parameter stands in, and its key or index there."""
    refused = InputError(f"study {study.name!r}", f"calibration.{name!r} is no parameter of the study",
                         f"a number that is given under {', '.join(prefix.rstrip('.') for prefix in FITTED)}")
    if not name.startswith(FITTED):
        raise refused
    *path, last = name.split(".")
    table = raw
    try:
        for key in path:
            table = table[_key(table, key)]
        place = _key(table, last)
        if not isinstance(table[place], int | float):
            raise refused
    except (KeyError, IndexError, ValueError, TypeError):
        raise refused from None
    return table, place


def _key(table: Any, name: str) -> int | str:
    """A list's places are told in one way only: two names of one parameter would be fitted against each other."""
    return int(name) if isinstance(table, list) and name == str(int(name)) else name
