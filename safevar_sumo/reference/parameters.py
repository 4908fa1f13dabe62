"""Free parameters of studies that are fitted together: a study's own, or shared by several."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from safevar_sumo.analysis.parameters import value_of, with_values
from safevar_sumo.errors import InputError
from safevar_sumo.study import FreeParameter, Study
from safevar_sumo.sumo.system import models_of


class Free(NamedTuple):
    """A free parameter: its key, the indices of the studies that take its value, and its bounds."""

    key: str
    studies: tuple[int, ...]
    bounds: FreeParameter

    def label(self, studies: Sequence[Study]) -> str:
        """The key; after the names of its studies if not all of them share it."""
        return self.key if len(self.studies) == len(studies) else f"{', '.join(studies[k].name for k in self.studies)}: {self.key}"


def free_parameters(studies: Sequence[Study]) -> list[Free]:
    """The free parameters of studies that are fitted together.

    All studies that give a parameter the same value share it, except a study whose table marks it as `own`. A study that gives it
    another value, or none, does not take part.

    Raises
    ------
    InputError
        If a declared parameter cannot be fitted, or its value is outside its bounds.
    """
    free: list[Free] = []
    for index, study in enumerate(studies):
        for key, bounds in study.calibration.items():
            if any(key == one.key and index in one.studies for one in free):
                continue
            value = value_of(study, key)
            if not bounds.lower <= value <= bounds.upper:
                legal = f"a value in its bounds, [{bounds.lower:g}, {bounds.upper:g}]"
                raise InputError(study.source, f"{key} = {value}", legal)
            check_bounds(study, key, bounds)
            others = () if bounds.own else (k for k, other in enumerate(studies) if k > index and _shares(other, key, value))
            free.append(Free(key, (index, *others), bounds))
    return free


def _shares(study: Study, key: str, value: float) -> bool:
    """Whether a study shares a parameter to which another study gives `value`."""
    declared = study.calibration.get(key)
    if declared is not None and declared.own:
        return False
    try:
        return value_of(study, key) == value
    except InputError:
        return False


def check_bounds(study: Study, name: str, bounds: FreeParameter) -> None:
    """Refuse bounds that the models do not accept: a search goes that far."""
    if bounds.log and bounds.lower <= 0:
        raise InputError(study.source, f"calibration.{name!r} has log = true and lower = {bounds.lower:g}",
                         "a lower bound above 0")
    for side in ("lower", "upper"):
        bound = getattr(bounds, side)
        try:
            models_of(with_values(study, {name: bound}), name)
        except InputError as error:
            legal = error.legal or error.problem
            raise InputError(study.source, f"calibration.{name!r}.{side} = {bound:g}", legal) from None
