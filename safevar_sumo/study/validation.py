"""Converts tables to records: the first mistake with its path, the value, what is expected, and the
nearest key.

Checks within a record, and between records, stand in `__post_init__` of the records.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import msgspec
from msgspec import Struct

from safevar_sumo.errors import InputError, did_you_mean, one_of, unknown_name

T = TypeVar("T")
MAX_QUOTE = 100
"""Largest number of characters of a value that an error quotes."""
WORDS = {
    "object": "a table",
    "array": "a list",
    "str": "a text",
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
}
"""What msgspec expects, in words."""


def convert_table(raw: Any, table: type[T], prefix: str = "") -> T:
    """Convert a table to a record.

    Raises
    ------
    InputError
        With the first mistake.
    """
    try:
        for path, number in _infinite_numbers(raw, [prefix] if prefix else []):
            raise InputError("", f"{path} = {number}", "a finite number")
        return msgspec.convert(raw, table)
    except msgspec.ValidationError as error:
        raise _mistake(raw, table, prefix, str(error)) from None


NO_KEY = "origin"
"""Field of a study that no file may have."""


def _mistake(raw: Any, table: Any, prefix: str, message: str) -> InputError:
    """The error for a message of msgspec, which ends with the place of the mistake."""
    problem, _, location = message.partition(" - at `$")
    path = [prefix] if prefix else []
    value = raw
    kinds = [table]
    siblings = dict[str, Any]()
    for name, index in re.findall(r"\.(\w+)|\[([\d.]+)\]", location):
        inner = _inner_type(_meant(kinds[-1], value), name)
        siblings = value if isinstance(value, dict) else {}
        key: Any = name or (_wrong_key(value, inner) if index == "..." else int(index))
        path = [*path, key]
        value = value[key]
        kinds.append(inner)
    kind = _meant(kinds[-1], value)
    text = _path_text(path)
    quoted = _short_text(value)
    if field := re.match(r"Object contains unknown field `(.*)`", problem):
        return _unknown_key(_path_text([*path, field[1]]), field[1], kind, table)
    if field := re.match(r"Object missing required field `(.*)`", problem):
        known = [
            name
            for name, other in siblings.items()
            if isinstance(other, dict) and field[1] in other
        ]
        hint = did_you_mean(path[-1], known) if path else ""  # a mistyped table is a new one
        needed = ", ".join(one.name for one in msgspec.structs.fields(kind) if one.required)
        legal = f"{needed} for what is new here" + (f"; else {', '.join(known)}" if known else "")
        return InputError("", f"{text}: {field[1]} is missing{hint}".removeprefix(": "), legal)
    if problem.startswith("Invalid enum value"):
        return unknown_name("", f"{text} = {quoted}", value, filter(None, get_args(kind)))
    if problem.startswith("Invalid value"):  # of the key that tells which table is meant
        tags = [one.__struct_config__.tag for one in get_args(kinds[-2])]
        return unknown_name("", f"{text} = {quoted}", value, tags)
    if expected := re.match(r"Expected (.*?)(, got `?\w+`?)?$", problem):
        if expected[1] == "`object`" and _is_record(kind):
            return InputError(
                "", f"{text} = {quoted}", f"a table of {', '.join(kind.__struct_fields__)}"
            )
        for meta in getattr(kinds[-1], "__metadata__", ()):
            if meta.pattern and meta.description:
                return InputError("", f"{text} = {quoted}", meta.description)
        legal = re.sub(
            r"\b(?:" + "|".join(WORDS) + r")\b", lambda word: WORDS[word[0]], expected[1]
        )
        return InputError("", f"{text} = {quoted}", legal.replace("`", "").replace(" | ", " or "))
    problem, _, legal = problem.partition("\n")  # of a `__post_init__`
    return InputError("", f"{text}: {problem}".removeprefix(": "), legal)


def _unknown_key(path: str, key: str, kind: Any, table: Any) -> InputError:
    """The error for an unknown key, with the nearest key of its own table, or of another table in
    the whole one.
    """
    own = [name for name in kind.__struct_fields__ if name != NO_KEY]
    places = dict[str, str]()
    for field in msgspec.structs.fields(table):
        if field.name != NO_KEY:
            places |= {
                inner: f"{field.name}.{inner}"
                for inner in getattr(field.type, "__struct_fields__", ())
            }
    places |= {name: name for name in own}
    nearest = [key] if key in places else get_close_matches(key, places, n=1)
    hint = "".join(f"; did you mean {places[name]!r}?" for name in nearest)
    return InputError("", f"{path}: there is no such key{hint}", one_of(own))


def _meant(kind: Any, value: Any) -> Any:
    """The type that a value is meant to have, of several ones."""
    if get_origin(kind) is Annotated:
        return _meant(get_args(kind)[0], value)
    if get_origin(kind) not in (Union, UnionType):
        return kind
    kinds = [
        one
        for one in get_args(kind)
        if one is not NoneType and _is_table(one) == isinstance(value, dict)
    ]
    for one in filter(_is_record, kinds):
        config = one.__struct_config__
        if value.get(config.tag_field or "") == config.tag:
            return one
    return next(iter(kinds), kind)


def _is_table(kind: Any) -> bool:
    return _is_record(kind) or get_origin(kind) is dict


def _is_record(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, Struct)


def _inner_type(kind: Any, name: str) -> Any:
    """The type of a record's field, or of the elements of a list or table."""
    if _is_record(kind):
        return next(
            (field.type for field in msgspec.structs.fields(kind) if field.encode_name == name), Any
        )
    return (get_args(kind) or [Any])[-1]


def _wrong_key(value: Mapping[str, Any], kind: Any) -> str:
    """The first key of a table by names whose value cannot be converted; msgspec does not tell
    it.
    """
    for key, inner in value.items():
        try:
            msgspec.convert(inner, kind)
        except msgspec.ValidationError:
            return key
    raise AssertionError("a value that was wrong is right")


def _path_text(path: Sequence[str | int]) -> str:
    text = ""
    for key in path:
        if isinstance(key, int):
            text += f"[{key}]"
        else:
            text += ("." if text else "") + (
                repr(key) if ("." in key and text) or not key.isprintable() else key
            )
    return text


def _short_text(value: object) -> str:
    """A value as an error quotes it."""
    text = repr(value)
    return text if len(text) <= MAX_QUOTE else f"{text[: MAX_QUOTE - 3]}..."


def _infinite_numbers(value: object, path: list[str | int]) -> Iterator[tuple[str, float]]:
    """Numbers in tables that are not finite, with their paths."""
    if isinstance(value, Mapping | list | tuple):
        for key, inner in value.items() if isinstance(value, Mapping) else enumerate(value):
            yield from _infinite_numbers(inner, [*path, key])
    elif isinstance(value, float) and not math.isfinite(value):
        yield _path_text(path), value
