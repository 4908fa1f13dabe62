"""Both lanes ahead are blocked by parked vehicles."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from safevar_sumo.records import Encounter, FloatArray, Trace
from safevar_sumo.scenarios.base import VUT, Grade, PreCrash, Scenario, Scene, World
from safevar_sumo.scenarios.frame import Frame

PARKED_VEHICLE = "parked_ahead"


class _Memory(NamedTuple):
    """The frame of the lane, the parked vehicle's rear bumper along the lane [m], and zeros; arrays of shape (N,)."""

    frame: Frame
    parked_rear: FloatArray
    zeros: FloatArray


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

    def begin(self, world: World) -> _Memory:
        frame = Frame.through_origin(world.lane_of(VUT))
        rear = frame.along(world.vehicle_positions(PARKED_VEHICLE)) - world.vehicle_length(PARKED_VEHICLE)
        return _Memory(frame, rear, np.zeros_like(rear))

    def observe(self, world: World, step: float, memory: _Memory) -> tuple[Scene, _Memory]:
        gap = memory.parked_rear - memory.frame.along(world.vehicle_positions(VUT))
        return Scene(gap, memory.zeros, memory.zeros, memory.zeros > 0), memory  # never over

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
