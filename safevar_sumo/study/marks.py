"""Marks on the fields of a study's records. A mark says what the key of a field affects, or whether
a study inherits the key from the study that it `extends`.
"""

from __future__ import annotations

from functools import cache
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import msgspec
from msgspec import Meta, Struct


class Table(Struct, frozen=True, forbid_unknown_fields=True):
    """Base of the tables of a study file, and of the parameters of models. Unknown keys are
    refused.
    """


def _mark(name: str) -> Meta:
    return Meta(extra={name: True})


WITHOUT_EFFECT = _mark("without effect")
"""The key changes no evaluation."""
ORDERED = _mark("ordered")
"""The order of the keys in this table changes results, because arrays of settings and points are in
this order.
"""
PART_OF_SYSTEM = _mark("part of system")
"""The key names a part of the simulated system: a model and its network, a weather, or a matrix."""
OF_SYSTEM = _mark("of system")
"""The key describes one system. A study with another part of the system does not inherit the
key.
"""
OF_VEHICLE_AND_ADS = _mark("of vehicle and ADS")
"""The key is about parameters of the vehicle and of the ADS. A study with another vehicle or
another ADS does not inherit the key.
"""
OF_SCENARIO = _mark("of scenario")
"""The key is about one scenario. A study that names another scenario does not inherit the key."""
OF_STUDY = _mark("of study")
"""The key is about one study. No other study inherits the key."""
WHOLE = _mark("whole")
"""A study inherits the whole table or nothing: single keys of the table cannot be overridden."""


fields_of = cache(msgspec.structs.fields)
"""The fields of a record. Without the cache, msgspec would evaluate the annotations each time."""


def keys_with(mark: Meta, record: type[Table]) -> tuple[str, ...]:
    """The keys of a record's fields that have this mark."""
    return tuple(
        field.name
        for field in fields_of(record)
        if mark in getattr(field.type, "__metadata__", ())
    )


def with_effect(value: Any, kind: Any) -> Any:
    """A value as plain tables, without the keys that change no evaluation. If the order of a
    table's keys changes results, the order is added. `kind` is the type of the value.
    """
    origin = get_origin(kind)
    inner_kinds = get_args(kind)
    if origin is Annotated:
        return with_effect(value, inner_kinds[0])
    if origin is dict:
        return {name: with_effect(item, inner_kinds[1]) for name, item in value.items()}
    if origin is list:
        return [with_effect(item, inner_kinds[0]) for item in value]
    if origin in (Union, UnionType) and isinstance(value, dict):
        records = (member for member in inner_kinds if isinstance(member, type))
        return with_effect(value, next(records, None))
    if not (isinstance(kind, type) and issubclass(kind, Table)):
        return value
    kinds = {field.name: field.type for field in fields_of(kind)}
    effects = {
        f"order of {key}": list(value[key])
        for key in keys_with(ORDERED, kind)
        if key in value
    }
    without_effect = keys_with(WITHOUT_EFFECT, kind)
    for key, item in value.items():
        if key not in without_effect:
            effects[key] = with_effect(item, kinds.get(key))
    return effects
