"""Instances of an FMU for N vehicles, in separate processes, and vehicles that can continue from any earlier step."""

from __future__ import annotations

import heapq
import math
import pickle
import shutil
import signal
import subprocess
import sys
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.errors import EnvironmentFault, SafevarError
from safevar_sumo.fmu.description import Description, Variable
from safevar_sumo.fmu.host import HostSetup
from safevar_sumo.fmu.ports import FloatArray, Port

STEP_LIMIT = 10.0
"""Longest time that an instance may take for one simulation step; beyond it the instance counts as hung [s]."""
MAX_INSTANCES, MAX_PROCESSES = 200, 4
"""Largest number of vehicles of a simulation: with all instances in one process, and with one process for each."""
POINT_TOLERANCE = 1e-9
"""Tolerance for times of communication points, as a share of a step [-]."""


class Fault(SafevarError):
    """An FMU crashed, hung or failed; the message continues a sentence that begins with the FMU's name."""


class History(NamedTuple):
    """All inputs so far, as a chain: `inputs` of step `step_number` after the steps of `previous`; the initialisation is the first link."""

    previous: History | None
    inputs: FloatArray
    step_number: int


class _Host:
    """A process with instances of an FMU."""

    def __init__(self, setup: HostSetup) -> None:
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", str(Path(__file__).with_name("host.py"))], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL, start_new_session=True)
        except OSError as error:
            raise EnvironmentFault(f"no process for an FMU can be started: {error.strerror}") from None
        self._folder = list[str]()
        self.end = weakref.finalize(self, _end_process, self._process, self._folder)
        self.activity = "is loaded"
        self.send(("open", *setup))
        self._folder.append(self.receive())
        self.receive()

    def send(self, request: tuple[Any, ...]) -> None:
        try:
            pickle.dump(request, self._process.stdin, protocol=pickle.HIGHEST_PROTOCOL)  # type: ignore[arg-type]
            self._process.stdin.flush()  # type: ignore[union-attr]
        except OSError:  # the process has ended, which `receive` reports
            return

    def receive(self) -> Any:
        try:
            status, answer = pickle.load(self._process.stdout)  # type: ignore[arg-type]
        except (EOFError, OSError, pickle.UnpicklingError):
            self._process.wait()
            raise Fault(f"crashed {_describe_end(self._process.returncode)} while it {self.activity}") from None
        if status == "hangs":
            self.end()
            raise Fault(answer)
        if status == "failed":
            raise Fault(f"failed: {answer}")
        return answer


def _end_process(process: subprocess.Popen[bytes], folders: list[str]) -> None:
    process.kill()
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            try:
                stream.close()
            except OSError:  # nobody needs the data that is still to be written
                continue
    process.wait()


def _describe_end(exit_code: int) -> str:
    try:
        return f"(signal {signal.Signals(-exit_code).name})" if exit_code < 0 else f"(exit code {exit_code})"
    except ValueError:
        return f"(signal {-exit_code})"


