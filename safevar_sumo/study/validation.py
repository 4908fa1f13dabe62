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

from safevar_sumo.errors import InputError, did_you_mean, one_of, unknown_name
from safevar_sumo.study.constraints import constraint_mistakes
from safevar_sumo.study.schema import FMU_KEYS, CharacteristicTable, Origin, Study
from safevar_sumo.study.variation import variation_mistakes

T = TypeVar("T")
MAX_MISTAKES = 8
"""Largest number of mistakes of a file that an error lists."""


def convert_table(source: object, raw: object, table: type[T], prefix: str = "") -> T:
    """Convert a table to a record.

    Raises
    ------
    InputError
        If a key is wrong; the error names every wrong key.
    """
    raise_mistakes(mistakes(source, raw, table, prefix))
    try:
        return msgspec.convert(raw, table)
    except msgspec.ValidationError as error:
        raise error_with_key(source, raw, error, prefix) from None


def raise_mistakes(errors: Iterable[InputError]) -> None:
    """Raise all mistakes as one error; do nothing without mistakes."""
    all_errors = list(errors)
    if len(all_errors) == 1:
        raise all_errors[0]
    if all_errors:
        texts = [f"{error.problem}{f' (expected: {error.legal})' if error.legal else ''}" for error in all_errors[:MAX_MISTAKES]]
        if len(all_errors) > MAX_MISTAKES:
            texts.append(f"and {len(all_errors) - MAX_MISTAKES} more")
        raise InputError(all_errors[0].source, f"{len(all_errors)} mistakes: {'; '.join(texts)}")


def mistakes(source: object, raw: Any, kind: Any, key_path: str = "") -> Iterator[InputError]:
    """All mistakes in `raw`, which should be of type `kind`."""
    if isinstance(kind, type) and issubclass(kind, Struct) and isinstance(raw, Mapping):
        fields = _fields(kind)
        for key in raw:
            if key not in fields and key != kind.__struct_config__.tag_field:
                yield _unknown_key(source, _path_within(key_path, key), key, fields)
        for name, field in fields.items():
            if name in raw:
                yield from mistakes(source, raw[name], field.type, _path_within(key_path, name))
            elif field.required:
                model = f", for model = {short_text(raw['model'])}" if "model" in raw else ""
                yield InputError(source, f"{_path_within(key_path, name)} is missing{model}")
    elif get_origin(kind) is dict and isinstance(raw, Mapping):
        for key, value in raw.items():
            inner_path, missing_keys = _path_within(key_path, str(key)), _missing_keys(value, get_args(kind)[1])
            hint = did_you_mean(key, [name for name in raw if name != key]) if len(missing_keys) > 1 else ""
            if hint:  # the table probably overrides single keys of the table in the hint
                yield InputError(source, f"{inner_path} lacks {', '.join(missing_keys)}{hint}")
            else:
                yield from mistakes(source, value, get_args(kind)[1], inner_path)
    elif get_origin(kind) in (Union, UnionType) and isinstance(raw, Mapping) and (tables := _record_types(kind)):
        field = tables[0].__struct_config__.tag_field
        by_tag = {table.__struct_config__.tag: table for table in tables}
        if len(tables) == 1 or raw.get(field) in by_tag:
            yield from mistakes(source, raw, by_tag.get(raw.get(field), tables[0]), key_path)
        else:
            yield _unknown_choice(source, _path_within(key_path, field), raw.get(field), by_tag)
    elif get_origin(kind) is Literal:
        if raw not in get_args(kind):
            yield _unknown_choice(source, key_path, raw, get_args(kind))
    elif isinstance(raw, list) and get_origin(list_type := get_args(kind)[0] if get_origin(kind) is Annotated else kind) is list and (
            member_errors := [error for i, value in enumerate(raw)
                              for error in mistakes(source, value, get_args(list_type)[0], f"{key_path}[{i}]")]):
        yield from member_errors
    else:
        try:
            msgspec.convert(raw, kind)
        except msgspec.ValidationError as error:
            yield error_with_key(source, raw, error, key_path)


def _missing_keys(raw: object, kind: Any) -> list[str]:
    """The required keys that a table lacks; none if `kind` is no record."""
    is_table = isinstance(kind, type) and issubclass(kind, Struct) and isinstance(raw, Mapping)
    return [name for name, field in _fields(kind).items() if field.required and name not in raw] if is_table else []  # type: ignore[operator]


