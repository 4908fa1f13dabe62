"""Ports: the variables of an FMU that a study maps, each with its unit in the FMU and the unit of its values outside
the FMU.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from safevar_sumo.errors import InputError, unknown_name
from safevar_sumo.fmu.description import NUMBER_TYPES, REAL_TYPES, Description, causality_of, number_of
from safevar_sumo.fmu.units import SI, Unit

if TYPE_CHECKING:
    from fmpy.model_description import ModelVariable

FloatArray = npt.NDArray[np.float64]
Constant = str | bool | float
"""A value of a parameter."""
PYTHON_TYPES: Mapping[str, tuple[type, ...]] = {
    "String": (str,),
    "Boolean": (bool,),
    **dict.fromkeys(REAL_TYPES, (int, float)),
}
"""Python types that a study may give parameters of an FMI type; other FMI types take whole numbers."""


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

    def to_fmu(self, values: FloatArray) -> FloatArray:
        """Values in the FMU's unit; those of an input, such as an infinite gap, are clipped to its declared bounds."""
        return np.asarray(np.clip(self.outer_unit.to(self.fmu_unit, values), self.lower, self.upper))

    def from_fmu(self, values: FloatArray) -> FloatArray:
        """Values of the FMU in the outer unit."""
        return np.asarray(self.fmu_unit.to(self.outer_unit, values))


def ports_of(
    description: Description,
    variable_names: Mapping[str, str],
    units: Mapping[str, str],
    causalities: Collection[str],
    source: str,
    key: str,
    constants: Collection[str] = (),
) -> dict[str, Port]:
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
        outer_unit = SI[units[quantity]]
        port = Port(
            variable,
            description.unit_for(variable, outer_unit, units[quantity], source, f"{key}.{quantity}"),
            outer_unit,
        )
        lower, upper = (number_of(variable, end) if port.is_input else None for end in ("min", "max"))
        ports[quantity] = port._replace(
            lower=-np.inf if lower is None else lower, upper=np.inf if upper is None else upper
        )
    return ports


def constants_of(
    description: Description, values: Mapping[str, Constant], ports: Collection[Port], source: str, key: str
) -> list[tuple[ModelVariable, Constant]]:
    """Parameters of an FMU that a study sets besides the `ports` that it writes, with their values in the FMU's units.

    Raises
    ------
    InputError
        As `ports_of`; also if two parameters or ports have the same value reference, hence the same value.
    """
    constants = []
    for name, value in values.items():
        variable = description.variable(
            name, ("parameter", "structuralParameter"), source, key, (*NUMBER_TYPES, "String")
        )
        if type(value) not in PYTHON_TYPES.get(variable.type, (int,)):
            raise InputError(source, f"{key}.{name} = {value!r}", f"a value of type {variable.type}")
        constants.append((variable, value))
    for one, other in combinations([*(port.variable for port in ports), *(variable for variable, _ in constants)], 2):
        if (one.type, one.valueReference) == (other.type, other.valueReference):
            raise InputError(
                source,
                f"{key.partition('.')[0]}: {one.name!r} and {other.name!r} have one value, and two keys set it",
                "one key for each value reference of the FMU",
            )
    return constants
