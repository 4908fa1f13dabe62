from typing import NamedTuple

import numpy as np

from safevar_sumo.vehicles import SumoType


class State(NamedTuple):
    speed: np.ndarray
    throttle: np.ndarray
    brake: np.ndarray
    gear: np.ndarray


class Cart:
    """Accelerates and brakes in proportion to its pedals; a lighter cart brakes harder."""

    UNITS = {"mass": "kg", "power": "m/s^2", "grip": "m/s^2"}  # noqa: RUF012

    def __init__(self, top_speed=20.0):
        self.top_speed = top_speed

    def prepare(self, characteristics, road_friction, step):
        return {**characteristics, "friction": road_friction, "step": step}

    def sumo_type(self, prepared):
        n = np.ones_like(prepared["mass"])
        return SumoType(prepared["mass"], prepared["power"], prepared["grip"], self.top_speed * n, 0.1 * n)

    def at_rest(self, prepared):
        nothing = np.zeros_like(prepared["mass"])
        return State(nothing, nothing, nothing, nothing)

    def sense(self, prepared, state, seen):
        return seen, state

    def advance(self, prepared, state, command):
        grip = prepared["grip"] * prepared["friction"] * 1000 / prepared["mass"]
        change = (prepared["power"] * command.throttle - grip * command.brake) * prepared["step"]
        speed = np.minimum(np.maximum(state.speed + change, 0.0), self.top_speed)
        return State(speed, command.throttle, command.brake, state.gear)
