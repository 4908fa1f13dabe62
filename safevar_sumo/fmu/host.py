"""The program that runs an FMU in a separate process, where a crash or a hang does no harm; it communicates over its standard streams.

The parent process starts the program by its path; it imports nothing of this package. A request is a pickled tuple of a name and
arguments; an answer is a pickled tuple of a status and a value.
"""

from __future__ import annotations

import copy
import os
import pickle
import shutil
import sys
import threading
import time
from collections.abc import Callable
from ctypes import byref
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, BinaryIO, NamedTuple, NoReturn
from zipfile import ZipFile

import numpy as np

CHECK_INTERVAL = 0.1
"""Time between two checks for requests that take too long [s]."""
FUNCTION_NAMES = {"Real": "Real", "Integer": "Integer", "Enumeration": "Integer", "Boolean": "Boolean", "String": "String"}
"""Ends of the names of FMI 2.0 functions by the type of a variable; FMI 3.0 uses the names of the types, except for enumerations."""


class HostSetup(NamedTuple):
    """Facts that all instances of an FMU share; the arguments of the first request.

    `path` and `digest` identify the FMU's file; `identifier` and `token` are as in `Description`; `inputs`, `parameters` and `outputs`
    are types and value references; `time_limit` is the longest time that one instance may take for a request [s].
    """

    path: str
    digest: str
    version: str
    identifier: str
    token: str
    inputs: tuple[tuple[str, int], ...]
    parameters: tuple[tuple[str, int], ...]
    outputs: tuple[tuple[str, int], ...]
    time_limit: float


class Activity(NamedTuple):
    """What an instance does since `start` [s]; `description` completes "while it ..."."""

    start: float
    description: str


class InstanceFailure(Exception):
    """An FMU could not carry out a request."""


class HostedInstances:
    """All instances in this process, by the numbers by which requests name them."""

    def __init__(self, setup: HostSetup, folder: str) -> None:
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        self._is_3 = setup.version.startswith("3")
        self._messages, self._setup = list[str](), setup
        arguments = {"guid": setup.token, "unzipDirectory": folder, "modelIdentifier": setup.identifier}
        self._library = (FMU3Slave if self._is_3 else FMU2Slave)(instanceName=setup.identifier, **arguments)
        self._callbacks = None if self._is_3 else self._callbacks_of_fmi_2()
        self._instances: dict[int, Any] = {}
        self._inputs, self._parameters, self._outputs = map(self._groups_of, (setup.inputs, setup.parameters, setup.outputs))
        self.activity: Activity | None = None
        """The activity in progress."""

    def start(self, numbers: list[int], parameters: list[list[Any]], inputs: list[list[float]]) -> np.ndarray:
        """Initialise N instances, new or reset; returns their m outputs, shape (N, m)."""
        return self._on_each_instance(numbers, "is initialised", lambda i, instance: self._start(instance, parameters[i], inputs[i]))

    def step(self, numbers: list[int], steps: list[tuple[float, float]], inputs: list[list[float]], kept_steps: int) -> np.ndarray:
        """Advance N instances by (start, length) steps [s]; returns m outputs after the last `kept_steps`, shape (N, kept_steps, m)."""
        def advance(position: int, instance: Any) -> list[list[float]]:
            self._set(instance, self._inputs, inputs[position])
            outputs = []
            for count, (start, length) in enumerate(steps, 1):
                self._step(instance, start, length)
                if count > len(steps) - kept_steps:
                    outputs.append(self._read_outputs(instance))
            return outputs

        return self._on_each_instance(numbers, f"is at {steps[0][0]:g} s", advance)

    def _on_each_instance(self, numbers: list[int], description: str, work: Callable[[int, Any], Any]) -> np.ndarray:
        results = []
        for position, number in enumerate(numbers):
            self.activity = Activity(time.monotonic(), description)
            try:
                instance = self._instances.get(number)
                if instance is None:
                    instance = self._instances[number] = self._new_instance()
                results.append(work(position, instance))
            except Exception as error:  # any error of FMPy about an FMU
                self._instances.pop(number, None)  # any further call of an instance that failed, even freeing it, is undefined
                raise InstanceFailure(f"{self._reason(error)} while it {description}") from error
            finally:
                self.activity = None
        return np.array(results, dtype=float)

    def _new_instance(self) -> Any:
        instance = copy.copy(self._library)  # shares the library and its functions
        instance.component, instance.used = None, False
        if self._is_3:
            instance.instantiate(loggingOn=True, logMessage=lambda _, status, category, message: self._note_message(status, message))
        else:
            instance.instantiate(callbacks=self._callbacks, loggingOn=True)
        return instance

    def _start(self, instance: Any, parameters: list[Any], inputs: list[float]) -> list[float]:
        if instance.used:
            instance.terminate()
            instance.reset()
        instance.used = True
        self._set(instance, self._parameters, parameters)
        if self._is_3:
            instance.enterInitializationMode(startTime=0.0)
        else:
            instance.setupExperiment(startTime=0.0)
            instance.enterInitializationMode()
        self._set(instance, self._inputs, inputs)
        instance.exitInitializationMode()
        return self._read_outputs(instance)

    def _step(self, instance: Any, start: float, length: float) -> None:
        result = instance.doStep(start, length)
        if not self._is_3:
            return
        _, termination, early_return, end_time = result
        if termination:
            raise InstanceFailure("it requests the end of the simulation")
        if early_return:
            raise InstanceFailure(f"it returned early, at {end_time:g} s")

    def _set(self, instance: Any, groups: list[tuple[str, list[int], list[int]]], values: list[Any]) -> None:
        for type_name, references, positions in groups:
            group_values = [values[position] for position in positions]
            if type_name == "Boolean":
                group_values = [bool(value) for value in group_values]
            elif type_name not in ("Real", "Float64", "Float32", "String"):
                group_values = [round(value) for value in group_values]
            getattr(instance, f"set{type_name}")(references, group_values)

    def _read_outputs(self, instance: Any) -> list[float]:
        outputs = [0.0] * len(self._setup.outputs)
        for type_name, references, positions in self._outputs:
            for position, value in zip(positions, getattr(instance, f"get{type_name}")(references), strict=True):
                outputs[position] = float(value)
        return outputs

    def _groups_of(self, ports: tuple[tuple[str, int], ...]) -> list[tuple[str, list[int], list[int]]]:
        """Value references and positions, grouped by the FMI function that sets or gets them."""
        groups: dict[str, tuple[list[int], list[int]]] = {}
        for position, (type_name, reference) in enumerate(ports):
            name = ("Int64" if type_name == "Enumeration" else type_name) if self._is_3 else FUNCTION_NAMES[type_name]
            references, positions = groups.setdefault(name, ([], []))
            references.append(reference)
            positions.append(position)
        return [(name, *group) for name, group in groups.items()]

    def _callbacks_of_fmi_2(self) -> Any:
        from fmpy.fmi2 import defaultCallbacks, fmi2CallbackFunctions, fmi2CallbackLoggerTYPE
        from fmpy.logging import addLoggerProxy

        callbacks = fmi2CallbackFunctions()
        callbacks.logger = fmi2CallbackLoggerTYPE(lambda _, name, status, category, message: self._note_message(status, message))
        callbacks.allocateMemory, callbacks.freeMemory = defaultCallbacks.allocateMemory, defaultCallbacks.freeMemory
        addLoggerProxy(byref(callbacks))
        return callbacks

    def _note_message(self, status: int, message: bytes | None) -> None:
        if status > 1 and message:  # worse than a warning
            self._messages[:] = [*self._messages[-1:], " ".join(message.decode(errors="replace").split())]

    def _reason(self, error: Exception) -> str:
        messages, self._messages[:] = list(self._messages), []
        lines = str(error).strip().splitlines()
        text = lines[0].rstrip(".") if lines else type(error).__name__
        return f"{text}: {messages[-1]}" if messages else text


