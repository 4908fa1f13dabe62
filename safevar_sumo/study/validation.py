"""Validation of a study's tables: every mistake with its key and what is expected."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache, reduce
from itertools import islice
from operator import getitem
from typing import Any, TypeVar

import msgspec
from jsonschema import ValidationError

from safevar_sumo.errors import InputError, did_you_mean, one_of, unknown_name
from safevar_sumo.study.characteristics import (
    CharacteristicTable,
    constraint_mistakes,
    limit_mistakes,
    variation_mistakes,
)
from safevar_sumo.study.schema import FMU_KEYS, Parameters, Study, Tables

T = TypeVar("T")
MAX_MISTAKES = 8
"""Largest number of mistakes of a file that an error lists."""
MAX_MAGNITUDE = 1e12
"""Largest magnitude of a characteristic."""
FITTED_TABLES = ("vehicle.parameters.", "ads.parameters.", "weather.")
"""Prefixes of the parameters that may be fitted."""
MAX_QUOTE = 100
"""Largest number of characters of a value that an error quotes."""


def convert_table(source: object, raw: object, table: type[T], prefix: str = "") -> T:
    """Convert a table to a record.

    Raises
    ------
    InputError
        If a key is wrong; the error names every wrong key.
    """
    try:
        return msgspec.convert(raw, table)
    except msgspec.ValidationError as error:
        raise_mistakes(schema_mistakes(source, raw, table, prefix))
        # The schema finds nothing: msgspec's own error, whose place becomes the key.
        problem, _, location = str(error).partition(" - at `$")
        path = f"{prefix}{location.rstrip('`')}".removeprefix(".")
        raise InputError(source, f"{path}: {problem}" if path else problem) from None


def raise_mistakes(errors: Iterable[InputError]) -> None:
    """Raise all mistakes as one error, which quotes the first ones; do nothing without mistakes."""
    mistakes = list(islice(errors, MAX_MISTAKES + 1))
    if len(mistakes) == 1:
        raise mistakes[0]
    if mistakes:
        texts, said = [], {""}
        for mistake in mistakes:  # what several mistakes expect is said once
            texts.append(mistake.problem + (f" (expected: {mistake.legal})" if mistake.legal not in said else ""))
            said.add(mistake.legal)
        count = f"more than {MAX_MISTAKES}" if len(mistakes) > MAX_MISTAKES else len(mistakes)
        raise InputError(mistakes[0].source, f"{count} mistakes: {'; '.join(texts[:MAX_MISTAKES])}")


@cache
def json_schema(table: type) -> Parameters:
    """The JSON schema (2020-12) of a record, which describes its tables in TOML or JSON."""
    return msgspec.json.schema(table)


def schema_mistakes(source: object, raw: Any, table: type, prefix: str) -> Iterator[InputError]:
    """All mistakes in `raw` by the JSON schema of `table`, in jsonschema's words; one for each unknown key."""
    import jsonschema  # here, as it takes longer to load than a study

    validator = jsonschema.Draft202012Validator(json_schema(table))
    errors = [
        leaf
        for error in validator.iter_errors(msgspec.json.decode(msgspec.json.encode(raw)))
        for leaf in _leaves(error)
    ]
    for error in sorted(errors, key=lambda error: [str(key) for key in error.absolute_path]):
        path = [*([prefix] if prefix else []), *error.absolute_path]
        value = error.instance
        schema = error.schema
        if error.validator == "additionalProperties":
            for key in [key for key in value if key not in schema["properties"]]:
                yield _unknown_key(source, _path_text([*path, key]), key, schema["properties"])
        elif error.validator == "enum":
            yield unknown_name(source, f"{_path_text(path)} = {value!r}", value, filter(None, schema["enum"]))
        elif error.validator == "anyOf":
            choices = schema.get("discriminator", {}).get("mapping") or [
                choice.get("type", "object") for choice in schema["anyOf"] if choice.get("type") != "null"
            ]
            yield InputError(source, f"{_path_text(path)} = {short_text(value)}", one_of(choices))
        elif error.validator == "pattern":
            yield InputError(source, f"{_path_text(path)} = {short_text(value)}", schema["description"])
        elif error.validator == "type" and schema["type"] == "object":
            legal = " of ".join(filter(None, ("a table", ", ".join(schema.get("properties", ())))))
            yield InputError(source, f"{_path_text(path)} = {short_text(value)}", legal)
        else:
            message = error.message.removeprefix(repr(value)).strip()
            quoted = f" = {short_text(value)}" if message != error.message else ":"
            hint = ""
            *parents, name = error.absolute_path or [0]
            if error.validator == "required" and isinstance(name, str):  # a table with a mistyped name is a new one
                hint = did_you_mean(name, {*reduce(getitem, parents, raw)} - {name})
            yield InputError(source, f"{_path_text(path)}{quoted} {message}".removeprefix(": ") + hint)


