"""What no schema tells: numbers and texts that can be used, domains that make sense, tables of a bounded size."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterator, Mapping
from typing import Any

from safevar_sumo.errors import InputError
from safevar_sumo.study.schema import CharacteristicTable, Study

LARGEST = 1e12
"""Of what a characteristic may be, in its unit."""
DEEPEST = 12
"""Tables inside each other."""
MOST_VALUES = 100_000
"""In all tables together."""
LONGEST_KEY = 200
MOST_CHARACTERISTICS = 1000


def unusable(source: object, raw: Mapping[str, Any]) -> Iterator[InputError]:
    """Values anywhere in a study's tables that nobody can use the same way everywhere."""
    waiting: list[tuple[str, Any, int]] = [("", raw, 0)]
    seen = 0
    while waiting:
        where, value, depth = waiting.pop()
        seen += 1
        if depth > DEEPEST or seen > MOST_VALUES:
            legal = f"up to {DEEPEST} tables inside each other and {MOST_VALUES} values"
            yield InputError(source, f"{where[:80]}: is nested too deeply, or there is too much of it", legal)
            return
        if isinstance(value, Mapping | list | tuple):
            inner = value.items() if isinstance(value, Mapping) else enumerate(value)
            entries = [(str(key), one) for key, one in inner]
            for key, _ in entries:
                if len(key) > LONGEST_KEY or not key.isprintable():
                    yield InputError(source, f"{where or 'a key'}: {key[:40]!r} is no name", f"up to {LONGEST_KEY} printable characters")
            waiting += reversed([(f"{where}.{key}" if where else key, one, depth + 1) for key, one in entries])
        else:
            reason = _unusable(value, where)
            if reason:
                yield InputError(source, f"{where} = {reason[0]}", reason[1])


def _unusable(value: object, where: str) -> tuple[str, str] | None:
    """How a value is told, and what would be legal instead; None where it can be used."""
    if isinstance(value, datetime.date | datetime.time):
        return f"{value}, a date or time", "a number, or a text in quotes"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value), "a finite number"
    if isinstance(value, int) and not -2**63 <= value < 2**63:
        return f"an integer of {value.bit_length()} bits", "an integer of 64 bits"
    if isinstance(value, str) and ".parameters." not in f".{where}" and not value.isprintable():
        return repr(value)[:80], "a text without control characters"
    return None


def implausible(source: object, study: Study) -> Iterator[InputError]:
    """Numbers of a study that contradict each other."""
    rows = study.vehicle.characteristics
    if not 1 <= len(rows) <= MOST_CHARACTERISTICS:
        yield InputError(source, f"vehicle.characteristics: {len(rows)} of them", f"1 to {MOST_CHARACTERISTICS}")
    for name, row in rows.items():
        yield from _characteristic(source, f"vehicle.characteristics.{name}", row)
    for name, free in study.calibration.items():
        if free.lower >= free.upper:
            yield InputError(source, f"calibration.{name!r}: lower = {free.lower} and upper = {free.upper}", "numbers, lower < upper")
    if study.matrix is not None and study.matrix.aggregate == "mean":
        yield InputError(source, "matrix.aggregate = 'mean' would average distances [m] with minus the speeds of collisions [m/s]",
                         "'worst', the point in which a setting comes off worst")
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
