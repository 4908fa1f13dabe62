"""What is wrong with a table: every mistake by its key, with what would be right."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterable, Iterator, Mapping
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin

import msgspec
from msgspec import Struct

from safevar_sumo.errors import InputError, unknown
from safevar_sumo.study.schema import CharacteristicTable, Study

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


LARGEST = 1e12
"""Of what a characteristic may be, in its unit."""
DEEPEST = 12
"""Tables inside each other."""
MOST_VALUES = 100_000
"""In all tables together."""
LONGEST_KEY = 200
MOST_CHARACTERISTICS = 1000


def unusable(source: object, raw: Mapping[str, Any]) -> Iterator[InputError]:
    """Values anywhere in a study's tables that nobody can use the same way everywhere."""
    waiting: list[tuple[str, Any, int]] = [("", raw, 0)]
    seen = 0
    while waiting:
        where, value, depth = waiting.pop()
        seen += 1
        if depth > DEEPEST or seen > MOST_VALUES:
            legal = f"up to {DEEPEST} tables inside each other and {MOST_VALUES} values"
            yield InputError(source, f"{where[:80]}: is nested too deeply, or there is too much of it", legal)
            return
        if isinstance(value, Mapping | list | tuple):
            inner = value.items() if isinstance(value, Mapping) else enumerate(value)
            entries = [(str(key), one) for key, one in inner]
            for key, _ in entries:
                if len(key) > LONGEST_KEY or not key.isprintable():
                    yield InputError(source, f"{where or 'a key'}: {key[:40]!r} is no name", f"up to {LONGEST_KEY} printable characters")
            waiting += reversed([(f"{where}.{key}" if where else key, one, depth + 1) for key, one in entries])
        else:
            reason = _unusable(value, where)
            if reason:
                yield InputError(source, f"{where} = {reason[0]}", reason[1])


def _unusable(value: object, where: str) -> tuple[str, str] | None:
    """How a value is told, and what would be legal instead; None where it can be used."""
    if isinstance(value, datetime.date | datetime.time):
        return f"{value}, a date or time", "a number, or a text in quotes"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value), "a finite number"
    if isinstance(value, int) and not -2**63 <= value < 2**63:
        return f"an integer of {value.bit_length()} bits", "an integer of 64 bits"
    if isinstance(value, str) and ".parameters." not in f".{where}" and not value.isprintable():
        return repr(value)[:80], "a text without control characters"
    return None


def implausible(source: object, study: Study) -> Iterator[InputError]:
    """Numbers of a study that contradict each other."""
    rows = study.vehicle.characteristics
    if not 1 <= len(rows) <= MOST_CHARACTERISTICS:
        yield InputError(source, f"vehicle.characteristics: {len(rows)} of them", f"1 to {MOST_CHARACTERISTICS}")
    for name, row in rows.items():
        yield from _characteristic(source, f"vehicle.characteristics.{name}", row)
    for name, free in study.calibration.items():
        if free.lower >= free.upper:
            yield InputError(source, f"calibration.{name!r}: lower = {free.lower} and upper = {free.upper}", "numbers, lower < upper")
    if study.matrix is not None and study.matrix.aggregate == "mean":
        yield InputError(source, "matrix.aggregate = 'mean' would average distances [m] with minus the speeds of collisions [m/s]",
                         "'worst', the point in which a setting comes off worst")
    for name, number in study.published.items():
        if number == 0:
            yield InputError(source, f"published.{name} = 0", "a number other than 0")


def _characteristic(source: object, key: str, row: CharacteristicTable) -> Iterator[InputError]:
    for name, value in {"original": row.original, "lower": row.lower, "upper": row.upper}.items():
        if abs(value) > LARGEST:
            yield InputError(source, f"{key}.{name} = {value}", f"a number up to {LARGEST:g}")
    if row.lower >= row.upper:
        yield InputError(source, f"{key}: lower = {row.lower} and upper = {row.upper}", "lower < upper")
    elif not row.lower <= row.original <= row.upper:
        yield InputError(source, f"{key}.original = {row.original}", f"a value in [{row.lower}, {row.upper}]")
    if row.original == 0:
        yield InputError(source, f"{key}.original = 0", "a value other than 0: changes are relative to it")
