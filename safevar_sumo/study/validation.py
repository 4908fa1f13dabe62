"""Validation of tables: every mistake with its key and what is expected."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import islice
from typing import Any, TypeVar

import msgspec

from safevar_sumo.errors import InputError, did_you_mean, one_of, unknown_name
from safevar_sumo.study.characteristics import CharacteristicTable
from safevar_sumo.study.constraints import constraint_mistakes
from safevar_sumo.study.schema import FMU_KEYS, Study
from safevar_sumo.study.variation import variation_mistakes

T = TypeVar("T")
MAX_MISTAKES = 8
"""Largest number of mistakes of a file that an error lists."""
MAX_MAGNITUDE = 1e12
"""Largest magnitude of a characteristic, in its unit."""
TYPE_NAMES = {
    "number": "a number",
    "integer": "a whole number",
    "string": "a text",
    "boolean": "true or false",
    "array": "a list",
    "object": "a table",
}


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
        raise error_with_key(source, raw, error, prefix) from None


def raise_mistakes(errors: Iterable[InputError]) -> None:
    """Raise all mistakes as one error, which quotes the first ones; do nothing without mistakes."""
    mistakes = iter(errors)
    first_mistakes = list(islice(mistakes, MAX_MISTAKES))
    if len(first_mistakes) == 1:
        raise first_mistakes[0]
    if first_mistakes:
        legal = [error.legal for error in first_mistakes]
        texts = [
            error.problem + (f" (expected: {error.legal})" if error.legal and error.legal not in legal[:number] else "")
            for number, error in enumerate(first_mistakes)
        ]
        more = ["and more"] if next(mistakes, None) else []
        count = f"more than {MAX_MISTAKES}" if more else len(texts)
        raise InputError(first_mistakes[0].source, f"{count} mistakes: {'; '.join(texts + more)}")


@cache
def json_schema(table: type) -> dict[str, Any]:
    """The JSON schema (2020-12) of a record, which describes its tables in TOML or JSON."""
    return msgspec.json.schema(table)


def schema_mistakes(source: object, raw: object, table: type, prefix: str = "") -> Iterator[InputError]:
    """All mistakes in `raw` by the JSON schema of `table`."""
    import jsonschema  # here, as it takes longer to load than a study

    validator = jsonschema.Draft202012Validator(json_schema(table))
    errors = [leaf for error in validator.iter_errors(msgspec.to_builtins(raw)) for leaf in _leaves(error)]
    for error in sorted(errors, key=lambda error: [str(key) for key in error.absolute_path]):
        yield from _mistakes_of(source, error, raw, [*([prefix] if prefix else []), *error.absolute_path])


def _leaves(error: Any) -> Iterator[Any]:
    """The errors of the alternative that a value of several alternatives belongs to, or the error itself."""
    if not error.context:
        yield error
        return
    tag = error.schema.get("discriminator", {}).get("propertyName")
    branches: dict[int, list[Any]] = {}
    for inner in error.context:
        branches.setdefault(inner.schema_path[0], []).append(inner)
    fitting = [
        branch
        for branch in branches.values()
        if not any((not inner.path and inner.validator == "type") or list(inner.path) == [tag] for inner in branch)
    ]
    for inner in fitting[0] if len(fitting) == 1 else []:
        yield from _leaves(inner)
    if len(fitting) != 1:
        yield error


def _mistakes_of(source: object, error: Any, raw: object, path: Sequence[str | int]) -> Iterator[InputError]:
    """The mistakes behind an error of jsonschema: one for each unknown or missing key."""
    value, schema, key_path = error.instance, error.schema, _path_text(path)
    if error.validator == "additionalProperties":
        for key in value:
            if key not in schema["properties"]:
                yield _unknown_key(source, _path_text([*path, key]), key, schema["properties"], top_level=not path)
    elif error.validator == "required":
        names = [name for name in schema["required"] if name not in value]
        if error.message.startswith(repr(names[0])):  # jsonschema has an error for each of the names
            yield _missing_keys(source, names, value, raw, path)
    elif tag := schema.get("discriminator"):
        choice = value.get(tag["propertyName"]) if isinstance(value, dict) else value
        yield _unknown_choice(source, f"{key_path}.{tag['propertyName']}", choice, tag["mapping"])
    elif error.validator in ("enum", "const"):
        yield _unknown_choice(source, key_path, value, schema["enum"])
    else:
        text = f"{key_path} is a table" if isinstance(value, dict) else f"{key_path} = {short_text(value)}"
        yield InputError(
            source, text, " or ".join(dict.fromkeys(filter(None, map(_expectation, schema.get("anyOf", [schema])))))
        )


def _missing_keys(
    source: object, names: Sequence[str], table: Mapping[str, Any], raw: Any, path: Sequence[str | int]
) -> InputError:
    """The error for required keys that a table lacks; it may be meant to override single keys of a table with a similar
    name.
    """
    siblings: Any = raw
    for key in path[:-1]:
        siblings = siblings[key]
    hint = did_you_mean(path[-1], [key for key in siblings if key != path[-1]]) if path and len(names) > 1 else ""
    if hint:
        return InputError(source, f"{_path_text(path)} lacks {', '.join(names)}{hint}")
    model = f", for model = {short_text(table['model'])}" if "model" in table else ""
    return InputError(source, f"{', '.join(_path_text([*path, name]) for name in names)} is missing{model}")


def _unknown_key(source: object, key_path: str, key: str, names: Iterable[str], *, top_level: bool) -> InputError:
    """The error for an unknown key: it suggests tables of a study that have this key or a similar one, else the nearest
    known key.
    """
    definitions = json_schema(Study)["$defs"]
    tables = {
        name: definitions[schema["$ref"].rpartition("/")[2]]["properties"]
        for name, schema in definitions["Study"]["properties"].items()
        if "$ref" in schema
    }
    paths = [f"{table}.{name}" for table, table_names in tables.items() for name in table_names if name == key]
    nearest = {name: table for table, table_names in tables.items() for name in table_names}
    if not paths and top_level and (hint := did_you_mean(key, [*nearest, *names])):
        paths = [f"{nearest[name]}.{name}" for name in nearest if repr(name) in hint and name not in names]
    if paths and "[" not in key_path:
        return InputError(
            source, f"{key_path}: there is no such key; did you mean {' or '.join(paths)}?", one_of(names)
        )
    return unknown_name(source, f"{key_path}: there is no such key", key, names)


def _unknown_choice(source: object, key_path: str, value: object, names: Iterable[str]) -> InputError:
    """The error for a value that is none of `names`; "" among the names means that the key may be omitted."""
    problem = f"{key_path} is missing" if value is None else f"{key_path} = {short_text(value)}"
    return unknown_name(source, problem, value, filter(None, names), ", or no such key" * ("" in names))


def _expectation(schema: Mapping[str, Any]) -> str:
    """The expected value in words, from a JSON schema."""
    if "description" in schema and "$ref" not in schema:
        return str(schema["description"])
    kind = "object" if "$ref" in schema else schema.get("type", "")
    words = {"exclusiveMinimum": "above", "minimum": "from", "maximum": "to", "exclusiveMaximum": "below"}
    bounds = [f"{word} {schema[key]:g}" for key, word in words.items() if key in schema]
    sizes = {
        "minItems": "of at least {} entries",
        "maxItems": "of at most {} entries",
        "minLength": "that is not empty",
        "maxLength": "of at most {} characters",
    }
    bounds += [text.format(schema[key]) for key, text in sizes.items() if key in schema]
    return " ".join([TYPE_NAMES.get(kind, ""), *bounds]).strip()


def _path_text(path: Sequence[str | int]) -> str:
    text = ""
    for key in path:
        if isinstance(key, int):
            text += f"[{key}]"
        else:
            text += ("." if text else "") + (repr(key) if ("." in key and text) or not key.isprintable() else key)
    return text


def error_with_key(source: object, raw: object, error: msgspec.ValidationError, prefix: str = "") -> InputError:
    """Turn msgspec's error on `raw` into an error that names the key and its value."""
    problem, _, location = str(error).partition(" - at `$")
    path: list[str | int] = [prefix] if prefix else []
    value = raw
    for index, key in re.findall(r"\[(\d+)\]|([^.\[\]]+)", location.rstrip("`").replace("[...]", "")):
        path.append(int(index) if index else key)
        try:
            value = value[path[-1]]  # type: ignore[index]
        except (KeyError, IndexError, TypeError):
            return InputError(source, f"{_path_text(path)}: {problem}")
    return InputError(source, f"{_path_text(path)} = {short_text(value)}: {problem}" if path else problem)


