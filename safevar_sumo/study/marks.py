"""Marks on the fields of a study's records: what the key of a field affects, and what a study that
`extends` another one inherits.
"""

from __future__ import annotations

from functools import cache
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import msgspec
from msgspec import Meta, Struct


class Table(Struct, frozen=True, forbid_unknown_fields=True):
    """A table of a study file, or the parameters of a model in it; a key that is unknown is a
    mistake.
    """


def _mark(name: str) -> Meta:
    return Meta(extra={name: True})


WITHOUT_EFFECT = _mark("without effect")
"""No evaluation depends on it."""
ORDERED = _mark("ordered")
"""The order of its keys has an effect, too: settings and points are arrays in this order."""
PART_OF_SYSTEM = _mark("part of system")
"""It names a part of the system that is studied: a model and its network, a weather, a matrix."""
OF_SYSTEM = _mark("of system")
"""It describes one system: a study in which a part of it differs does not inherit it."""
OF_VEHICLE_AND_ADS = _mark("of vehicle and ADS")
"""It is about parameters of both: a study in which one of them differs does not inherit it."""
OF_SCENARIO = _mark("of scenario")
"""It is about one scenario: a study that names another one does not inherit it."""
OF_STUDY = _mark("of study")
"""It is about one study: no other one inherits it."""
WHOLE = _mark("whole")
"""A study inherits it as a whole or not at all."""


fields_of = cache(msgspec.structs.fields)
"""The fields of a record, whose annotations msgspec evaluates anew each time."""


def keys_with(mark: Meta, record: type[Table]) -> tuple[str, ...]:
    """The keys of a record's fields that have a mark."""
    return tuple(
        field.name
        for field in fields_of(record)
        if mark in getattr(field.type, "__metadata__", ())
    )


def with_effect(value: Any, kind: Any) -> Any:
    """A value of a type, as plain tables, without the keys on which no evaluation depends, and with
    the order of the keys of tables whose order has an effect.
    """
    inner_kinds = get_args(kind)
    if get_origin(kind) is Annotated:
        return with_effect(value, inner_kinds[0])
    if get_origin(kind) is dict:
        return {name: with_effect(item, inner_kinds[1]) for name, item in value.items()}
    if get_origin(kind) is list:
        return [with_effect(item, inner_kinds[0]) for item in value]
    if get_origin(kind) in (Union, UnionType) and isinstance(value, dict):
        records = (member for member in inner_kinds if isinstance(member, type))
        return with_effect(value, next(records, None))
    if not (isinstance(kind, type) and issubclass(kind, Table)):
        return value
    kinds = {field.name: field.type for field in fields_of(kind)}
    effects = {}
    for key in keys_with(ORDERED, kind):
        if key in value:
            effects[f"order of {key}"] = list(value[key])
    without_effect = keys_with(WITHOUT_EFFECT, kind)
    for key, item in value.items():
        if key not in without_effect:
            effects[key] = with_effect(item, kinds.get(key))
    return effects
