"""Weathers by name; they are data, kept beside this module in weather.toml."""

from __future__ import annotations

import tomllib
from pathlib import Path

import msgspec

from safevar_sumo.errors import unknown
from safevar_sumo.study import Weather

_CATALOGUE = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
WEATHERS = {name: msgspec.convert({"name": name, **row}, Weather) for name, row in _CATALOGUE.items()}


def weather_of(choice: str | Weather, source: object) -> Weather:
    """The weather that a study names or gives itself.

    Raises
    ------
    InputError
        If there is no weather of that name.
    """
    if isinstance(choice, Weather):
        return choice
    if choice not in WEATHERS:
        fields = ", ".join(Weather.__struct_fields__)
        raise unknown(source, f"weather = {choice!r}", choice, WEATHERS, f", or a table with {fields}")
    return WEATHERS[choice]
