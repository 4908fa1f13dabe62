"""Parameters of a scenario or a weather that a study may search, as their fields declare them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import lru_cache
from typing import Any, get_args, get_type_hints

import msgspec
from msgspec import Meta

from safevar_sumo.study.marks import Table

PHASE = "phase"
"""The parameter of an encounter by which all of it begins later, as a share of the time between two
decisions of the driving system.
"""
PHASE_DECIMALS = 4
"""Decimals of a phase that is simulated and printed: unsafe windows of 0.1 % of a step occur."""

_hints_of = lru_cache(get_type_hints)
"""The types of a class's fields, which Python compiles anew each time."""


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
    """The mark of a field that a study may search, with the widest domain, unit and meaning:
    `speed: Annotated[float, searched(10, 80, "km/h", "speed of the vehicle")] = 40.0`.
    """
    return Meta(
        description=meaning,
        extra={
            "free": FreeParameter(lower=lower, upper=upper, unit=unit, meaning=meaning)
        },
    )


def free_parameters(model: type) -> dict[str, FreeParameter]:
    """The fields of a `msgspec.Struct` or dataclass that are marked by `searched`, or by a `Meta`
    with the bounds `ge` and `le`, a `description` and `extra={"unit": ...}`.
    """
    if not (issubclass(model, msgspec.Struct) or dataclasses.is_dataclass(model)):
        return {}
    parameters = {}
    for name, kind in _hints_of(model, include_extras=True).items():
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


def _metas_in(kind: Any) -> Iterator[Meta]:
    """The marks of a field's type, also within a union."""
    for mark in getattr(kind, "__metadata__", ()):
        if isinstance(mark, Meta):
            yield mark
    for member in get_args(kind):
        yield from _metas_in(member)