def _leaves(error: ValidationError) -> list[ValidationError]:
    """The errors that say most: if one of several alternatives is meant, those within this alternative; else the error
    itself.

    The type of a value, or the tag of a table, tells which alternatives are not meant.
    """
    tag = error.schema.get("discriminator", {}).get("propertyName")
    validators_of_type = ("type", "enum") if isinstance(error.instance, dict) else ("type",)
    excluded = {
        inner.schema_path[0]  # the number of the alternative
        for inner in error.context
        if (not inner.path and inner.validator in validators_of_type) or list(inner.path) == [tag]
    }
    meant = [inner for inner in error.context if inner.schema_path[0] not in excluded]
    return [leaf for inner in meant for leaf in _leaves(inner)] or [error]


def _unknown_key(source: object, key_path: str, key: str, names: Iterable[str]) -> InputError:
    """The error for an unknown key. It suggests the tables of a study that have this key; else the nearest key of its
    own table or, for a key outside of tables, of any table.
    """
    keys_of_tables = [
        (field.name, known)
        for field in msgspec.structs.fields(Study)
        for known in getattr(field.type, "__struct_fields__", ())
    ]
    hint = did_you_mean(key, [*names, *(known for _, known in keys_of_tables if key_path == key)])
    exact = [f"{table}.{known}" for table, known in keys_of_tables if known == key]
    nearest = [f"{table}.{known}" for table, known in keys_of_tables if repr(known) in hint and known not in names]
    suggestions = exact or nearest
    if suggestions and "[" not in key_path:
        hint = f"; did you mean {' or '.join(suggestions)}?"
    return InputError(source, f"{key_path}: there is no such key{hint}", one_of(names))


def _path_text(path: Sequence[str | int]) -> str:
    text = ""
    for key in path:
        if isinstance(key, int):
            text += f"[{key}]"
        else:
            text += ("." if text else "") + (repr(key) if ("." in key and text) or not key.isprintable() else key)
    return text


def short_text(value: object) -> str:
    """A value as an error quotes it."""
    text = repr(value)
    return text if len(text) <= MAX_QUOTE else f"{text[: MAX_QUOTE - 3]}..."


def infinite_numbers(source: object, value: object, path: Sequence[str | int] = ()) -> Iterator[InputError]:
    """Errors for numbers of a study's tables that are not finite."""
    if isinstance(value, Mapping | list | tuple):
        for key, inner in value.items() if isinstance(value, Mapping) else enumerate(value):
            yield from infinite_numbers(source, inner, [*path, key])
    elif isinstance(value, float) and not math.isfinite(value):
        yield InputError(source, f"{_path_text(path)} = {value}", "a finite number")