class Instances:
    """The instances of one FMU with the same inputs and outputs: created when needed, and returned for reuse after a reset.

    Parameters
    ----------
    inputs, outputs
        The FMU's ports, in the order of the values. Ports for parameters are set once, at the start.
    constants
        Further parameters and their values.
    time_limit
        Longest time that an instance may take for one request [s].
    """

    def __init__(self, description: Description, inputs: Sequence[Port], outputs: Sequence[Port],
                 constants: Sequence[tuple[Variable, Any]], time_limit: float) -> None:
        self.description, self.inputs, self.outputs = description, tuple(inputs), tuple(outputs)
        self._constants = [value for _, value in constants]
        self._parameter_indices = [k for k, port in enumerate(inputs) if not port.is_input]
        self._input_indices = [k for k, port in enumerate(inputs) if port.is_input]
        constant_references = ((variable.type, variable.reference) for variable, _ in constants)
        self._setup = HostSetup(
            description.path, description.digest, description.version, description.identifier, description.token,
            inputs=tuple(inputs[k].typed_reference for k in self._input_indices),
            parameters=(*(inputs[k].typed_reference for k in self._parameter_indices), *constant_references),
            outputs=tuple(port.typed_reference for port in outputs), time_limit=time_limit)
        self._hosts = dict[int, _Host]()
        self._free_numbers, self._next_number = list[int](), 0
        self.generation = 0
        """Number of times that all instances were lost."""

    @property
    def max_vehicles(self) -> int:
        return MAX_PROCESSES if self.description.single_instance else MAX_INSTANCES

    def lease(self, n: int) -> list[int]:
        """Numbers of n instances."""
        reused_numbers = [heapq.heappop(self._free_numbers) for _ in range(min(n, len(self._free_numbers)))]
        new_numbers = range(self._next_number, self._next_number + n - len(reused_numbers))
        self._next_number = new_numbers.stop
        return [*reused_numbers, *new_numbers]

    def give_back(self, numbers: Sequence[int]) -> None:
        for number in numbers:
            heapq.heappush(self._free_numbers, number)

    def start(self, numbers: Sequence[int], values: FloatArray) -> FloatArray:
        """Initialise N instances with values of the k inputs, shape (k, N); returns the m outputs, shape (m, N)."""
        fmu_values = [port.to_fmu(values[k]) for k, port in enumerate(self.inputs)]
        parameters = [[*(float(fmu_values[k][i]) for k in self._parameter_indices), *self._constants] for i in range(len(numbers))]
        inputs = [[float(fmu_values[k][i]) for k in self._input_indices] for i in range(len(numbers))]
        answers = self._request("start", numbers, "is initialised",
                                lambda positions: ([parameters[i] for i in positions], [inputs[i] for i in positions]))
        return np.asarray(self._outputs_of(answers[:, np.newaxis])[-1])

    def step(self, numbers: Sequence[int], steps: Sequence[tuple[float, float]], values: FloatArray) -> FloatArray:
        """Advance N instances by one or more steps, each given by its start and length [s].

        Returns the m outputs after the last two steps, shape (2, m, N), or after a single step, shape (1, m, N).
        """
        fmu_values = [self.inputs[k].to_fmu(values[k]).tolist() for k in self._input_indices]
        inputs = list(map(list, zip(*fmu_values, strict=True))) or [[] for _ in numbers]
        kept_steps = min(len(steps), 2)
        return self._outputs_of(self._request("step", numbers, f"is at {steps[0][0]:g} s",
                                             lambda positions: (steps, [inputs[i] for i in positions], kept_steps)))

    def _outputs_of(self, answers: FloatArray) -> FloatArray:
        """Answers, shape (N, steps, m), as outputs in the outer units of the ports, shape (steps, m, N)."""
        outputs = np.ascontiguousarray(answers.transpose(1, 2, 0))
        return np.stack([port.from_fmu(outputs[:, k]) for k, port in enumerate(self.outputs)], axis=1)

    def _request(self, name: str, numbers: Sequence[int], activity: str, arguments: Any) -> FloatArray:
        """Answers of N instances, shape (N, ...). All instances run in one process, or each runs in its own process."""
        groups = {number: [i] for i, number in enumerate(numbers)} if self.description.single_instance else {0: [*range(len(numbers))]}
        hosts = {}
        try:
            for host_number, positions in groups.items():
                hosts[host_number] = host = self._host(host_number)
                host.activity = activity
                host.send((name, [numbers[i] for i in positions], *arguments(positions)))
            return np.concatenate([host.receive() for host in hosts.values()])
        except Fault:
            self.close()  # answers of other processes may be pending
            raise

    def _host(self, number: int) -> _Host:
        if number not in self._hosts:
            self._hosts[number] = _Host(self._setup)
        return self._hosts[number]

    def close(self) -> None:
        """End the processes. A vehicle that continues is simulated again from its start."""
        for host in self._hosts.values():
            host.end()
        self._hosts = {}
        self.generation += 1


class Fleet:
    """N vehicles with one instance each. They can continue from any earlier step: the fleet simulates again up to that step.

    Parameters
    ----------
    step
        Time between two calls [s].
    communication_step
        Time between two communication points [s]; `step` if None.
    """

    def __init__(self, instances: Instances, n: int, step: float, communication_step: float | None) -> None:
        self._instances, self._step, self._communication_step = instances, step, communication_step
        self._numbers = instances.lease(n)
        weakref.finalize(self, instances.give_back, self._numbers)
        self._history: History | None = None
        self._generation = instances.generation
        self._last_outputs: FloatArray
        """Outputs at the last two communication points, shape (2, m, N)."""

    def start(self, inputs: FloatArray) -> tuple[FloatArray, History]:
        """Initialise the vehicles with k inputs, shape (k, N); returns the m outputs, shape (m, N), and the history."""
        outputs = self._instances.start(self._numbers, inputs)
        self._generation = self._instances.generation
        self._last_outputs, self._history = np.stack([outputs, outputs]), History(previous=None, inputs=inputs, step_number=-1)
        return outputs, self._history

    def advance(self, history: History, inputs: FloatArray) -> tuple[FloatArray, History]:
        """Advance by one step after `history` with inputs of shape (k, N); returns outputs of shape (2, m, N), and the new history.

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
        interval = self._communication_step or self._step
        points = range(self._first_point_in(step_number), self._first_point_in(step_number + 1))
        if points:
            outputs = self._instances.step(self._numbers, [(point * interval, interval) for point in points], inputs)
            self._last_outputs = outputs if len(outputs) == 2 else np.stack([self._last_outputs[1], outputs[0]])

    def _first_point_in(self, step_number: int) -> int:
        """Number of the first communication point at or after the start of a step."""
        return math.ceil(step_number * self._step / (self._communication_step or self._step) - POINT_TOLERANCE)

    def _end_outputs(self, step_number: int) -> FloatArray:
        interval = self._communication_step or self._step
        # how far the last communication point lies beyond the end of the step [intervals]
        overshoot = self._first_point_in(step_number + 1) - (step_number + 1) * self._step / interval
        if abs(overshoot) <= POINT_TOLERANCE:
            return np.asarray(self._last_outputs[1])
        return np.asarray(self._last_outputs[1] - (self._last_outputs[1] - self._last_outputs[0]) * overshoot)
