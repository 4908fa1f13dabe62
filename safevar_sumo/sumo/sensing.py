"""Other actors as N vehicles sense them, with latency and limited range, for controllers that read SUMO themselves."""

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

LEADER_RANGE = 1000.0  # distance within which SUMO looks for a leader [m]
MOTION = ("getPosition", "getPosition3D", "getSpeed", "getAngle", "getRoadID", "getLaneID", "getLanePosition")
SENSED_FUNCTIONS: Mapping[str, tuple[str, ...]] = {
    "vehicle": (*MOTION, "getLaneIndex", "getAcceleration", "getLateralSpeed", "getLateralLanePosition", "getSignals"), "person": MOTION}
"""TraCI's functions, by domain, that return values of other actors that sensors can measure."""
HELD_FUNCTIONS = ("getAngle", "getSignals", "getLaneIndex")
"""Functions whose values are held between steps instead of interpolated."""

Values = dict[str, Any]
"""An actor's values, by function."""


class Snapshot(NamedTuple):
    """The traffic at one time: values of the vehicle itself, values of other actors by name, and the leader with its gap [m]."""

    own_values: Values
    vehicle: dict[str, Values]
    person: dict[str, Values]
    leader: tuple[str, float] | None

    def actors(self, domain: str) -> dict[str, Values]:
        return self.vehicle if domain == "vehicle" else self.person


EMPTY_SNAPSHOT = Snapshot({}, {}, {}, None)


class SensedTraffic:
    """The traffic around N vehicles in their copies of the network, delayed and limited by the vehicles' sensors."""

    def __init__(self, world: SumoWorld, step: float) -> None:
        self._world, self._sensors = world, world.sensors
        self._ages = np.round(world.sensors.latency / step, STEP_DECIMALS).tolist()
        self._snapshots = [deque[Snapshot](maxlen=int(age) + 2) for age in self._ages]
        self._sensed_snapshots: dict[int, Snapshot] = {}
        self._names: list[dict[str, list[str]]] | None = None
        self._lengths: dict[str, float] = {}

    def record_step(self) -> None:
        """Record the traffic of this step; must be called in every step."""
        self._sensed_snapshots, self._names = {}, None
        for copy, age in enumerate(self._ages):
            if age > 0:
                self._snapshots[copy].append(self._take_snapshot(copy))

    def snapshot(self, copy: int) -> Snapshot:
        """What the sensors of a vehicle report now."""
        if copy not in self._sensed_snapshots:
            snapshots, age = self._snapshots[copy], self._ages[copy]
            delayed_snapshot = _delay_snapshot(snapshots, age) if age > 0 else self._take_snapshot(copy)
            self._sensed_snapshots[copy] = self._limit_to_range(delayed_snapshot, copy)
        return self._sensed_snapshots[copy]

    def _take_snapshot(self, copy: int) -> Snapshot:
        api, vut = self._world.api, copied_id(copy, VUT)
        if self._world.has_left(vut):
            return EMPTY_SNAPSHOT
        if self._names is None:
            self._names = self._names_by_copy()
        values = {domain: {name: {function: getattr(getattr(api, domain), function)(copied_id(copy, name)) for function in functions}
                         for name in self._names[copy][domain]} for domain, functions in SENSED_FUNCTIONS.items()}
        own_values = values["vehicle"].pop(VUT)
        leader = api.vehicle.getLeader(vut, LEADER_RANGE)
        named_leader = (copy_and_name(leader[0])[1], float(leader[1])) if leader and leader[0] else None
        return Snapshot(own_values, values["vehicle"], values["person"], named_leader)

    def _names_by_copy(self) -> list[dict[str, list[str]]]:
        """Names of the actors on the road in each copy, by domain."""
        names: list[dict[str, list[str]]] = [{domain: [] for domain in SENSED_FUNCTIONS} for _ in range(self._world.n)]
        for domain in SENSED_FUNCTIONS:
            for id_ in getattr(self._world.api, domain).getIDList():
                copy, name = copy_and_name(id_)
                if copy < len(names):
                    names[copy][domain].append(name)
        return names

    def _limit_to_range(self, snapshot: Snapshot, copy: int) -> Snapshot:
        """The snapshot without actors beyond the sensors' range, and with distances multiplied by the sensors' scale."""
        reach, scale = float(self._sensors.reach[copy]), float(self._sensors.scale[copy])
        if not snapshot.own_values or (reach == math.inf and scale == 1):
            return snapshot
        own_position = snapshot.own_values["getPosition"]

        def actors_in_range(domain: str) -> dict[str, Values]:
            return {name: _scale_values(values, snapshot.own_values, scale) for name, values in snapshot.actors(domain).items()
                    if _distance(own_position, values, self._length(domain, copy, name)) <= reach}

        vehicles = actors_in_range("vehicle")
        leader = (snapshot.leader[0], snapshot.leader[1] * scale) if snapshot.leader and snapshot.leader[0] in vehicles else None
        return Snapshot(snapshot.own_values, vehicles, actors_in_range("person"), leader)

    def _length(self, domain: str, copy: int, name: str) -> float:
        """Distance from an actor's position in SUMO to its rear [m]: a vehicle's length, 0 for a person."""
        if domain == "person":
            return 0.0
        if name not in self._lengths:
            self._lengths[name] = float(self._world.api.vehicle.getLength(copied_id(copy, name)))
        return self._lengths[name]


