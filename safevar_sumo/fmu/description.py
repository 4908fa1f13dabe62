"""An FMU's model description, as FMPy reads it: the variables, units and steps that a study may use; and units."""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from safevar_sumo.errors import InputError, describe_error, unknown_name
from safevar_sumo.output import file_beside

if TYPE_CHECKING:
    from fmpy.model_description import ModelDescription, ModelVariable

Values = TypeVar("Values", float, npt.NDArray[np.float64])
BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
"""FMI's base units (FMI 2.0.4, section 2.2.2)."""


class Unit(NamedTuple):
    """A unit: value in SI = `factor` * value + `offset`; `exponents` belong to the units `BASE_UNITS`."""

    exponents: tuple[int, ...]
    factor: float = 1.0
    offset: float = 0.0

    def fits(self, other: Unit) -> bool:
        """Whether both measure the same kind of quantity; radians count as plain numbers."""
        return self.exponents[:-1] == other.exponents[:-1]

    def to(self, other: Unit, value: Values) -> Values:
        """A value or an array converted to another unit of the same kind; unchanged where both units are equal."""
        if (self.factor, self.offset) == (other.factor, other.offset):
            return value
        return (self.factor * value + (self.offset - other.offset)) / other.factor


def _unit(factor: float = 1.0, offset: float = 0.0, **exponents: int) -> Unit:
    return Unit(tuple(exponents.get(base, 0) for base in BASE_UNITS), factor, offset)


SI: Mapping[str, Unit] = {
    "-": _unit(),
    "s": _unit(s=1),
    "m": _unit(m=1),
    "m/s": _unit(m=1, s=-1),
    "m/s^2": _unit(m=1, s=-2),
    "kg": _unit(kg=1),
}
"""Units of the quantities that vehicles and driving systems exchange."""
_FORCE, _TORQUE = {"kg": 1, "m": 1, "s": -2}, {"kg": 1, "m": 2, "s": -2}
_POWER, _PRESSURE = {"kg": 1, "m": 2, "s": -3}, {"kg": 1, "m": -1, "s": -2}
COMMON_UNITS: Mapping[str, Unit] = {
    **SI,
    "": _unit(),
    "1": _unit(),
    "%": _unit(0.01),
    "rad": _unit(rad=1),
    "deg": _unit(math.pi / 180, rad=1),
    "ms": _unit(1e-3, s=1),
    "min": _unit(60.0, s=1),
    "h": _unit(3600.0, s=1),
    "1/s": _unit(s=-1),
    "Hz": _unit(s=-1),
    "mm": _unit(1e-3, m=1),
    "cm": _unit(1e-2, m=1),
    "km": _unit(1e3, m=1),
    "m2": _unit(m=2),
    "m^2": _unit(m=2),
    "m.s-1": _unit(m=1, s=-1),
    "km/h": _unit(1 / 3.6, m=1, s=-1),
    "kph": _unit(1 / 3.6, m=1, s=-1),
    "mph": _unit(0.44704, m=1, s=-1),
    "m/s2": _unit(m=1, s=-2),
    "m/s**2": _unit(m=1, s=-2),
    "m.s-2": _unit(m=1, s=-2),
    "g": _unit(1e-3, kg=1),
    "t": _unit(1e3, kg=1),
    "rad/s": _unit(rad=1, s=-1),
    "rpm": _unit(math.pi / 30, rad=1, s=-1),
    "r/min": _unit(math.pi / 30, rad=1, s=-1),
    "N": _unit(**_FORCE),
    "kN": _unit(1e3, **_FORCE),
    "N.m": _unit(**_TORQUE),
    "Nm": _unit(**_TORQUE),
    "J": _unit(**_TORQUE),
    "W": _unit(**_POWER),
    "kW": _unit(1e3, **_POWER),
    "Pa": _unit(**_PRESSURE),
    "kPa": _unit(1e3, **_PRESSURE),
    "bar": _unit(1e5, **_PRESSURE),
    "K": _unit(K=1),
    "degC": _unit(1.0, 273.15, K=1),
}
"""Units by their common names, for models whose description does not define them."""


