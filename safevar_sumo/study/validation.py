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
from typing import Annotated, Any, NamedTuple, TypeVar, Union, get_args, get_origin

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


class _Place(NamedTuple):
    """Where a mistake is: its path, the value there and the type that is intended there, also as
    declared; the types above; and the other values of the same table.
    """

    path: list[str | int]
    value: Any
    kind: Any
    declared: list[Any]
    siblings: dict[str, Any]

    @property
    def text(self) -> str:
        """The path and its value."""
        return f"{_path_text(self.path)} = {_short_text(self.value)}"


def _place(raw: Any, table: Any, prefix: str, location: str) -> _Place:
    """The place that a message of msgspec names, such as `.search.runs` or `.tests[0]`."""
    path: list[str | int] = [prefix] if prefix else []
    value = raw
    declared = [table]
    siblings = dict[str, Any]()
    for name, index in re.findall(r"\.(\w+)|\[([\d.]+)\]", location):
        inner = _inner_type(_intended_type(declared[-1], value), name)
        siblings = value if isinstance(value, dict) else {}
        key: Any = name or (_wrong_key(value, inner) if index == "..." else int(index))
        path.append(key)
        value = value[key]
        declared.append(inner)
    return _Place(path, value, _intended_type(declared[-1], value), declared, siblings)


def _mistake(raw: Any, table: Any, prefix: str, message: str) -> InputError:
    """The error for a message of msgspec, which ends with the place of the mistake."""
    problem, _, location = message.partition(" - at `$")
    place = _place(raw, table, prefix, location)
    if field := re.match(r"Object contains unknown field `(.*)`", problem):
        return _unknown_key(_path_text([*place.path, field[1]]), field[1], place.kind, table)
    if field := re.match(r"Object missing required field `(.*)`", problem):
        return _missing_key(place, field[1])
    if problem.startswith("Invalid enum value"):
        return unknown_name("", place.text, place.value, filter(None, get_args(place.kind)))
    if problem.startswith("Invalid value"):  # of the key that names the kind of table
        tags = [kind.__struct_config__.tag for kind in get_args(place.declared[-2])]
        return unknown_name("", place.text, place.value, tags)
    if expected := re.match(r"Expected (.*?)(, got `?\w+`?)?$", problem):
        return InputError("", place.text, _expected_in_words(place, expected[1]))
    problem, _, legal = problem.partition("\n")  # of a `__post_init__`
    return InputError("", f"{_path_text(place.path)}: {problem}".removeprefix(": "), legal)


def _missing_key(place: _Place, key: str) -> InputError:
    """The error for a missing key: a table without it may have a mistyped name, and thus be taken
    for a new one.
    """
    known = [
        name for name, table in place.siblings.items() if isinstance(table, dict) and key in table
    ]
    hint = did_you_mean(place.path[-1], known) if place.path else ""
    needed = ", ".join(field.name for field in msgspec.structs.fields(place.kind) if field.required)
    legal = f"{needed} for what is new here" + (f"; else {', '.join(known)}" if known else "")
    problem = f"{_path_text(place.path)}: {key} is missing{hint}".removeprefix(": ")
    return InputError("", problem, legal)


def _expected_in_words(place: _Place, expected: str) -> str:
    """What msgspec expects of a value, in words."""
    if expected == "`object`" and _is_record(place.kind):
        return f"a table of {', '.join(place.kind.__struct_fields__)}"
    for meta in getattr(place.declared[-1], "__metadata__", ()):
        if meta.pattern and meta.description:
            return str(meta.description)
    legal = re.sub(r"\b(?:" + "|".join(WORDS) + r")\b", lambda word: WORDS[word[0]], expected)
    return legal.replace("`", "").replace(" | ", " or ")


def _unknown_key(path: str, key: str, kind: Any, table: Any) -> InputError:
    """The error for an unknown key, with the place of a key of this name, else with the nearest key
    of its own table, else of another table in the whole one.
    """
    own = [name for name in kind.__struct_fields__ if name != NO_KEY]
    places = dict[str, str]()
    for field in msgspec.structs.fields(table):
        if field.name != NO_KEY:
            kind_of_field = getattr(field.type, "__origin__", field.type)  # without its marks
            inner_keys = getattr(kind_of_field, "__struct_fields__", ())
            places |= {inner: f"{field.name}.{inner}" for inner in inner_keys}
    places |= {name: name for name in own}
    likely = own if "." in path else places  # a key above all tables belongs to any of them
    nearest = [key] if key in places else get_close_matches(key, likely, n=1)
    nearest = nearest or get_close_matches(key, places, n=1)
    hint = "".join(f"; did you mean {places[name]!r}?" for name in nearest)
    return InputError("", f"{path}: there is no such key{hint}", one_of(own))


def _intended_type(kind: Any, value: Any) -> Any:
    """The intended type of a value, of several ones."""
    if get_origin(kind) is Annotated:
        return _intended_type(get_args(kind)[0], value)
    if get_origin(kind) not in (Union, UnionType):
        return kind
    kinds = [
        member
        for member in get_args(kind)
        if member is not NoneType
        and (_is_record(member) or get_origin(member) is dict) == isinstance(value, dict)
    ]
    for record in filter(_is_record, kinds):
        config = record.__struct_config__
        if value.get(config.tag_field or "") == config.tag:
            return record
    return next(iter(kinds), kind)


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
