"""The two scenarios of the published study: a pedestrian walks into the lane, and parked vehicles
block both lanes.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta
from msgspec.structs import replace

from safevar_sumo.errors import InputError
from safevar_sumo.records import (
    KMH_PER_MS,
    BoolArray,
    Encounter,
    FloatArray,
    Quantity,
    Trace,
)
from safevar_sumo.scenarios.ahead import CarToCar
from safevar_sumo.scenarios.base import (
    CROSSING_LANE,
    PEDESTRIAN,
    VUT,
    Grade,
    Layout,
    PreCrash,
    Scenario,
    Scene,
    WorldScenario,
    XmlChanges,
    as_text,
)
from safevar_sumo.scenarios.crossing import Crossing
from safevar_sumo.scenarios.roads import NETWORK_KEY, Frame, Roads, World
from safevar_sumo.study import Table, searched

_Positive = Annotated[float, Meta(gt=0, le=3600)]
TURN_ROUNDING = 1e-6
"""How far a pedestrian may get beyond the place of the turn by rounding errors [m]."""
VUT_LANE = "approach_0"
"""Id of the lane of the vehicle under test before the crossing."""
FOOTPATH_LANE = "footpath_0"
"""Id of the lane on which the pedestrian starts."""
WALKING_SPEED = 1.8
"""The pedestrian's speed in the traffic file [m/s]."""
LATERAL_START = 5.16
"""The pedestrian's start in the traffic file, to the right of the lane's middle [m]."""
SLOW_SPEEDS = (10.0, 15.0, 20.0)
"""Speeds of benign scenes, near which vehicles reach the pedestrian [km/h]."""
BENIGN_TIME = 7.0
"""Time from the start of a benign scene until the vehicle reaches the pedestrian's path, unless a
slow pedestrian needs more [s].
"""
CITY_SPEEDS = (20.0, 30.0, 35.0, 40.0, 45.0, 50.0, 55.0, 60.0)
"""Speeds of benign scenes with a car in the next lane [km/h]. (The tested vehicle starts at
rest.)
"""


def approach(roads: Roads | World) -> Frame:
    """The coordinates of the vehicle's lane before the crossing."""
    return Frame.of(roads.lane(VUT_LANE))


def _place(position: float, name: str) -> str:
    """A departure position [m] as text for SUMO. SUMO would count a position below 0 from the
    lane's end: such a position is refused, and the error names the parameter `name`.
    """
    if position < 0:
        raise InputError(
            "scenario.parameters",
            f"{name} is {-position:.2f} m longer than the lane before the encounter",
            f"a smaller {name}",
        )
    return as_text(position)


class _Memory(NamedTuple):
    """The scenario's memory of a run.

    Attributes
    ----------
    frame
        Coordinates along and across the vehicle's lane.
    conflict_point, clear_point
        Positions of the vehicle's front at which the conflict begins and ends [m].
    last_lateral
        Lateral positions of the pedestrians at the last step [m], shape (N,).
    has_turned
        Whether each pedestrian has turned round, shape (N,).
    """

    frame: Frame
    conflict_point: float
    clear_point: float
    last_lateral: FloatArray
    has_turned: BoolArray


