"""Units, and an FMU's model description, as FMPy reads it: the variables, units and steps that a study may use."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import sha256
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
import platformdirs

from safevar_sumo.errors import InputError, describe_error, unknown_name
from safevar_sumo.output import file_beside

if TYPE_CHECKING:
    from fmpy.model_description import ModelDescription, ModelVariable

Values = TypeVar("Values", float, npt.NDArray[np.float64])
Constant = str | bool | float
"""A value of a parameter."""
BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd")
"""FMI's base units (FMI 2.0.4, section 2.2.2), without radians, which are plain numbers."""


class Unit(NamedTuple):
    """A unit: value in SI = `factor` * value + `offset`; `exponents` belong to the units `BASE_UNITS`."""

    exponents: tuple[int, ...]
    factor: float = 1.0
    offset: float = 0.0

    def to(self, other: Unit, value: Values) -> Values:
        """A value or an array converted to another unit of the same kind; unchanged where both units are equal."""
        if (self.factor, self.offset) == (other.factor, other.offset):
            return value
        return (self.factor * value + (self.offset - other.offset)) / other.factor


def _unit(factor: float = 1.0, **exponents: int) -> Unit:
    return Unit(tuple(exponents.get(base, 0) for base in BASE_UNITS), factor)


COMMON_UNITS: Mapping[str, Unit] = {
    name: unit
    for names, unit in {
        "- 1 rad": _unit(),
        "%": _unit(0.01),
        "deg": _unit(math.pi / 180),
        "s": _unit(s=1),
        "ms": _unit(1e-3, s=1),
        "1/s Hz rad/s": _unit(s=-1),
        "rpm r/min": _unit(math.pi / 30, s=-1),
        "m": _unit(m=1),
        "mm": _unit(1e-3, m=1),
        "cm": _unit(1e-2, m=1),
        "km": _unit(1e3, m=1),
        "m2 m^2": _unit(m=2),
        "m/s m.s-1": _unit(m=1, s=-1),
        "km/h kph": _unit(1 / 3.6, m=1, s=-1),
        "mph": _unit(0.44704, m=1, s=-1),
        "m/s^2 m/s2 m/s**2 m.s-2": _unit(m=1, s=-2),
        "kg": _unit(kg=1),
        "t": _unit(1e3, kg=1),
        "N": _unit(kg=1, m=1, s=-2),
        "kN": _unit(1e3, kg=1, m=1, s=-2),
        "N.m Nm": _unit(kg=1, m=2, s=-2),
        "kW": _unit(1e3, kg=1, m=2, s=-3),
        "Pa": _unit(kg=1, m=-1, s=-2),
        "bar": _unit(1e5, kg=1, m=-1, s=-2),
    }.items()
    for name in names.split()
}
"""Units by their common names, for models whose description does not define them."""
REAL_TYPES = ("Real", "Float64", "Float32")
"""Types of variables that have units."""
INTEGER_TYPES = ("Integer", "Enumeration", *(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)))
NUMBER_TYPES = (*REAL_TYPES, "Boolean", *INTEGER_TYPES)
"""Types of variables that hold numbers."""
SUPPORTED_FMU = "an FMU of FMI 2.0 or 3.0 for co-simulation"
MAX_MEANING = 200
"""Longest description of a variable that becomes a characteristic's meaning [characters]."""
MAX_LISTED = 12
"""Largest number of variables that an error lists."""
MIN_STEP, MAX_STEP = 1e-6, 10.0
"""Shortest and longest communication step [s]."""