REAL_TYPES = ("Real", "Float64", "Float32")
"""Types of variables that have units."""
NUMBER_TYPES = (
    *REAL_TYPES,
    "Integer",
    "Boolean",
    "Int8",
    "UInt8",
    "Int16",
    "UInt16",
    "Int32",
    "UInt32",
    "Int64",
    "UInt64",
    "Enumeration",
)
"""Types of variables that hold numbers."""
SUPPORTED_FMU = "an FMU of FMI 2.0 or 3.0 for co-simulation"
MAX_MEANING = 200
"""Longest description of a variable that becomes a characteristic's meaning [characters]."""
MAX_LISTED = 12
"""Largest number of variables that an error lists."""
MIN_STEP, MAX_STEP = 1e-6, 10.0
"""Shortest and longest communication step [s]."""


@dataclass(frozen=True)
class Description:
    """An FMU: its file, the digest of the file, FMPy's model description, the units that it defines, and its scalar
    variables by name.
    """

    path: str
    digest: str
    model: ModelDescription = field(compare=False, repr=False)
    units: Mapping[str, Unit] = field(compare=False, repr=False)
    variables: Mapping[str, ModelVariable] = field(compare=False, repr=False)

    @property
    def is_single(self) -> bool:
        """Whether a process may hold only one instance."""
        return bool(self.model.coSimulation.canBeInstantiatedOnlyOncePerProcess)

    def communication_step(self, stated: float | None, source: str, key: str) -> float | None:
        """The time between two calls [s]: as stated, else the step that the FMU requires; None if any step will do.

        An FMU requires its internal step, or its default step if its step cannot change.
        """
        simulation, default = self.model.coSimulation, getattr(self.model.defaultExperiment, "stepSize", None)
        required = simulation.fixedInternalStepSize or (
            None if simulation.canHandleVariableCommunicationStepSize else default
        )
        step = stated or float(required or 0.0)
        if step and not MIN_STEP <= step <= MAX_STEP:
            raise InputError(
                source,
                f"{Path(self.path).name} requires a step of {step:g} s",
                f"a step from {MIN_STEP:g} to {MAX_STEP:g} s; {key}.step sets another",
            )
        return step or None

    def variable(
        self, name: str, causalities: Collection[str], source: str, key: str, types: Collection[str] = NUMBER_TYPES
    ) -> ModelVariable:
        """A variable by name.

        Raises
        ------
        InputError
            If the variable does not exist, or has another causality or type.
        """
        variable = self.variables.get(name)
        if variable is not None and causality_of(variable) in causalities and variable.type in types:
            return variable
        others = self.variables.values()
        names = [other.name for other in others if causality_of(other) in causalities and other.type in types]
        problem = f"is no {' or '.join(causalities)} of {Path(self.path).name} that holds a number"
        raise unknown_name(source, f"{key} = {name!r} {problem}", name, names[:MAX_LISTED])

    def unit_of(self, variable: ModelVariable) -> Unit | None:
        """The unit of a variable; None if it declares none, or one that is not defined."""
        name = declared(variable, "unit")
        unit = self.units.get(name) or COMMON_UNITS.get(name)
        return unit._replace(offset=0.0) if unit is not None and declared(variable, "relativeQuantity") else unit

    def unit_for(self, variable: ModelVariable, unit: Unit, unit_name: str, source: str, key: str) -> Unit:
        """The unit of a variable that is to hold a quantity given in `unit`; `unit` itself if the variable declares no
        unit.

        Raises
        ------
        InputError
            If the unit of the variable measures another kind of quantity or is not defined.
        """
        name, variable_unit = declared(variable, "unit"), self.unit_of(variable)
        if variable.type not in REAL_TYPES or not name:
            return unit
        if variable_unit is None:
            raise InputError(
                source,
                f"{key} = {variable.name!r}: its unit {name!r} has no BaseUnit in the UnitDefinitions",
                f"a unit with a BaseUnit of the same kind as {unit_name}",
            )
        if not variable_unit.fits(unit):
            raise InputError(source, f"{key} = {variable.name!r}: its unit is {name!r}", f"a unit of {unit_name}")
        return variable_unit

    def table_rows(self, fixed_names: Collection[str]) -> dict[str, dict[str, str | float]]:
        """Rows of the characteristics' table for all real parameters with start, min and max, except those of
        `fixed_names`.
        """
        rows = {
            name: self.table_row(name)
            for name, variable in self.variables.items()
            if name not in fixed_names and variable.type in REAL_TYPES and variable.variability != "constant"
        }
        return {
            name: row
            for name, row in rows.items()
            if {"original", "lower", "upper"} <= row.keys() and row["lower"] != row["upper"] and row["original"] != 0
        }

    def table_row(self, name: str, unit: str = "") -> dict[str, str | float]:
        """The table row that a parameter declares, converted to `unit` if a unit is given; empty if the variable is no
        parameter.
        """
        variable = self.variables.get(name)
        if variable is None or causality_of(variable) != "parameter":
            return {}
        declared_name, meaning = declared(variable, "unit"), " ".join((variable.description or "").split())
        numbers = {
            key: number
            for key, attribute in (("original", "start"), ("lower", "min"), ("upper", "max"))
            if (number := number_of(variable, attribute)) is not None
        }
        row_unit, declared_unit = self.units.get(unit) or COMMON_UNITS.get(unit), self.unit_of(variable)
        if unit and declared_name not in ("", unit):
            if declared_unit is None or row_unit is None or not declared_unit.fits(row_unit):
                return {}  # the vehicle model refuses the unit later
            numbers = {key: declared_unit.to(row_unit, number) for key, number in numbers.items()}
        return {
            "unit": declared_name or "-",
            **numbers,
            **({"meaning": meaning} if 0 < len(meaning) <= MAX_MEANING else {}),
        }


