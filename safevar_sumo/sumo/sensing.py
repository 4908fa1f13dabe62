"""Other actors as N vehicles sense them, with latency and limited range, for controllers that read the world themselves."""

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


class Look(NamedTuple):
    """One observation: values of the vehicle itself and of other actors, by name in the traffic file; the leader and its gap [m]."""

    own_values: Values
    vehicle: dict[str, Values]
    person: dict[str, Values]
    leader: tuple[str, float] | None

    def actors(self, domain: str) -> dict[str, Values]:
        return self.vehicle if domain == "vehicle" else self.person


EMPTY_LOOK = Look({}, {}, {}, None)


class Sensing:
    """Observations of N vehicles in their copies of the network, delayed and limited by their sensors."""

    def __init__(self, world: SumoWorld, step: float) -> None:
        self._world, self._sensors = world, world.sensors
        self._ages = np.round(world.sensors.latency / step, STEP_DECIMALS).tolist()
        self._looks = [deque[Look](maxlen=int(age) + 2) for age in self._ages]
        self._sensed_looks: dict[int, Look] = {}
        self._names: list[dict[str, list[str]]] | None = None
        self._lengths: dict[str, float] = {}

    def record_step(self) -> None:
        """Record what there is to observe in this step; must be called in every step."""
        self._sensed_looks, self._names = {}, None
        for copy, age in enumerate(self._ages):
            if age > 0:
                self._looks[copy].append(self._look(copy))

    def sensed_look(self, copy: int) -> Look:
        """What the sensors of a vehicle report now."""
        if copy not in self._sensed_looks:
            looks, age = self._looks[copy], self._ages[copy]
            delayed_look = _delayed_look(looks, age) if age > 0 else self._look(copy)
            self._sensed_looks[copy] = self._look_in_range(delayed_look, copy)
        return self._sensed_looks[copy]

    def _look(self, copy: int) -> Look:
        api, vut = self._world.api, copied_id(copy, VUT)
        if self._world.has_left(vut):
            return EMPTY_LOOK
        if self._names is None:
            self._names = self._names_by_copy()
        values = {kind: {name: {function: getattr(getattr(api, kind), function)(copied_id(copy, name)) for function in functions}
                         for name in self._names[copy][kind]} for kind, functions in SENSED_FUNCTIONS.items()}
        own_values = values["vehicle"].pop(VUT)
        leader = api.vehicle.getLeader(vut, LEADER_RANGE)
        named_leader = (copy_and_name(leader[0])[1], float(leader[1])) if leader and leader[0] else None
        return Look(own_values, values["vehicle"], values["person"], named_leader)

    def _names_by_copy(self) -> list[dict[str, list[str]]]:
        """Names of the actors on the road in each copy, by domain."""
        names: list[dict[str, list[str]]] = [{kind: [] for kind in SENSED_FUNCTIONS} for _ in range(self._world.n)]
        for kind in SENSED_FUNCTIONS:
            for id_ in getattr(self._world.api, kind).getIDList():
                copy, name = copy_and_name(id_)
                if copy < len(names):
                    names[copy][kind].append(name)
        return names

    def _look_in_range(self, look: Look, copy: int) -> Look:
        """The observation without actors beyond the sensors' range, and with distances multiplied by the sensors' scale."""
        reach, scale = float(self._sensors.reach[copy]), float(self._sensors.scale[copy])
        if not look.own_values or (reach == math.inf and scale == 1):
            return look
        own_position = look.own_values["getPosition"]

        def actors_in_range(kind: str) -> dict[str, Values]:
            return {name: _scaled_values(values, look.own_values, scale) for name, values in look.actors(kind).items()
                    if _distance(own_position, values, self._length(kind, copy, name)) <= reach}

        vehicles = actors_in_range("vehicle")
        leader = (look.leader[0], look.leader[1] * scale) if look.leader and look.leader[0] in vehicles else None
        return Look(look.own_values, vehicles, actors_in_range("person"), leader)

    def _length(self, kind: str, copy: int, name: str) -> float:
        """How far an actor extends behind its position in SUMO [m]: a vehicle by its length, a person by 0."""
        if kind == "person":
            return 0.0
        if name not in self._lengths:
            self._lengths[name] = float(self._world.api.vehicle.getLength(copied_id(copy, name)))
        return self._lengths[name]


def _distance(point: tuple[float, float], values: Values, length: float) -> float:
    """Distance from a point to the line between the front and the rear of an actor [m]."""
    heading = math.radians(values["getAngle"])
    rearward = -math.sin(heading), -math.cos(heading)
    x, y = (point[i] - values["getPosition"][i] for i in range(2))
    along = min(max(x * rearward[0] + y * rearward[1], 0.0), length)
    return math.hypot(x - along * rearward[0], y - along * rearward[1])


def _scaled_values(values: Values, own_values: Values, scale: float) -> Values:
    if scale == 1:
        return values
    result = dict(values)
    for name in ("getPosition", "getPosition3D"):
        result[name] = tuple(own + scale * (other - own) for own, other in zip(own_values[name], values[name], strict=True))
    if values["getRoadID"] == own_values["getRoadID"]:
        result["getLanePosition"] = own_values["getLanePosition"] + scale * (values["getLanePosition"] - own_values["getLanePosition"])
    return result


def _delayed_look(looks: deque[Look], age: float) -> Look:
    """The observation `age` steps ago, interpolated linearly between two steps; the first observation if `age` exceeds the steps so far."""
    steps, fraction = divmod(age, 1)
    newest = len(looks) - 1
    after, before = looks[max(newest - int(steps), 0)], looks[max(newest - int(steps) - 1, 0)]
    if not fraction or after is before or not after.own_values:
        return after
    actors = {kind: {name: _interpolated_values(after.actors(kind).get(name, values), values, fraction)
                     for name, values in before.actors(kind).items()} for kind in SENSED_FUNCTIONS}
    is_same = after.leader and before.leader and after.leader[0] == before.leader[0]
    leader = (before.leader[0], _interpolate(after.leader[1], before.leader[1], fraction)) if is_same else before.leader  # type: ignore[index]
    own_values = _interpolated_values(after.own_values, before.own_values, fraction)
    return Look(own_values, actors["vehicle"], actors["person"], leader)


def _interpolated_values(after: Values, before: Values, fraction: float) -> Values:
    is_same_lane = after["getLaneID"] == before["getLaneID"]
    held_functions = HELD_FUNCTIONS if is_same_lane else (*HELD_FUNCTIONS, "getLanePosition", "getLateralLanePosition")
    return {name: old if name in held_functions else _interpolate(after[name], old, fraction) for name, old in before.items()}


def _interpolate(after: Any, before: Any, fraction: float) -> Any:
    if isinstance(before, float):
        return after + (before - after) * fraction
    if isinstance(before, tuple):
        return tuple(_interpolate(new, old, fraction) for new, old in zip(after, before, strict=True))
    return before
