"""Objects that this process keeps between the runs of users' simulators: for each class a handle,
such as a connection, that is opened only once.
"""

from __future__ import annotations

import atexit
import inspect
from contextlib import suppress
from copy import Error, copy, deepcopy
from inspect import getattr_static
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import msgspec
import numpy as np

from safevar_sumo.plugins import Modules, running_modules
from safevar_sumo.plugins.process import end_children, this_process
from safevar_sumo.scenarios import Simulator

ARRAYS = (np.generic, np.ndarray, np.random.Generator, np.random.RandomState)
PLAIN = (bool, int, float, complex, str, bytes, tuple, list, dict, set, Random, *ARRAYS)
"""Types of attributes of which each run gets a copy of its own. Values of other types, such as an
open connection, may pass from run to run.
"""


class _Handle(NamedTuple):
    """A handle, the class that opened it, the modules of its code, and its edition: its file with
    the time of the last edit or, of a class that opens nothing, the class itself.
    """

    edition: object
    kind: type[Simulator]
    modules: Modules
    handle: Any


class Kept:
    """The objects that this process keeps: for each class of a user's simulator, the handle that
    `open_worker` returned, and the object that simulated last. `simulated` counts simulations.
    """

    def __init__(self) -> None:
        self._last = dict[str, Simulator]()
        self._handles = dict[str, _Handle]()
        self.simulated = 0

    def at(self, scenario: Simulator) -> Simulator:
        """A simulator that is a copy of `scenario`, with the handle of its class. If the file of
        the class was edited, the old handle is closed and a new one is opened.
        """
        kind = type(scenario)
        name = f"{kind.__module__}:{kind.__qualname__}"
        has_worker = (
            getattr_static(kind, "open_worker") is not Simulator.__dict__["open_worker"]
        )
        handle = self._opened(kind, name, has_worker=has_worker)

        # A run must not change the scenario, which later runs copy, too. Without `open_worker`,
        # this object inherits connections that the last run opened and stored in its object.
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
            # A Struct has no attributes beside its fields.
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

    def _opened(self, kind: type[Simulator], name: str, *, has_worker: bool) -> Any:
        """The handle of a class. A handle of other or older code is closed before."""
        # Another study may have a class of the same name, in another file.
        edition: object = kind
        if has_worker:
            file = inspect.getfile(kind.open_worker)
            edition = file, Path(file).stat().st_mtime_ns
        kept = self._handles.get(name)
        if kept is not None and (
            kept.edition != edition or (has_worker and kept.modules.are_edited)
        ):
            self._close(name)
        if name not in self._handles:
            modules = running_modules()
            handle = kind.open_worker(this_process.worker)
            self._handles[name] = _Handle(edition, kind, modules, handle)
        return self._handles[name].handle

    def close(self) -> None:
        """End all simulators."""
        for name in list(self._handles):
            self._close(name)

    def _close(self, name: str) -> None:
        simulator = self._last.pop(name, None)
        kept = self._handles.pop(name)
        with kept.modules.active():
            if simulator is not None:
                simulator.close()
            kept.kind.close_worker(kept.handle)


def _attributes(simulator: Simulator) -> dict[str, Any]:
    """The attributes of a simulator, or the fields of a Struct, by name. A class with slots has
    none.
    """
    if isinstance(simulator, msgspec.Struct):
        return msgspec.structs.asdict(simulator)
    return dict(getattr(simulator, "__dict__", {}))


def _deep_copy(value: Any) -> Any:
    """A deep copy of a value; the value itself if it cannot be copied, such as a lock."""
    try:
        return deepcopy(value)
    except (TypeError, AttributeError, ValueError, RuntimeError, Error):
        return value


KEPT = Kept()
"""The only `Kept` of this process."""


@atexit.register
def close_simulator() -> None:
    """End the simulators of this process and the processes that they started, even if a simulator
    fails to end.
    """
    with suppress(Exception):
        KEPT.close()
    end_children(this_process.mark)
