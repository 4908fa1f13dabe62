"""Other actors as sensed by N vehicles, for controllers that read the world themselves: with latency and limited range."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.ads.driver import STEP_DECIMALS
from safevar_sumo.scenarios import VUT
from safevar_sumo.sumo.copies import copied_id, copy_and_name
from safevar_sumo.sumo.world import SumoWorld

LEADER_RANGE = 1000.0  # m, within which SUMO looks for a leader
PLACE = ("getPosition", "getPosition3D", "getSpeed", "getAngle", "getRoadID", "getLaneID", "getLanePosition")
SENSED: Mapping[str, tuple[str, ...]] = {
    "vehicle": (*PLACE, "getLaneIndex", "getAcceleration", "getLateralSpeed", "getLateralLanePosition", "getSignals"), "person": PLACE}
"""TraCI's functions whose values of other actors sensors can measure, by domain."""
STEADY = ("getAngle", "getSignals", "getLaneIndex")
"""Those of these functions whose values are not interpolated: they stay until they change."""

Values = dict[str, Any]
"""Values of an actor by function."""


class Look(NamedTuple):
    """One observation: the vehicle itself, other actors by their names in the traffic file, and the leader with the gap to it [m]."""

    own: Values
    vehicle: dict[str, Values]
    person: dict[str, Values]
    leader: tuple[str, float] | None

    def others(self, domain: str) -> dict[str, Values]:
        return self.vehicle if domain == "vehicle" else self.person


NOTHING = Look({}, {}, {}, None)


class Sensing:
    """Observations of N vehicles in their copies of the network, delayed and limited by their sensors."""

    def __init__(self, world: SumoWorld, step: float) -> None:
        self._world, self._sensors = world, world.sensors
        self._age = np.round(world.sensors.latency / step, STEP_DECIMALS).tolist()
        self._looks = [deque[Look](maxlen=int(age) + 2) for age in self._age]
        self._seen: dict[int, Look] = {}
        self._present: list[dict[str, list[str]]] | None = None
        self._lengths: dict[str, float] = {}

    def look(self) -> None:
        """Record this step; must be called in every step."""
        self._seen, self._present = {}, None
        for copy, age in enumerate(self._age):
            if age > 0:
                self._looks[copy].append(self._look(copy))

    def seen(self, copy: int) -> Look:
        """The observation of a vehicle through its sensors now."""
        if copy not in self._seen:
            looks, age = self._looks[copy], self._age[copy]
            late = _between(looks, age) if age > 0 else self._look(copy)
            self._seen[copy] = self._within_range(late, copy)
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
        leader = api.vehicle.getLeader(vut, LEADER_RANGE)
        named_leader = (copy_and_name(leader[0])[1], float(leader[1])) if leader and leader[0] else None
        return Look(own, values["vehicle"], values["person"], named_leader)

    def _by_copy(self) -> list[dict[str, list[str]]]:
        """Names of the actors on the road in each copy, by domain."""
        names: list[dict[str, list[str]]] = [{kind: [] for kind in SENSED} for _ in range(self._world.n)]
        for kind in SENSED:
            for id_ in getattr(self._world.api, kind).getIDList():
                copy, name = copy_and_name(id_)
                if copy < len(names):
                    names[copy][kind].append(name)
        return names

    def _within_range(self, look: Look, copy: int) -> Look:
        """The observation without actors beyond the range, and with distances scaled as the sensors measure them."""
        reach, scale = float(self._sensors.reach[copy]), float(self._sensors.scale[copy])
        if not look.own or (reach == math.inf and scale == 1):
            return look
        own_position = look.own["getPosition"]

        def sensed(kind: str) -> dict[str, Values]:
            return {name: _scaled(values, look.own, scale) for name, values in look.others(kind).items()
                    if _distance(own_position, values, self._length(kind, copy, name)) <= reach}

        vehicles = sensed("vehicle")
        leader = (look.leader[0], look.leader[1] * scale) if look.leader and look.leader[0] in vehicles else None
        return Look(look.own, vehicles, sensed("person"), leader)

    def _length(self, kind: str, copy: int, name: str) -> float:
        """Length of an actor behind its SUMO position, which is a vehicle's front bumper; 0 for persons [m]."""
        if kind == "person":
            return 0.0
        if name not in self._lengths:
            self._lengths[name] = float(self._world.api.vehicle.getLength(copied_id(copy, name)))
        return self._lengths[name]


def _distance(point: tuple[float, float], values: Values, length: float) -> float:
    """Distance from a point to the line between an actor's front and back [m]."""
    heading = math.radians(values["getAngle"])
    back = -math.sin(heading), -math.cos(heading)
    x, y = (point[i] - values["getPosition"][i] for i in range(2))
    along = min(max(x * back[0] + y * back[1], 0.0), length)
    return math.hypot(x - along * back[0], y - along * back[1])


def _scaled(values: Values, own: Values, scale: float) -> Values:
    if scale == 1:
        return values
    result = dict(values)
    for name in ("getPosition", "getPosition3D"):
        result[name] = tuple(mine + scale * (other - mine) for mine, other in zip(own[name], values[name], strict=True))
    if values["getRoadID"] == own["getRoadID"]:
        result["getLanePosition"] = own["getLanePosition"] + scale * (values["getLanePosition"] - own["getLanePosition"])
    return result


def _between(looks: deque[Look], age: float) -> Look:
    """The observation `age` steps ago, interpolated linearly between two steps; before the first step the first one holds."""
    steps, fraction = divmod(age, 1)
    newest = len(looks) - 1
    after, before = looks[max(newest - int(steps), 0)], looks[max(newest - int(steps) - 1, 0)]
    if not fraction or after is before or not after.own:
        return after
    others = {kind: {name: _interpolated(after.others(kind).get(name, values), values, fraction)
                     for name, values in before.others(kind).items()} for kind in SENSED}
    same = after.leader and before.leader and after.leader[0] == before.leader[0]
    leader = (before.leader[0], _linear(after.leader[1], before.leader[1], fraction)) if same else before.leader  # type: ignore[index]
    return Look(_interpolated(after.own, before.own, fraction), others["vehicle"], others["person"], leader)


def _interpolated(after: Values, before: Values, fraction: float) -> Values:
    steady = STEADY if after["getLaneID"] == before["getLaneID"] else (*STEADY, "getLanePosition", "getLateralLanePosition")
    return {name: old if name in steady else _linear(after[name], old, fraction) for name, old in before.items()}


def _linear(after: Any, before: Any, fraction: float) -> Any:
    if isinstance(before, float):
        return after + (before - after) * fraction
    if isinstance(before, tuple):
        return tuple(_linear(new, old, fraction) for new, old in zip(after, before, strict=True))
    return before