class PedestrianCrossing(WorldScenario, Table, frozen=True, kw_only=True):
    """A pedestrian crosses the lane at right angles, turns round and walks back, without reacting
    to the vehicle.

    Parameters
    ----------
    duration
        Duration of a simulation [s].
    turns_after
        Distance past the middle of the lane at which the pedestrian turns round [m]; None if the
        pedestrian walks on.
    lane_width
        Width of the lane [m]: the pedestrian leaves the lane at half of this width from the middle.
    distance
        Gap at the start, from the front bumper to the middle of the pedestrian's path [m].
    walking_speed, lateral_start
        The pedestrian's speed [m/s], and start to the right of the lane's middle [m].
    grade
        Rise of the road over its length, negative downhill [%].

    Notes
    -----
    Positions, speed and the turn are by default those of the traffic file, from the published
    study's package.
    """

    network: str = "pedestrian_crossing"
    duration: _Positive = 9.5
    turns_after: float | None = 0.7
    lane_width: _Positive = 3.5
    distance: (
        Annotated[
            _Positive,
            searched(
                6.0,
                30.0,
                "m",
                "gap at the start, from the front bumper to the middle of the pedestrian's path",
            ),
        ]
        | None
    ) = None
    walking_speed: (
        Annotated[_Positive, searched(0.5, 2.5, "m/s", "speed of the pedestrian")]
        | None
    ) = None
    lateral_start: (
        Annotated[
            _Positive,
            searched(
                4.0,
                13.0,
                "m",
                "start of the pedestrian, to the right of the lane's middle",
            ),
        ]
        | None
    ) = None
    grade: Grade = 0.0
    reactive_actors = False
    pre_crash = PreCrash.PEDESTRIAN_AFTER_MANOEUVRE

    def actors(self, roads: Roads) -> XmlChanges:
        """Set the vehicle's position, and the pedestrian's start and speed, if the study states
        them.
        """
        changes = {}
        if self.distance is not None:
            changes["vehicle[@id='vut']"] = {
                "departPos": _place(self._front(roads), "distance")
            }
        if self.lateral_start is not None:
            _, footpath = approach(roads).lane_coordinates(
                roads.lane(FOOTPATH_LANE).start
            )
            start = _place(-footpath - self.lateral_start, "lateral_start")
            changes["person[@id='pedestrian']"] = {"departPos": start}
        if self.walking_speed is not None:
            changes["person[@id='pedestrian']/walk"] = {
                "speed": as_text(self.walking_speed)
            }
        return changes

    def _front(self, roads: Roads) -> Quantity:
        """Position of the vehicle's front on its lane at the start [m]; None if the traffic file
        states it.
        """
        if self.distance is None:
            return None
        return approach(roads).crossing_position(roads, CROSSING_LANE) - self.distance

    def benign(self) -> Iterable[tuple[str, Scenario]]:
        """Scenes with a pedestrian of the same speed, and vehicles at the `SLOW_SPEEDS`. The
        pedestrian stops before the vehicle's path, or leaves the path in time.
        """
        speed = self.walking_speed or WALKING_SPEED
        # A slower pedestrian needs more time from the footpath to the vehicle's path.
        time = BENIGN_TIME * max(WALKING_SPEED / speed, 1.0)
        adult = Crossing(
            test="CPNA", target_speed=speed * KMH_PER_MS, time_to_impact=time
        )
        for walk, slow in product((adult, replace(adult, test="CPFA")), SLOW_SPEEDS):
            yield from replace(walk, speed=slow).benign()

    def layout(self, roads: Roads, step: float, samples: int) -> Layout:
        times = np.arange(samples)[:, np.newaxis]
        speed = self.walking_speed
        start = self.lateral_start
        if speed is None:
            speed = WALKING_SPEED
        if start is None:
            start = LATERAL_START
        lateral = speed * step * times - start
        if self.turns_after is None:
            return Layout(self._front(roads), PEDESTRIAN, lateral, speed)

        is_past = lateral > self.turns_after + TURN_ROUNDING
        turn = np.where(is_past[-1], np.argmax(is_past, axis=0), samples)
        # At the sample of the turn, the pedestrian is back at the place of two steps before.
        back = 2 * speed * step * np.maximum(times - turn + 1, 0)
        return Layout(
            self._front(roads), PEDESTRIAN, lateral - back, speed, times >= turn
        )

    def begin(self, world: World) -> _Memory:
        frame = Frame.through_origin(world.lane_of(VUT))
        path = frame.crossing_position(world, CROSSING_LANE)
        lateral = frame.left(world.person_positions(PEDESTRIAN)) - frame.left(
            world.vehicle_positions(VUT)
        )
        if self.turns_after is not None and lateral.max() > self.turns_after:
            raise InputError(
                NETWORK_KEY,
                f"the pedestrian begins {lateral.max():.2f} m to the left of the vehicle",
                "to the right of it, or turns_after = None",
            )

        half_width = world.person_width(PEDESTRIAN) / 2
        clear_point = path + half_width + world.vehicle_length(VUT)
        return _Memory(
            frame,
            path - half_width,
            clear_point,
            lateral,
            np.zeros(len(lateral), bool),
        )

    def observe(
        self, world: World, step: float, memory: _Memory
    ) -> tuple[Scene, _Memory]:
        vehicle_positions = world.vehicle_positions(VUT)
        lateral = memory.frame.left(
            world.person_positions(PEDESTRIAN)
        ) - memory.frame.left(vehicle_positions)
        lateral_speed = (lateral - memory.last_lateral) / step
        if self.turns_after is not None:
            turns_now = ~memory.has_turned & (
                lateral + step * lateral_speed > self.turns_after + TURN_ROUNDING
            )
            if turns_now.any():
                world.turn_back(PEDESTRIAN, np.flatnonzero(turns_now).tolist())
                memory = memory._replace(has_turned=memory.has_turned | turns_now)
        front = memory.frame.along(vehicle_positions)
        moves_away = lateral * lateral_speed > 0
        over = ((np.abs(lateral) > self.lane_width / 2) & moves_away) | (
            front > memory.clear_point
        )
        width = np.array(world.person_width(PEDESTRIAN))
        scene = Scene(
            memory.conflict_point - front,
            lateral,
            lateral_speed,
            over,
            obstacle_width=width,
        )
        return scene, memory._replace(last_lateral=lateral)

    def encounter(self, trace: Trace) -> Encounter:
        """The geometry of the encounter. The separation is the distance from the front bumper to
        the pedestrian's path. TTC is computed along the line of sight from the vehicle's centre.

        TTC = (centre distance - half length) / (v cos(theta) + v_ped sin(theta)) (docs/method.md,
        section 4). theta is the angle between the lane and the line of sight.
        """
        half_length = trace.vehicle_length / 2
        centre_gap = trace.gap + half_length
        centre_distance = np.sqrt(
            centre_gap * centre_gap + trace.lateral * trace.lateral
        )
        approach = trace.speed * centre_gap + np.abs(
            trace.lateral_speed * trace.lateral
        )
        return Encounter(
            separation=trace.gap,
            distance=centre_distance - half_length,
            closing_speed=approach / centre_distance,
            in_conflict=trace.gap > 0,
        )


