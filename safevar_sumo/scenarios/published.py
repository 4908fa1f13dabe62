"""The two scenarios of the published study: a pedestrian walks into the lane; parked vehicles block both lanes."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.errors import InputError
from safevar_sumo.records import Encounter, FloatArray, Trace
from safevar_sumo.scenarios.base import (
    CROSSING_LANE,
    NETWORK_KEY,
    PEDESTRIAN,
    VUT,
    Frame,
    Grade,
    PreCrash,
    Scenario,
    Scene,
    World,
)

Positive = Annotated[float, Meta(gt=0, le=3600)]


class _Memory(NamedTuple):
    """What the scenario remembers of a run.

    Attributes
    ----------
    frame
        Frame of the vehicle's lane.
    conflict_point, clear_point
        Positions of the vehicle's front at which the conflict begins and ends [m].
    last_lateral, has_turned
        The pedestrian's last lateral position [m], shape (N,), and whether the pedestrian has turned round.
    """

    frame: Frame
    conflict_point: float
    clear_point: float
    last_lateral: FloatArray
    has_turned: bool


class PedestrianCrossing(Scenario, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A pedestrian crosses the lane at right angles, turns round and walks back, without reacting to the vehicle.

    Parameters
    ----------
    duration
        Duration of a simulation [s].
    turns_after
        Distance past the middle of the lane at which the pedestrian turns round [m]; None if the pedestrian walks on.
    lane_width
        Width of the lane [m]: the pedestrian leaves the lane at half of this width from the middle.
    grade
        Rise of the road over its length, negative downhill [%].

    Notes
    -----
    Positions, speed and the turn are taken from the published study's package.
    """

    network: str = "pedestrian_crossing"
    duration: Positive = 9.5
    turns_after: float | None = 0.7
    lane_width: Positive = 3.5
    grade: Grade = 0.0
    reactive_actors = False
    pre_crash = PreCrash.PEDESTRIAN_AFTER_MANOEUVRE

    def begin(self, world: World) -> _Memory:
        frame = Frame.through_origin(world.lane_of(VUT))
        path = frame.crossing_position(world, CROSSING_LANE)
        lateral = frame.left(world.person_positions(PEDESTRIAN)) - frame.left(world.vehicle_positions(VUT))
        if self.turns_after is not None and lateral[0] > self.turns_after:
            raise InputError(
                NETWORK_KEY,
                f"the pedestrian begins {lateral[0]:.2f} m to the left of the vehicle",
                "to the right of it, or turns_after = None",
            )
        half_width = world.person_width(PEDESTRIAN) / 2
        clear_point = path + half_width + world.vehicle_length(VUT)
        return _Memory(frame, path - half_width, clear_point, lateral, has_turned=False)

    def observe(self, world: World, step: float, memory: _Memory) -> tuple[Scene, _Memory]:
        vehicle_positions = world.vehicle_positions(VUT)
        lateral = memory.frame.left(world.person_positions(PEDESTRIAN)) - memory.frame.left(vehicle_positions)
        lateral_speed = (lateral - memory.last_lateral) / step
        # The pedestrian does the same in all copies, so the first stands for all.
        turns_now = self.turns_after is not None and lateral[0] + step * lateral_speed[0] > self.turns_after
        if turns_now and not memory.has_turned:
            world.turn_back(PEDESTRIAN)
            memory = memory._replace(has_turned=True)
        front = memory.frame.along(vehicle_positions)
        moves_away = lateral * lateral_speed > 0
        over = ((np.abs(lateral) > self.lane_width / 2) & moves_away) | (front > memory.clear_point)
        return Scene(memory.conflict_point - front, lateral, lateral_speed, over), memory._replace(last_lateral=lateral)

    def encounter(self, trace: Trace) -> Encounter:
        """Distance from the front bumper to the pedestrian's path; TTC along the line of sight from the vehicle's
        centre.

        TTC = (centre distance - half length) / (v cos(theta) + v_ped sin(theta)) (docs/method.md, section 4);
        theta is the angle between the lane and the line of sight.
        """
        half_length = trace.vehicle_length / 2
        ahead = trace.gap + half_length
        centre_distance = np.sqrt(ahead * ahead + trace.lateral * trace.lateral)
        approach = trace.speed * ahead + np.abs(trace.lateral_speed * trace.lateral)
        return Encounter(
            separation=trace.gap,
            distance=centre_distance - half_length,
            closing_speed=approach / centre_distance,
            in_conflict=trace.gap > 0,
        )


PARKED_VEHICLE = "parked_ahead"


class LeadVehicleStopped(Scenario, Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The vehicle starts at rest and drives up to vehicles that are parked in both lanes.

    Parameters
    ----------
    duration
        Length of a run [s].
    grade
        Rise of the road over its length, negative downhill [%].

    Notes
    -----
    A run ends with a collision or after `duration`, as a vehicle that has stopped may start again.
    """

    network: str = "lead_vehicle_stopped"
    duration: Annotated[float, Meta(gt=0, le=3600)] = 16.0
    grade: Grade = 0.0
    reactive_actors = False
    pre_crash = PreCrash.LEAD_STOPPED
    centre_to_centre = True

    def begin(self, world: World) -> tuple[Frame, FloatArray]:
        frame = Frame.through_origin(world.lane_of(VUT))
        return frame, frame.along(world.vehicle_positions(PARKED_VEHICLE)) - world.vehicle_length(PARKED_VEHICLE)

    def observe(
        self, world: World, step: float, memory: tuple[Frame, FloatArray]
    ) -> tuple[Scene, tuple[Frame, FloatArray]]:
        frame, parked_rear = memory
        gap = parked_rear - frame.along(world.vehicle_positions(VUT))
        zeros = np.zeros_like(gap)
        return Scene(gap, zeros, zeros, over=zeros > 0), memory  # never over

    def encounter(self, trace: Trace) -> Encounter:
        """Safety degree: distance between the centres of two vehicles of equal length; TTC = gap / v (docs/method.md,
        section 4).
        """
        return Encounter(
            separation=trace.gap + trace.vehicle_length,
            distance=trace.gap,
            closing_speed=trace.speed,
            in_conflict=trace.gap > 0,
        )
