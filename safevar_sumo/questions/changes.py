"""Changed values of characteristics as users type them: `mass=2500`, `mass=+10%` or a sweep,
`mass=2100..2600:6`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from safevar_sumo.errors import InputError, check_name
from safevar_sumo.vehicles import CharacteristicSet

NUMBER_PATTERN = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
SIGNED_NUMBER = re.compile(r"[+-](?:\d+\.?\d*|\.\d+)")
PERCENTAGE = re.compile(rf"({SIGNED_NUMBER.pattern})%")
SWEEP = re.compile(rf"({NUMBER_PATTERN})\.\.({NUMBER_PATTERN})(?::(\d{{1,6}}))?")
DEFAULT_SWEEP_LENGTH = 11
"""Number of values of a sweep without `:NUMBER`."""
MAX_SETTINGS = 10_000
"""Maximum number of settings that all changes together may produce."""
SINGLE_VALUE_FORMS = (
    "one value for each: NAME=VALUE in the characteristic's unit, or NAME=+10% of the original"
)
CHANGE_FORMS = (
    "NAME=VALUE in the characteristic's unit, NAME=+10% of the original, or NAME=FROM..TO,"
    " NAME=FROM..TO:NUMBER"
)


def read_changes(
    changes: Sequence[str],
    characteristics: CharacteristicSet,
    *,
    beyond: bool = False,
    single: bool = False,
) -> dict[str, list[float]]:
    """Parse changes into the values of each named characteristic; `single` refuses sweeps,
    without suggesting --beyond.

    Raises
    ------
    InputError
        If a change cannot be parsed, a name is unknown or given twice, or a value is outside its
        domain.
    """
    values_by_name = {}
    forms = SINGLE_VALUE_FORMS if single else CHANGE_FORMS

    # A name and its values, which are legal.
    for change in changes:
        name, equals, text = (text.strip() for text in change.partition("="))
        if not equals:
            raise InputError("", repr(change), forms)
        if name in values_by_name:
            raise InputError("", f"{name} is set twice", "each characteristic once")
        check_name("", f"there is no characteristic {name!r}", name, characteristics.names)
        characteristic = characteristics.members[characteristics.names.index(name)]
        values_by_name[name] = _parse_values(change, text, characteristic.original, forms)
        if single and len(values_by_name[name]) > 1:
            raise InputError("", f"{change!r} is a sweep", forms)
        for value in values_by_name[name]:
            is_relative = SIGNED_NUMBER.fullmatch(text) and characteristic.original
            hint = f", or {name}={text}% of the original" if is_relative else ""
            characteristic.check(
                value, beyond=beyond, otherwise=hint, switch="" if single else "--beyond"
            )

    # Not too many settings.
    if np.prod([len(values) for values in values_by_name.values()], dtype=float) > MAX_SETTINGS:
        raise InputError(
            "",
            f"{' '.join(changes)}: more than {MAX_SETTINGS} settings",
            "shorter sweeps, FROM..TO:NUMBER",
        )
    return values_by_name


def _parse_values(change: str, text: str, original: float, forms: str) -> list[float]:
    # A percentage of the original, a sweep, or a number.
    if percentage := PERCENTAGE.fullmatch(text):
        if not original:
            raise InputError(
                "", f"{change!r}: the original is 0", "NAME=VALUE in the characteristic's unit"
            )
        return [original + abs(original) * float(percentage[1]) / 100]
    if sweep := SWEEP.fullmatch(text):
        count = int(sweep[3] or DEFAULT_SWEEP_LENGTH)
        if count < 2:
            raise InputError(
                "",
                f"{change!r}: {count} values from {sweep[1]} to {sweep[2]}",
                "NUMBER of at least 2",
            )
        return np.linspace(float(sweep[1]), float(sweep[2]), count).tolist()  # type: ignore[no-any-return]
    if re.fullmatch(NUMBER_PATTERN, text):
        return [float(text)]
    raise InputError("", repr(change), forms)