PARKED_VEHICLE = "parked_ahead"
"""Id of the parked vehicle ahead."""
PARKED_POSITION = 85.0
"""Position of the front of the parked vehicle in the traffic file [m]."""
PARKED_LENGTH = 4.7
"""Length of the parked vehicle in the traffic file [m]."""
VUT_FRONT = 20.0
"""Position of the front of the vehicle under test in the traffic file [m]."""


class _Parked(NamedTuple):
    """The scenario's memory of a run.

    Attributes
    ----------
    frame
        Coordinates along and across the vehicle's lane.
    rear
        Position of the parked vehicle's rear [m], shape (N,).
    length
        Length of the parked vehicle [m].
    """

    frame: Frame
    rear: FloatArray
    length: FloatArray


class LeadVehicleStopped(WorldScenario, Table, frozen=True, kw_only=True):
    """The vehicle starts at rest and drives up to vehicles that are parked in both lanes.

    Parameters
    ----------
    duration
        Length of a run [s].
    distance
        Gap at the start, from the front bumper to the parked vehicle [m]; by default that of the
        traffic file.
    grade
        Rise of the road over its length, negative downhill [%].

    Notes
    -----
    A run ends with a collision or after `duration`, as a vehicle that has stopped may start again.
    """

    network: str = "lead_vehicle_stopped"
    duration: _Positive = 16.0
    distance: (
        Annotated[
            _Positive,
            searched(
                10.0,
                75.0,
                "m",
                "gap at the start, from the front bumper to the parked vehicle",
            ),
        ]
        | None
    ) = None
    grade: Grade = 0.0
    reactive_actors = False
    pre_crash = PreCrash.LEAD_STOPPED
    centre_to_centre = True

    def actors(self, roads: Roads) -> XmlChanges:
        """Place the vehicle at its distance from the parked vehicle, if the study states the
        distance.
        """
        if self.distance is None:
            return {}
        return {"vehicle[@id='vut']": {"departPos": _place(self._front, "distance")}}

    @property
    def _front(self) -> Quantity:
        """Position of the vehicle's front on its lane at the start [m]."""
        if self.distance is None:
            return VUT_FRONT
        return PARKED_POSITION - PARKED_LENGTH - self.distance

    def benign(self) -> Iterable[tuple[str, Scenario]]:
        """A car stands in the next lane."""
        for speed in CITY_SPEEDS:
            yield from CarToCar(speed=speed).benign()

    def layout(self, roads: Roads, step: float, samples: int) -> Layout:
        return Layout(self._front)

    def begin(self, world: World) -> _Parked:
        frame = Frame.through_origin(world.lane_of(VUT))
        length = world.vehicle_length(PARKED_VEHICLE)
        return _Parked(
            frame,
            frame.along(world.vehicle_positions(PARKED_VEHICLE)) - length,
            np.array(length),
        )

    def observe(
        self, world: World, step: float, memory: _Parked
    ) -> tuple[Scene, _Parked]:
        gap = memory.rear - memory.frame.along(world.vehicle_positions(VUT))
        zeros = np.zeros_like(gap)
        never = zeros > 0
        return Scene(
            gap, zeros, zeros, over=never, obstacle_length=memory.length
        ), memory

    def encounter(self, trace: Trace) -> Encounter:
        """The geometry of the encounter. The separation is the distance between the centres of both
        vehicles. TTC = gap / v (docs/method.md, section 4).
        """
        return Encounter(
            separation=trace.gap + (trace.vehicle_length + trace.obstacle_length) / 2,
            distance=trace.gap,
            closing_speed=trace.speed,
            in_conflict=trace.gap > 0,
        )
