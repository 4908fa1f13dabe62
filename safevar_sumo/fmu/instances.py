"""Instances of an FMU for N vehicles, with the variables that a study maps; vehicles continue from any earlier step."""

from __future__ import annotations

import math
import os
import sys
import tempfile
import weakref
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from hashlib import sha256
from io import BytesIO
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from zipfile import ZipFile

import numpy as np
import numpy.typing as npt
import platformdirs

from safevar_sumo.errors import InputError, unknown_name
from safevar_sumo.fmu.description import NUMBER_TYPES, REAL_TYPES, SI, Description, Unit, causality_of, number_of

if TYPE_CHECKING:
    from fmpy.fmi2 import FMU2Slave
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


MAX_INSTANCES = 200
"""Largest number of vehicles of a simulation; 1 for an FMU that allows only one instance in a process."""
POINT_TOLERANCE = 1e-9
"""Tolerance for times of communication points, as a share of a step [-]."""


class FmuError(Exception):
    """An FMU failed; the message says what it did and logged, and when."""


class History(NamedTuple):
    """All inputs so far, as a chain: `inputs` of step `step_number` after the steps of `previous`; the initialisation
    is the first link.
    """

    previous: History | None
    inputs: FloatArray
    step_number: int


class Instances:
    """The instances of one FMU with the same inputs and outputs: created when needed, and returned for reuse after a
    reset.

    Parameters
    ----------
    inputs, outputs
        The FMU's ports, in the order of the values. Ports for parameters are set once, at the start.
    constants
        Further parameters and their values.
    """

    def __init__(
        self,
        description: Description,
        inputs: Sequence[Port],
        outputs: Sequence[Port],
        constants: Sequence[tuple[ModelVariable, Constant]],
    ) -> None:
        self._description, self._inputs, self._outputs, self._constants = description, inputs, outputs, constants
        self._is_3 = description.model.fmiVersion.startswith("3")
        self._free, self._messages = list["FMU2Slave"](), list[str]()
        self.max_vehicles = 1 if description.is_single else MAX_INSTANCES
        self.generation = 0
        """Number of times that vehicles have lost their instances."""

    def lease(self, n: int) -> list[FMU2Slave]:
        """N instances; the only instance that an FMU allows is taken from the vehicle that had it."""
        if self._description.is_single:
            self.generation += 1
            self._free = self._free or [self._new_slave()]
            return list(self._free)
        return [self._free.pop() if self._free else self._new_slave() for _ in range(n)]

    def give_back(self, slaves: list[FMU2Slave], generation: int) -> None:
        if generation == self.generation and not self._description.is_single:
            self._free += slaves

    def start(self, slaves: Sequence[FMU2Slave], values: FloatArray) -> FloatArray:
        """Initialise N instances, new or used, with values of the k inputs, shape (k, N); returns the m outputs, shape
        (m, N).
        """
        return self._on_each("is initialised", slaves, values, self._start)

    def step(self, slaves: Sequence[FMU2Slave], time: float, length: float, values: FloatArray) -> FloatArray:
        """Advance N instances by a step from `time` [s]; returns the m outputs after it, shape (m, N)."""

        def step(slave: FMU2Slave, column: Sequence[float]) -> None:
            self._write_inputs(slave, column, are_inputs=True)
            result = slave.doStep(time, length)
            if self._is_3 and (result[1] or result[2]):
                raise FmuError(
                    "it requests the end of the simulation" if result[1] else f"it returned early, at {result[3]:g} s"
                )

        return self._on_each(f"is at {time:g} s", slaves, values, step)

    def _start(self, slave: FMU2Slave, column: Sequence[float]) -> None:
        if slave.has_started:
            slave.terminate()
            slave.reset()
        slave.has_started = True
        self._write_inputs(slave, column, are_inputs=False)
        for variable, value in self._constants:
            self._write(slave, variable, value)
        if not self._is_3:
            slave.setupExperiment(startTime=0.0)
        slave.enterInitializationMode()
        self._write_inputs(slave, column, are_inputs=True)
        slave.exitInitializationMode()

    def _on_each(
        self,
        activity: str,
        slaves: Sequence[FMU2Slave],
        values: FloatArray,
        work: Callable[[FMU2Slave, Sequence[float]], None],
    ) -> FloatArray:
        columns = np.array([port.to_fmu(row) for port, row in zip(self._inputs, values, strict=True)]).T.tolist()
        outputs = np.zeros((len(self._outputs), len(slaves)))
        try:
            for i, slave in enumerate(slaves):
                work(slave, columns[i])
                outputs[:, i] = [
                    getattr(slave, f"get{self._function(port.variable)}")([port.variable.valueReference])[0]
                    for port in self._outputs
                ]
        except Exception as error:  # any error of FMPy about an FMU
            # Any further call of an instance that failed is undefined.
            self._free, self.generation = ([], self.generation + 1)
            messages, self._messages[:] = self._messages[-1:], []
            reason = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
            raise FmuError(f"{': '.join([reason, *messages])} while it {activity}") from error
        return np.stack([port.from_fmu(row) for port, row in zip(self._outputs, outputs, strict=True)])

    def _write_inputs(self, slave: FMU2Slave, column: Sequence[float], *, are_inputs: bool) -> None:
        """Set the inputs of an instance or its parameters among the ports."""
        for port, value in zip(self._inputs, column, strict=True):
            if port.is_input == are_inputs:
                self._write(slave, port.variable, value)

    def _write(self, slave: FMU2Slave, variable: ModelVariable, value: Constant) -> None:
        is_kept = variable.type in (*REAL_TYPES, "String")
        typed_value = value if is_kept else bool(value) if variable.type == "Boolean" else round(float(value))
        getattr(slave, f"set{self._function(variable)}")([variable.valueReference], [typed_value])

    def _function(self, variable: ModelVariable) -> str:
        """End of the names of the functions that set and get a variable."""
        integer = "Int64" if self._is_3 else "Integer"
        return integer if variable.type == "Enumeration" else str(variable.type)

    def _new_slave(self) -> FMU2Slave:
        from fmpy.simulation import instantiate_fmu

        def note(*arguments: bytes | int | None) -> None:
            *_, status, _, message = arguments
            if isinstance(message, bytes) and status not in (0, 1):  # worse than a warning
                self._messages.append(" ".join(message.decode(errors="replace").split()))

        folder = _unpacked(self._description)
        _forget_other_modules(folder)
        slave = instantiate_fmu(folder, self._description.model, "CoSimulation", debug_logging=True, logger=note)
        slave.has_started = False
        return slave