def _unknown_key(source: object, key_path: str, key: str, fields: Iterable[str]) -> InputError:
    """The error for an unknown key: it suggests tables of a study that have this key, else the nearest known key."""
    tables = {name: _record_types(field.type) for name, field in _fields(Study).items() if get_origin(field.type) not in (dict, list)}
    known_paths = [f"{name}.{key}" for name, kinds in tables.items() if any(key in _fields(kind) for kind in kinds)]
    if known_paths and "[" not in key_path:
        return InputError(source, f"{key_path}: there is no such key; did you mean {' or '.join(known_paths)}?", one_of(fields))
    return unknown_name(source, f"{key_path}: there is no such key", key, fields)


@cache
def _fields(kind: type[Struct]) -> dict[str, msgspec.structs.FieldInfo]:
    """A record's fields by name; cached, as msgspec evaluates their annotations anew each time."""
    return {field.name: field for field in msgspec.structs.fields(kind) if field.type is not Origin}


def _record_types(kind: Any) -> list[Any]:
    """The records among the alternatives of a type."""
    return [option for option in get_args(kind) or (kind,) if isinstance(option, type) and issubclass(option, Struct)]


def _unknown_choice(source: object, key_path: str, value: object, names: Iterable[str]) -> InputError:
    """The error for a value that is none of `names`; "" among the names means that the key may be omitted."""
    problem = f"{key_path} is missing" if value is None else f"{key_path} = {short_text(value)}"
    return unknown_name(source, problem, value, filter(None, names), ", or no such key" * ("" in names))


def _path_within(key_path: str, key: str) -> str:
    key_text = repr(key) if "." in key or not key.isprintable() else key
    return f"{key_path}.{key_text}" if key_path else key_text


def error_with_key(source: object, raw: object, error: msgspec.ValidationError, prefix: str = "") -> InputError:
    """Turn msgspec's error on `raw` into an error that names the key and its value."""
    problem, _, location = str(error).partition(" - at `$")
    key_path, value, exists = prefix, raw, True
    for index, key in re.findall(r"\[(\d+)\]|([^.\[\]]+)", location.rstrip("`").replace("[...]", "")):
        key_path = f"{key_path}[{index}]" if index else ".".join(filter(None, (key_path, key)))
        try:
            value = value[int(index) if index else key]  # type: ignore[index]
        except (KeyError, IndexError, TypeError):
            exists = False
    if exists and key_path:
        text = f"{key_path} is a table" if isinstance(value, dict) else f"{key_path} = {short_text(value)}"
        return InputError(source, text, _expectation(problem))
    return InputError(source, f"{key_path}: {problem}" if key_path else problem)


TYPE_NAMES = {"float": "a number", "int": "a whole number", "str": "a text", "bool": "true or false", "array": "a list",
              "object": "a table", "null": ""}


def _expectation(problem: str) -> str:
    """The expected value in words, from a message of msgspec such as "Expected `int | null`, got `str`"."""
    expected = re.sub(r"^Expected |, got `[^`]*`$", "", problem)
    return re.sub(r"`([a-z| ]+)`", lambda types: " or ".join(filter(None, (TYPE_NAMES.get(name, name) for name in types[1].split(" | ")))),
                  expected)


def short_text(value: object) -> str:
    """A value as an error quotes it."""
    try:
        text = repr(value)
    except ValueError:  # an integer of more digits than Python prints
        return "a number of thousands of digits"
    return text if len(text) <= 100 else f"{text[:97]}..."


MAX_MAGNITUDE = 1e12
"""Largest magnitude of a characteristic, in its unit."""
MAX_NESTING = 32
"""Maximum nesting of tables and lists in a study; Python gives up at about a thousand."""


def unusable_values(source: object, value: object, key_path: str = "", depth: int = 0) -> Iterator[InputError]:
    """Errors for unusable values and names in a study's tables; `value` lies within `depth` tables and lists."""
    if isinstance(value, Mapping | list | tuple) and depth > MAX_NESTING:
        yield InputError(source, f"{key_path.partition('.')[0]} is nested too deeply", f"at most {MAX_NESTING} tables within each other")
    elif isinstance(value, Mapping | list | tuple):
        for key, inner in value.items() if isinstance(value, Mapping) else enumerate(value):
            if not str(key).isprintable():
                yield InputError(source, f"{key_path or 'a key'}: {key!r} is no name", "printable characters")
            yield from unusable_values(source, inner, f"{key_path}.{key}" if key_path else str(key), depth + 1)
    elif reason := _reason_against(value, key_path):
        yield InputError(source, f"{key_path} = {reason[0]}", reason[1])


