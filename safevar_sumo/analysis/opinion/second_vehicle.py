"""The second vehicle model in place of ours: in the same simulation it takes a driving system's commands and returns speeds.

Its sensors are the study's own; its engine torque is that of our original vehicle, which is simulated beside it with the same pedal at
the same speed. Brakes, tyres, axles and body are the second model's.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from safevar_sumo.analysis.opinion.mapping import Declared, Represented
from safevar_sumo.analysis.opinion.multi_body import STEP, WHEELS, MultiBody, advance, at_speed
from safevar_sumo.records import BoolArray, Command, FloatArray, Observation
from safevar_sumo.study import Study, load_study
from safevar_sumo.vehicles import LEVEL, CharacteristicSet, Sensors, Slope, SumoType, Vehicle
from safevar_sumo.vehicles.base import Characteristics
from safevar_sumo.vehicles.sensors import delayed, history, remembered

CREEPS = 0.01
"""Speed above which the original vehicle's wheel speed is scaled with its speed [m/s]."""


class _Prepared(NamedTuple):
    """Constants of a run: the study's vehicle, for its sensors; the original one, for its engine; and the second model's parameters.

    `engine_mass` is the mass that the original's engine moves, turning wheels included [kg], `engine_radius` that of its wheels [m].
    """

    own: Any
    original: Any
    represented: Represented
    engine_mass: FloatArray
    engine_radius: FloatArray
    slope: Slope
    step: float


class SecondState(NamedTuple):
    """State of N vehicles: speed [m/s], actuated pedals, gear, and the states of the vehicles behind it."""

    speed: FloatArray
    throttle: FloatArray
    brake: FloatArray
    gear: FloatArray
    own: Any
    original: Any
    body: MultiBody
    brake_commands: FloatArray


class SecondVehicle:
    """A vehicle of the second model for every setting of a study; the contract is `safevar_sumo.vehicles.Vehicle`.

    Parameters
    ----------
    own
        The study's vehicle.
    declared
        The vehicle's representation in the second model.
    study
        The study.
    """

    def __init__(self, own: Vehicle, declared: Declared, study: Study) -> None:
        self._own, self._declared = own, declared
        self.UNITS = own.UNITS
        shipped = load_study(declared.table.study).vehicle.characteristics
        rows = {**shipped, **{name: row for name, row in study.vehicle.characteristics.items() if name not in declared.foreign}}
        self._original = {one.name: one.original for one in CharacteristicSet.of({name: rows[name] for name in declared.vehicle.UNITS})}

    def prepare(self, characteristics: Characteristics, road_friction: Any, step: float, slope: Slope = LEVEL,
                wet: bool | BoolArray = False) -> _Prepared:
        ones = np.ones_like(next(iter(characteristics.values())))
        original = {name: value * ones for name, value in self._original.items()}
        surface = (road_friction, slope, wet)
        optional = () if slope is LEVEL and not np.any(wet) else (slope, wet) if np.any(wet) else (slope,)
        twin, represent = self._declared.vehicle, self._declared.table.represent
        engine = represent(twin, original, self._original, surface).plant
        return _Prepared(
            own=self._own.prepare(characteristics, road_friction, step, *optional),
            original=twin.prepare(original, road_friction, step, slope, wet),
            represented=represent(twin, {**original, **{name: characteristics[name] for name in original if name in characteristics}},
                                  self._original, surface),
            engine_mass=engine.mass + WHEELS * engine.wheel_inertia / engine.radius**2, engine_radius=engine.radius, slope=slope, step=step)

    def sumo_type(self, prepared: _Prepared) -> SumoType:
        return self._own.sumo_type(prepared.own)

    def at_rest(self, prepared: _Prepared) -> SecondState:
        standstill = np.zeros_like(prepared.engine_mass)
        return self._state(prepared, standstill, self._own.at_rest(prepared.own), self._declared.vehicle.at_rest(prepared.original))

    def at_speed(self, prepared: _Prepared, speed: FloatArray) -> SecondState:
        """The state with the pedals that hold the original vehicle's speed."""
        return self._state(prepared, speed, self._own.at_speed(prepared.own, speed),
                           self._declared.vehicle.at_speed(prepared.original, speed))

    def _state(self, p: _Prepared, speed: FloatArray, own: Any, original: Any) -> SecondState:
        commands = history(float(np.max(p.represented.brake_delay)), p.step, original.brake)
        return SecondState(speed, original.throttle, original.brake, original.gear, own, original, at_speed(p.represented.plant, speed),
                           commands)

    def sensors(self, prepared: _Prepared) -> Sensors | None:
        sensors = getattr(self._own, "sensors", None)
        return None if sensors is None else sensors(prepared.own)

    def sense(self, prepared: _Prepared, state: SecondState, seen: Observation) -> tuple[Observation, SecondState]:
        """Sense through the study's own sensors."""
        sensed, own = self._own.sense(prepared.own, state.own, seen)
        return sensed, state._replace(own=own)

    def hold_gear(self, prepared: _Prepared, state: SecondState, holds: BoolArray) -> SecondState:
        hold = getattr(self._declared.vehicle, "hold_gear", None)
        return state if hold is None else state._replace(original=hold(prepared.original, state.original, holds))

    def advance(self, prepared: _Prepared, state: SecondState, command: Command) -> SecondState:
        p, r = prepared, prepared.represented
        original, driving = self._engine(p, state, command.throttle)
        commands = remembered(state.brake_commands, command.brake)
        demand, body, brake = delayed(commands, r.brake_delay, p.step), state.body, state.brake
        steps = math.ceil(p.step / STEP)
        step = p.step / steps
        follows = step / (step + r.brake_lag)
        for _ in range(steps):
            brake = brake + np.minimum(np.maximum((demand - brake) * follows, -r.brake_fall * step), r.brake_rise * step)
            body = advance(r.plant, body, brake, driving, step)
        return SecondState(body.speed, original.throttle, brake, original.gear, state.own, original, body, commands)

    def _engine(self, p: _Prepared, state: SecondState, throttle: FloatArray) -> tuple[Any, FloatArray]:
        """The original vehicle one step later, and the torque of its engine and drags on all wheels, at the speed of these [N m]."""
        r, before = p.represented, state.original
        speed = state.speed * p.engine_radius / r.plant.radius
        before = before._replace(speed=speed) if not hasattr(before, "wheel_speed") else before._replace(
            speed=speed, wheel_speed=np.where(before.speed > CREEPS, before.wheel_speed * speed / np.maximum(before.speed, CREEPS),
                                              before.wheel_speed))
        after = self._declared.vehicle.advance(p.original, before, Command(throttle, np.zeros_like(throttle)))
        torque = p.engine_mass * ((after.speed - speed) / p.step + p.slope.back) * p.engine_radius
        torque = np.where(torque > 0, torque * r.drive, torque)
        resists = r.plant.radius * (r.drag + r.air_drag * state.speed) * state.speed + r.wheel_damping * state.speed / r.plant.radius
        return after, torque - resists
