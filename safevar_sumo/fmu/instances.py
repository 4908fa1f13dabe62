"""Instances of an FMU for N vehicles, in a process beside this one, and vehicles that can be taken up again at any step they were at."""

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
"""How long an instance may take for one step of a simulation before it counts as hung [s]."""
MOST, MOST_ALONE = 200, 4
"""Vehicles of a simulation: in one process of an FMU, and in processes of their own."""
EXACT = 1e-9
"""Share of a step by which a time may miss a communication point and be there."""


class Fault(SafevarError):
    """An FMU crashed, hung or refused; in words that follow its name."""


class Past(NamedTuple):
    """What a vehicle has been given so far: `inputs` after all `before`, in the `number`-th step; the first are those of its start."""

    before: Past | None
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
        self.end = weakref.finalize(self, _ended, self._process, self._folder)
        self.doing = "is loaded"
        self.send(("open", *setting))
        self._folder.append(self.receive())
        self.receive()

    def send(self, request: tuple[Any, ...]) -> None:
        try:
            pickle.dump(request, self._process.stdin, protocol=pickle.HIGHEST_PROTOCOL)  # type: ignore[arg-type]
            self._process.stdin.flush()  # type: ignore[union-attr]
        except OSError:  # it is gone, which its answer tells
            return

    def receive(self) -> Any:
        try:
            how, answer = pickle.load(self._process.stdout)  # type: ignore[arg-type]
        except (EOFError, OSError, pickle.UnpicklingError):
            self._process.wait()
            raise Fault(f"crashed {_cause(self._process.returncode)} while it {self.doing}") from None
        if how == "hangs":
            self.end()
            raise Fault(answer)
        if how == "failed":
            raise Fault(f"failed: {answer}")
        return answer


def _ended(process: subprocess.Popen[bytes], folders: list[str]) -> None:
    process.kill()
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            try:
                stream.close()
            except OSError:  # what was still to be written is of no use
                continue
    process.wait()


def _cause(code: int) -> str:
    try:
        return f"(signal {signal.Signals(-code).name})" if code < 0 else f"(exit code {code})"
    except ValueError:
        return f"(signal {-code})"


class Instances:
    """The instances of one FMU with the same inputs and outputs: they are made when needed, and given back to be reset.

    Parameters
    ----------
    inputs, outputs
        Its ports, in the order in which values are given and told. Those for parameters are set once, at the start.
    fixed
        Further parameters and their values.
    limit
        How long an instance may take for one request [s].
    """

    def __init__(self, description: Description, inputs: Sequence[Port], outputs: Sequence[Port],
                 fixed: Sequence[tuple[Variable, Any]], limit: float) -> None:
        self.description, self.inputs, self.outputs = description, tuple(inputs), tuple(outputs)
        self._fixed = [value for _, value in fixed]
        self._set_once = [k for k, port in enumerate(inputs) if not port.is_input]
        self._set_always = [k for k, port in enumerate(inputs) if port.is_input]
        self._slots = (tuple(inputs[k].slot for k in self._set_always),
                       (*(inputs[k].slot for k in self._set_once), *((one.type, one.reference) for one, _ in fixed)),
                       tuple(port.slot for port in outputs))
        self._limit, self._hosts = limit, dict[int, _Host]()
        self._free, self._next = list[int](), 0
        self.generation = 0
        """How often all instances were lost."""

    @property
    def most_vehicles(self) -> int:
        return MOST_ALONE if self.description.alone else MOST

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
        given = [port.given(values[k]) for k, port in enumerate(self.inputs)]
        once = [[*(float(given[k][i]) for k in self._set_once), *self._fixed] for i in range(len(numbers))]
        always = [[float(given[k][i]) for k in self._set_always] for i in range(len(numbers))]
        answers = self._asked("start", numbers, "is initialised", lambda rows: ([once[i] for i in rows], [always[i] for i in rows]))
        return np.asarray(self._read(answers[:, np.newaxis])[-1])

    def step(self, numbers: Sequence[int], times: Sequence[tuple[float, float]], values: FloatArray) -> FloatArray:
        """Instances after steps that begin at times and are so long [s], one of them at least; outputs after the last two, or the one,
        shape (1 or 2, m, N).
        """
        given = [self.inputs[k].given(values[k]).tolist() for k in self._set_always]
        always = list(map(list, zip(*given, strict=True))) or [[] for _ in numbers]
        kept = min(len(times), 2)
        return self._read(self._asked("step", numbers, f"is at {times[0][0]:g} s", lambda rows: (times, [always[i] for i in rows], kept)))

    def _read(self, answers: FloatArray) -> FloatArray:
        """Answers, shape (N, steps, m), in our units as (steps, m, N)."""
        told = np.ascontiguousarray(answers.transpose(1, 2, 0))
        return np.stack([port.told(told[:, k]) for k, port in enumerate(self.outputs)], axis=1)

    def _asked(self, name: str, numbers: Sequence[int], doing: str, arguments: Any) -> FloatArray:
        """What instances answer, shape (N, ...): all in one process, or each in its own."""
        places = range(len(numbers))
        groups = {numbers[place]: [place] for place in places} if self.description.alone else {0: [*places]}
        hosts = {}
        try:
            for key, rows in groups.items():
                hosts[key] = host = self._host(key)
                host.doing = doing
                host.send((name, [numbers[i] for i in rows], *arguments(rows)))
            return np.concatenate([host.receive() for host in hosts.values()])
        except Fault:
            self.close()  # instances elsewhere have answers under way
            raise

    def _host(self, key: int) -> _Host:
        if key not in self._hosts:
            said = self.description
            self._hosts[key] = _Host(Setting(said.path, said.digest, said.version, said.identifier, said.token, *self._slots, self._limit))
        return self._hosts[key]

    def close(self) -> None:
        """End the processes; whoever goes on begins anew."""
        for host in self._hosts.values():
            host.end()
        self._hosts = {}
        self.generation += 1


