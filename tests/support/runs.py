"""Drive vehicles open loop: pedals over time give states over time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.records import Command, FloatArray
from safevar_sumo.vehicles import slope_of
from tests.support.made_up import system_of, uniform

STEP = 0.05
STUDY_OF = {"carla": "sun", "lgsvl": "lgsvl", "sumo": "native", "worn": "wear"}
SYSTEMS = {model: system_of(study) for model, study in STUDY_OF.items()}
Pedals = Callable[[float], tuple[Any, Any]]


class Drive(NamedTuple):
    """States of N vehicles at T times 0, STEP, 2 STEP, ... [s]; speeds [m/s] and travelled
    distances [m] have shape (T, N).
    """

    prepared: Any
    states: list[Any]

    @property
    def speed(self) -> FloatArray:
        return np.stack([state.speed for state in self.states])

    @property
    def distance(self) -> FloatArray:
        speed = self.speed
        return np.concatenate(
            [
                np.zeros((1, speed.shape[1])),
                np.cumsum((speed[1:] + speed[:-1]) / 2 * STEP, axis=0),
            ]
        )

    def at(self, time: float) -> int:
        return round(time / STEP)


def prepare(
    model: str,
    settings: FloatArray,
    road: float = 1.0,
    grade: float = 0.0,
    water: float = 0.0,
) -> Any:
    """The constants of vehicles with these settings, shape (N, n)."""
    values = SYSTEMS[model].characteristics.columns(settings)
    return SYSTEMS[model].vehicle.prepare(
        values, road, STEP, slope_of(np.full(len(settings), grade)), water
    )


def drive(
    model: str,
    settings: FloatArray,
    pedals: Pedals,
    duration: float,
    road: float = 1.0,
    rolling: float = 0.0,
    grade: float = 0.0,
    water: float = 0.0,
) -> Drive:
    """Drive settings, shape (N, n); pedals(t) -> (throttle, brake), for all vehicles or one each.
    `rolling` is the initial speed [m/s].
    """
    vehicle = SYSTEMS[model].vehicle
    prepared = prepare(model, settings, road, grade, water)
    states = [_rolling(vehicle.at_rest(prepared), prepared, rolling)]
    for k in range(round(duration / STEP)):
        throttle, brake = pedals(round(k * STEP, 9))
        command = Command(
            np.zeros(len(settings)) + throttle, np.zeros(len(settings)) + brake
        )
        states.append(vehicle.advance(prepared, states[-1], command))
    return Drive(prepared, states)


def _rolling(state: Any, prepared: Any, speed: float) -> Any:
    """The state of the vehicle at rest, changed to rolling without slip in the same gear."""
    wheels = (
        {"wheel_speed": speed / getattr(prepared, "car", prepared).radius}
        if hasattr(state, "wheel_speed")
        else {}
    )
    return state._replace(speed=state.speed + speed, **wheels)


def original(model: str, n: int = 1) -> FloatArray:
    return np.repeat(SYSTEMS[model].characteristics.original_settings, n, axis=0)


def ends(model: str, name: str) -> FloatArray:
    """Five settings of the original vehicle with one characteristic spread over its domain."""
    characteristics = SYSTEMS[model].characteristics
    settings = original(model, 5)
    column = characteristics.names.index(name)
    settings[:, column] = np.linspace(
        characteristics.lower[column], characteristics.upper[column], 5
    )
    return settings


def drawn(model: str, n: int, seed: int) -> FloatArray:
    return uniform(SYSTEMS[model].characteristics, n, seed)


def full_throttle(time: float) -> tuple[float, float]:
    return 1.0, 0.0


def half_throttle(time: float) -> tuple[float, float]:
    return 0.5, 0.0


def coasting_after(start: float) -> Pedals:
    return lambda time: (1.0, 0.0) if time < start else (0.0, 0.0)


def braking_after(start: float) -> Pedals:
    return lambda time: (1.0, 0.0) if time < start else (0.0, 1.0)
