"""Instances of an FMU for N vehicles, with the variables that a study maps; vehicles may continue from any earlier
step.
"""

from __future__ import annotations

import math
import sys
import weakref
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from safevar_sumo.fmu.description import REAL_TYPES, Constant, Description, Port

if TYPE_CHECKING:
    from fmpy.fmi2 import FMU2Slave
    from fmpy.model_description import ModelVariable

FloatArray = npt.NDArray[np.float64]
Outputs = dict[str, FloatArray]
"""Outputs of N vehicles by quantity, each of shape (N,)."""
CONVERSIONS = {"String": str, "Boolean": bool, **dict.fromkeys(REAL_TYPES, float)}
"""Functions that make a number fit for variables of an FMI type; other FMI types hold whole numbers."""
MAX_INSTANCES = 200
"""Largest number of vehicles of a simulation; 1 for an FMU that allows only one instance in a process."""
POINT_TOLERANCE = 1e-9
"""Tolerance for times of communication points, as a share of a step [-]."""


class FmuError(Exception):
    """An FMU failed; the message says what it did and logged, and when."""


class History(NamedTuple):
    """All inputs of a vehicle fleet so far, as a chain: the `inputs` of the step `step_number`, and those of all steps
    before it, `previous`. The first link is the initialisation.
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
        The FMU's ports by quantity. Ports for parameters are set once, at the start.
    constants
        Further parameters and their values.
    """

    def __init__(
        self,
        description: Description,
        inputs: Mapping[str, Port],
        outputs: Mapping[str, Port],
        constants: Sequence[tuple[ModelVariable, Constant]],
    ) -> None:
        self.inputs, self.outputs = inputs, outputs
        self._description, self._constants = description, constants
        self._is_fmi3 = description.model.fmiVersion.startswith("3")
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

        def start(slave: FMU2Slave, column: Sequence[float]) -> None:
            if slave.has_started:
                slave.terminate()
                slave.reset()
            slave.has_started = True
            self._write_inputs(slave, column, are_inputs=False)
            for variable, value in self._constants:
                self._write(slave, variable, value)
            if not self._is_fmi3:
                slave.setupExperiment(startTime=0.0)
            slave.enterInitializationMode()
            self._write_inputs(slave, column, are_inputs=True)
            slave.exitInitializationMode()

        return self._on_each("is initialised", slaves, values, start)

    def step(self, slaves: Sequence[FMU2Slave], time: float, length: float, values: FloatArray) -> FloatArray:
        """Advance N instances by a step from `time` [s]; returns the m outputs after it, shape (m, N)."""

        def step(slave: FMU2Slave, column: Sequence[float]) -> None:
            self._write_inputs(slave, column, are_inputs=True)
            result = slave.doStep(time, length)
            if self._is_fmi3:
                _, terminates, returns_early, end_time = result
                if terminates or returns_early:
                    raise FmuError(f"it ends the simulation or returns early, at {end_time:g} s")

        return self._on_each(f"is at {time:g} s", slaves, values, step)

    def _on_each(
        self,
        activity: str,
        slaves: Sequence[FMU2Slave],
        values: FloatArray,
        act: Callable[[FMU2Slave, Sequence[float]], None],
    ) -> FloatArray:
        columns = np.array(
            [port.to_fmu(row) for port, row in zip(self.inputs.values(), values, strict=True)]
        ).T.tolist()
        outputs = np.zeros((len(self.outputs), len(slaves)))
        try:
            for i, slave in enumerate(slaves):
                act(slave, columns[i])
                for row, port in enumerate(self.outputs.values()):
                    read = getattr(slave, f"get{self._function(port.variable)}")
                    outputs[row, i] = read([port.variable.valueReference])[0]
        except Exception as error:  # any error of FMPy about an FMU
            # Any further call of an instance that failed is undefined.
            self._free, self.generation = [], self.generation + 1
            last_message = self._messages[-1:]
            self._messages.clear()
            reason = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
            raise FmuError(f"{': '.join([reason, *last_message])} while it {activity}") from error
        return np.stack(
            [port.fmu_unit.to(port.outer_unit, row) for port, row in zip(self.outputs.values(), outputs, strict=True)]
        )

    def _write_inputs(self, slave: FMU2Slave, column: Sequence[float], *, are_inputs: bool) -> None:
        """Set the inputs of an instance or its parameters among the ports."""
        for port, value in zip(self.inputs.values(), column, strict=True):
            if port.is_input == are_inputs:
                self._write(slave, port.variable, value)

    def _write(self, slave: FMU2Slave, variable: ModelVariable, value: Constant) -> None:
        write = getattr(slave, f"set{self._function(variable)}")
        convert = CONVERSIONS.get(variable.type)
        write([variable.valueReference], [round(float(value)) if convert is None else convert(value)])

    def _function(self, variable: ModelVariable) -> str:
        """End of the names of the functions that set and get a variable."""
        integer = "Int64" if self._is_fmi3 else "Integer"
        return integer if variable.type == "Enumeration" else str(variable.type)

    def _new_slave(self) -> FMU2Slave:
        from fmpy.simulation import instantiate_fmu

        def note(*arguments: bytes | int | None) -> None:
            *_, status, _, message = arguments
            if isinstance(message, bytes) and status not in (0, 1):  # neither "OK" nor a warning
                self._messages.append(" ".join(message.decode(errors="replace").split()))

        folder = self._description.folder
        for file in Path(folder, "resources").glob("*.py"):  # an FMU in Python imports its own modules, not namesakes
            if not str(getattr(sys.modules.get(file.stem), "__file__", folder)).startswith(folder):
                del sys.modules[file.stem]
        slave = instantiate_fmu(folder, self._description.model, "CoSimulation", debug_logging=True, logger=note)
        slave.has_started = False
        return slave


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

    def start(self, values: Mapping[str, npt.ArrayLike]) -> tuple[Outputs, History]:
        """Initialise the vehicles with values of the inputs; returns the outputs, shape (N,), and the history."""
        inputs = self._inputs(values)
        outputs, self._history = self._start(inputs), History(None, inputs, step_number=-1)
        return self._named(outputs), self._history

    def advance(self, history: History, values: Mapping[str, npt.ArrayLike]) -> tuple[Outputs, Outputs, History]:
        """Advance by one step after `history` with values of the inputs; returns the outputs at the last communication
        point, those interpolated to the end of the step, and the new history.
        """
        if self._history is not history or self._generation != self._instances.generation:
            self._replay(history)
        inputs, step_number = self._inputs(values), history.step_number + 1
        self._history = None
        self._drive(step_number, inputs)
        self._history = History(history, inputs, step_number)
        return self._named(self._last_outputs[1]), self._named(self._end_outputs(step_number)), self._history

    def _inputs(self, values: Mapping[str, npt.ArrayLike]) -> FloatArray:
        return np.stack(
            [np.broadcast_to(np.asarray(values[name], dtype=float), self._n) for name in self._instances.inputs]
        )

    def _named(self, outputs: FloatArray) -> Outputs:
        return dict(zip(self._instances.outputs, outputs, strict=True))

    def _start(self, inputs: FloatArray) -> FloatArray:
        if self._generation != self._instances.generation:
            self._slaves = self._instances.lease(self._n)
            self._generation = self._instances.generation
            weakref.finalize(self, self._instances.give_back, self._slaves, self._generation)
        outputs = self._instances.start(self._slaves, inputs)
        self._last_outputs = np.stack([outputs, outputs])
        return outputs

    def _replay(self, history: History) -> None:
        chain = [history]
        while chain[-1].previous is not None:
            chain.append(chain[-1].previous)
        self._start(chain.pop().inputs)
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
        before, last = self._last_outputs
        return np.asarray(last if abs(overshoot) <= POINT_TOLERANCE else last - (last - before) * overshoot)
