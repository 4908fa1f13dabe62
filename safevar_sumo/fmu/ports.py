"""Ports: the variables of an FMU that a study maps, each with its unit in the FMU and the unit of its values outside the FMU."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from safevar_sumo.errors import InputError, unknown_name
from safevar_sumo.fmu.description import NUMBER_TYPES, REAL_TYPES, Description, Variable
from safevar_sumo.fmu.units import SI, Unit

FloatArray = npt.NDArray[np.float64]
PYTHON_TYPES = {"String": (str,), "Boolean": (bool,), **dict.fromkeys(REAL_TYPES, (int, float))}
"""Python types that a study may give parameters of an FMI type; other FMI types take whole numbers."""


class Port(NamedTuple):
    """A variable of an FMU, its unit, and the unit of its values outside the FMU."""

    variable: Variable
    fmu_unit: Unit
    outer_unit: Unit

    @property
    def is_input(self) -> bool:
        return self.variable.causality == "input"

    @property
    def typed_reference(self) -> tuple[str, int]:
        """Type and value reference of the variable."""
        return self.variable.type, self.variable.reference

    def to_fmu(self, values: FloatArray) -> FloatArray:
        """Values in the FMU's unit; those of an input, such as an infinite gap, are clipped to its declared bounds."""
        converted = np.asarray(self.outer_unit.to(self.fmu_unit, values))
        lower, upper = (self.variable.lower, self.variable.upper) if self.is_input else (None, None)
        return np.asarray(np.clip(converted, -np.inf if lower is None else lower, np.inf if upper is None else upper))

    def from_fmu(self, values: FloatArray) -> FloatArray:
        """Values of the FMU in the outer unit."""
        return np.asarray(self.fmu_unit.to(self.outer_unit, values))


def ports_of(description: Description, variable_names: Mapping[str, str], units: Mapping[str, str], causalities: Collection[str],
             source: str, key: str, constants: Collection[str] = ()) -> dict[str, Port]:
    """The ports that a table of a study names, by quantity.

    Parameters
    ----------
    variable_names
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
    for quantity, name in variable_names.items():
        if quantity not in units:
            raise unknown_name(source, f"{key}.{quantity}: there is no such quantity", quantity, units)
        legal_causalities = (*causalities, "parameter") if quantity in constants else causalities
        variable = description.variable(name, legal_causalities, source, f"{key}.{quantity}")
        first_quantity = next((mapped_quantity for mapped_quantity, port in ports.items() if port.variable.name == name), None)
        if first_quantity and "parameter" not in causalities:  # variables of sumo_type may hold several quantities
            raise InputError(source, f"{key}.{quantity} = {name!r}: that variable is {key}.{first_quantity} already", "each variable once")
        outer_unit = SI[units[quantity]]
        ports[quantity] = Port(variable, description.unit_for(variable, outer_unit, units[quantity], source, f"{key}.{quantity}"),
                               outer_unit)
    return ports


def constants_of(description: Description, values: Mapping[str, Any], mapped_names: Collection[str], source: str,
                 key: str) -> Iterator[tuple[Variable, Any]]:
    """Parameters of an FMU that a study sets, with their values in the FMU's units; raises the same errors as `ports_of`."""
    for name, value in values.items():
        variable = description.variable(name, ("parameter", "structuralParameter"), source, key, (*NUMBER_TYPES, "String"))
        if type(value) not in PYTHON_TYPES.get(variable.type, (int,)):
            raise InputError(source, f"{key}.{name} = {value!r}", f"a value of type {variable.type}")
        if name in mapped_names:
            raise InputError(source, f"{key}.{name}: another key of the study sets the same parameter", "each parameter once")
        yield variable, value
