"""Instances of an FMU for N vehicles, in a separate process, and vehicles that can be resumed from any earlier step."""

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
from safevar_sumo.fmu.host import Setting
from safevar_sumo.fmu.ports import FloatArray, Port

LONGEST = 10.0
"""Longest time that an instance may take for one simulation step; beyond it the instance counts as hung [s]."""
MOST, MOST_PROCESSES = 200, 4
"""Largest number of vehicles of a simulation: with all instances in one process, and with one process for each."""
EXACT = 1e-9
"""Share of a step within which a time counts as being at a communication point [-]."""


class Fault(SafevarError):
    """An FMU crashed, hung or failed; the message continues a sentence that begins with its name."""


class History(NamedTuple):
    """All inputs so far: `inputs` of step `number` after those of `previous`; the first ones are those of the initialisation."""

    previous: History | None
    inputs: FloatArray
    number: int


class _Host:
    """A process with instances of an FMU."""

    def __init__(self, setting: Setting) -> None:
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", str(Path(__file__).with_name("host.py"))], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL, start_new_session=True)
        except OSError as error:
            raise EnvironmentFault(f"no process for an FMU can be started: {error.strerror}") from None
        self._folder = list[str]()
        self.end = weakref.finalize(self, _end_process, self._process, self._folder)
        self.doing = "is loaded"
        self.send(("open", *setting))
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
            raise Fault(f"crashed {_cause(self._process.returncode)} while it {self.doing}") from None
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
            except OSError:  # data still to be written is of no use
                continue
    process.wait()


def _cause(code: int) -> str:
    try:
        return f"(signal {signal.Signals(-code).name})" if code < 0 else f"(exit code {code})"
    except ValueError:
        return f"(signal {-code})"


class Instances:
    """The instances of one FMU with the same inputs and outputs: created when needed, and returned for reuse after a reset.

    Parameters
    ----------
    inputs, outputs
        The FMU's ports, in the order of the values. Ports for parameters are set once, at the start.
    fixed
        Further parameters and their values.
    limit
        Longest time that an instance may take for one request [s].
    """

    def __init__(self, description: Description, inputs: Sequence[Port], outputs: Sequence[Port],
                 fixed: Sequence[tuple[Variable, Any]], limit: float) -> None:
        self.description, self.inputs, self.outputs = description, tuple(inputs), tuple(outputs)
        self._fixed = [value for _, value in fixed]
        self._set_once = [k for k, port in enumerate(inputs) if not port.is_input]
        self._set_always = [k for k, port in enumerate(inputs) if port.is_input]
        self._slots = (tuple(inputs[k].slot for k in self._set_always),
                       (*(inputs[k].slot for k in self._set_once), *((variable.type, variable.reference) for variable, _ in fixed)),
                       tuple(port.slot for port in outputs))
        self._limit, self._hosts = limit, dict[int, _Host]()
        self._free, self._next = list[int](), 0
        self.generation = 0
        """Number of times that all instances were lost."""

    @property
    def most_vehicles(self) -> int:
        return MOST_PROCESSES if self.description.single_instance else MOST

    def lease(self, n: int) -> list[int]:
        """Numbers of n instances."""
        leased = [heapq.heappop(self._free) for _ in range(min(n, len(self._free)))]
        new = range(self._next, self._next + n - len(leased))
        self._next = new.stop
        return [*leased, *new]

    def give_back(self, numbers: Sequence[int]) -> None:
        for number in numbers:
            heapq.heappush(self._free, number)

    def start(self, numbers: Sequence[int], values: FloatArray) -> FloatArray:
        """Initialise instances with values of the inputs, shape (k, N); returns the outputs, shape (m, N)."""
        converted = [port.to_fmu(values[k]) for k, port in enumerate(self.inputs)]
        parameters = [[*(float(converted[k][i]) for k in self._set_once), *self._fixed] for i in range(len(numbers))]
        inputs = [[float(converted[k][i]) for k in self._set_always] for i in range(len(numbers))]
        answers = self._request("start", numbers, "is initialised", lambda rows: ([parameters[i] for i in rows], [inputs[i] for i in rows]))
        return np.asarray(self._converted(answers[:, np.newaxis])[-1])

    def step(self, numbers: Sequence[int], times: Sequence[tuple[float, float]], values: FloatArray) -> FloatArray:
        """Advance instances by one or more steps, given by start and length [s]; returns the outputs after the last two steps, or after
        the only one, shape (1 or 2, m, N).
        """
        converted = [self.inputs[k].to_fmu(values[k]).tolist() for k in self._set_always]
        inputs = list(map(list, zip(*converted, strict=True))) or [[] for _ in numbers]
        kept_steps = min(len(times), 2)
        return self._converted(self._request("step", numbers, f"is at {times[0][0]:g} s",
                                             lambda rows: (times, [inputs[i] for i in rows], kept_steps)))

    def _converted(self, answers: FloatArray) -> FloatArray:
        """Answers, shape (N, steps, m), converted to the ports' outer units, shape (steps, m, N)."""
        outputs = np.ascontiguousarray(answers.transpose(1, 2, 0))
        return np.stack([port.from_fmu(outputs[:, k]) for k, port in enumerate(self.outputs)], axis=1)

    def _request(self, name: str, numbers: Sequence[int], doing: str, arguments: Any) -> FloatArray:
        """Answers of instances, shape (N, ...), which run in one process or each in its own."""
        places = range(len(numbers))
        groups = {numbers[place]: [place] for place in places} if self.description.single_instance else {0: [*places]}
        hosts = {}
        try:
            for key, rows in groups.items():
                hosts[key] = host = self._host(key)
                host.doing = doing
                host.send((name, [numbers[i] for i in rows], *arguments(rows)))
            return np.concatenate([host.receive() for host in hosts.values()])
        except Fault:
            self.close()  # answers of other processes may be pending
            raise

    def _host(self, key: int) -> _Host:
        if key not in self._hosts:
            d = self.description
            self._hosts[key] = _Host(Setting(d.path, d.digest, d.version, d.identifier, d.token, *self._slots, self._limit))
        return self._hosts[key]

    def close(self) -> None:
        """End the processes; a vehicle that continues starts anew."""
        for host in self._hosts.values():
            host.end()
        self._hosts = {}
        self.generation += 1