def _unpacked(description: Description) -> str:
    """The folder with an FMU's files, in the user's cache folder by the digest of its file.

    Raises
    ------
    FmuError
        If the file has changed.
    """
    folder = platformdirs.user_cache_path("safevar_sumo") / "fmus" / description.digest
    if not folder.is_dir():
        content = Path(description.path).read_bytes()
        if sha256(content).hexdigest() != description.digest:
            raise FmuError("its file has changed since the study was read")
        folder.parent.mkdir(parents=True, exist_ok=True)
        with (
            tempfile.TemporaryDirectory(dir=folder.parent, ignore_cleanup_errors=True) as new,
            ZipFile(BytesIO(content)) as archive,
        ):
            archive.extractall(new)
            with suppress(OSError):  # another process was faster
                os.rename(new, folder)
    return str(folder)


def _forget_other_modules(folder: str) -> None:
    """Let an FMU that is written in Python import its own modules, not others of the same names."""
    for file in Path(folder, "resources").glob("*.py"):
        if not str(getattr(sys.modules.get(file.stem), "__file__", folder)).startswith(folder):
            del sys.modules[file.stem]


class Fleet:
    """N vehicles with one instance each. They can continue from any earlier step: the fleet simulates again up to that
    step.

    Parameters
    ----------
    step
        Time between two calls [s].
    communication_step
        Time between two communication points [s]; `step` if None.
    """

    def __init__(self, instances: Instances, n: int, step: float, communication_step: float | None) -> None:
        self._instances, self._n, self._step, self._interval = instances, n, step, communication_step or step
        self._slaves, self._generation = list["FMU2Slave"](), -1
        self._history: History | None = None
        self._last_outputs: FloatArray
        """Outputs at the last two communication points, shape (2, m, N)."""

    def start(self, inputs: FloatArray) -> tuple[FloatArray, History]:
        """Initialise the vehicles with k inputs, shape (k, N); returns the m outputs, shape (m, N), and the history."""
        if self._generation != self._instances.generation:
            self._slaves = self._instances.lease(self._n)
            self._generation = self._instances.generation
            weakref.finalize(self, self._instances.give_back, self._slaves, self._generation)
        outputs = self._instances.start(self._slaves, inputs)
        self._last_outputs, self._history = (
            np.stack([outputs, outputs]),
            History(previous=None, inputs=inputs, step_number=-1),
        )
        return outputs, self._history

    def advance(self, history: History, inputs: FloatArray) -> tuple[FloatArray, History]:
        """Advance by one step after `history` with inputs of shape (k, N); returns outputs of shape (2, m, N), and the
        new history.

        First come the outputs at the last communication point, then the outputs interpolated to the end of the step.
        """
        if self._history is not history or self._generation != self._instances.generation:
            self._replay(history)
        step_number = history.step_number + 1
        self._history = None
        self._drive(step_number, inputs)
        self._history = History(history, inputs, step_number)
        return np.stack([self._last_outputs[1], self._end_outputs(step_number)]), self._history

    def _replay(self, history: History) -> None:
        chain = [history]
        while chain[-1].previous is not None:
            chain.append(chain[-1].previous)
        self.start(chain.pop().inputs)
        for link in reversed(chain):
            self._drive(link.step_number, link.inputs)

    def _drive(self, step_number: int, inputs: FloatArray) -> None:
        """Advance to the last communication point in a step, if the step contains any."""
        for point in range(self._first_point_in(step_number), self._first_point_in(step_number + 1)):
            outputs = self._instances.step(self._slaves, point * self._interval, self._interval, inputs)
            self._last_outputs = np.stack([self._last_outputs[1], outputs])

    def _first_point_in(self, step_number: int) -> int:
        """Number of the first communication point at or after the start of a step."""
        return math.ceil(step_number * self._step / self._interval - POINT_TOLERANCE)

    def _end_outputs(self, step_number: int) -> FloatArray:
        # how far the last communication point lies beyond the end of the step [intervals]
        overshoot = self._first_point_in(step_number + 1) - (step_number + 1) * self._step / self._interval
        if abs(overshoot) <= POINT_TOLERANCE:
            return np.asarray(self._last_outputs[1])
        return np.asarray(self._last_outputs[1] - (self._last_outputs[1] - self._last_outputs[0]) * overshoot)