def _reason_against(value: object, key_path: str) -> tuple[str, str] | None:
    """An unusable value and the expected value, in words; None for a usable value."""
    if isinstance(value, datetime.date | datetime.time):
        return f"{value}, a date or time", "a number, or a text in quotes"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value), "a finite number"
    if isinstance(value, int) and not -2**63 <= value < 2**63:
        return f"{str(value)[:30]}, beyond 64 bits", "an integer from -2^63 to 2^63 - 1"
    if isinstance(value, str) and ".parameters." not in f".{key_path}" and not value.isprintable():
        return repr(value)[:80], "a text without control characters"
    return None


def contradictions(source: object, study: Study) -> Iterator[InputError]:
    """Errors for values of a study that contradict each other, or that leave nothing to simulate or compare."""
    characteristics = study.vehicle.characteristics
    if not characteristics:
        yield InputError(source, "vehicle.characteristics: none", "at least one")
    for name, row in characteristics.items():
        yield from _characteristic_mistakes(source, f"vehicle.characteristics.{name}", row)
    yield from _keys_of_fmus(source, study)
    yield from variation_mistakes(source, characteristics, study.variation, study.correlations)
    yield from constraint_mistakes(source, characteristics, study.constraints)
    for name, bounds in study.calibration.items():
        if bounds.lower >= bounds.upper:
            yield InputError(source, f"calibration.{name!r}: lower = {bounds.lower} and upper = {bounds.upper}", "numbers, lower < upper")
    if study.fit.ensemble == 1:
        yield InputError(source, "fit.ensemble = 1", "0 for starts without an ensemble, or at least 2 places")
    if study.matrix is not None and bool(study.matrix.tests) == bool(study.matrix.protocol):
        yield InputError(source, f"matrix: {len(study.matrix.tests)} tests and protocol = {study.matrix.protocol!r}",
                         "tests, or a protocol")
    if len({len(values) for values in study.spread.values()}) > 1 or not all(study.spread.values()):
        yield InputError(source, "spread: its lists differ in length or are empty", "a list for each parameter, all of one length")
    if study.matrix is not None and study.matrix.aggregate == "mean":
        yield InputError(source, "matrix.aggregate = 'mean' would average distances [m] and negative collision speeds [m/s]",
                         "'worst', the safety degree at a setting's worst point")
    for name, count in Counter(study.metrics.also).items():
        if count > 1:
            yield InputError(source, f"metrics.also = {study.metrics.also}: {name!r} is listed {count} times", "each metric once")
    for name, value in study.published.items():
        if value == 0:
            yield InputError(source, f"published.{name} = 0", "a number other than 0")


def _keys_of_fmus(source: object, study: Study) -> Iterator[InputError]:
    """Errors for keys of FMUs in tables of models that are none."""
    for name, table in (("vehicle", study.vehicle), ("ads", study.ads), ("scenario", study.scenario)):
        for key in FMU_KEYS if name == "scenario" else FMU_KEYS[1:] if table.kind != "fmu" else ():
            if getattr(table, key, None):
                yield InputError(source, f"{name}.{key}: {table.model!r} is no FMU",
                                 "no such key" if name == "scenario" else f'no such key, or {name}.kind = "fmu"')


def _characteristic_mistakes(source: object, key: str, row: CharacteristicTable) -> Iterator[InputError]:
    for name, value in {"original": row.original, "lower": row.lower, "upper": row.upper}.items():
        if abs(value) > MAX_MAGNITUDE:
            yield InputError(source, f"{key}.{name} = {value}", f"a number up to {MAX_MAGNITUDE:g}")
    if row.lower >= row.upper:
        yield InputError(source, f"{key}: lower = {row.lower} and upper = {row.upper}", "lower < upper")
    elif not row.lower <= row.original <= row.upper:
        yield InputError(source, f"{key}.original = {row.original}", f"a value in [{row.lower}, {row.upper}]")
    if row.original == 0:
        yield InputError(source, f"{key}.original = 0", "a value other than 0: changes are relative to it")
