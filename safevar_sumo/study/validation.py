"""Validation of tables: every mistake with its key and what is expected."""

from __future__ import annotations

import datetime
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec
from msgspec import Struct

from safevar_sumo.errors import InputError, did_you_mean, one_of, unknown
from safevar_sumo.study.constraints import constraint_mistakes
from safevar_sumo.study.schema import CharacteristicTable, Origin, Study
from safevar_sumo.study.variation import variation_mistakes

T = TypeVar("T")
MOST_SHOWN = 8
"""Largest number of mistakes of a file that an error lists."""


def converted(source: object, raw: object, table: type[T], prefix: str = "") -> T:
    """A table converted to a record.

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


def refuse(errors: Iterable[InputError]) -> None:
    """Raise mistakes as one error, if there are any."""
    mistakes = list(errors)
    if len(mistakes) == 1:
        raise mistakes[0]
    if mistakes:
        texts = [f"{error.problem}{f' (expected: {error.legal})' if error.legal else ''}" for error in mistakes[:MOST_SHOWN]]
        if len(mistakes) > MOST_SHOWN:
            texts.append(f"and {len(mistakes) - MOST_SHOWN} more")
        raise InputError(mistakes[0].source, f"{len(mistakes)} mistakes: {'; '.join(texts)}")


def mistakes(source: object, raw: Any, kind: Any, where: str = "") -> Iterator[InputError]:
    """All mistakes in `raw`, which should be of type `kind`."""
    if isinstance(kind, type) and issubclass(kind, Struct) and isinstance(raw, Mapping):
        fields = _fields(kind)
        for key in raw:
            if key not in fields and key != kind.__struct_config__.tag_field:
                yield _no_key(source, _inside(where, key), key, fields)
        for name, field in fields.items():
            if name in raw:
                yield from mistakes(source, raw[name], field.type, _inside(where, name))
            elif field.required:
                yield InputError(source, f"{_inside(where, name)} is missing")
    elif get_origin(kind) is dict and isinstance(raw, Mapping):
        for key, value in raw.items():
            inside, missing = _inside(where, str(key)), _missing(value, get_args(kind)[1])
            hint = did_you_mean(key, [name for name in raw if name != key]) if len(missing) > 1 else ""
            if hint:  # such a table changes single keys of one that is spelt otherwise
                yield InputError(source, f"{inside} lacks {', '.join(missing)}{hint}")
            else:
                yield from mistakes(source, value, get_args(kind)[1], inside)
    elif get_origin(kind) in (Union, UnionType) and isinstance(raw, Mapping) and (tables := _tables(kind)):
        field = tables[0].__struct_config__.tag_field
        by_tag = {table.__struct_config__.tag: table for table in tables}
        if len(tables) == 1 or raw.get(field) in by_tag:
            yield from mistakes(source, raw, by_tag.get(raw.get(field), tables[0]), where)
        else:
            yield _no_choice(source, _inside(where, field), raw.get(field), by_tag)
    elif get_origin(kind) is Literal:
        if raw not in get_args(kind):
            yield _no_choice(source, where, raw, get_args(kind))
    elif isinstance(raw, list) and get_origin(bare := get_args(kind)[0] if get_origin(kind) is Annotated else kind) is list and (
            of_members := [one for i, value in enumerate(raw) for one in mistakes(source, value, get_args(bare)[0], f"{where}[{i}]")]):
        yield from of_members
    else:
        try:
            msgspec.convert(raw, kind)
        except msgspec.ValidationError as error:
            yield invalid(source, raw, error, where)


def _missing(raw: object, kind: Any) -> list[str]:
    """The required keys that a table lacks; none if `kind` is no record."""
    is_table = isinstance(kind, type) and issubclass(kind, Struct) and isinstance(raw, Mapping)
    return [name for name, field in _fields(kind).items() if field.required and name not in raw] if is_table else []  # type: ignore[operator]


def _no_key(source: object, where: str, key: str, fields: Iterable[str]) -> InputError:
    """The error for an unknown key: it suggests the tables of a study that have this key, else the nearest key of its own table."""
    tables = {name: _tables(field.type) for name, field in _fields(Study).items()}
    elsewhere = [f"{name}.{key}" for name, kinds in tables.items() if any(key in _fields(kind) for kind in kinds)]
    if elsewhere:
        return InputError(source, f"{where}: there is no such key; did you mean {' or '.join(elsewhere)}?", one_of(fields))
    return unknown(source, f"{where}: there is no such key", key, fields)


@cache
def _fields(kind: type[Struct]) -> dict[str, msgspec.structs.FieldInfo]:
    """A record's fields by name; cached, as msgspec evaluates their annotations anew each time."""
    return {field.name: field for field in msgspec.structs.fields(kind) if field.type is not Origin}


def _tables(kind: Any) -> list[Any]:
    """The records among the alternatives of a type."""
    return [option for option in get_args(kind) or (kind,) if isinstance(option, type) and issubclass(option, Struct)]


def _no_choice(source: object, where: str, value: object, names: Iterable[str]) -> InputError:
    """The error for a value that is none of `names`, of which "" stands for leaving the key out."""
    problem = f"{where} is missing" if value is None else f"{where} = {_short(value)}"
    return unknown(source, problem, value, filter(None, names), ", or no such key" * ("" in names))


