"""A car before a wall, in a simulator whose stop is a formula."""

from __future__ import annotations

MODELS = """
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from safevar_sumo.study import searched

CLOSED, OPENED = [], []


@dataclass(frozen=True)
class Wall:
    '''Brakes in front of a wall after half a second.'''

    UNITS = {"decel": "m/s^2", "delay": "s"}
    OPTIONAL = ("delay",)
    LIBRARIES = ("numpy",)
    version = "1.2"
    speed: Annotated[float, searched(5.0, 30.0, "m/s", "speed at the start")] = 15.0
    gap: Annotated[float, searched(20.0, 80.0, "m", "distance of the wall")] = 40.0

    def simulate(self, setting):
        if not hasattr(self, "engine"):
            object.__setattr__(self, "engine", OPENED.append(1))
        time, speed, x, rows = 0.0, self.speed, 0.0, []
        while True:
            brakes = time >= 0.5 + setting["delay"]
            rows.append((time, speed, max(self.gap - x, 0.0), self.gap - x, 0.0, brakes, x))
            if x >= self.gap or speed <= 0:
                break
            speed = max(speed - brakes * setting["decel"] * 0.05, 0.0)
            x, time = x + speed * 0.05, time + 0.05
        names = ("time", "speed", "separation", "gap", "obstacle_speed", "brake", "position")
        trace = dict(zip(names, np.array(rows, dtype=float).T))
        ends = {"outcome": "collision", "impact_speed": speed} if x >= self.gap else {}
        return {**trace, "outcome": "stopped", **ends}

    def close(self):
        CLOSED.append(1)


class Rig:
    UNITS = {"decel": "m/s^2", "delay": "s"}
    OPTIONAL = ("delay",)

    def simulate(self, setting):
        rest = 40 - 15 * (0.5 + setting["delay"]) - 15**2 / 2 / setting["decel"]
        if rest < 0:
            impact = (-2 * setting["decel"] * rest) ** 0.5
            return {"outcome": "collision", "safety_degree": -impact}
        return {"outcome": "stopped", "safety_degree": rest, "ave_dece": setting["decel"]}


class Listed(msgspec.Struct, frozen=True, kw_only=True):
    UNITS = Wall.UNITS
    OPTIONAL = ("delay",)
    speed: Annotated[float, searched(5.0, 30.0, "m/s", "speed at the start")] = 15.0
    gap: float = 40.0

    def simulate(self, setting):
        result = Wall(self.speed, self.gap).simulate(setting)
        return {name: getattr(value, "tolist", lambda: value)() for name, value in result.items()}


class Wrong(Wall):
    def simulate(self, setting):
        result = Wall.simulate(self, setting)
        change = CHANGE
        return change(result)
"""
STUDY = """
name = "wall"
title = "Brakes in front of a wall"

[scenario]
model = "models:Wall"

[vehicle.characteristics]
decel = { unit = "m/s^2", original = 8, lower = 3, upper = 9 }
delay = { unit = "s", original = 0, lower = 0, upper = 1 }

[metrics]
ttc_threshold = 1.5

[search]
algorithms = ["nsga2", "rs"]
population = 10
evaluations = 40
runs = 2
seed = 1
"""
