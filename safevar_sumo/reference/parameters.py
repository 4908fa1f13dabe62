"""Free parameters of studies that are fitted together. One study has a parameter alone, or several studies share it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from safevar_sumo.analysis.parameters import value_of, with_values
from safevar_sumo.errors import InputError
from safevar_sumo.study import FreeParameter, Study
from safevar_sumo.sumo.system import models_of


class FittedParameter(NamedTuple):
    """A free parameter: its key, the indices of the studies that take its value, and its bounds."""

    key: str
    study_indices: tuple[int, ...]
    bounds: FreeParameter

    def label(self, studies: Sequence[Study]) -> str:
        """The key; if not all studies share the parameter, with the names of those that do: `STUDY, STUDY: KEY`."""
        names = ", ".join(studies[k].name for k in self.study_indices)
        return self.key if len(self.study_indices) == len(studies) else f"{names}: {self.key}"


def free_parameters(studies: Sequence[Study]) -> list[FittedParameter]:
    """The free parameters of studies that are fitted together.

    Studies that give a parameter the same value share the parameter, except studies whose table [calibration] marks it as `own`.
    A study with another value, or without the parameter, does not take part.

    Raises
    ------
    InputError
        If a parameter of a table [calibration] cannot be fitted, or its value lies outside its bounds.
    """
    parameters: list[FittedParameter] = []
    for index, study in enumerate(studies):
        for key, bounds in study.calibration.items():
            if any(key == parameter.key and index in parameter.study_indices for parameter in parameters):
                continue
            value = value_of(study, key)
            if not bounds.lower <= value <= bounds.upper:
                legal = f"a value in its bounds, [{bounds.lower:g}, {bounds.upper:g}]"
                raise InputError(study.source, f"{key} = {value}", legal)
            check_bounds(study, key, bounds)
            sharing_indices = (k for k, other in enumerate(studies) if k > index and not bounds.own and _is_shared_by(other, key, value))
            parameters.append(FittedParameter(key, (index, *sharing_indices), bounds))
    return parameters


def _is_shared_by(study: Study, key: str, value: float) -> bool:
    """Whether a study shares a parameter that has `value` in another study."""
    declaration = study.calibration.get(key)
    if declaration is not None and declaration.own:
        return False
    try:
        return value_of(study, key) == value
    except InputError:
        return False


def check_bounds(study: Study, key: str, bounds: FreeParameter) -> None:
    """Refuse bounds if the models do not accept a value at one of their ends: the search may try both ends."""
    if bounds.log and bounds.lower <= 0:
        raise InputError(study.source, f"calibration.{key!r} has log = true and lower = {bounds.lower:g}",
                         "a lower bound above 0")
    for end in ("lower", "upper"):
        bound = getattr(bounds, end)
        try:
            models_of(with_values(study, {key: bound}), key)
        except InputError as error:
            legal = error.legal or error.problem
            raise InputError(study.source, f"calibration.{key!r}.{end} = {bound:g}", legal) from None