def _distance(position: tuple[float, float], values: Values, length: float) -> float:
    """Distance from a position to the line between the front and the rear of an actor [m]."""
    heading = math.radians(values["getAngle"])
    rearward = -math.sin(heading), -math.cos(heading)
    x, y = (position[i] - values["getPosition"][i] for i in range(2))
    along = min(max(x * rearward[0] + y * rearward[1], 0.0), length)
    return math.hypot(x - along * rearward[0], y - along * rearward[1])


def _scale_values(values: Values, own_values: Values, scale: float) -> Values:
    if scale == 1:
        return values
    result = dict(values)
    for function in ("getPosition", "getPosition3D"):
        result[function] = tuple(own + scale * (other - own) for own, other in zip(own_values[function], values[function], strict=True))
    if values["getRoadID"] == own_values["getRoadID"]:
        result["getLanePosition"] = own_values["getLanePosition"] + scale * (values["getLanePosition"] - own_values["getLanePosition"])
    return result


def _delay_snapshot(snapshots: deque[Snapshot], age: float) -> Snapshot:
    """The snapshot `age` steps ago, interpolated linearly between two steps; the first snapshot if `age` exceeds the steps so far."""
    steps, fraction = divmod(age, 1)
    newest = len(snapshots) - 1
    after, before = snapshots[max(newest - int(steps), 0)], snapshots[max(newest - int(steps) - 1, 0)]
    if not fraction or after is before or not after.own_values:
        return after
    actors = {domain: {name: _interpolate_values(after.actors(domain).get(name, values), values, fraction)
                     for name, values in before.actors(domain).items()} for domain in SENSED_FUNCTIONS}
    same_leader = after.leader and before.leader and after.leader[0] == before.leader[0]
    leader = (before.leader[0], _interpolate(after.leader[1], before.leader[1], fraction)) if same_leader else before.leader  # type: ignore[index]
    own_values = _interpolate_values(after.own_values, before.own_values, fraction)
    return Snapshot(own_values, actors["vehicle"], actors["person"], leader)


def _interpolate_values(after: Values, before: Values, fraction: float) -> Values:
    is_same_lane = after["getLaneID"] == before["getLaneID"]
    held = HELD_FUNCTIONS if is_same_lane else (*HELD_FUNCTIONS, "getLanePosition", "getLateralLanePosition")
    return {function: old if function in held else _interpolate(after[function], old, fraction) for function, old in before.items()}


def _interpolate(after: Any, before: Any, fraction: float) -> Any:
    if isinstance(before, float):
        return after + (before - after) * fraction
    if isinstance(before, tuple):
        return tuple(_interpolate(new, old, fraction) for new, old in zip(after, before, strict=True))
    return before
