"""A stop: the vehicle brakes fully from a speed, on a road without anybody else."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from msgspec import Meta

from safevar_sumo.records import STANDSTILL, Encounter, Trace
from safevar_sumo.scenarios.base import VUT, Grade, Scene, WorldScenario, XmlChanges
from safevar_sumo.scenarios.roads import Frame, Roads, World
from safevar_sumo.scenarios.tracks import KMH, Speed
from safevar_sumo.study import Table


class Stop(WorldScenario, Table, frozen=True, kw_only=True):
    """The vehicle brakes fully from a speed until it stands; the driving system is not asked.

    The metric `stopping_distance` says how far it went from the first brake force on.

    Parameters
    ----------
    speed
        Speed of the vehicle under test at the start [km/h].
    duration
        Length of a run in which the vehicle does not stop [s].
    grade
        Rise of the road over its length, negative downhill [%].
    """

    speed: Speed = 80.0
    duration: Annotated[float, Meta(gt=0, le=3600)] = 120.0
    grade: Grade = 0.0
    network: str = "along"
    reactive_actors = False
    brakes_fully = True

    @property
    def test_speed(self) -> float:
        """Speed from which the vehicle brakes [m/s]."""
        return self.speed * KMH

    def actors(self, roads: Roads) -> XmlChanges:
        """Set the departure speed of the vehicle under test, the only vehicle."""
        return {"vehicle[@id='vut']": {"departSpeed": repr(self.test_speed)}}

    def begin(self, world: World) -> Frame:
        return Frame.of(world.lane_of(VUT))

    def observe(self, world: World, step: float, memory: Frame) -> tuple[Scene, Frame]:
        """The scene without an obstacle: the gap is infinite. The encounter is over when the
        vehicle stands.
        """
        speeds = world.speeds()
        zeros = np.zeros_like(speeds)
        return Scene(zeros + np.inf, zeros, zeros, speeds <= STANDSTILL), memory

    def encounter(self, trace: Trace) -> Encounter:
        """The geometry without an encounter: metrics of encounters are undefined."""
        return Encounter(trace.gap, trace.gap, trace.speed, np.zeros_like(trace.active))
