"""An FMU's `modelDescription.xml`: version, variables, units, and how the FMU may be simulated."""

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

from safevar_sumo.errors import InputError, describe_error, did_you_mean
from safevar_sumo.fmu.units import BASE_UNITS, COMMON_UNITS, Unit

REAL_TYPES = ("Real", "Float64", "Float32")
"""Types of variables that have units."""
NUMBER_TYPES = (*REAL_TYPES, "Integer", "Boolean", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Enumeration")
"""Types of variables that hold numbers."""
SUPPORTED_FMU = "an FMU of FMI 2.0 or 3.0 for co-simulation"
MAX_MEANING = 200
"""Longest description of a variable that becomes a characteristic's meaning [characters]."""
MAX_LISTED = 12
"""Largest number of variables that an error lists."""


class Variable(NamedTuple):
    """A variable; `unit` is None if the FMU does not define it; `start`, `lower` and `upper` are None if the FMU declares none."""

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
    def can_be_characteristic(self) -> bool:
        """Whether this is a real parameter with the original value and the domain that a characteristic needs."""
        return self.causality == "parameter" and self.variability != "constant" and self.type in REAL_TYPES and None not in (
            self.start, self.lower, self.upper) and self.lower < self.upper and self.start != 0  # type: ignore[operator]


@dataclass(frozen=True)
class Description:
    """An FMU: its file, the digest of the file, and the declarations in it.

    `identifier` is the name of its library, `token` its GUID (FMI 2.0) or instantiation token (FMI 3.0).
    `step` is the step that the FMU requires [s], None if any step will do; with `single_instance` a process may hold only one instance.
    """

    path: str
    digest: str
    version: str
    identifier: str
    token: str
    step: float | None
    single_instance: bool
    units: Mapping[str, Unit] = field(compare=False, repr=False)
    variables: Mapping[str, Variable] = field(compare=False, repr=False)

    def variable(self, name: str, causalities: Collection[str], source: str, key: str, types: Collection[str] = NUMBER_TYPES) -> Variable:
        """A variable by name.

        Raises
        ------
        InputError
            If the variable does not exist, or has another causality or type.
        """
        candidates = [variable.name for variable in self.variables.values() if variable.causality in causalities and variable.type in types]
        listing = ", ".join(candidates[:MAX_LISTED]) + ", ..." * (len(candidates) > MAX_LISTED)
        expected = f"{_with_article(' or '.join(causalities))} of the FMU: {listing or 'it has none'}"
        if name not in self.variables:
            problem = f"{Path(self.path).name} has no such variable{did_you_mean(name, candidates)}"
            raise InputError(source, f"{key} = {name!r}: {problem}", expected)
        variable = self.variables[name]
        if variable.causality not in causalities:
            raise InputError(source, f"{key} = {name!r}: that variable is {_with_article(variable.causality)}", expected)
        if variable.type not in types:
            raise InputError(source, f"{key} = {name!r}: that variable is of type {variable.type}", f"a type among {', '.join(types)}")
        return variable

    def table_rows(self, fixed_names: Collection[str]) -> dict[str, dict[str, Any]]:
        """Rows of the characteristics' table for all parameters that can be characteristics, except those of `fixed_names`."""
        return {name: self.table_row(name) for name, variable in self.variables.items()
                if variable.can_be_characteristic and name not in fixed_names}

    def table_row(self, name: str, unit: str = "") -> dict[str, Any]:
        """The table row that a parameter declares, converted to `unit` if a unit is given; empty if the variable is no parameter."""
        variable = self.variables.get(name)
        if variable is None or variable.causality != "parameter":
            return {}
        row = {"unit": variable.unit_name or "-", "original": variable.start, "lower": variable.lower, "upper": variable.upper,
               "meaning": variable.meaning if len(variable.meaning) <= MAX_MEANING else ""}
        declared_unit, row_unit = variable.unit, self.units.get(unit) or COMMON_UNITS.get(unit)
        if unit and unit != row["unit"] and variable.unit_name:
            if declared_unit is None or row_unit is None or not declared_unit.fits(row_unit):
                return {}  # the vehicle model refuses the unit later
            row |= {key: declared_unit.to(row_unit, row[key]) for key in ("original", "lower", "upper") if row[key] is not None}
        return {key: value for key, value in row.items() if value not in (None, "")}

    def unit_for(self, variable: Variable, unit: Unit, unit_name: str, source: str, key: str) -> Unit:
        """The unit of a variable that is to hold a quantity given in `unit`; `unit` itself if the variable declares no unit.

        Raises
        ------
        InputError
            If the unit of the variable measures another kind of quantity or is not defined.
        """
        if variable.type not in REAL_TYPES or not variable.unit_name:
            return unit
        if variable.unit is None:
            raise InputError(source, f"{key} = {variable.name!r}: its unit {variable.unit_name!r} has no BaseUnit in the UnitDefinitions",
                             f"a unit with a BaseUnit of the same kind as {unit_name}")
        if not variable.unit.fits(unit):
            raise InputError(source, f"{key} = {variable.name!r}: its unit is {variable.unit_name!r}", f"a unit of {unit_name}")
        return variable.unit


def file_of(model: str, folders: Sequence[str]) -> str:
    """The path of the FMU that a study names: relative to the folders of the study's files, else to the working directory."""
    try:
        return next((os.path.abspath(path) for folder in (folders or (os.getcwd(),)) if (path := Path(folder, model)).is_file()), "")
    except (OSError, ValueError):  # not a valid path
        return ""


def description_of(model: str, folders: Sequence[str], source: str, key: str) -> Description:
    """The description of the FMU that a study names.

    Raises
    ------
    InputError
        If there is no such file, it is not an FMU, its version or kind is not supported, it has no binary for this machine, or FMPy
        is not installed.
    """
    path = file_of(model, folders)
    if not path:
        folder = folders[0] if folders else os.getcwd()
        problem = "is a directory" if os.path.isdir(os.path.join(folder, model)) else f"there is no such file in {folder}"
        raise InputError(source, f"{key} = {model!r}: {problem}", SUPPORTED_FMU)
    status = os.stat(path)
    try:
        return _read_description(path, status.st_mtime_ns, status.st_size, status.st_ino)
    except InputError as error:
        raise InputError(source, f"{key} = {model!r} {error.problem}", error.legal) from None


@lru_cache(maxsize=32)
def _read_description(path: str, *_: int) -> Description:  # also cached by the file's time, size and inode
    try:
        from fmpy import platform, platform_tuple, sharedLibraryExtension
        from fmpy.model_description import read_model_description
    except ImportError:
        raise InputError("fmu", "needs FMPy, which is not installed", "in the checkout: pip install '.[fmu]'") from None
    try:
        with zipfile.ZipFile(path) as archive:
            files = set(archive.namelist())
            version = ElementTree.fromstring(archive.read("modelDescription.xml")).get("fmiVersion", "")
    except Exception as error:  # any error in a user's file
        raise InputError("fmu", f"cannot be read as an FMU: {describe_error(error)}", SUPPORTED_FMU) from None
    if not version.startswith(("2.", "3.")):
        raise InputError("fmu", f"is of FMI {version}", SUPPORTED_FMU)
    try:
        model = read_model_description(path, validate=False)
    except Exception as error:  # any error of FMPy about a user's file
        raise InputError("fmu", f"cannot be read as an FMU: {describe_error(error)}", SUPPORTED_FMU) from None
    simulation = model.coSimulation
    if simulation is None:
        kind = "model exchange" if model.modelExchange is not None else "scheduled execution"
        raise InputError("fmu", f"is for {kind} only, without a solver of its own", SUPPORTED_FMU)
    folder = platform_tuple if model.fmiVersion.startswith("3") else platform
    if f"binaries/{folder}/{simulation.modelIdentifier}{sharedLibraryExtension}" not in files:
        platforms = sorted({name.split("/")[1] for name in files
                            if name.startswith("binaries/") and name.count("/") > 1 and name[-1] != "/"})
        others = f"only for {', '.join(platforms)}" if platforms else "nor for any other"
        raise InputError("fmu", f"has no binary for this machine ({folder}), {others}", f"binaries/{folder}")
    units = {unit.name: Unit(tuple(int(getattr(unit.baseUnit, base)) for base in BASE_UNITS), float(unit.baseUnit.factor),
                             float(unit.baseUnit.offset)) for unit in model.unitDefinitions if unit.baseUnit is not None}
    return Description(
        path, sha256(Path(path).read_bytes()).hexdigest(), model.fmiVersion, identifier=simulation.modelIdentifier, token=model.guid or "",
        step=_required_step(model), single_instance=simulation.canBeInstantiatedOnlyOncePerProcess, units=units,
        variables={variable.name: _variable_of(variable, units) for variable in model.modelVariables if not variable.dimensions})


def _required_step(model: Any) -> float | None:
    """The step that an FMU requires [s]: its internal step, or its default step if its step cannot change; None if any step will do."""
    simulation, default_step = model.coSimulation, getattr(model.defaultExperiment, "stepSize", None)
    step = simulation.fixedInternalStepSize or (None if simulation.canHandleVariableCommunicationStepSize else default_step)
    return float(step) if step and float(step) > 0 else None


def _variable_of(variable: Any, units: Mapping[str, Unit]) -> Variable:
    def attribute(name: str) -> Any:
        value = getattr(variable, name, None)
        return getattr(variable.declaredType, name, None) if value is None else value

    unit_name, start = attribute("unit") or "", variable.start
    unit = units.get(unit_name) or COMMON_UNITS.get(unit_name)
    if unit is not None and attribute("relativeQuantity"):
        unit = unit._replace(offset=0.0)
    variability = variable.variability or ("continuous" if variable.type in REAL_TYPES else "discrete")
    return Variable(variable.name, variable.valueReference, variable.type, variable.causality or "local", variability, unit_name, unit,
                    start=_to_float(start) if variable.type in REAL_TYPES else start, lower=_to_float(attribute("min")),
                    upper=_to_float(attribute("max")), meaning=" ".join((variable.description or "").split()))


def _to_float(text: Any) -> float | None:
    try:
        number = float(text)
    except (TypeError, ValueError):
        return None
    return number if isfinite(number) else None


def _with_article(word: str) -> str:
    return f"{'an' if word[0] in 'aeiou' else 'a'} {word}"