def contradictions(source: object, study: Study) -> Iterator[InputError]:
    """Errors for values of a study that contradict each other, or that leave nothing to simulate or compare."""
    characteristics = study.vehicle.characteristics
    if not characteristics:
        yield InputError(source, "vehicle.characteristics: none", "at least one")
    for name, row in characteristics.items():
        yield from _characteristic_mistakes(source, f"vehicle.characteristics.{name}", row)
    for name, table in (("ads", study.ads), ("scenario", study.scenario)):
        if table.kind == "fmu" and name == "ads":
            continue
        for key in FMU_KEYS if name == "scenario" else FMU_KEYS[1:]:  # an ADS may be of another kind, `traci`
            if getattr(table, key, None):
                yield InputError(source, f"{name}.{key}: {table.model!r} is no FMU", "no such key")
    yield from variation_mistakes(source, characteristics, study.variation, study.correlations)
    yield from constraint_mistakes(source, characteristics, study.constraints)
    yield from limit_mistakes(source, characteristics, study.limits, "limits.")
    if study.matrix is not None and bool(study.matrix.tests) == bool(study.matrix.protocol):
        problem = f"matrix: {len(study.matrix.tests)} tests and protocol = {study.matrix.protocol!r}"
        yield InputError(source, problem, "tests, or a protocol")
    if len({len(values) for values in study.spread.values()}) > 1 or not all(study.spread.values()):
        problem = "spread: its lists differ in length or are empty"
        yield InputError(source, problem, "a list for each parameter, all of one length")
    if len({*study.metrics.also}) < len(study.metrics.also):
        yield InputError(source, f"metrics.also = {study.metrics.also}", "each metric once")
    for name, value in study.published.items():
        if value == 0:
            yield InputError(source, f"published.{name} = 0", "a number other than 0")


def _characteristic_mistakes(source: object, key: str, row: CharacteristicTable) -> Iterator[InputError]:
    if max(abs(row.original), abs(row.lower), abs(row.upper)) > MAX_MAGNITUDE:
        problem = f"{key}: {row.original} in [{row.lower}, {row.upper}]"
        yield InputError(source, problem, f"numbers up to {MAX_MAGNITUDE:g}")
    elif row.lower >= row.upper:
        yield InputError(source, f"{key}: lower = {row.lower} and upper = {row.upper}", "lower < upper")
    elif not row.lower <= row.original <= row.upper:
        yield InputError(source, f"{key}.original = {row.original}", f"a value in [{row.lower}, {row.upper}]")
    if row.original == 0:
        yield InputError(source, f"{key}.original = 0", "a value other than 0: changes are relative to it")


def locate_parameter(tables: Any, name: str) -> tuple[Any, int | str] | None:
    """The table or list that holds a parameter that may be fitted, and the parameter's key or index in it; None if
    there is none.
    """
    if not name.startswith(FITTED_TABLES):
        return None
    *path, last = name.split(".")
    table = tables
    try:
        for key in path:
            table = table[_key_or_index(table, key)]
        key_or_index = _key_or_index(table, last)
        is_number = isinstance(table[key_or_index], int | float)
    except (KeyError, IndexError, ValueError, TypeError):
        return None
    return (table, key_or_index) if is_number else None


def _key_or_index(table: Any, name: str) -> int | str:
    """The key in a table, or the index in a list; an index has one spelling, so that each parameter has one name."""
    return int(name) if isinstance(table, list) and name == str(int(name)) else name


def missing_parameter(source: object, name: str) -> InputError:
    """The error for a parameter that [spread] names and the study does not have."""
    return InputError(
        source,
        f"spread.{name!r} is no parameter of the study",
        f"a number that is given under {', '.join(prefix.rstrip('.') for prefix in FITTED_TABLES)}",
    )


def contradictions_of_file(source: object, stated: Tables, tables: Tables) -> Iterator[InputError]:
    """Errors for tables that a file states itself and that do not fit the study's `tables`, with the inherited ones."""
    spread = stated.get("spread")
    for name in spread if isinstance(spread, Mapping) else ():
        if name.startswith("weather.") and isinstance(tables.get("weather"), str):
            continue  # a shipped weather: its values are looked up later
        if locate_parameter(tables, name) is None:
            yield missing_parameter(source, name)
    rating = stated.get("rating")
    matrix = tables.get("matrix")
    if (
        isinstance(rating, Mapping)
        and rating.get("claims")
        and not (isinstance(matrix, Mapping) and matrix.get("protocol"))
    ):
        yield InputError(source, "rating.claims: the study is not rated", "matrix.protocol, or no claims")
