"""How much a setting changes the vehicle: what a search may minimise beside metrics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from msgspec import Struct

from safevar_sumo.errors import InputError
from safevar_sumo.plugins import Guard, read_only_copy
from safevar_sumo.records import FloatArray
from safevar_sumo.vehicles.characteristics import CharacteristicSet

Function = Callable[[FloatArray, CharacteristicSet], FloatArray]


class Change(Struct, frozen=True, kw_only=True):
    """A measure of change: `function` takes filtered settings, shape (N, n), and the characteristics; returns shape (N,)."""

    name: str
    title: str
    unit: str
    function: Function


CHANGES = {change.name: change for change in (
    Change(name="f_diff", title="largest change", unit="fraction", function=lambda settings, known: known.largest_change(settings)),
    Change(name="f_num_diff", title="characteristics changed", unit="-", function=lambda settings, known: known.number_changed(settings)),
)}


def foreign_change(change: Any, guard: Guard) -> Change:
    """A measure of change from outside the package: its function is given copies, its result checked.

    Raises
    ------
    InputError
        If its record is wrong.
    """
    texts = (change.name, change.title, change.unit)
    if not (all(isinstance(text, str) and text.isprintable() for text in texts) and change.name.isidentifier()):
        raise InputError(guard.source, f"{guard.name}: name, title, unit = {texts!r}", "printable texts, the name an identifier")
    if not callable(change.function):
        raise InputError(guard.source, f"{guard.name}: function = {change.function!r}", "a function of settings and characteristics")

    def checked(settings: FloatArray, known: CharacteristicSet) -> FloatArray:
        given = guard.call(change.name, change.function, read_only_copy(settings), known)
        return guard.numbers(change.name, "values", given, (len(settings),))

    return Change(name=change.name, title=change.title, unit=change.unit, function=checked)
