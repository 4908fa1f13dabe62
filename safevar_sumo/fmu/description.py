"""What an FMU says of itself in its `modelDescription.xml`: version, variables, units, and how it may be simulated."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import sha256
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

from safevar_sumo.errors import InputError, did_you_mean, first_line
from safevar_sumo.fmu.units import BASES, USUAL, Unit

CONVERTIBLE = ("Real", "Float64", "Float32")
"""Types of variables that have units."""
NUMBERS = (*CONVERTIBLE, "Integer", "Boolean", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Enumeration")
"""Types of variables that numbers can be put into and read from."""
LEGAL = "an FMU of FMI 2.0 or 3.0 for co-simulation"
LONGEST_MEANING = 200
"""Characters of a description that a study takes over."""
MOST_LISTED = 12
"""Variables that an error lists."""


class Variable(NamedTuple):
    """A variable; `unit` is None if nobody says what its unit stands for, `start`, `lower` and `upper` if it declares none."""

    name: str
    reference: int
    type: str
    causality: str
    variability: str
    unit_name: str
    unit: Unit | None
    start: Any
    lower: float | None
    upper: float | None
    meaning: str

    @property
    def is_tunable(self) -> bool:
        """Whether it is a real parameter with an original and a domain, as a characteristic needs them."""
        return self.causality == "parameter" and self.variability != "constant" and self.type in CONVERTIBLE and None not in (
            self.start, self.lower, self.upper) and self.lower < self.upper and self.start != 0  # type: ignore[operator]


@dataclass(frozen=True)
class Description:
    """An FMU: its file, its digest, and what it declares.

    `step` is the step that it needs [s], None if it takes any; `alone` if a process may hold one instance; `named` is how errors call
    it, such as `ads.model = 'controller.fmu'`.
    """

    path: str
    digest: str
    version: str
    identifier: str
    token: str
    step: float | None
    alone: bool
    units: Mapping[str, Unit] = field(compare=False, repr=False)
    variables: Mapping[str, Variable] = field(compare=False, repr=False)

    def variable(self, name: str, causalities: Collection[str], source: str, key: str, types: Collection[str] = NUMBERS) -> Variable:
        """A variable by name.

        Raises
        ------
        InputError
            If there is none, or it is of another causality or type.
        """
        fitting = [one.name for one in self.variables.values() if one.causality in causalities and one.type in types]
        listed = ", ".join(fitting[:MOST_LISTED]) + ", ..." * (len(fitting) > MOST_LISTED)
        legal = f"{_article(' or '.join(causalities))} of the FMU: {listed or 'it has none'}"
        if name not in self.variables:
            raise InputError(source, f"{key} = {name!r}: {Path(self.path).name} has no such variable{did_you_mean(name, fitting)}", legal)
        found = self.variables[name]
        if found.causality not in causalities:
            raise InputError(source, f"{key} = {name!r}: that variable is {_article(found.causality)}", legal)
        if found.type not in types:
            raise InputError(source, f"{key} = {name!r}: that variable is of type {found.type}", f"one of type {', '.join(types)}")
        return found

    def rows(self, fixed: Collection[str]) -> dict[str, dict[str, Any]]:
        """What it declares of its parameters, as rows of the characteristics' table: those that lack nothing, but not those in `fixed`."""
        return {name: self.row(name) for name, one in self.variables.items() if one.is_tunable and name not in fixed}

    def row(self, name: str, unit: str = "") -> dict[str, Any]:
        """What it declares of a parameter, in its own unit or in another one."""
        one = self.variables.get(name)
        if one is None or one.causality != "parameter":
            return {}
        said = {"unit": one.unit_name or "-", "original": one.start, "lower": one.lower, "upper": one.upper,
                "meaning": one.meaning if len(one.meaning) <= LONGEST_MEANING else ""}
        theirs, ours = one.unit, self.units.get(unit) or USUAL.get(unit)
        if unit and unit != said["unit"] and one.unit_name:
            if theirs is None or ours is None or not theirs.fits(ours):
                return {}  # whoever uses the unit refuses it
            said |= {key: theirs.to(ours, said[key]) for key in ("original", "lower", "upper") if said[key] is not None}
        return {key: value for key, value in said.items() if value not in (None, "")}

    def converted(self, variable: Variable, unit: Unit, unit_name: str, source: str, key: str) -> Unit:
        """The unit of a variable that is to hold a quantity in another one; the same if the variable has none.

        Raises
        ------
        InputError
            If its unit is of another kind, or nobody says what it stands for.
        """
        if variable.type not in CONVERTIBLE or not variable.unit_name:
            return unit
        if variable.unit is None:
            raise InputError(source, f"{key} = {variable.name!r}: its unit {variable.unit_name!r} has no BaseUnit in the UnitDefinitions",
                             f"a unit that says how much of {unit_name} it is")
        if not variable.unit.fits(unit):
            raise InputError(source, f"{key} = {variable.name!r}: its unit is {variable.unit_name!r}", f"a unit of {unit_name}")
        return variable.unit