def causality_of(variable: ModelVariable) -> str:
    return variable.causality or "local"


def declared(variable: ModelVariable, name: str) -> str:
    """An attribute of a variable or of its declared type; "" if neither has it."""
    value = getattr(variable, name, None)
    return (getattr(variable.declaredType, name, None) if value is None else value) or ""


def number_of(variable: ModelVariable, name: str) -> float | None:
    """A finite number that a variable or its declared type declares."""
    try:
        number = float(declared(variable, name))
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def file_of(model: str, folders: Sequence[str]) -> str:
    """The path of the FMU that a study names: relative to the folders of the study's files, else to the working
    directory.
    """
    return file_beside(model, folders or (os.getcwd(),))


def description_of(model: str, folders: Sequence[str], source: str, key: str) -> Description:
    """The description of the FMU that a study names.

    Raises
    ------
    InputError
        If there is no such file, it is not an FMU, its version or kind is not supported, it has no binary for this
        machine, or FMPy is not installed.
    """
    path = file_of(model, folders)
    if not path:
        raise InputError(
            source,
            f"{key} = {model!r}: there is no such file in {folders[0] if folders else os.getcwd()}",
            SUPPORTED_FMU,
        )
    return _read_description(path, sha256(Path(path).read_bytes()).hexdigest(), source, f"{key} = {model!r}")


@lru_cache(maxsize=32)
def _read_description(path: str, digest: str, source: str, name: str) -> Description:
    try:
        from fmpy import platform, platform_tuple, supported_platforms
        from fmpy.model_description import read_model_description
    except ImportError:
        raise InputError(
            source, f"{name} needs FMPy, which is not installed", "in the checkout: pip install '.[fmu]'"
        ) from None
    try:
        model = read_model_description(path, validate=False)
        platforms = {*supported_platforms(path)}
    except Exception as error:  # any error of FMPy about a user's file
        raise InputError(source, f"{name} cannot be read as an FMU: {describe_error(error)}", SUPPORTED_FMU) from None
    if not model.fmiVersion.startswith(("2.", "3.")) or model.coSimulation is None:
        kind = "" if model.coSimulation is None else "for co-simulation"
        raise InputError(
            source, f"{name} is of FMI {model.fmiVersion}, {kind or 'not for co-simulation'}", SUPPORTED_FMU
        )
    if not {platform, platform_tuple} & platforms:
        problem = f"{name} has no binary for this machine, only for {', '.join(sorted(platforms)) or 'none'}"
        raise InputError(source, problem, f"binaries/{platform}")
    units = {
        unit.name: Unit(
            tuple(int(getattr(unit.baseUnit, base)) for base in BASE_UNITS),
            float(unit.baseUnit.factor),
            float(unit.baseUnit.offset),
        )
        for unit in model.unitDefinitions
        if unit.baseUnit is not None
    }
    variables = {variable.name: variable for variable in model.modelVariables if not variable.dimensions}
    return Description(path, digest, model, units, variables)
