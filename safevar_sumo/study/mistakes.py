"""What is wrong with a table: every mistake by its key, with what would be right."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin

import msgspec
from msgspec import Struct

from safevar_sumo.errors import InputError, unknown

T = TypeVar("T")
MOST_TOLD = 8
"""Mistakes of one file that are told."""


def converted(source: object, raw: object, table: type[T], prefix: str = "") -> T:
    """A table as what it should be.

    Raises
    ------
    InputError
        Naming every key that is wrong.
    """
    refuse(mistakes(source, raw, table, prefix))
    try:
        return msgspec.convert(raw, table)
    except msgspec.ValidationError as error:
        raise invalid(source, raw, error, prefix) from None


def refuse(found: Iterable[InputError]) -> None:
    """Raise mistakes as one error, if there are any."""
    several = list(found)
    if len(several) == 1:
        raise several[0]
    if several:
        told = [f"{one.problem}{f' (legal: {one.legal})' if one.legal else ''}" for one in several[:MOST_TOLD]]
        if len(several) > MOST_TOLD:
            told.append(f"and {len(several) - MOST_TOLD} more")
        raise InputError(several[0].source, f"{len(several)} mistakes: {'; '.join(told)}")


def mistakes(source: object, raw: Any, kind: Any, where: str = "") -> Iterator[InputError]:
    """Everything in `raw` that is not as `kind` says."""
    if isinstance(kind, type) and issubclass(kind, Struct) and isinstance(raw, Mapping):
        fields = {field.name: field for field in msgspec.structs.fields(kind)}
        for key in raw:
            if key not in fields:
                yield unknown(source, f"{_inside(where, key)}: there is no such key", key, fields)
        for name, field in fields.items():
            if name in raw:
                yield from mistakes(source, raw[name], field.type, _inside(where, name))
            elif field.required:
                yield InputError(source, f"{_inside(where, name)} is missing")
    elif get_origin(kind) is dict and isinstance(raw, Mapping):
        for key, value in raw.items():
            yield from mistakes(source, value, get_args(kind)[1], _inside(where, str(key)))
    elif get_origin(kind) in (Union, UnionType) and isinstance(raw, Mapping) and len(tables := _tables(kind)) == 1:
        yield from mistakes(source, raw, tables[0], where)
    else:
        try:
            msgspec.convert(raw, kind)
        except msgspec.ValidationError as error:
            yield invalid(source, raw, error, where)


def _tables(kind: Any) -> list[Any]:
    return [one for one in get_args(kind) if isinstance(one, type) and issubclass(one, Struct)]


def _inside(where: str, key: str) -> str:
    shown = repr(key) if "." in key or not key.isprintable() else key
    return f"{where}.{shown}" if where else shown


def invalid(source: object, raw: object, error: msgspec.ValidationError, prefix: str = "") -> InputError:
    """Turn msgspec's error on `raw` into one that names the key and its value."""
    problem, _, location = str(error).partition(" - at `$")
    keys = [key for key in location.rstrip("`").replace("[...]", "").split(".") if key]
    value, known = raw, True
    for key in keys:
        known = known and isinstance(value, dict) and key in value
        value = value[key] if known and isinstance(value, dict) else None
    where = ".".join([*([prefix] if prefix else []), *keys])
    if known and where and not isinstance(value, dict):
        return InputError(source, f"{where} = {_short(value)}", problem)
    return InputError(source, f"{where}: {problem}" if where else problem)


def _short(value: object) -> str:
    try:
        text = repr(value)
    except ValueError:  # an integer of more digits than Python prints
        return "a number of thousands of digits"
    return text if len(text) <= 100 else f"{text[:97]}..."