def file_of(model: str, places: Sequence[str]) -> str:
    """The path of an FMU that a study names: relative to the folders of its files, or to the working directory for one without a file."""
    try:
        return next((os.path.abspath(path) for place in (places or (os.getcwd(),)) if (path := Path(place, model)).is_file()), "")
    except (OSError, ValueError):  # the text is no path
        return ""


def description_of(model: str, places: Sequence[str], source: str, key: str) -> Description:
    """What the FMU that a study names says of itself.

    Raises
    ------
    InputError
        In one line each: no such file, no FMU, another version or kind, nothing for this machine, FMPy is not installed.
    """
    path = file_of(model, places)
    if not path:
        where = places[0] if places else os.getcwd()
        problem = "is a directory" if os.path.isdir(os.path.join(where, model)) else f"there is no such file in {where}"
        raise InputError(source, f"{key} = {model!r}: {problem}", LEGAL)
    at = os.stat(path)
    try:
        return _read(path, at.st_mtime_ns, at.st_size, at.st_ino)
    except InputError as error:
        raise InputError(source, f"{key} = {model!r} {error.problem}", error.legal) from None


@lru_cache(maxsize=32)
def _read(path: str, *_: int) -> Description:
    try:
        from fmpy import platform, platform_tuple, sharedLibraryExtension
        from fmpy.model_description import read_model_description
    except ImportError:
        raise InputError("fmu", "needs FMPy, which is not installed", "pip install 'safevar_sumo[fmu]'") from None
    try:
        with zipfile.ZipFile(path) as archive:
            files = set(archive.namelist())
            version = ElementTree.fromstring(archive.read("modelDescription.xml")).get("fmiVersion", "")
    except Exception as error:  # whatever is wrong with somebody's file
        raise InputError("fmu", f"is no FMU that can be read: {first_line(error)}", LEGAL) from None
    if not version.startswith(("2.", "3.")):
        raise InputError("fmu", f"is of FMI {version}", LEGAL)
    try:
        said = read_model_description(path, validate=False)
    except Exception as error:  # whatever FMPy stumbles over in somebody's file
        raise InputError("fmu", f"is no FMU that can be read: {first_line(error)}", LEGAL) from None
    way = said.coSimulation
    if way is None:
        kind = "model exchange" if said.modelExchange is not None else "scheduled execution"
        raise InputError("fmu", f"is for {kind} only, without a solver of its own", LEGAL)
    folder = platform_tuple if said.fmiVersion.startswith("3") else platform
    if f"binaries/{folder}/{way.modelIdentifier}{sharedLibraryExtension}" not in files:
        there = sorted({name.split("/")[1] for name in files if name.startswith("binaries/") and name.count("/") > 1 and name[-1] != "/"})
        raise InputError("fmu", f"has no binary for this machine ({folder}), but {', '.join(there) or 'none at all'}", f"binaries/{folder}")
    units = {unit.name: Unit(tuple(int(getattr(unit.baseUnit, base)) for base in BASES), float(unit.baseUnit.factor),
                             float(unit.baseUnit.offset)) for unit in said.unitDefinitions if unit.baseUnit is not None}
    return Description(
        path, sha256(Path(path).read_bytes()).hexdigest(), said.fmiVersion, way.modelIdentifier, said.guid or "", _step(said),
        way.canBeInstantiatedOnlyOncePerProcess, units,
        {one.name: _variable(one, units) for one in said.modelVariables if not one.dimensions})


def _step(said: Any) -> float | None:
    """The step that an FMU needs [s]: one that it has inside, or the usual one of an FMU that cannot change it."""
    way, usual = said.coSimulation, getattr(said.defaultExperiment, "stepSize", None)
    fixed = way.fixedInternalStepSize or (None if way.canHandleVariableCommunicationStepSize else usual)
    return float(fixed) if fixed and float(fixed) > 0 else None


def _variable(said: Any, units: Mapping[str, Unit]) -> Variable:
    def declared(name: str) -> Any:
        own = getattr(said, name, None)
        return getattr(said.declaredType, name, None) if own is None else own

    unit_name, start = declared("unit") or "", said.start
    unit = units.get(unit_name) or USUAL.get(unit_name)
    if unit is not None and declared("relativeQuantity"):
        unit = unit._replace(offset=0.0)
    variability = said.variability or ("continuous" if said.type in CONVERTIBLE else "discrete")
    return Variable(said.name, said.valueReference, said.type, said.causality or "local", variability, unit_name, unit,
                    _number(start) if said.type in CONVERTIBLE else start, _number(declared("min")), _number(declared("max")),
                    " ".join((said.description or "").split()))


def _number(text: Any) -> float | None:
    try:
        number = float(text)
    except (TypeError, ValueError):
        return None
    return number if isfinite(number) else None


def _article(word: str) -> str:
    return f"{'an' if word[0] in 'aeiou' else 'a'} {word}"
