"""What a process keeps of simulators of the user's own: a handle of each class, opened once."""

from __future__ import annotations

import atexit
import inspect
from contextlib import suppress
from copy import Error, copy, deepcopy
from inspect import getattr_static
from pathlib import Path
from random import Random
from typing import Any

import msgspec
import numpy as np

from safevar_sumo.plugins.process import end_children, this_process
from safevar_sumo.scenarios import Simulator

ARRAYS = (np.generic, np.ndarray, np.random.Generator, np.random.RandomState)
PLAIN = (bool, int, float, complex, str, bytes, tuple, list, dict, set, Random, *ARRAYS)
"""Types of attributes of a simulator that each run has for itself, unlike an open connection."""


class Kept:
    """What this process keeps of the simulators of the user's own: of each class the handle that
    its `open_worker` returned, and the object that simulated last; and how often it has
    `simulated`.
    """

    def __init__(self) -> None:
        self._last = dict[str, Simulator]()
        self._handles = dict[str, tuple[int, type[Simulator], Any]]()
        self.simulated = 0

    def at(self, scenario: Simulator) -> Simulator:
        """An object as `scenario` was when it was created with its fields, with the handle of its
        class; a new handle if the file of the class was edited.
        """
        kind = type(scenario)
        name = f"{kind.__module__}:{kind.__qualname__}"
        has_worker = (
            getattr_static(kind, "open_worker") is not Simulator.__dict__["open_worker"]
        )
        edited = (
            Path(inspect.getfile(kind.open_worker)).stat().st_mtime_ns
            if has_worker
            else id(kind)
        )
        if name in self._handles and self._handles[name][0] != edited:
            self._close(name)
        if name not in self._handles:
            handle = kind.open_worker(this_process.worker)
            self._handles[name] = edited, kind, handle
        handle = self._handles[name][2]

        # Nothing that a run changes stays in the scenario. Without `open_worker`, what the run
        # before opened and put into the object is handed on.
        is_struct = isinstance(scenario, msgspec.Struct)
        set_field: Any = (
            msgspec.structs.force_setattr if is_struct else object.__setattr__
        )
        simulator = copy(scenario)
        for field, value in _attributes(scenario).items():
            if has_worker or is_struct or isinstance(value, PLAIN):
                set_field(simulator, field, _deep_copy(value))
        if has_worker:
            try:
                set_field(simulator, "worker", handle)
            # A Struct has its fields alone.
            except AttributeError:
                kind.worker = property(lambda self: handle)
        elif not is_struct:
            for field, value in _attributes(self._last.get(name, simulator)).items():
                if getattr(simulator, field, None) is None and not isinstance(
                    value, PLAIN
                ):
                    set_field(simulator, field, value)
        self._last[name] = simulator
        return simulator

    def close(self) -> None:
        """End all simulators."""
        for name in [*self._handles]:
            self._close(name)

    def _close(self, name: str) -> None:
        simulator = self._last.pop(name, None)
        _, kind, handle = self._handles.pop(name)
        if simulator is not None:
            simulator.close()
        kind.close_worker(handle)


def _attributes(simulator: Simulator) -> dict[str, Any]:
    """The attributes of a simulator, or the fields of a Struct; none where its class has slots."""
    if isinstance(simulator, msgspec.Struct):
        return msgspec.structs.asdict(simulator)
    return dict(getattr(simulator, "__dict__", {}))


def _deep_copy(value: Any) -> Any:
    """A copy that shares nothing; the value itself, such as a lock, where there is none."""
    try:
        return deepcopy(value)
    except (TypeError, AttributeError, ValueError, RuntimeError, Error):
        return value


KEPT = Kept()
"""What this process keeps."""


@atexit.register
def close_simulator() -> None:
    """End the simulators of this process, also where one fails to end."""
    with suppress(Exception):
        KEPT.close()
    end_children(this_process.mark)