class Port(NamedTuple):
    """A variable of an FMU, its unit, the unit of its values outside the FMU, and the bounds to which these are clipped
    (FMU's unit).
    """

    variable: ModelVariable
    fmu_unit: Unit
    outer_unit: Unit
    lower: float = -np.inf
    upper: float = np.inf

    @property
    def is_input(self) -> bool:
        return causality_of(self.variable) == "input"

    def to_fmu(self, values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Values in the FMU's unit; those of an input, such as an infinite gap, are clipped to its declared bounds."""
        return np.clip(self.outer_unit.to(self.fmu_unit, values), self.lower, self.upper)


@dataclass(frozen=True)
class Description:
    """An FMU: its file, the digest of the file, the folder with its content, FMPy's model description, the units that
    it defines, and its scalar variables by name.
    """

    path: str
    digest: str
    folder: str
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
        takes_any = simulation.canHandleVariableCommunicationStepSize
        required = simulation.fixedInternalStepSize or (None if takes_any else default)
        step = stated or float(required or 0.0)
        if step and not MIN_STEP <= step <= MAX_STEP:
            problem = f"{Path(self.path).name} requires a step of {step:g} s"
            expected = f"a step from {MIN_STEP:g} to {MAX_STEP:g} s; {key}.step sets another"
            raise InputError(source, problem, expected)
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
        legal = {
            variable.name: variable
            for variable in self.variables.values()
            if causality_of(variable) in causalities and variable.type in types
        }
        if name not in legal:
            problem = f"is no {' or '.join(causalities)} of {Path(self.path).name} that holds a number"
            raise unknown_name(source, f"{key} = {name!r} {problem}", name, list(legal)[:MAX_LISTED])
        return legal[name]

    def unit(self, name: str) -> Unit | None:
        """A unit by its name; None if neither the FMU nor this module defines it."""
        return self.units.get(name) or COMMON_UNITS.get(name)

    def units_between(self, variable: ModelVariable, unit: str) -> tuple[Unit, Unit] | None:
        """The unit that a variable declares, and the `unit` in which its values are given; None if one is not
        defined or they are of different kinds.

        If the variable declares no unit or the same one, values stay as they are: both are plain numbers.
        """
        name = declared(variable, "unit") if variable.type in REAL_TYPES else ""
        if name in ("", unit):
            return COMMON_UNITS["-"], COMMON_UNITS["-"]
        declared_unit, given_unit = self.unit(name), self.unit(unit)
        if declared_unit is None or given_unit is None or declared_unit.exponents != given_unit.exponents:
            return None
        if declared(variable, "relativeQuantity"):
            declared_unit = declared_unit._replace(offset=0.0)
        return declared_unit, given_unit

    def ports(
        self,
        names: Mapping[str, str],
        units: Mapping[str, str],
        causalities: Collection[str],
        source: str,
        key: str,
        constants: Collection[str] = (),
        types: Collection[str] = NUMBER_TYPES,
    ) -> dict[str, Port]:
        """The ports that a table of a study names, by quantity.

        Parameters
        ----------
        names
            Names of variables by quantity, from the study.
        units
            Unit of every legal quantity.
        key
            The table's key in the study.
        constants
            Quantities that are constant during a run: parameters may take them, too.

        Raises
        ------
        InputError
            If a quantity or variable does not exist, or the variable cannot hold the quantity.
        """
        ports: dict[str, Port] = {}
        for quantity, name in names.items():
            where = f"{key}.{quantity}"
            if quantity not in units:
                raise unknown_name(source, f"{where}: there is no such quantity", quantity, units)
            legal_causalities = (*causalities, "parameter") if quantity in constants else causalities
            variable = self.variable(name, legal_causalities, source, where, types)
            both_units = self.units_between(variable, units[quantity])
            if both_units is None:
                problem = f"{where} = {name!r}: its unit is {declared(variable, 'unit')!r}"
                expected = f"a unit of the same kind as {units[quantity]}, with a BaseUnit in the UnitDefinitions"
                raise InputError(source, problem, expected)
            ports[quantity] = port = Port(variable, *both_units)
            if port.is_input:
                lower, upper = number_of(variable, "min"), number_of(variable, "max")
                ports[quantity] = port._replace(
                    lower=-np.inf if lower is None else lower, upper=np.inf if upper is None else upper
                )
        return ports

    def constants(
        self, values: Mapping[str, Constant], ports: Collection[Port], source: str, key: str
    ) -> list[tuple[ModelVariable, Constant]]:
        """Parameters that a study sets besides the `ports` that it writes, with their values in the FMU's units.

        Raises
        ------
        InputError
            As `ports`; also if two parameters or ports have the same value reference, hence the same value.
        """
        constants = []
        for name, value in values.items():
            variable = self.variable(name, ("parameter", "structuralParameter"), source, key, (*NUMBER_TYPES, "String"))
            if type(value) not in PYTHON_TYPES.get(variable.type, (int,)):
                raise InputError(source, f"{key}.{name} = {value!r}", f"a value of type {variable.type}")
            constants.append((variable, value))
        variables = [*(port.variable for port in ports), *(variable for variable, _ in constants)]
        for first, second in combinations(variables, 2):
            if (first.type, first.valueReference) == (second.type, second.valueReference):
                table = key.partition(".")[0]
                problem = f"{table}: {first.name!r} and {second.name!r} have one value, and two keys set it"
                raise InputError(source, problem, "one key for each value reference of the FMU")
        return constants

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
        parameter or has another kind of unit, which the vehicle model refuses.
        """
        variable = self.variables.get(name)
        if variable is None or causality_of(variable) != "parameter":
            return {}
        declared_unit, meaning = declared(variable, "unit"), " ".join((variable.description or "").split())
        units = self.units_between(variable, unit or declared_unit)
        if units is None:
            return {}
        ends = {"original": "start", "lower": "min", "upper": "max"}
        numbers = {key: number_of(variable, attribute) for key, attribute in ends.items()}
        return {
            "unit": declared_unit or "-",
            **{key: units[0].to(units[1], number) for key, number in numbers.items() if number is not None},
            **({"meaning": meaning} if 0 < len(meaning) <= MAX_MEANING else {}),
        }


PYTHON_TYPES: Mapping[str, tuple[type, ...]] = {
    "String": (str,),
    "Boolean": (bool,),
    **dict.fromkeys(REAL_TYPES, (int, float)),
}
"""Python types that a study may give parameters of an FMI type; other FMI types take whole numbers."""


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
        place = folders[0] if folders else os.getcwd()
        raise InputError(source, f"{key} = {model!r}: there is no such file in {place}", SUPPORTED_FMU)
    return _read_description(path, sha256(Path(path).read_bytes()).hexdigest(), source, f"{key} = {model!r}")


@lru_cache(maxsize=32)
def _read_description(path: str, digest: str, source: str, name: str) -> Description:
    """Read an FMU, which is unpacked in the user's cache folder by the digest of its file."""
    try:
        from fmpy import extract, platform, platform_tuple, supported_platforms
        from fmpy.model_description import read_model_description
    except ImportError:
        raise InputError(
            source, f"{name} needs FMPy, which is not installed", "in the checkout: pip install '.[fmu]'"
        ) from None
    folder = platformdirs.user_cache_path("safevar_sumo") / "fmus" / digest
    try:
        if not folder.is_dir():
            folder.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=folder.parent, ignore_cleanup_errors=True) as new_folder:
                extract(path, new_folder)
                with suppress(OSError):  # another process was faster
                    os.rename(new_folder, folder)
        model = read_model_description(folder, validate=False)
        platforms = {*supported_platforms(folder)}
    except Exception as error:  # any error of FMPy about a user's file
        raise InputError(source, f"{name} cannot be read as an FMU: {describe_error(error)}", SUPPORTED_FMU) from None
    if not model.fmiVersion.startswith(("2.", "3.")) or model.coSimulation is None:
        problem = (
            f"{name} is of FMI {model.fmiVersion}{', not for co-simulation' if model.coSimulation is None else ''}"
        )
        raise InputError(source, problem, SUPPORTED_FMU)
    if not {platform, platform_tuple} & platforms:
        problem = f"{name} has no binary for this machine, only for {', '.join(sorted(platforms)) or 'none'}"
        raise InputError(source, problem, f"binaries/{platform}")
    units = {
        definition.name: Unit(tuple(getattr(base, name) for name in BASE_UNITS), base.factor, base.offset)
        for definition in model.unitDefinitions
        if (base := definition.baseUnit) is not None
    }
    variables = {variable.name: variable for variable in model.modelVariables if not variable.dimensions}
    return Description(path, digest, str(folder), model, units, variables)
