"""Converts tables to records. An error names the first mistake: its path, its value, what is
expected, and the nearest legal key.

The records check single fields against each other in their `__post_init__`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
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
"""Types in msgspec's messages, and the words of our errors for these types."""


def convert_table(raw: Any, table: type[T], *prefix: str) -> T:
    """Convert a table to a record. `prefix` is the path of the table in the study, for errors.

    Raises
    ------
    InputError
        If the table has a mistake; the error names the first mistake.
    """
    try:
        for path, number in _infinite_numbers(raw, prefix):
            raise InputError("", f"{path} = {number}", "a finite number")
        return msgspec.convert(raw, table)
    except msgspec.ValidationError as error:
        raise _mistake(raw, table, prefix, str(error)) from None


NO_KEY = "origin"
"""A field of a study's record that no file may state."""


class _Place(NamedTuple):
    """The place of a mistake.

    Attributes
    ----------
    path
        The keys and indices that lead to the place.
    value
        The value at the place.
    kind
        The type that the value should have.
    declared
        The declared types of all values on the path; the last is the type at the place.
    siblings
        The table with the value, if a table holds it.
    """

    path: list[str | int]
    value: Any
    kind: Any
    declared: list[Any]
    siblings: dict[str, Any]

    @property
    def text(self) -> str:
        """The path and the value at the place, as a text."""
        return f"{_path_text(self.path)} = {_short_text(self.value)}"


def _place(raw: Any, table: Any, prefix: Sequence[str], location: str) -> _Place:
    """Find the place that a message of msgspec names, such as `.search.runs` or `.tests[0]`."""
    path: list[str | int] = list(prefix)
    value = raw
    declared = [table]
    siblings = dict[str, Any]()
    for name, index in re.findall(r"\.(\w+)|\[([\d.]+)\]", location):
        kind = _inner_type(_intended_type(declared[-1], value), name)
        key: Any = name
        if index == "...":
            key = _wrong_key(value, kind)
        elif index:
            key = int(index)
        path.append(key)
        siblings = {}
        if isinstance(value, dict):
            siblings = value
        value = value[key]
        declared.append(kind)
    return _Place(path, value, _intended_type(declared[-1], value), declared, siblings)


def _mistake(raw: Any, table: Any, prefix: Sequence[str], message: str) -> InputError:
    """Make an error of a message of msgspec. The message ends with the place of the mistake."""
    problem, _, location = message.partition(" - at `$")
    place = _place(raw, table, prefix, location)
    if field := re.match(r"Object contains unknown field `(.*)`", problem):
        return _unknown_key(
            _path_text([*place.path, field[1]]), field[1], place.kind, table
        )
    if field := re.match(r"Object missing required field `(.*)`", problem):
        return _missing_key(place, field[1])
    if problem.startswith("Invalid enum value"):
        return unknown_name(
            "", place.text, place.value, (name for name in get_args(place.kind) if name)
        )
    # The value belongs to the key that names the kind of table, such as `distribution`.
    if problem.startswith("Invalid value"):
        tags = [kind.__struct_config__.tag for kind in get_args(place.declared[-2])]
        return unknown_name("", place.text, place.value, tags)
    if expected := re.match(r"Expected (.*?)(, got `?\w+`?)?$", problem):
        return InputError("", place.text, _expected_in_words(place, expected[1]))
    # In the message of a `__post_init__`, the second line says what is expected.
    problem, _, legal = problem.partition("\n")
    return InputError(
        "", f"{_path_text(place.path)}: {problem}".removeprefix(": "), legal
    )


def _missing_key(place: _Place, key: str) -> InputError:
    """The error for a missing key. The table may have a mistyped name: then the key is missing
    because the table counts as new. The error therefore suggests tables with this key.
    """
    names = [
        name
        for name, table in place.siblings.items()
        if isinstance(table, dict) and key in table
    ]
    required = [
        field.name for field in msgspec.structs.fields(place.kind) if field.required
    ]
    # The key that names the kind of table, such as `distribution`, is no field of a kind.
    if key not in required:
        tags = [kind.__struct_config__.tag for kind in get_args(place.declared[-1])]
        required.insert(0, f"{key} ({one_of(tags)})")
    legal = f"{', '.join(required)} for what is new here"
    if not place.path:
        legal = f"{', '.join(required)}; or extends, with the name of a study"
    hint = ""
    if names:
        hint = did_you_mean(place.path[-1], names)
        legal += f"; else {', '.join(names)}"
    return InputError(
        "",
        f"{_path_text(place.path)}: {key} is missing{hint}".removeprefix(": "),
        legal,
    )


