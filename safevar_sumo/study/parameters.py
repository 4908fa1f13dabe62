"""Parameters of a scenario or a weather that a study may search. Fields of their classes declare
them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, get_args, get_type_hints
from weakref import WeakKeyDictionary

import msgspec
from msgspec import Meta

from safevar_sumo.study.marks import Table

PHASE = "phase"
"""The parameter by which the whole encounter begins later. Its unit is the time between two
decisions of the driving system.
"""
PHASE_DECIMALS = 4
"""Decimals to which phases are rounded. A range of unsafe phases may be as narrow as 0.1 % of a
step.
"""

_hints = WeakKeyDictionary[type, dict[str, Any]]()
"""The types of classes' fields. Python evaluates the annotations in the class's module, which may
be loaded only while user code runs.
"""


class FreeParameter(Table, frozen=True, kw_only=True):
    """A parameter that a repair or a search may change: its bounds `lower` and `upper` in `unit`,
    and its `meaning`.

    With `log = true`, the search compares two values of the parameter by their ratio, else by their
    difference. Ratios suit positive quantities of unknown magnitude.
    """

    lower: float
    upper: float
    unit: str
    meaning: str
    log: bool = False


def searched(lower: float, upper: float, unit: str, meaning: str) -> Meta:
    """The mark of a field that a study may search. The mark states the widest domain, the unit and
    the meaning: `speed: Annotated[float, searched(10, 80, "km/h", "speed of the vehicle")] = 40.0`.
    """
    return Meta(
        description=meaning,
        extra={
            "free": FreeParameter(lower=lower, upper=upper, unit=unit, meaning=meaning)
        },
    )


def free_parameters(model: type) -> dict[str, FreeParameter]:
    """The fields of a class that a study may search. The class is a `msgspec.Struct` or a
    dataclass. A field is marked by `searched`, or by a `Meta` with the bounds `ge` and `le`, a
    `description` and `extra={"unit": ...}`.
    """
    if not (issubclass(model, msgspec.Struct) or dataclasses.is_dataclass(model)):
        return {}
    parameters = {}
    for name, kind in _hints_of(model).items():
        for meta in _metas_in(kind):
            extra = meta.extra or {}
            if "free" in extra:
                parameters[name] = extra["free"]
            elif "unit" in extra and meta.ge is not None and meta.le is not None:
                parameters[name] = FreeParameter(
                    lower=float(meta.ge),
                    upper=float(meta.le),
                    unit=extra["unit"],
                    meaning=meta.description or name,
                )
    return parameters


def _hints_of(model: type) -> dict[str, Any]:
    """The types of a class's fields. They are evaluated only once."""
    if model not in _hints:
        _hints[model] = get_type_hints(model, include_extras=True)
    return _hints[model]


def _metas_in(kind: Any) -> Iterator[Meta]:
    """Yield the marks of a field's type, also the marks of members of a union."""
    for mark in getattr(kind, "__metadata__", ()):
        if isinstance(mark, Meta):
            yield mark
    for member in get_args(kind):
        yield from _metas_in(member)
