"""The variables of an FMU that a study maps: each with the unit that it has and the one that its values are given or wanted in."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from safevar_sumo.errors import InputError, unknown
from safevar_sumo.fmu.description import CONVERTIBLE, NUMBERS, Description, Variable
from safevar_sumo.fmu.units import SI, Unit

FloatArray = npt.NDArray[np.float64]
PYTHON_TYPES = {"String": (str,), "Boolean": (bool,), **dict.fromkeys(CONVERTIBLE, (int, float))}
"""Types of values that a study gives a parameter; others take whole numbers."""


class Port(NamedTuple):
    """A variable of an FMU, its unit, and that of its values outside."""

    variable: Variable
    theirs: Unit
    ours: Unit

    @property
    def is_input(self) -> bool:
        return self.variable.causality == "input"

    @property
    def slot(self) -> tuple[str, int]:
        return self.variable.type, self.variable.reference

    def given(self, values: FloatArray) -> FloatArray:
        """Values in the FMU's unit, within the bounds that an input declares: a gap to nobody is as large as it takes."""
        theirs = np.asarray(self.ours.to(self.theirs, values))
        lower, upper = (self.variable.lower, self.variable.upper) if self.is_input else (None, None)
        return np.asarray(np.clip(theirs, -np.inf if lower is None else lower, np.inf if upper is None else upper))

    def told(self, values: FloatArray) -> FloatArray:
        """The FMU's values outside of it."""
        return np.asarray(self.theirs.to(self.ours, values))


def ports_of(description: Description, named: Mapping[str, str], units: Mapping[str, str], causalities: Collection[str], source: str,
             key: str, constant: Collection[str] = ()) -> dict[str, Port]:
    """The ports that a table of a study names, by quantity.

    Parameters
    ----------
    named
        Variables by quantity, as the study has them.
    units
        The unit of every quantity that there is.
    key
        The table's key in the study.
    constant
        Quantities that stay the same during a run: parameters take them, too.

    Raises
    ------
    InputError
        If there is no such quantity or variable, or the variable cannot hold it.
    """
    found: dict[str, Port] = {}
    for quantity, name in named.items():
        if quantity not in units:
            raise unknown(source, f"{key}.{quantity}: there is no such quantity", quantity, units)
        fitting = (*causalities, "parameter") if quantity in constant else causalities
        variable = description.variable(name, fitting, source, f"{key}.{quantity}")
        other = next((one for one, port in found.items() if port.variable.name == name), None)
        if other and "parameter" not in causalities:  # one that is only read may be the bound of several
            raise InputError(source, f"{key}.{quantity} = {name!r}: that variable is {key}.{other} already", "each variable once")
        ours = SI[units[quantity]]
        found[quantity] = Port(variable, description.converted(variable, ours, units[quantity], source, f"{key}.{quantity}"), ours)
    return found


def fixed_of(description: Description, values: Mapping[str, Any], taken: Collection[str], source: str,
             key: str) -> Iterator[tuple[Variable, Any]]:
    """Parameters of an FMU that a study sets, with their values in the FMU's units; raises as `ports_of`."""
    for name, value in values.items():
        variable = description.variable(name, ("parameter", "structuralParameter"), source, key, (*NUMBERS, "String"))
        if type(value) not in PYTHON_TYPES.get(variable.type, (int,)):
            raise InputError(source, f"{key}.{name} = {value!r}", f"a value of type {variable.type}")
        if name in taken:
            raise InputError(source, f"{key}.{name}: the same parameter has its value from elsewhere in the study", "each parameter once")
        yield variable, value
