"""The program that runs an FMU in a separate process, where a crash or a hang does no harm; it answers over its standard streams.

It is started by its path and imports nothing of this package. Requests and answers are pickled tuples: a name and arguments.
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
GROUPS = {"Real": "Real", "Integer": "Integer", "Enumeration": "Integer", "Boolean": "Boolean", "String": "String"}
"""Names of FMI 2.0's functions by the type of a variable; FMI 3.0's are named after the types, except for enumerations."""


class Setting(NamedTuple):
    """Facts that all instances of an FMU share, the arguments of the first request.

    `path` and `digest` are those of the FMU's file; `inputs`, `parameters` and `outputs` are types and value references; `limit` is the
    longest time that one instance may take for a request [s].
    """

    path: str
    digest: str
    version: str
    identifier: str
    token: str
    inputs: tuple[tuple[str, int], ...]
    parameters: tuple[tuple[str, int], ...]
    outputs: tuple[tuple[str, int], ...]
    limit: float


class InstanceFailure(Exception):
    """An FMU could not carry out a request."""


class HostedInstances:
    """All instances in this process, by numbers that the requests give them."""

    def __init__(self, setting: Setting, folder: str) -> None:
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        self._is_3 = setting.version.startswith("3")
        self._logged, self._setting = list[str](), setting
        arguments = {"guid": setting.token, "unzipDirectory": folder, "modelIdentifier": setting.identifier}
        self._library = (FMU3Slave if self._is_3 else FMU2Slave)(instanceName=setting.identifier, **arguments)
        self._callbacks = None if self._is_3 else self._callbacks_2()
        self._instances: dict[int, Any] = {}
        self._inputs, self._parameters, self._outputs = map(self._grouped, (setting.inputs, setting.parameters, setting.outputs))
        self.busy: tuple[float, int, str] | None = None
        """Start time [s], place and activity of the request in progress."""

    def start(self, numbers: list[int], parameters: list[list[Any]], inputs: list[list[float]]) -> np.ndarray:
        """Initialise instances, new or reset; returns the outputs, shape (N, m)."""
        return self._each(numbers, "is initialised", lambda place, instance: self._start(instance, parameters[place], inputs[place]))

    def step(self, numbers: list[int], times: list[tuple[float, float]], inputs: list[list[float]], kept_steps: int) -> np.ndarray:
        """Advance instances by some steps with constant inputs; returns outputs after the last `kept_steps`, shape (N, kept_steps, m)."""
        def advance(place: int, instance: Any) -> list[list[float]]:
            self._set(instance, self._inputs, inputs[place])
            outputs = []
            for number, (time_, step) in enumerate(times, 1):
                self._step(instance, time_, step)
                if number > len(times) - kept_steps:
                    outputs.append(self._read_outputs(instance))
            return outputs

        return self._each(numbers, f"is at {times[0][0]:g} s", advance)

    def _each(self, numbers: list[int], doing: str, work: Callable[[int, Any], Any]) -> np.ndarray:
        results = []
        for place, number in enumerate(numbers):
            self.busy = (time.monotonic(), place, doing)
            try:
                instance = self._instances.get(number)
                if instance is None:
                    instance = self._instances[number] = self._new_instance()
                results.append(work(place, instance))
            except Exception as error:  # any error of FMPy about an FMU
                self._drop(number)
                raise InstanceFailure(f"{self._reason(error)} while it {doing}") from error
            finally:
                self.busy = None
        return np.array(results, dtype=float)

    def _new_instance(self) -> Any:
        instance = copy.copy(self._library)  # shares the library and its functions
        instance.component, instance.used = None, False
        if self._is_3:
            instance.instantiate(loggingOn=True, logMessage=lambda _, status, category, message: self._note(status, message))
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

    def _step(self, instance: Any, time_: float, step: float) -> None:
        result = instance.doStep(time_, step)
        if not self._is_3:
            return
        _, terminated, early, reached = result
        if terminated:
            raise InstanceFailure("it requests the end of the simulation")
        if early:
            raise InstanceFailure(f"it returned early, at {reached:g} s")

    def _set(self, instance: Any, groups: list[tuple[str, list[int], list[int]]], values: list[Any]) -> None:
        for kind, references, columns in groups:
            chosen = [values[column] for column in columns]
            if kind == "Boolean":
                chosen = [bool(value) for value in chosen]
            elif kind not in ("Real", "Float64", "Float32", "String"):
                chosen = [round(value) for value in chosen]
            getattr(instance, f"set{kind}")(references, chosen)

    def _read_outputs(self, instance: Any) -> list[float]:
        outputs = [0.0] * len(self._setting.outputs)
        for kind, references, columns in self._outputs:
            for column, value in zip(columns, getattr(instance, f"get{kind}")(references), strict=True):
                outputs[column] = float(value)
        return outputs

    def _grouped(self, ports: tuple[tuple[str, int], ...]) -> list[tuple[str, list[int], list[int]]]:
        """Value references and columns, grouped by the FMI function that sets or gets them."""
        groups: dict[str, tuple[list[int], list[int]]] = {}
        for column, (kind, reference) in enumerate(ports):
            name = ("Int64" if kind == "Enumeration" else kind) if self._is_3 else GROUPS[kind]
            references, columns = groups.setdefault(name, ([], []))
            references.append(reference)
            columns.append(column)
        return [(name, *group) for name, group in groups.items()]

    def _drop(self, number: int) -> None:
        """Forget an instance that failed: any further call, even freeing it, is undefined."""
        self._instances.pop(number, None)

    def _callbacks_2(self) -> Any:
        from fmpy.fmi2 import defaultCallbacks, fmi2CallbackFunctions, fmi2CallbackLoggerTYPE
        from fmpy.logging import addLoggerProxy

        callbacks = fmi2CallbackFunctions()
        callbacks.logger = fmi2CallbackLoggerTYPE(lambda _, name, status, category, message: self._note(status, message))
        callbacks.allocateMemory, callbacks.freeMemory = defaultCallbacks.allocateMemory, defaultCallbacks.freeMemory
        addLoggerProxy(byref(callbacks))
        return callbacks

    def _note(self, status: int, message: bytes | None) -> None:
        if status > 1 and message:  # worse than a warning
            self._logged[:] = [*self._logged[-1:], " ".join(message.decode(errors="replace").split())]

    def _reason(self, error: Exception) -> str:
        logged, self._logged[:] = list(self._logged), []
        lines = str(error).strip().splitlines()
        text = lines[0].rstrip(".") if lines else type(error).__name__
        return f"{text}: {logged[-1]}" if logged else text


def unpack(setting: Setting) -> str:
    """Unpack the FMU into a new folder."""
    content = Path(setting.path).read_bytes()
    if sha256(content).hexdigest() != setting.digest:
        raise InstanceFailure("its file was changed meanwhile")
    folder = mkdtemp(prefix="safevar_sumo_fmu_")
    with ZipFile(BytesIO(content)) as archive:
        archive.extractall(folder)
    return folder


def watch(instances: HostedInstances, limit: float, folder: str, parent: int, answers: BinaryIO) -> None:
    """End the process when an instance takes too long, or when the parent process has ended."""
    while os.getppid() == parent:
        time.sleep(CHECK_INTERVAL)
        busy = instances.busy
        if busy is not None and time.monotonic() - busy[0] > limit:
            send(answers, ("hangs", f"takes longer than {limit:g} s while it {busy[2]}"))
            break
    end(folder)


def end(folder: str) -> NoReturn:
    """End at once, without running the code of an FMU that unloading its library would run."""
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


def send(stream: BinaryIO, message: Any) -> None:
    pickle.dump(message, stream, protocol=pickle.HIGHEST_PROTOCOL)
    stream.flush()


def main() -> None:
    """Answer requests until there are no more."""
    requests = os.fdopen(os.dup(0), "rb")
    answers = os.fdopen(os.dup(1), "wb")
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):  # output that an FMU prints must not be read as an answer
        os.dup2(null, descriptor)
    sys.stdin, sys.stdout, sys.stderr = (os.fdopen(number, mode) for number, mode in enumerate("rww"))
    parent, folder, instances = os.getppid(), "", None
    while True:
        try:
            name, *arguments = pickle.load(requests)
        except EOFError:
            end(folder)
        try:
            if instances is None:
                setting = Setting(*arguments)
                folder = unpack(setting)
                send(answers, ("done", folder))
                instances = HostedInstances(setting, folder)
                threading.Thread(target=watch, args=(instances, setting.limit, folder, parent, answers), daemon=True).start()
                send(answers, ("done", None))
            else:
                send(answers, ("done", getattr(instances, name)(*arguments)))
        except InstanceFailure as failure:
            send(answers, ("failed", str(failure)))
        except Exception as error:  # the parent process reports it
            send(answers, ("failed", f"{type(error).__name__}: {error}"))


if __name__ == "__main__":
    main()