class Fleet:
    """N vehicles with an instance each. Any step that they were at can be gone on from: they then drive there once more.

    Parameters
    ----------
    step
        Time between two calls [s].
    own_step
        Time between two communication points [s]; the same if None.
    """

    def __init__(self, instances: Instances, n: int, step: float, own_step: float | None) -> None:
        self._instances, self._step, self._own_step = instances, step, own_step
        self._numbers = instances.lease(n)
        weakref.finalize(self, instances.give_back, self._numbers)
        self._at: Past | None = None
        self._generation = instances.generation
        self._last: FloatArray
        """Outputs at the last two communication points, shape (2, m, N)."""

    def start(self, inputs: FloatArray) -> tuple[FloatArray, Past]:
        """Initialise the vehicles with inputs of shape (k, N); returns the outputs, shape (m, N)."""
        outputs = self._instances.start(self._numbers, inputs)
        self._generation = self._instances.generation
        self._last, self._at = np.stack([outputs, outputs]), Past(None, inputs, -1)
        return outputs, self._at

    def advance(self, past: Past, inputs: FloatArray) -> tuple[FloatArray, Past]:
        """Drive one step on from a past with inputs of shape (k, N); returns the outputs then, and those in between before, (2, m, N).

        The first are at the last communication point, the second interpolated to the end of the step.
        """
        if self._at is not past or self._generation != self._instances.generation:
            self._go_back(past)
        number = past.number + 1
        self._at = None
        self._drive(number, inputs)
        self._at = Past(past, inputs, number)
        return np.stack([self._last[1], self._at_end_of(number)]), self._at

    def _go_back(self, past: Past) -> None:
        way = [past]
        while way[-1].before is not None:
            way.append(way[-1].before)
        self.start(way.pop().inputs)
        for one in reversed(way):
            self._drive(one.number, one.inputs)

    def _drive(self, number: int, inputs: FloatArray) -> None:
        """Past the communication points of a step, if there is one."""
        own = self._own_step or self._step
        times = [(point * own, own) for point in range(self._points(number), self._points(number + 1))]
        if times:
            told = self._instances.step(self._numbers, times, inputs)
            self._last = told if len(told) == 2 else np.stack([self._last[1], told[0]])

    def _points(self, number: int) -> int:
        """Number of the first own communication point that is not before the start of a step."""
        return math.ceil(number * self._step / (self._own_step or self._step) - EXACT)

    def _at_end_of(self, number: int) -> FloatArray:
        own = self._own_step or self._step
        after = self._points(number + 1) - (number + 1) * self._step / own  # by how many own steps it is ahead
        if abs(after) <= EXACT:
            return np.asarray(self._last[1])
        return np.asarray(self._last[1] - (self._last[1] - self._last[0]) * after)
