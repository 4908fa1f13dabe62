"""Reads changed values of characteristics as users type them: `mass=2500` or `mass=+10%`."""

from __future__ import annotations

import re
from collections.abc import Sequence

from safevar_sumo.errors import InputError, check_name
from safevar_sumo.records import NamedValues
from safevar_sumo.vehicles import CharacteristicSet

NUMBER_PATTERN = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
SIGNED_NUMBER = re.compile(r"[+-](?:\d+\.?\d*|\.\d+)")
PERCENTAGE = re.compile(rf"({SIGNED_NUMBER.pattern})%")
CHANGE_FORMS = (
    "one value for each: NAME=VALUE in the characteristic's unit, or NAME=+10% of the original;"
    " several values are simulated by sv.evaluate"
)


def read_changes(
    changes: Sequence[str],
    characteristics: CharacteristicSet,
    *,
    beyond: bool | None = None,
) -> NamedValues:
    """Read changes as the value of each named characteristic. `beyond` says whether values outside
    of their domains are allowed; None also keeps an error from suggesting the option --beyond.

    Raises
    ------
    InputError
        If a change cannot be parsed, a name is unknown or given twice, or a value is outside its
        domain.
    """
    switch = "" if beyond is None else "--beyond"
    values = {}

    for change in changes:
        name, equals, text = (text.strip() for text in change.partition("="))
        if not equals:
            raise InputError("", repr(change), CHANGE_FORMS)
        if name in values:
            raise InputError("", f"{name} is set twice", "each characteristic once")
        check_name(
            "", f"there is no characteristic {name!r}", name, characteristics.names
        )
        characteristic = characteristics.members[characteristics.names.index(name)]
        values[name] = _parse(change, text, characteristic.original)
        is_relative = SIGNED_NUMBER.fullmatch(text) and characteristic.original
        hint = ""
        if is_relative:
            hint = f", or {name}={text}% of the original"
        characteristic.check(
            values[name], beyond=bool(beyond), otherwise=hint, switch=switch
        )
    return values


def _parse(change: str, text: str, original: float) -> float:
    """The value that `text` states: a number, or a signed percentage of the original value.
    `change` is the whole text, for errors.
    """
    if percentage := PERCENTAGE.fullmatch(text):
        if not original:
            raise InputError(
                "",
                f"{change!r}: the original is 0",
                "NAME=VALUE in the characteristic's unit",
            )
        return original + abs(original) * float(percentage[1]) / 100
    if re.fullmatch(NUMBER_PATTERN, text):
        return float(text)
    raise InputError("", repr(change), CHANGE_FORMS)