class Fleet:
    """N vehicles with one instance each. They can continue from any earlier step, which they reach by simulating up to it again.

    Parameters
    ----------
    step
        Time between two calls [s].
    own_step
        Time between two communication points [s]; `step` if None.
    """

    def __init__(self, instances: Instances, n: int, step: float, own_step: float | None) -> None:
        self._instances, self._step, self._own_step = instances, step, own_step
        self._numbers = instances.lease(n)
        weakref.finalize(self, instances.give_back, self._numbers)
        self._position: History | None = None
        self._generation = instances.generation
        self._last: FloatArray
        """Outputs at the last two communication points, shape (2, m, N)."""

    def start(self, inputs: FloatArray) -> tuple[FloatArray, History]:
        """Initialise the vehicles with inputs of shape (k, N); returns the outputs, shape (m, N)."""
        outputs = self._instances.start(self._numbers, inputs)
        self._generation = self._instances.generation
        self._last, self._position = np.stack([outputs, outputs]), History(None, inputs, -1)
        return outputs, self._position

    def advance(self, history: History, inputs: FloatArray) -> tuple[FloatArray, History]:
        """Advance by one step after `history` with inputs of shape (k, N); returns outputs of shape (2, m, N), and the new history.

        The first outputs are those at the last communication point, the second are interpolated to the end of the step.
        """
        if self._position is not history or self._generation != self._instances.generation:
            self._go_back(history)
        number = history.number + 1
        self._position = None
        self._drive(number, inputs)
        self._position = History(history, inputs, number)
        return np.stack([self._last[1], self._at_end_of(number)]), self._position

    def _go_back(self, history: History) -> None:
        steps = [history]
        while steps[-1].previous is not None:
            steps.append(steps[-1].previous)
        self.start(steps.pop().inputs)
        for step in reversed(steps):
            self._drive(step.number, step.inputs)

    def _drive(self, number: int, inputs: FloatArray) -> None:
        """Advance to the last communication point of a step, if it has any."""
        own = self._own_step or self._step
        times = [(point * own, own) for point in range(self._points(number), self._points(number + 1))]
        if times:
            outputs = self._instances.step(self._numbers, times, inputs)
            self._last = outputs if len(outputs) == 2 else np.stack([self._last[1], outputs[0]])

    def _points(self, number: int) -> int:
        """Number of the first communication point at or after the start of a step."""
        return math.ceil(number * self._step / (self._own_step or self._step) - EXACT)

    def _at_end_of(self, number: int) -> FloatArray:
        own = self._own_step or self._step
        after = self._points(number + 1) - (number + 1) * self._step / own  # from the step's end to the last point, in own steps
        if abs(after) <= EXACT:
            return np.asarray(self._last[1])
        return np.asarray(self._last[1] - (self._last[1] - self._last[0]) * after)