def _inside(where: str, key: str) -> str:
    shown = repr(key) if "." in key or not key.isprintable() else key
    return f"{where}.{shown}" if where else shown


def invalid(source: object, raw: object, error: msgspec.ValidationError, prefix: str = "") -> InputError:
    """Turn msgspec's error on `raw` into one that names the key and its value."""
    problem, _, location = str(error).partition(" - at `$")
    keys = [key for key in location.rstrip("`").replace("[...]", "").split(".") if key]
    value, exists = raw, True
    for key in keys:
        exists = exists and isinstance(value, dict) and key in value
        value = value[key] if exists and isinstance(value, dict) else None
    where = ".".join([*([prefix] if prefix else []), *keys])
    if exists and where:
        return InputError(source, f"{where} is a table" if isinstance(value, dict) else f"{where} = {_short(value)}", _legal(problem))
    return InputError(source, f"{where}: {problem}" if where else problem)


WORDS_OF_TYPES = {"float": "a number", "int": "a whole number", "str": "a text", "bool": "true or false", "array": "a list",
                  "object": "a table", "null": ""}


def _legal(problem: str) -> str:
    """What is expected, from msgspec's words, such as "Expected `int | null`, got `str`"."""
    expected = re.sub(r"^Expected |, got `[^`]*`$", "", problem)
    return re.sub(r"`([a-z| ]+)`", lambda types: " or ".join(filter(None, (WORDS_OF_TYPES.get(one, one) for one in types[1].split(" | ")))),
                  expected)


def _short(value: object) -> str:
    try:
        text = repr(value)
    except ValueError:  # an integer of more digits than Python prints
        return "a number of thousands of digits"
    return text if len(text) <= 100 else f"{text[:97]}..."


LARGEST = 1e12
"""Largest magnitude of a characteristic, in its unit."""
DEEPEST = 32
"""Maximum nesting of tables and lists in a study; Python gives up at about a thousand."""


def unusable(source: object, value: object, where: str = "", depth: int = 0) -> Iterator[InputError]:
    """Unusable values and names anywhere in a study's tables; `value` lies within `depth` tables and lists."""
    if isinstance(value, Mapping | list | tuple) and depth > DEEPEST:
        yield InputError(source, f"{where.partition('.')[0]} is nested too deeply", f"at most {DEEPEST} tables within each other")
    elif isinstance(value, Mapping | list | tuple):
        for key, inner in value.items() if isinstance(value, Mapping) else enumerate(value):
            if not str(key).isprintable():
                yield InputError(source, f"{where or 'a key'}: {key!r} is no name", "printable characters")
            yield from unusable(source, inner, f"{where}.{key}" if where else str(key), depth + 1)
    elif reason := _unusable(value, where):
        yield InputError(source, f"{where} = {reason[0]}", reason[1])


def _unusable(value: object, where: str) -> tuple[str, str] | None:
    """An unusable value in words, and what is legal instead; None for others."""
    if isinstance(value, datetime.date | datetime.time):
        return f"{value}, a date or time", "a number, or a text in quotes"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value), "a finite number"
    if isinstance(value, int) and not -2**63 <= value < 2**63:
        return f"{str(value)[:30]}, beyond 64 bits", "an integer from -2^63 to 2^63 - 1"
    if isinstance(value, str) and ".parameters." not in f".{where}" and not value.isprintable():
        return repr(value)[:80], "a text without control characters"
    return None


def implausible(source: object, study: Study) -> Iterator[InputError]:
    """Numbers of a study that contradict each other."""
    rows = study.vehicle.characteristics
    if not rows:
        yield InputError(source, "vehicle.characteristics: none", "at least one")
    for name, row in rows.items():
        yield from _characteristic(source, f"vehicle.characteristics.{name}", row)
    yield from variation_mistakes(source, rows, study.variation, study.correlations)
    yield from constraint_mistakes(source, rows, study.constraints)
    for name, free in study.calibration.items():
        if free.lower >= free.upper:
            yield InputError(source, f"calibration.{name!r}: lower = {free.lower} and upper = {free.upper}", "numbers, lower < upper")
    if study.matrix is not None and bool(study.matrix.tests) == bool(study.matrix.protocol):
        yield InputError(source, f"matrix: {len(study.matrix.tests)} tests and protocol = {study.matrix.protocol!r}",
                         "tests, or a protocol")
    if len({len(values) for values in study.spread.values()}) > 1 or not all(study.spread.values()):
        yield InputError(source, "spread: its lists differ in length or are empty", "a list for each parameter, all of one length")
    if study.matrix is not None and study.matrix.aggregate == "mean":
        yield InputError(source, "matrix.aggregate = 'mean' would average distances [m] with minus the speeds of collisions [m/s]",
                         "'worst', the safety degree at a setting's worst point")
    for name, times in Counter(study.metrics.also).items():
        if times > 1:
            yield InputError(source, f"metrics.also = {study.metrics.also}: {name!r} is listed {times} times", "each metric once")
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
