"""What the sensors of N vehicles leave of the others to controllers that read the world themselves: late, and within reach."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.scenarios import VUT
from safevar_sumo.sumo.copies import copied_id, copy_and_name
from safevar_sumo.sumo.world import SumoWorld

LOOKS_AHEAD = 1000.0  # m, for a leader
STEP_DECIMALS = 6  # of a delay in steps: a whole number of steps is whole
PLACE = ("getPosition", "getPosition3D", "getSpeed", "getAngle", "getRoadID", "getLaneID", "getLanePosition")
SENSED: Mapping[str, tuple[str, ...]] = {
    "vehicle": (*PLACE, "getLaneIndex", "getAcceleration", "getLateralSpeed", "getLateralLanePosition", "getSignals"), "person": PLACE}
"""TraCI's functions that tell what sensors can tell of others, by domain."""
STEADY = ("getAngle", "getSignals", "getLaneIndex")
"""Of them those between whose values there is nothing: they stay until they change."""

Values = dict[str, Any]
"""What one function after the other tells of somebody."""


class Look(NamedTuple):
    """One look around: the vehicle itself, others by their names in the traffic file, and the leader with the gap to it [m]."""

    own: Values
    vehicle: dict[str, Values]
    person: dict[str, Values]
    leader: tuple[str, float] | None

    def others(self, domain: str) -> dict[str, Values]:
        return self.vehicle if domain == "vehicle" else self.person


NOTHING = Look({}, {}, {}, None)


class Sensing:
    """Looks of N vehicles around their copies of the network, and what of them their sensors have told so far."""

    def __init__(self, world: SumoWorld, step: float) -> None:
        self._world, self._sensors = world, world.sensors
        self._age = np.round(world.sensors.latency / step, STEP_DECIMALS).tolist()
        self._looks = [deque[Look](maxlen=int(age) + 2) for age in self._age]
        self._seen: dict[int, Look] = {}
        self._present: list[dict[str, list[str]]] | None = None
        self._lengths: dict[str, float] = {}

    def look(self) -> None:
        """Take note of this step; every step has to be noted."""
        self._seen, self._present = {}, None
        for copy, age in enumerate(self._age):
            if age > 0:
                self._looks[copy].append(self._look(copy))

    def seen(self, copy: int) -> Look:
        """What a vehicle's sensors tell now."""
        if copy not in self._seen:
            looks, age = self._looks[copy], self._age[copy]
            late = _between(looks, age) if age > 0 else self._look(copy)
            self._seen[copy] = self._within_reach(late, copy)
        return self._seen[copy]

    def _look(self, copy: int) -> Look:
        api, vut = self._world.api, copied_id(copy, VUT)
        if self._world.has_left(vut):
            return NOTHING
        if self._present is None:
            self._present = self._by_copy()
        values = {kind: {name: {function: getattr(getattr(api, kind), function)(copied_id(copy, name)) for function in SENSED[kind]}
                         for name in names} for kind, names in self._present[copy].items()}
        own = values["vehicle"].pop(VUT)
        leader = api.vehicle.getLeader(vut, LOOKS_AHEAD)
        found = (copy_and_name(leader[0])[1], float(leader[1])) if leader and leader[0] else None
        return Look(own, values["vehicle"], values["person"], found)

    def _by_copy(self) -> list[dict[str, list[str]]]:
        """Who is about in each copy."""
        found: list[dict[str, list[str]]] = [{kind: [] for kind in SENSED} for _ in range(self._world.n)]
        for kind in SENSED:
            for one in getattr(self._world.api, kind).getIDList():
                copy, name = copy_and_name(one)
                if copy < len(found):
                    found[copy][kind].append(name)
        return found

    def _within_reach(self, look: Look, copy: int) -> Look:
        """Without those who are too far away, the others as far away as the sensors have it."""
        reach, scale = float(self._sensors.reach[copy]), float(self._sensors.scale[copy])
        if not look.own or (reach == math.inf and scale == 1):
            return look
        here = look.own["getPosition"]

        def sensed(kind: str) -> dict[str, Values]:
            return {name: _scaled(values, look.own, scale) for name, values in look.others(kind).items()
                    if _distance(here, values, self._length(kind, copy, name)) <= reach}

        vehicles = sensed("vehicle")
        leader = (look.leader[0], look.leader[1] * scale) if look.leader and look.leader[0] in vehicles else None
        return Look(look.own, vehicles, sensed("person"), leader)

    def _length(self, kind: str, copy: int, name: str) -> float:
        """From the point that SUMO calls the position, a vehicle's front bumper, backwards [m]."""
        if kind == "person":
            return 0.0
        if name not in self._lengths:
            self._lengths[name] = float(self._world.api.vehicle.getLength(copied_id(copy, name)))
        return self._lengths[name]


def _distance(here: tuple[float, float], values: Values, length: float) -> float:
    """From a point to the nearest one of the line from somebody's front to the back [m]."""
    heading = math.radians(values["getAngle"])
    back = -math.sin(heading), -math.cos(heading)
    x, y = (here[i] - values["getPosition"][i] for i in range(2))
    along = min(max(x * back[0] + y * back[1], 0.0), length)
    return math.hypot(x - along * back[0], y - along * back[1])


def _scaled(values: Values, own: Values, scale: float) -> Values:
    if scale == 1:
        return values
    found = dict(values)
    for name in ("getPosition", "getPosition3D"):
        found[name] = tuple(mine + scale * (theirs - mine) for mine, theirs in zip(own[name], values[name], strict=True))
    if values["getRoadID"] == own["getRoadID"]:
        found["getLanePosition"] = own["getLanePosition"] + scale * (values["getLanePosition"] - own["getLanePosition"])
    return found


def _between(looks: deque[Look], age: float) -> Look:
    """What was seen so many steps ago, linear between two of them; before the first one nothing was different."""
    whole, part = divmod(age, 1)
    newest = len(looks) - 1
    after, before = looks[max(newest - int(whole), 0)], looks[max(newest - int(whole) - 1, 0)]
    if not part or after is before or not after.own:
        return after
    others = {kind: {name: _mixed(after.others(kind).get(name, values), values, part) for name, values in before.others(kind).items()}
              for kind in SENSED}
    same = after.leader and before.leader and after.leader[0] == before.leader[0]
    leader = (before.leader[0], _linear(after.leader[1], before.leader[1], part)) if same else before.leader  # type: ignore[index]
    return Look(_mixed(after.own, before.own, part), others["vehicle"], others["person"], leader)


def _mixed(after: Values, before: Values, part: float) -> Values:
    steady = STEADY if after["getLaneID"] == before["getLaneID"] else (*STEADY, "getLanePosition", "getLateralLanePosition")
    return {name: old if name in steady else _linear(after[name], old, part) for name, old in before.items()}


def _linear(after: Any, before: Any, part: float) -> Any:
    if isinstance(before, float):
        return after + (before - after) * part
    if isinstance(before, tuple):
        return tuple(_linear(new, old, part) for new, old in zip(after, before, strict=True))
    return before
