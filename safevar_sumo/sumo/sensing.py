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
    "vehicle": (*MOTION, "getLaneIndex", "getAcceleration", "getLateralSpeed", "getLateralLanePosition", "getSignals"),
    "person": MOTION,
}
"""TraCI's functions, by domain, that return values of other actors that sensors can measure."""
HELD_FUNCTIONS = ("getAngle", "getSignals", "getLaneIndex")
"""Functions whose values are held between steps instead of interpolated."""

Values = dict[str, Any]
"""An actor's values, by function; of a vehicle its length, too."""


class Snapshot(NamedTuple):
    """The traffic at one time: the vehicle itself, other actors by domain and name, and the leader with its gap [m]."""

    own: Values
    actors: Mapping[str, dict[str, Values]]
    leader: tuple[str, float] | None


class SensedTraffic:
    """The traffic around N vehicles in their copies of the network, delayed and limited by the vehicles' sensors."""

    def __init__(self, world: SumoWorld, step: float) -> None:
        self._world, self._sensors = world, world.sensors
        self._ages = np.round(world.sensors.latency / step, STEP_DECIMALS).tolist()
        self._snapshots = [deque[Snapshot](maxlen=int(age) + 2) for age in self._ages]
        self._sensed_snapshots: dict[int, Snapshot] = {}
        self._names: list[dict[str, list[str]]] | None = None

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
            reach, scale = float(self._sensors.reach[copy]), float(self._sensors.scale[copy])
            self._sensed_snapshots[copy] = _limit_to_range(delayed_snapshot, reach, scale)
        return self._sensed_snapshots[copy]

    def _take_snapshot(self, copy: int) -> Snapshot:
        api, vut = self._world.api, copied_id(copy, VUT)
        if self._world.has_left(vut):
            return Snapshot({}, {domain: {} for domain in SENSED_FUNCTIONS}, None)
        self._names = self._names_by_copy() if self._names is None else self._names
        actors: dict[str, dict[str, Values]] = {}
        for domain, functions in SENSED_FUNCTIONS.items():
            getters = [(name, getattr(getattr(api, domain), name)) for name in (*functions, "getLength")]
            actors[domain] = {
                actor: {name: get(copied_id(copy, actor)) for name, get in getters}
                for actor in self._names[copy][domain]
            }
        own, leader = actors["vehicle"].pop(VUT), api.vehicle.getLeader(vut, LEADER_RANGE)
        return Snapshot(own, actors, (copy_and_name(leader[0])[1], float(leader[1])) if leader and leader[0] else None)

    def _names_by_copy(self) -> list[dict[str, list[str]]]:
        """Names of the actors on the road in each copy, by domain."""
        names: list[dict[str, list[str]]] = [{domain: [] for domain in SENSED_FUNCTIONS} for _ in range(self._world.n)]
        for domain in SENSED_FUNCTIONS:
            for id_ in getattr(self._world.api, domain).getIDList():
                copy, name = copy_and_name(id_)
                if copy < len(names):
                    names[copy][domain].append(name)
        return names


def _limit_to_range(snapshot: Snapshot, reach: float, scale: float) -> Snapshot:
    """The snapshot without actors beyond the sensors' range, and with distances multiplied by the sensors' scale."""
    if not snapshot.own or (reach == math.inf and scale == 1):
        return snapshot
    position = snapshot.own["getPosition"]
    actors = {
        domain: {
            name: _scale_values(values, snapshot.own, scale)
            for name, values in members.items()
            if _distance(position, values, values["getLength"] * (domain == "vehicle")) <= reach
        }
        for domain, members in snapshot.actors.items()
    }
    leader = snapshot.leader if snapshot.leader and snapshot.leader[0] in actors["vehicle"] else None
    return Snapshot(snapshot.own, actors, leader and (leader[0], leader[1] * scale))


def _distance(position: tuple[float, float], values: Values, length: float) -> float:
    """Distance from a position to the line between front and rear of an actor, `length` apart [m]; 0 for a person."""
    heading = math.radians(values["getAngle"])
    rearward = -math.sin(heading), -math.cos(heading)
    x, y = (position[i] - values["getPosition"][i] for i in range(2))
    along = min(max(x * rearward[0] + y * rearward[1], 0.0), length)
    return math.hypot(x - along * rearward[0], y - along * rearward[1])


def _scale_values(values: Values, own: Values, scale: float) -> Values:
    def scaled(function: str) -> Any:
        pairs = zip(own[function], values[function], strict=True)
        return tuple(here + scale * (there - here) for here, there in pairs)

    if scale == 1:
        return values
    result = {**values, "getPosition": scaled("getPosition"), "getPosition3D": scaled("getPosition3D")}
    if values["getRoadID"] == own["getRoadID"]:
        here, there = own["getLanePosition"], values["getLanePosition"]
        result["getLanePosition"] = here + scale * (there - here)
    return result


def _delay_snapshot(snapshots: deque[Snapshot], age: float) -> Snapshot:
    """The snapshot `age` steps ago, linear between two steps; the first snapshot if `age` exceeds the steps so far."""
    steps, fraction = divmod(age, 1)
    newest = len(snapshots) - 1
    after, before = snapshots[max(newest - int(steps), 0)], snapshots[max(newest - int(steps) - 1, 0)]
    if not fraction or after is before or not after.own:
        return after
    actors = {
        domain: {
            name: _interpolate_values(after.actors[domain].get(name, values), values, fraction)
            for name, values in members.items()
        }
        for domain, members in before.actors.items()
    }
    leader = before.leader
    if after.leader and leader and after.leader[0] == leader[0]:
        leader = leader[0], _interpolate(after.leader[1], leader[1], fraction)
    return Snapshot(_interpolate_values(after.own, before.own, fraction), actors, leader)


def _interpolate_values(after: Values, before: Values, fraction: float) -> Values:
    is_same_lane = after["getLaneID"] == before["getLaneID"]
    held = HELD_FUNCTIONS if is_same_lane else (*HELD_FUNCTIONS, "getLanePosition", "getLateralLanePosition")
    return {
        function: old if function in held else _interpolate(after[function], old, fraction)
        for function, old in before.items()
    }


def _interpolate(after: Any, before: Any, fraction: float) -> Any:
    if isinstance(before, float):
        return after + (before - after) * fraction
    if isinstance(before, tuple):
        return tuple(_interpolate(new, old, fraction) for new, old in zip(after, before, strict=True))
    return before
