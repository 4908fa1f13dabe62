import numpy as np

from safevar_sumo.records import Encounter
from safevar_sumo.scenarios import Scene


class Wall:
    """A wall stands across the road where the parked vehicles begin."""

    network = "lead_vehicle_stopped"

    def __init__(self, duration=8.0):
        self.duration = duration

    def begin(self, world):
        return world.vehicle_positions("parked_ahead")[:, 0] - world.vehicle_length("parked_ahead")

    def observe(self, world, step, memory):
        gap = memory - world.vehicle_positions("vut")[:, 0]
        nothing = np.zeros_like(gap)
        return Scene(gap, nothing, nothing, gap < -100), memory

    def encounter(self, trace):
        return Encounter(separation=trace.gap, distance=trace.gap, closing_speed=trace.speed, in_conflict=trace.gap > 0)