def unpack(setup: HostSetup) -> str:
    """Unpack the FMU into a new folder; returns its path."""
    content = Path(setup.path).read_bytes()
    if sha256(content).hexdigest() != setup.digest:
        raise InstanceFailure("its file has changed since the study was read")
    folder = mkdtemp(prefix="safevar_sumo_fmu_")
    with ZipFile(BytesIO(content)) as archive:
        archive.extractall(folder)
    return folder


def end_when_hung_or_orphaned(instances: HostedInstances, time_limit: float, folder: str, parent: int, answers: BinaryIO) -> None:
    """End the process when an instance takes too long, or when the parent process has ended."""
    while os.getppid() == parent:
        time.sleep(CHECK_INTERVAL)
        activity = instances.activity
        if activity is not None and time.monotonic() - activity.start > time_limit:
            send(answers, ("hangs", f"takes longer than {time_limit:g} s while it {activity.description}"))
            break
    exit_at_once(folder)


def exit_at_once(folder: str) -> NoReturn:
    """End without unloading the FMU's library, which could run code of the FMU."""
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


def send(stream: BinaryIO, message: Any) -> None:
    pickle.dump(message, stream, protocol=pickle.HIGHEST_PROTOCOL)
    stream.flush()


def main() -> None:
    """Answer requests until there are no more."""
    requests = os.fdopen(os.dup(0), "rb")
    answers = os.fdopen(os.dup(1), "wb")
    null_device = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):  # output that an FMU prints must not be read as an answer
        os.dup2(null_device, descriptor)
    sys.stdin, sys.stdout, sys.stderr = (os.fdopen(number, mode) for number, mode in enumerate("rww"))
    parent, folder, instances = os.getppid(), "", None
    while True:
        try:
            name, *arguments = pickle.load(requests)
        except EOFError:
            exit_at_once(folder)
        try:
            if instances is None:
                setup = HostSetup(*arguments)
                folder = unpack(setup)
                send(answers, ("done", folder))
                instances = HostedInstances(setup, folder)
                arguments = [instances, setup.time_limit, folder, parent, answers]
                threading.Thread(target=end_when_hung_or_orphaned, args=arguments, daemon=True).start()
                send(answers, ("done", None))
            else:
                send(answers, ("done", getattr(instances, name)(*arguments)))
        except InstanceFailure as failure:
            send(answers, ("failed", str(failure)))
        except Exception as error:  # the parent process reports it
            send(answers, ("failed", f"{type(error).__name__}: {error}"))


if __name__ == "__main__":
    main()
