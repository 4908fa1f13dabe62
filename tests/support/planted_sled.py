"""A sled whose driving system brakes at a gap: its repairs are formulas."""

from __future__ import annotations

SPEED, MARGIN, GAP_TODAY = 20.0, 0.3, 12.0
"""The speed [m/s], the clearance to keep and today's gap [m]. This gap lets even a new sled
collide, so that the price of every promise, at least 10 m, is far longer than the 0.2 m of a step.
"""
MODELS = """
import numpy as np
from typing import NamedTuple
from safevar_sumo.records import Command
from safevar_sumo.vehicles import SumoType


class State(NamedTuple):
    speed: np.ndarray
    throttle: np.ndarray
    brake: np.ndarray
    gear: np.ndarray


class Sled:
    UNITS = {"grip": "m/s^2", "paint": "-"}

    def __init__(self, wear=1.0):
        self.wear = wear

    def prepare(self, characteristics, road_friction, step):
        return {"grip": self.wear * characteristics["grip"], "step": step}

    def sumo_type(self, prepared):
        n = np.ones_like(prepared["grip"])
        return SumoType(1000 * n, 3 * n, prepared["grip"], 40 * n, 0.1 * n)

    def at_rest(self, prepared):
        nothing = np.zeros_like(prepared["grip"])
        return State(nothing, nothing, nothing, nothing)

    def at_speed(self, prepared, speed):
        nothing = np.zeros_like(prepared["grip"])
        return State(speed, nothing, nothing, nothing)

    def sense(self, prepared, state, seen):
        return seen, state

    def advance(self, prepared, state, command):
        acceleration = 3 * command.throttle - prepared["grip"] * command.brake
        speed = np.maximum(state.speed + acceleration * prepared["step"], 0.0)
        return State(speed, command.throttle, command.brake, state.gear)


class Brakes:
    def __init__(self, gap=12.0, always=0.0, colour=1.0):
        self.gap, self.always, self.colour = gap, always, colour

    def start(self, n, nominal, step):
        return np.zeros(n, dtype=bool)

    def drive(self, seen, braking):
        is_near = (seen.gap <= self.gap) & (np.abs(seen.lateral) < 1.75)
        braking = braking | is_near | (self.always + 0 * seen.speed >= 0.5)
        return Command(np.zeros(len(seen.speed)), braking.astype(float)), braking
"""
STUDY = """
name = "planted"
title = "A sled that brakes at a gap"
weather = "clear"
step_length = 0.01

[scenario]
model = "car_to_car"
parameters = { test = "CCRs", speed = 72.0, headway = 2.5, time_after = 3.5 }

[vehicle]
model = "models:Sled"
parameters = { wear = 1.0 }

[vehicle.characteristics]
grip = { unit = "m/s^2", original = 8, lower = 3.6, upper = 9 }
paint = { unit = "-", original = 1, lower = 0.5, upper = 2 }

[ads]
model = "models:Brakes"
parameters = { gap = 12.0, always = 0.0, colour = 1.0 }

[metrics]
ttc_threshold = 1.5

[search]
algorithms = ["rs"]
population = 20
evaluations = 40
runs = 1
seed = 1

[repair]
gap = { lower = 4.0, upper = 64.0, unit = "m", meaning = "gap at which it brakes" }
always = { lower = 0.0, upper = 1.0, unit = "-", meaning = "brakes without reason from 0.5 on" }
colour = { lower = 0.0, upper = 2.0, unit = "-", meaning = "colour of its box" }

[repair.promise]
grip = { at_least = 5 }

[spread]
"vehicle.parameters.wear" = [1.0, 0.9, 1.1]
"""
