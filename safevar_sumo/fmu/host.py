"""The program in whose process an FMU runs: it answers over its standard streams, and may crash or hang without harm to who asks.

It is started by its path and imports nothing of this package. A request is a tuple of a name and arguments, pickled; so is an answer.
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

LOOKS = 0.1
"""Time between two looks at what takes too long [s]."""
GROUPS = {"Real": "Real", "Integer": "Integer", "Enumeration": "Integer", "Boolean": "Boolean", "String": "String"}
"""FMI 2.0's functions by the type of a variable; FMI 3.0's are called like the types, but for enumerations."""


class Setting(NamedTuple):
    """What every instance of an FMU has in common, as the first request has it.

    `path` and `digest` are those of its file; `inputs`, `parameters` and `outputs` are types and value references; `limit` is how long one
    instance may take for a request [s].
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


class Failure(Exception):
    """What an FMU could not do."""


class Instances:
    """All instances in this process, by numbers that the other side gives them."""

    def __init__(self, setting: Setting, folder: str) -> None:
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        self._is_3 = setting.version.startswith("3")
        self._logged, self._setting = list[str](), setting
        known = {"guid": setting.token, "unzipDirectory": folder, "modelIdentifier": setting.identifier}
        self._library = (FMU3Slave if self._is_3 else FMU2Slave)(instanceName=setting.identifier, **known)
        self._callbacks = None if self._is_3 else self._callbacks_2()
        self._of: dict[int, Any] = {}
        self._inputs, self._parameters, self._outputs = map(self._grouped, (setting.inputs, setting.parameters, setting.outputs))
        self.busy: tuple[float, int, str] | None = None
        """Since when which instance has been doing what."""

    def start(self, numbers: list[int], parameters: list[list[Any]], inputs: list[list[float]]) -> np.ndarray:
        """Initialised instances, new or reset; returns outputs, shape (N, m)."""
        return self._each(numbers, "is initialised", lambda place, one: self._started(one, parameters[place], inputs[place]))

    def step(self, numbers: list[int], times: list[tuple[float, float]], inputs: list[list[float]], kept: int) -> np.ndarray:
        """Instances some steps on, with the same inputs: outputs after the last `kept` steps, shape (N, kept, m)."""
        def stepped(place: int, one: Any) -> list[list[float]]:
            self._set(one, self._inputs, inputs[place])
            told = []
            for number, (at, step) in enumerate(times, 1):
                self._step(one, at, step)
                if number > len(times) - kept:
                    told.append(self._told(one))
            return told

        return self._each(numbers, f"is at {times[0][0]:g} s", stepped)

    def _each(self, numbers: list[int], doing: str, work: Callable[[int, Any], Any]) -> np.ndarray:
        results = []
        for place, number in enumerate(numbers):
            self.busy = (time.monotonic(), place, doing)
            try:
                one = self._of.get(number)
                if one is None:
                    one = self._of[number] = self._instance()
                results.append(work(place, one))
            except Exception as error:  # whatever FMPy raises about an FMU
                self._drop(number)
                raise Failure(f"{self._reason(error)} while it {doing}") from error
            finally:
                self.busy = None
        return np.array(results, dtype=float)

    def _instance(self) -> Any:
        one = copy.copy(self._library)  # shares the library and its functions
        one.component, one.used = None, False
        if self._is_3:
            one.instantiate(loggingOn=True, logMessage=lambda _, status, category, message: self._note(status, message))
        else:
            one.instantiate(callbacks=self._callbacks, loggingOn=True)
        return one

    def _started(self, one: Any, parameters: list[Any], inputs: list[float]) -> list[float]:
        if one.used:
            one.terminate()
            one.reset()
        one.used = True
        self._set(one, self._parameters, parameters)
        if self._is_3:
            one.enterInitializationMode(startTime=0.0)
        else:
            one.setupExperiment(startTime=0.0)
            one.enterInitializationMode()
        self._set(one, self._inputs, inputs)
        one.exitInitializationMode()
        return self._told(one)

    def _step(self, one: Any, at: float, step: float) -> None:
        ended = one.doStep(at, step)
        if not self._is_3:
            return
        _, terminated, early, reached = ended
        if terminated:
            raise Failure("it asks for the end of the simulation")
        if early:
            raise Failure(f"it returned early, at {reached:g} s")

    def _set(self, one: Any, groups: list[tuple[str, list[int], list[int]]], values: list[Any]) -> None:
        for kind, references, columns in groups:
            chosen = [values[column] for column in columns]
            if kind == "Boolean":
                chosen = [bool(value) for value in chosen]
            elif kind not in ("Real", "Float64", "Float32", "String"):
                chosen = [round(value) for value in chosen]
            getattr(one, f"set{kind}")(references, chosen)

    def _told(self, one: Any) -> list[float]:
        told = [0.0] * len(self._setting.outputs)
        for kind, references, columns in self._outputs:
            for column, value in zip(columns, getattr(one, f"get{kind}")(references), strict=True):
                told[column] = float(value)
        return told

    def _grouped(self, ports: tuple[tuple[str, int], ...]) -> list[tuple[str, list[int], list[int]]]:
        """Value references and columns by the function that sets or gets them."""
        groups: dict[str, tuple[list[int], list[int]]] = {}
        for column, (kind, reference) in enumerate(ports):
            name = ("Int64" if kind == "Enumeration" else kind) if self._is_3 else GROUPS[kind]
            references, columns = groups.setdefault(name, ([], []))
            references.append(reference)
            columns.append(column)
        return [(name, *group) for name, group in groups.items()]

    def _drop(self, number: int) -> None:
        """Forget an instance that failed: what it would do next is undefined, even to be freed."""
        self._of.pop(number, None)

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


def unpacked(setting: Setting) -> str:
    """A new folder with what is in the FMU."""
    content = Path(setting.path).read_bytes()
    if sha256(content).hexdigest() != setting.digest:
        raise Failure("its file was changed meanwhile")
    folder = mkdtemp(prefix="safevar_sumo_fmu_")
    with ZipFile(BytesIO(content)) as archive:
        archive.extractall(folder)
    return folder


def watch(instances: Instances, limit: float, folder: str, parent: int, answers: BinaryIO) -> None:
    """End the process when an instance takes too long, or when nobody asks any more."""
    while os.getppid() == parent:
        time.sleep(LOOKS)
        busy = instances.busy
        if busy is not None and time.monotonic() - busy[0] > limit:
            send(answers, ("hangs", f"takes longer than {limit:g} s while it {busy[2]}"))
            break
    end(folder)


def end(folder: str) -> NoReturn:
    """End at once, without what an FMU would do when its library is unloaded."""
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)


def send(stream: BinaryIO, what: Any) -> None:
    pickle.dump(what, stream, protocol=pickle.HIGHEST_PROTOCOL)
    stream.flush()


def main() -> None:
    """Answer requests until there are no more."""
    requests = os.fdopen(os.dup(0), "rb")
    answers = os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):  # what an FMU prints must not pass for an answer
        os.dup2(nothing, descriptor)
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
                folder = unpacked(setting)
                send(answers, ("done", folder))
                instances = Instances(setting, folder)
                threading.Thread(target=watch, args=(instances, setting.limit, folder, parent, answers), daemon=True).start()
                send(answers, ("done", None))
            else:
                send(answers, ("done", getattr(instances, name)(*arguments)))
        except Failure as failure:
            send(answers, ("failed", str(failure)))
        except Exception as error:  # the other side tells it
            send(answers, ("failed", f"{type(error).__name__}: {error}"))


if __name__ == "__main__":
    main()
