"""A scenario from outside the package, held to its contract."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from safevar_sumo.plugins import Contract, Guard, read_only_copy
from safevar_sumo.records import Encounter, Trace
from safevar_sumo.scenarios.base import STEEPEST, Actors, Roads, Scenario, Scene, World

SCENARIO_CONTRACT = Contract.of(Scenario, "a scenario")
LONGEST = 3600.0
"""Of a run [s]."""
FASTEST_TEST = 100.0
"""[m/s]"""


class GuardedScenario:
    """Gives the scenario copies, checks what it returns, and keeps copies of that."""

    def __init__(self, scenario: Any, guard: Guard) -> None:
        self._scenario, self._guard = scenario, guard
        network = guard.field("__init__", scenario, "network")
        if not isinstance(network, str):
            raise guard.wrong("__init__", "network", network, "the name or path of a folder with a network")
        self.network = network
        duration = guard.numbers("__init__", "duration", guard.field("__init__", scenario, "duration"), (), 0.0, LONGEST, above=True)
        self.duration = float(duration)
        grade = guard.numbers("__init__", "grade", getattr(scenario, "grade", 0.0), (), -STEEPEST, STEEPEST)
        speed = getattr(scenario, "test_speed", None)
        self.test_speed = speed if speed is None else float(
            guard.numbers("__init__", "test_speed", speed, (), 0.0, FASTEST_TEST, above=True))
        self.grade, self.pre_crash = float(grade), str(getattr(scenario, "pre_crash", ""))

    def actors(self, roads: Roads) -> Actors:
        """What it makes of the network's traffic; nothing, if it says nothing of that."""
        given = self._guard.call("actors", getattr(self._scenario, "actors", lambda roads: {}), roads)
        if not isinstance(given, Mapping):
            raise self._guard.wrong("actors", "changes", given, "a mapping from XPaths of the traffic file to attributes")
        return {str(path): change if change is None else {str(name): str(value) for name, value in change.items()}
                for path, change in given.items()}

    def remarks(self) -> list[str]:
        """What a user should know of its parameters."""
        return [str(remark) for remark in self._guard.call("remarks", getattr(self._scenario, "remarks", list))]

    def begin(self, world: World) -> Any:
        return self._guard.call("begin", self._scenario.begin, _LentWorld(world))

    def observe(self, world: World, step: float, memory: Any) -> tuple[Scene, Any]:
        n = len(world.vehicle_positions("vut"))
        given = self._guard.call("observe", self._scenario.observe, _LentWorld(world), step, memory)
        theirs, memory = self._guard.parts("observe", given, "(Scene, memory)")
        values: dict[str, Any] = {}
        for name in Scene._fields:
            value = self._guard.field("observe", theirs, name)
            if name in ("over", "visible"):
                values[name] = self._guard.truths("observe", name, value, (n,))
            else:
                values[name] = self._guard.numbers("observe", name, value, (n,), infinite=name == "gap")
        return Scene(**values), memory

    def encounter(self, trace: Trace) -> Encounter:
        given = self._guard.call("encounter", self._scenario.encounter, read_only_copy(trace))
        shape = trace.speed.shape
        values = {name: self._guard.field("encounter", given, name) for name in Encounter._fields}
        in_conflict = self._guard.truths("encounter", "in_conflict", values.pop("in_conflict"), shape)
        counts = in_conflict & trace.active
        numbers = {name: self._guard.numbers("encounter", name, value, shape, infinite=True, undefined=True)
                   for name, value in values.items()}
        for name, found in numbers.items():
            if np.isnan(found[counts]).any():
                raise self._guard.wrong("encounter", name, float("nan"), "numbers wherever in_conflict is true")
        return Encounter(**numbers, in_conflict=in_conflict)


class _LentWorld:
    """The world as the contract has it, and nothing else of it; whoever writes to a result writes to a copy."""

    def __init__(self, world: World) -> None:
        self._world = world

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or not hasattr(World, name):
            raise AttributeError(f"a scenario's world has no {name!r}")
        method = getattr(self._world, name)
        return lambda *arguments: read_only_copy(method(*arguments))