def _expected_in_words(place: _Place, expected: str) -> str:
    """What a value must be, in the words of our errors. `expected` is a part of msgspec's
    message.
    """
    if expected == "`object`" and _is_record(place.kind):
        return f"a table of {', '.join(place.kind.__struct_fields__)}"
    for meta in getattr(place.declared[-1], "__metadata__", ()):
        if meta.pattern and meta.description:
            return str(meta.description)
    kinds = rf"\b(?:{'|'.join(WORDS)})\b"
    legal = re.sub(kinds, lambda word: WORDS[word[0]], expected)
    return legal.replace("`", "").replace(" | ", " or ")


def _unknown_key(path: str, key: str, kind: Any, table: Any) -> InputError:
    """The error for an unknown key. The error suggests the nearest key: first a key of the same
    name in another table, then a key of the same table, then any key.
    """
    names = [name for name in kind.__struct_fields__ if name != NO_KEY]
    places = {}
    for field in msgspec.structs.fields(table):
        if field.name != NO_KEY:
            record = getattr(field.type, "__origin__", field.type)
            for name in getattr(record, "__struct_fields__", ()):
                places[name] = f"{field.name}.{name}"
    places |= zip(names, names, strict=True)
    # A key at the top of a study may belong to any table: all places are likely.
    likely: Collection[str] = places
    if "." in path and key not in places:
        likely = names
    nearest = get_close_matches(key, likely, n=1) or get_close_matches(key, places, n=1)
    hint = "".join(f"; did you mean {places[name]!r}?" for name in nearest)
    return InputError("", f"{path}: there is no such key{hint}", one_of(names))


def _intended_type(kind: Any, value: Any) -> Any:
    """Choose the type that a value should have from the members of a union; other types stay."""
    if get_origin(kind) is Annotated:
        return _intended_type(get_args(kind)[0], value)
    if get_origin(kind) not in (Union, UnionType):
        return kind
    kinds = []
    for member in get_args(kind):
        is_table = _is_record(member) or get_origin(member) is dict
        if member is not NoneType and is_table == isinstance(value, dict):
            kinds.append(member)
    for record in (kind for kind in kinds if _is_record(kind)):
        config = record.__struct_config__
        if value.get(config.tag_field or "") == config.tag:
            return record
    return next(iter(kinds), kind)


def _is_record(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, Struct)


def _inner_type(kind: Any, name: str) -> Any:
    """The type of a record's field, or of the elements of a list or table."""
    if _is_record(kind):
        fields = msgspec.structs.fields(kind)
        return next((field.type for field in fields if field.encode_name == name), Any)
    return (get_args(kind) or [Any])[-1]


def _wrong_key(value: Mapping[str, Any], kind: Any) -> str:
    """The first key whose value cannot be converted, in a table with free keys. msgspec's message
    does not name this key.
    """
    for key, item in value.items():
        try:
            msgspec.convert(item, kind)
        except msgspec.ValidationError:
            return key
    raise AssertionError("a value that was wrong is right")


def _path_text(path: Sequence[str | int]) -> str:
    """The path of a key as a text, such as `tests[0].name`."""
    text = ""
    for key in path:
        if isinstance(key, int):
            text += f"[{key}]"
            continue
        if text:
            text += "."
        needs_quotes = ("." in key and text) or not key.isprintable()
        text += repr(key) if needs_quotes else key
    return text


def _short_text(value: object) -> str:
    """The text of a value for an error, cut off if it is long."""
    text = repr(value)
    if len(text) <= MAX_QUOTE:
        return text
    return f"{text[: MAX_QUOTE - 3]}..."


def _infinite_numbers(
    value: object, path: Sequence[str | int]
) -> Iterator[tuple[str, float]]:
    """Yield the numbers in tables that are not finite, with their paths."""
    if isinstance(value, list | tuple):
        value = dict(enumerate(value))
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _infinite_numbers(item, [*path, key])
    elif isinstance(value, float) and not math.isfinite(value):
        yield _path_text(path), value