def short_text(value: object) -> str:
    """A value as an error quotes it."""
    text = repr(value)
    return text if len(text) <= 100 else f"{text[:97]}..."


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
    yield from _keys_of_fmus(source, study)
    yield from variation_mistakes(source, characteristics, study.variation, study.correlations)
    yield from constraint_mistakes(source, characteristics, study.constraints)
    for name, bounds in study.calibration.items():
        if bounds.lower >= bounds.upper:
            yield InputError(
                source,
                f"calibration.{name!r}: lower = {bounds.lower} and upper = {bounds.upper}",
                "numbers, lower < upper",
            )
    if study.fit.ensemble == 1:
        yield InputError(source, "fit.ensemble = 1", "0 for starts without an ensemble, or at least 2 places")
    if study.matrix is not None and bool(study.matrix.tests) == bool(study.matrix.protocol):
        yield InputError(
            source,
            f"matrix: {len(study.matrix.tests)} tests and protocol = {study.matrix.protocol!r}",
            "tests, or a protocol",
        )
    if len({len(values) for values in study.spread.values()}) > 1 or not all(study.spread.values()):
        yield InputError(
            source, "spread: its lists differ in length or are empty", "a list for each parameter, all of one length"
        )
    for name, count in Counter(study.metrics.also).items():
        if count > 1:
            yield InputError(
                source, f"metrics.also = {study.metrics.also}: {name!r} is listed {count} times", "each metric once"
            )
    for name, value in study.published.items():
        if value == 0:
            yield InputError(source, f"published.{name} = 0", "a number other than 0")


def _keys_of_fmus(source: object, study: Study) -> Iterator[InputError]:
    """Errors for keys of FMUs in tables of models that are none."""
    for name, table in (("vehicle", study.vehicle), ("ads", study.ads), ("scenario", study.scenario)):
        for key in FMU_KEYS if name == "scenario" else FMU_KEYS[1:] if table.kind != "fmu" else ():
            if getattr(table, key, None):
                yield InputError(
                    source,
                    f"{name}.{key}: {table.model!r} is no FMU",
                    "no such key" if name == "scenario" else f'no such key, or {name}.kind = "fmu"',
                )


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
